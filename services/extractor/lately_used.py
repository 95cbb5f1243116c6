"""A few values that are costly to make: those used last."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, ValuesView
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class LruCache(Generic[Key, Value]):
    """At most `most` values, which is 1 or more; the one that was used least lately goes first.
    Not thread-safe.
    """

    def __init__(self, max_size: int) -> None:
        self._most = max_size
        self._values: OrderedDict[Key, Value] = OrderedDict()

    def get(self, key: Key, make: Callable[[], Value]) -> Value:
        """The key's value, made if it is not there; raises what `make` raises, and keeps nothing
        then."""
        if key not in self._values:
            self._values[key] = make()
        self._values.move_to_end(key)
        while len(self._values) > self._most:
            self._values.popitem(last=False)
        return self._values[key]

    def values(self) -> ValuesView[Value]:
        """Those that are there; asking for them is no use of them."""
        return self._values.values()
