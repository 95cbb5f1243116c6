"""Rebuilding the catalog from its object store: journal, chunk manifests and originals.

`take_in` brings everything that the store holds and the catalog does not know into the catalog. On
an empty catalog that is a rebuild; on one that is older than its store it is a repair.
"""
