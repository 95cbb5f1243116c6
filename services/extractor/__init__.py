"""Extractor service: describes photos and stores their descriptors in chunks; one process per GPU.

`worker` drains the job table: claim, prepare (read, decode), describe (forward pass, aggregation),
publish (chunk, then one transaction). Model changes run in steps between batches (`model_changes`).
"""
