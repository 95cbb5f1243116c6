"""Rebuilds the catalog from its object store: from journal, chunk manifests and originals.

`recover_catalog` inserts everything that the store has and the catalog lacks. On an empty catalog
this is a rebuild, on a catalog that is older than its store a repair.
"""
