"""Int8 codes of a whole generation, made in the background once someone asks for them.

At 98,304 dimensions they are 98 KB a row and take a millisecond each to make: most installations
never need them (`Mode.DETERMINISTIC`), so that they are not made before.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID

from services.search.chunk_loader import generation_loader
from services.search.snapshot import Snapshot
from shared.errors import Unavailable
from shared.storage import ObjectStore

if TYPE_CHECKING:
    from shared.codes.int8_codes import Int8Codes

log = logging.getLogger(__name__)

LOG_INTERVAL_SECONDS = 10.0
MAX_RETRY_SECONDS = 300.0


@dataclass(slots=True)
class _Int8Build:
    """The codes of one generation on their way."""

    rows: int
    done: int = 0
    started: float = field(default_factory=time.monotonic)
    ended: threading.Event = field(default_factory=threading.Event)
    error: OSError | None = None

    def seconds_left(self) -> float:
        """As the rows that are done tell; a second at least."""
        elapsed = time.monotonic() - self.started
        left = elapsed * (self.rows - self.done) / max(1, self.done)
        return min(max(left, 1.0), MAX_RETRY_SECONDS)


class Int8CodeBuilder:
    """Makes the codes of one generation at a time each, in a thread of its own. Thread-safe."""

    def __init__(
        self,
        store: ObjectStore,
        folder: Path,
        on_built: Callable[[UUID, dict[UUID, Int8Codes]], None],
    ) -> None:
        """Files are kept below `folder`. `on_built` is called with a generation and the codes
        of its
        chunks, by chunk id."""
        self._store = store
        self._folder = folder
        self._on_built = on_built
        self._lock = threading.Lock()
        self._builds: dict[UUID, _Int8Build] = {}

    def wait_for_codes(self, snapshot: Snapshot, seconds: float) -> None:
        """Make the codes of the snapshot's chunks, or wait for whoever does.

        Unavailable: `codes_being_made` when that takes longer, `codes_not_made` when the disk
        does not take them.
        """
        making = self.start_build(snapshot)
        if not making.ended.wait(seconds):
            raise Unavailable(
                "codes_being_made",
                f"The codes for mode=deterministic are being made: {making.done} of "
                f"{making.rows} rows are done. Ask again later, or with another mode.",
                done=making.done,
                rows=making.rows,
                retry_after_seconds=making.seconds_left(),
            )
        if making.error is not None:
            reason = making.error.strerror or str(making.error)
            raise Unavailable(
                "codes_not_made",
                "The codes for mode=deterministic can't be kept in the search worker's folder "
                f"({reason}). Make room there, or ask with mode=dense.",
            )

    def start_build(self, snapshot: Snapshot) -> _Int8Build:
        """Begin, unless someone has begun for this generation."""
        with self._lock:
            making = self._builds.get(snapshot.generation_id)
            if making is None:
                making = _Int8Build(sum(len(chunk.rows) for chunk in snapshot.chunks))
                self._builds[snapshot.generation_id] = making
                threading.Thread(
                    target=self._build, args=(snapshot, making), name="make-int8", daemon=True
                ).start()
        return making

    def _build(self, snapshot: Snapshot, making: _Int8Build) -> None:
        generation_id = snapshot.generation_id
        log.info("making int8 codes of %d rows of generation %s", making.rows, generation_id)
        loader = generation_loader(self._store, self._folder, generation_id)
        said = making.started
        made: dict[UUID, Int8Codes] = {}
        try:
            for chunk in snapshot.chunks:
                if chunk.stored is not None and chunk.int8 is None:
                    made[chunk.chunk_id] = loader.load_int8_codes(chunk.object_key, chunk.stored)
                making.done += len(chunk.rows)
                if time.monotonic() - said > LOG_INTERVAL_SECONDS:
                    said = time.monotonic()
                    log.info("int8 codes: %d of %d rows", making.done, making.rows)
            self._on_built(generation_id, made)
        except OSError as error:
            log.error("int8 codes of generation %s can't be kept: %s", generation_id, error)
            making.error = error
        finally:
            with self._lock:
                del self._builds[generation_id]
            making.ended.set()
