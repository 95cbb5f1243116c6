"""Batch imports: `listing` lists the photos of a prefix, `worker` imports them.

The tables of batches are in `shared.catalog.batch_items`.
"""
