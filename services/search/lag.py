"""How far behind a worker's snapshots are, told without asking the catalog.

A worker that is stuck in loading, or that can't reach the catalog, has to notice it by itself:
what counts is when a snapshot was last known to be level with its map.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from uuid import UUID

from services.search.follow import Wanted
from shared.catalog.generations import GenerationState
from shared.search_protocol import Lag


class Lags:
    """What the following threads note and the probes read."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._wanted: dict[UUID, Wanted] = {}
        self._level_at: dict[UUID, float] = {}
        self._looked_at: float | None = None

    def looked(self, wanted: Mapping[UUID, Wanted], at: float) -> None:
        """At `at` (monotonic) these were the generations and versions to follow."""
        with self._lock:
            self._looked_at = at
            self._wanted = dict(wanted)
            # One that is new counts from now on; one that is gone counts no more.
            self._level_at = {id_: self._level_at.get(id_, at) for id_ in wanted}

    def level(self, generation_id: UUID, at: float) -> None:
        """The snapshot has what the catalog had at `at`."""
        with self._lock:
            if generation_id in self._level_at:
                self._level_at[generation_id] = max(at, self._level_at[generation_id])

    def has_looked(self) -> bool:
        """Whether the catalog was read at all."""
        return self._looked_at is not None

    def now(self, loaded: Mapping[UUID, int]) -> dict[UUID, Lag]:
        """The lag of every generation to follow; `loaded` are the snapshots' versions."""
        with self._lock:
            now = time.monotonic()
            return {
                id_: Lag(
                    versions=max(0, wanted.version - loaded.get(id_, 0)),
                    seconds=now - self._level_at[id_],
                    answers=wanted.state == GenerationState.ACTIVE,
                )
                for id_, wanted in self._wanted.items()
            }
