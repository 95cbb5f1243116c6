"""How far behind a worker's snapshots are, told without asking the catalog.

A worker that is stuck in loading, or that can't reach the catalog, has to notice it by itself:
what counts is when a snapshot was last known to be level with its map.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from uuid import UUID

from services.search.follow import GenerationVersion
from shared.catalog.generations import GenerationState
from shared.search_protocol import ReplicationLag


class ReplicationLagTracker:
    """What the following threads note and the probes read."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._current: dict[UUID, GenerationVersion] = {}
        self._synced_at: dict[UUID, float] = {}
        self._catalog_read_at: float | None = None

    def record_catalog_read(self, wanted: Mapping[UUID, GenerationVersion], at: float) -> None:
        """At `at` (monotonic) these were the generations and versions to follow."""
        with self._lock:
            self._catalog_read_at = at
            self._current = dict(wanted)
            # One that is new counts from now on; one that is gone counts no more.
            self._synced_at = {id_: self._synced_at.get(id_, at) for id_ in wanted}

    def record_synced(self, generation_id: UUID, at: float) -> None:
        """The snapshot has what the catalog had at `at`."""
        with self._lock:
            if generation_id in self._synced_at:
                self._synced_at[generation_id] = max(at, self._synced_at[generation_id])

    def has_read_catalog(self) -> bool:
        """Whether the catalog was read at all."""
        return self._catalog_read_at is not None

    def current_lags(self, loaded: Mapping[UUID, int]) -> dict[UUID, ReplicationLag]:
        """The lag of every generation to follow; `loaded` are the snapshots' versions."""
        with self._lock:
            now = time.monotonic()
            return {
                id_: ReplicationLag(
                    versions=max(0, wanted.version - loaded.get(id_, 0)),
                    seconds=now - self._synced_at[id_],
                    answers=wanted.state == GenerationState.ACTIVE,
                )
                for id_, wanted in self._current.items()
            }
