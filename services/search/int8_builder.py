"""Builder of a generation's int8 codes, in a background thread on first use.

At 98,304 dimensions a row's code has 98 KB and takes a millisecond to compute. Most installations
never need it (`Mode.DETERMINISTIC`), so it is not computed in advance.
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
    """A running build of one generation's codes."""

    rows: int
    done: int = 0
    started: float = field(default_factory=time.monotonic)
    ended: threading.Event = field(default_factory=threading.Event)
    error: OSError | None = None

    def seconds_left(self) -> float:
        """Estimated remaining time: at least 1 and at most MAX_RETRY_SECONDS."""
        elapsed = time.monotonic() - self.started
        remaining = elapsed * (self.rows - self.done) / max(1, self.done)
        return min(max(remaining, 1.0), MAX_RETRY_SECONDS)


class Int8CodeBuilder:
    """Builds int8 codes in background threads, one for each generation; thread-safe."""

    def __init__(
        self,
        store: ObjectStore,
        folder: Path,
        on_built: Callable[[UUID, dict[UUID, Int8Codes]], None],
    ) -> None:
        """Create a builder.

        Args:
            store: The object store.
            folder: Files are cached below this folder.
            on_built: Called with a generation and its codes by chunk id.
        """
        self._store = store
        self._folder = folder
        self._on_built = on_built
        self._lock = threading.Lock()
        self._builds: dict[UUID, _Int8Build] = {}

    def wait_for_codes(self, snapshot: Snapshot, seconds: float) -> None:
        """Build the codes of the snapshot's chunks, or wait for a running build.

        Raises:
            Unavailable: `codes_being_made` if it takes longer than `seconds`; `codes_not_made` if
                the codes can't be written to disk.
        """
        build = self.start_build(snapshot)
        if not build.ended.wait(seconds):
            raise Unavailable(
                "codes_being_made",
                f"The codes for mode=deterministic are being built: {build.done} of "
                f"{build.rows} rows are done. Retry later, or use another mode.",
                done=build.done,
                rows=build.rows,
                retry_after_seconds=build.seconds_left(),
            )
        if build.error is not None:
            reason = build.error.strerror or str(build.error)
            raise Unavailable(
                "codes_not_made",
                "The codes for mode=deterministic can't be written to the search worker's folder "
                f"({reason}). Free some disk space, or use mode=dense.",
            )

    def start_build(self, snapshot: Snapshot) -> _Int8Build:
        """Start a build, or return the generation's running one."""
        with self._lock:
            build = self._builds.get(snapshot.generation_id)
            if build is None:
                build = _Int8Build(sum(len(chunk.rows) for chunk in snapshot.chunks))
                self._builds[snapshot.generation_id] = build
                threading.Thread(
                    target=self._build, args=(snapshot, build), name="build-int8", daemon=True
                ).start()
        return build

    def _build(self, snapshot: Snapshot, build: _Int8Build) -> None:
        generation_id = snapshot.generation_id
        log.info("building int8 codes of %d rows of generation %s", build.rows, generation_id)
        loader = generation_loader(self._store, self._folder, generation_id)
        logged_at = build.started
        codes: dict[UUID, Int8Codes] = {}
        try:
            for chunk in snapshot.chunks:
                if chunk.stored is not None and chunk.int8 is None:
                    codes[chunk.chunk_id] = loader.load_int8_codes(chunk.object_key, chunk.stored)
                build.done += len(chunk.rows)
                if time.monotonic() - logged_at > LOG_INTERVAL_SECONDS:
                    logged_at = time.monotonic()
                    log.info("int8 codes: %d of %d rows", build.done, build.rows)
            self._on_built(generation_id, codes)
        except OSError as error:
            log.error("int8 codes of generation %s can't be stored: %s", generation_id, error)
            build.error = error
        finally:
            with self._lock:
                del self._builds[generation_id]
            build.ended.set()
