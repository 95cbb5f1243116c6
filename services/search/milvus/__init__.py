"""Search on Milvus, for maps larger than one machine."""
