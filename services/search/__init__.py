"""The search worker: follows the catalog, holds chunks in memory, answers exact cosine top-k.

`follow` keeps an immutable `snapshot` up to date; `scan` is the arithmetic; `worker` is the port.
"""
