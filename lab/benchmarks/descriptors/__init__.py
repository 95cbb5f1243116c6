"""Speed and quality of descriptors: extraction, precision, reranking, training."""
