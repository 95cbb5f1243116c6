"""Shards: the partition of a generation's rows among search workers.

The slot of a chunk decides: slot s belongs to shard s % n. Compaction stays inside a slot, so that
no photo ever moves to another shard, and a shard only needs to know its own index and n.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

_PREFIX = "shard "


@dataclass(frozen=True, slots=True, order=True)
class Shard:
    """Shard `index` (from 0) of `of` shards, written `1/3`."""

    index: int
    of: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Parse `index/of`; ValueError for any other text."""
        match = re.fullmatch(r"\s*(\d{1,4})/(\d{1,4})\s*", text)
        if not match or int(match[1]) >= int(match[2]):
            raise ValueError(
                f"{text!r} is not a shard: use 0/1 for a single one, or 0/3, 1/3 and 2/3 for three"
            )
        return cls(int(match[1]), int(match[2]))

    def __str__(self) -> str:
        return f"{self.index}/{self.of}"

    def owns(self, slot: int) -> bool:
        """Return whether the chunks of this slot belong to the shard."""
        return slot % self.of == self.index

    @property
    def name(self) -> str:
        """The shard's name in the `missing` of a search response: `shard 1/3`."""
        return f"{_PREFIX}{self}"


SINGLE_SHARD = Shard(0, 1)


def is_shard_name(missing: str) -> bool:
    """Return whether an entry of a search response's `missing` is a shard, not an object."""
    return missing.startswith(_PREFIX)
