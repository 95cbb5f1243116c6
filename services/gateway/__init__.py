"""The HTTP API: a stateless FastAPI application without torch, vectors or local files.

`uploads` parses request bodies as streams, `shared.ingest` validates and
stores photos, `similarity` queries the search tier. `routes` has one module per resource.
"""
