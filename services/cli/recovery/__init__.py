"""The way back after a loss: a catalog is rebuilt from its object store.

A backup is a consistent copy of the object store that ends with a snapshot of the catalog, and a
restore is a copy and a rebuild.
"""
