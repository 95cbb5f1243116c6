"""The extractor: photo bytes -> descriptor rows -> a chunk. One process per GPU.

`worker` drains the job table: claim -> `prepare` (read, decode) -> `describe` (forward pass,
aggregate) -> `publish` (chunk, then one transaction). Model changes run in slices between batches
(`model_change`).
"""
