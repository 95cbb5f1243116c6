"""Search service: exact cosine top-k over the chunks of its shard, held in memory or mapped.

`catalog_sync` builds immutable snapshots, `executor` runs a query on one, and `worker` implements
`SearchBackend`. `service` serves it over HTTP.
"""
