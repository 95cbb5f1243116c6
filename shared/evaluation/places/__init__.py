"""The place of a query: evidence, levels, and a model of their probabilities."""
