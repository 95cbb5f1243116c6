"""Similarity searches: parameters, execution, the place estimate, and reranking."""
