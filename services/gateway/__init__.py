"""The HTTP API: a stateless FastAPI application without torch, vectors or local files.

`multipart_upload` and `batch_upload` parse request bodies as streams, `shared.ingest` validates and
stores photos, `similarity_search` queries the search tier. `routes` has one module per resource.
"""
