"""Pool of decoder processes with a memory limit and a timeout for each photo.

A photo that makes the decoder crash, hang or exhaust memory terminates its own process, not the
worker, and does not affect other photos. `concurrent.futures.ProcessPoolExecutor` has no timeout
for a running task, and a crash breaks its whole pool; `pebble.ProcessPool` replaces the process.
"""

from __future__ import annotations

import functools
import logging
import os
import pickle
import signal
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
from pebble import ProcessExpired, ProcessFuture, ProcessPool

from services.extractor.decoder_process import StoredPhoto, decode_into_memory, prepare_process
from shared.config.settings import Settings
from shared.errors import PlacewiseError, Unavailable, Unprocessable
from shared.ids import new_id
from shared.imaging.decode import DecodedPhoto, decode_photo
from shared.imaging.file_formats import Previews
from shared.imaging.preprocessing import Preprocessing
from shared.limited_pool import limited_pool

log = logging.getLogger(__name__)

POOL_POLL_SECONDS = 1.0  # interval at which a waiting batch checks that the pool is alive

# Photos of a batch scheduled per process: one running and the next. If all were scheduled at once,
# a query's photo, which comes from another thread, would wait for the whole batch.
SCHEDULED_PER_PROCESS = 2

DECODE_TIMEOUT_SECONDS = 30.0
DECODE_MEMORY_BYTES = 2_000_000_000  # of one process: a JPEG of 200 megapixels takes less

# A process may be killed for other reasons than its photo, so each photo gets a second attempt.
MAX_DECODE_ATTEMPTS = 2

Decode = Callable[[bytes], DecodedPhoto]
Photo = bytes | StoredPhoto


class _Decoding:
    """A photo that is being decoded, and the memory to which its pixels are written."""

    def __init__(self, pool: ProcessPool, data: Photo, decode: Decode, seconds: float) -> None:
        name = f"photo-{new_id()}"
        self._path: str | None = None
        if hasattr(os, "memfd_create"):
            self._file = os.memfd_create(name)
            path = f"/proc/{os.getpid()}/fd/{self._file}"
        else:  # not Linux
            self._file, self._path = tempfile.mkstemp(prefix=name)
            path = self._path
        try:
            self.future: ProcessFuture[tuple[bytes, list[int]]] = pool.schedule(
                decode_into_memory, args=[decode, data, seconds, path, name]
            )
        except RuntimeError as error:  # raised by pebble when the pool is not running
            self.close()
            raise _pool_broken_error() from error

    def photo(self) -> DecodedPhoto:
        photo, sizes = self.future.result()
        arrays = [np.empty(size, np.uint8).data for size in sizes]
        os.preadv(self._file, arrays, 0)
        decoded: DecodedPhoto = pickle.loads(photo, buffers=arrays)  # noqa: S301
        return decoded

    def close(self) -> None:
        os.close(self._file)
        if self._path is not None:
            Path(self._path).unlink()


class DecoderPool:
    """Decodes photos in parallel processes; results are in the order of the photos."""

    def __init__(
        self,
        settings: Settings,
        timeout_seconds: float = DECODE_TIMEOUT_SECONDS,
        memory_bytes: int = DECODE_MEMORY_BYTES,
    ) -> None:
        """Start the processes; a photo that takes more time or memory is refused."""
        self._settings = settings
        self._memory_bytes = memory_bytes
        self._timeout_seconds = timeout_seconds
        self._restart_lock = threading.Lock()
        self._pool = self._start_pool()

    def decode(
        self,
        photos: Iterable[Photo],
        preprocessing: Preprocessing,
        *,
        previews: Previews = Previews.NONE,
        for_detection: bool = False,
    ) -> list[DecodedPhoto | PlacewiseError]:
        """Decode photos; each result is a decoded photo, or the error that explains the failure.

        At most SCHEDULED_PER_PROCESS photos per process are taken from `photos` before the first
        of them is decoded: a generator that reads files holds as many in memory.

        Raises:
            Unavailable: The object store, or `decoders_broke`.
            OSError: As the object store raises it.
        """
        with self._restart_lock:  # batches and model changes decode from different threads
            if not self._pool.active:
                log.error("the decoder pool crashed, starting a new one")
                self.close()
                self._pool = self._start_pool()
        decode = functools.partial(
            decode_photo,
            preprocessing=preprocessing,
            max_pixels=self._settings.max_image_pixels,
            previews=previews,
            for_detection=for_detection,
        )
        outcomes: list[DecodedPhoto | PlacewiseError] = []
        pending: deque[tuple[_Decoding, Photo]] = deque()
        try:
            for data in photos:
                if len(pending) == self._settings.decode_processes * SCHEDULED_PER_PROCESS:
                    outcomes.append(self._result(*pending.popleft(), decode))
                decoding = _Decoding(self._pool, data, decode, self._timeout_seconds)
                pending.append((decoding, data))
            while pending:
                outcomes.append(self._result(*pending.popleft(), decode))
        finally:
            for decoding, _ in pending:
                decoding.close()
        return outcomes

    def close(self) -> None:
        """Terminate the processes."""
        self._pool.stop()  # type: ignore[no-untyped-call]
        self._pool.join()

    def _start_pool(self) -> ProcessPool:
        is_remote = self._settings.s3_endpoint is not None
        store_module = "shared.storage.s3" if is_remote else "shared.storage"
        processes = self._settings.decode_processes
        pool = limited_pool(processes, self._memory_bytes, prepare_process, store_module)
        pool.schedule(os.getpid)  # starts the processes; else the first photo would
        return pool

    def _result(
        self, decoding: _Decoding, data: Photo, decode: Decode
    ) -> DecodedPhoto | PlacewiseError:
        for attempt in range(1, MAX_DECODE_ATTEMPTS + 1):
            try:
                return self._await(decoding)
            except PlacewiseError as error:
                if isinstance(error, Unavailable):
                    raise
                return error
            except (ProcessExpired, MemoryError) as error:
                if isinstance(error, ProcessExpired) and error.exitcode == -signal.SIGALRM:
                    return Unprocessable(
                        "undecodable_photo",
                        f"The photo could not be decoded within {self._timeout_seconds:g} s.",
                    )
                if attempt == MAX_DECODE_ATTEMPTS:
                    return Unprocessable(
                        "undecodable_photo",
                        f"The decoder crashed on this photo {MAX_DECODE_ATTEMPTS} times "
                        f"({type(error).__name__}).",
                    )
                decoding = _Decoding(self._pool, data, decode, self._timeout_seconds)
        raise AssertionError("the last attempt returns")

    def _await(self, decoding: _Decoding) -> DecodedPhoto:
        """Wait for the photo and release its memory.

        Raises Unavailable if the pool stopped, because no result will come then.
        """
        try:
            while not wait([decoding.future], timeout=POOL_POLL_SECONDS).done:
                if not self._pool.active:
                    raise _pool_broken_error()
            return decoding.photo()
        except BrokenProcessPool as error:  # a child was killed between two photos
            raise _pool_broken_error() from error
        finally:
            decoding.close()


def _pool_broken_error() -> Unavailable:
    return Unavailable("decoders_broke", "The decoder processes crashed. The job will be retried.")
