"""Shards: which part of every generation a search worker holds.

A chunk's slot decides: slot s belongs to shard s % n. Merging stays inside a slot, so no photo
ever moves to another shard, and a shard needs to know nothing but its own number and n.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

_PREFIX = "shard "


@dataclass(frozen=True, slots=True, order=True)
class Shard:
    """Shard `index` (from 0) of `of`; written `1/3`."""

    index: int
    of: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """The shard that is written `index/of`; ValueError for what is none."""
        match = re.fullmatch(r"\s*(\d{1,4})/(\d{1,4})\s*", text)
        if not match or int(match[1]) >= int(match[2]):
            raise ValueError(
                f"{text!r} is no shard: write 0/1 for everything, or 0/3, 1/3 and 2/3 for three"
            )
        return cls(int(match[1]), int(match[2]))

    def __str__(self) -> str:
        return f"{self.index}/{self.of}"

    def owns(self, slot: int) -> bool:
        """Whether the chunks of this slot are its."""
        return slot % self.of == self.index

    @property
    def name(self) -> str:
        """What an answer calls the shard when it is missing: `shard 1/3`."""
        return f"{_PREFIX}{self}"


SINGLE_SHARD = Shard(0, 1)


def is_shard_name(missing: str) -> bool:
    """Whether this part of an answer's `missing` is a whole shard, not one object."""
    return missing.startswith(_PREFIX)
