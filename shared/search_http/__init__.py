"""The search tier as its clients see it: one port in front of many workers.

`workers` keeps who serves which shard; `port` asks one worker of each shard at once; `merge` makes
one answer of theirs. One worker that holds everything is the case of a single shard.
"""

from shared.search_http.port import HttpSearchClient

__all__ = ["HttpSearchClient"]
