"""Batches: `list_archive_photos` says what is in one, `bring_in` takes one photo, `worker` does
them all.

A module of the database's side is `shared.catalog.batch_items`.
"""
