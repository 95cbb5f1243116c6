"""Search service: cosine top-k over the rows of chunks, held in memory, mapped, or in Milvus.

`catalog_sync` builds immutable snapshots, `executor` runs a query on one, and `worker` implements
`SearchBackend`. `service` serves it over HTTP.
"""
