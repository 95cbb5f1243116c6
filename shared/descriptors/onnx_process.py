"""An ONNX network in a process of its own, which ends where it exceeds its time or memory.

A file of others may loop for ever, or multiply itself when it is read, and ONNX Runtime can't be
interrupted. The process imports no torch, so that it starts within a second.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import TimeoutError as TimedOut
from concurrent.futures import wait
from multiprocessing.util import Finalize
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pebble import ProcessExpired, ProcessPool

from shared.errors import Unavailable
from shared.limited_pool import limited_pool

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

PASS_SECONDS = 60.0  # to open the file, or for PHOTOS_PER_PASS photos
PHOTOS_PER_PASS = 4
MEMORY_BYTES = 4_000_000_000  # without the file itself
POLL_SECONDS = 0.2  # between two looks whether the process is to stop

TYPES: dict[str, np.dtype[Any]] = {
    "tensor(float)": np.dtype("f4"),
    "tensor(float16)": np.dtype("f2"),
    "tensor(double)": np.dtype("f8"),
    "tensor(uint8)": np.dtype("u1"),
}
"""Of photos, by ONNX Runtime's names"""

Array = NDArray[Any]
Result = TypeVar("Result")

_file: tuple[bytes, int]
"""In the process of a network: the content of its file, and its number of threads."""


class PassFailed(Exception):
    """The network failed, or exceeded its time or memory."""


class UnsuitableInput(PassFailed):
    """The network takes something else than photos."""


class OnnxProcess:
    """Runs the passes of one network one after the other, in the order of the calls.

    Thread-safe: a query waits for one pass of a batch at most. The process is started again for the
    pass after one that ended it.
    """

    def __init__(
        self, data: bytes, threads: int, is_stopping: Callable[[], bool] = lambda: False
    ) -> None:
        """Prepare the process; the first pass starts it.

        Args:
            data: Content of the file.
            threads: Number of threads that compute.
            is_stopping: Whether the caller's process is to stop; a running pass is then ended.
        """
        self._is_stopping = is_stopping
        self._pool = limited_pool(1, MEMORY_BYTES + len(data), _prepare, data, threads)
        Finalize(self, _end, [self._pool], exitpriority=0)  # atexit does not run in children

    def open(self) -> None:
        """Open the file; raises as a pass does."""
        self._run(_open)

    def __call__(self, batch: Array) -> Array:
        """Return the network's first output for a batch of photos.

        Raises:
            PassFailed: With the reason.
            Unavailable: `extractor_stopping`, if `is_stopping` became true meanwhile.
        """
        parts = np.split(batch, range(PHOTOS_PER_PASS, len(batch), PHOTOS_PER_PASS))
        return np.concatenate([self._run(_compute, part) for part in parts])

    def _run(self, function: Callable[..., Result], *args: Any) -> Result:
        future = self._pool.schedule(function, args=args, timeout=PASS_SECONDS)
        while not wait([future], POLL_SECONDS).done:
            if self._is_stopping():
                future.cancel()  # type: ignore[no-untyped-call]
                raise Unavailable(
                    "extractor_stopping", "The extractor stops. The job will be retried."
                )
        try:
            result: Result = future.result()
        except TimedOut:
            raise PassFailed(f"it computes for more than {PASS_SECONDS:g} s") from None
        except ProcessExpired as error:
            raise PassFailed(
                f"its process ended with code {error.exitcode}, perhaps because it needs more than "
                f"{MEMORY_BYTES / 1e9:g} GB of memory"
            ) from None
        return result


def _end(pool: ProcessPool) -> None:
    pool.stop()  # type: ignore[no-untyped-call]
    pool.join()


def _prepare(data: bytes, threads: int) -> None:
    global _file
    _file = data, threads


@functools.cache
def _session() -> InferenceSession:
    import onnxruntime

    data, threads = _file
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # errors are raised, too
    # By default, files that it names are read from the working directory. Nothing is in this one.
    options.add_session_config_entry(
        "session.model_external_initializers_file_folder_path", os.devnull
    )
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    inputs = session.get_inputs()
    if len(inputs) != 1:
        raise UnsuitableInput(f"it has {len(inputs)} inputs, expected photos only")
    if inputs[0].type not in TYPES:
        raise UnsuitableInput(f"its input is a {inputs[0].type}. Export it for float32")
    (count, *_) = inputs[0].shape or [None]
    if isinstance(count, int) and count > 1:
        raise UnsuitableInput(
            f"its input has a fixed batch of {count} photos. Export it for one, or for any number "
            "(a dynamic axis)"
        )
    return session


@contextlib.contextmanager
def _limits() -> Iterator[None]:
    # The kernel ends this process even if its parent, which limits the time, has been killed.
    signal.alarm(int(2 * PASS_SECONDS))
    try:
        yield
    except PassFailed:
        raise
    except MemoryError:
        raise PassFailed(f"it needs more than {MEMORY_BYTES / 1e9:g} GB of memory") from None
    except Exception as error:  # ONNX Runtime's own types have no other base
        raise PassFailed(" ".join(str(error).split())) from None
    finally:
        signal.alarm(0)


def _open() -> None:
    with _limits():
        _session()


def _compute(batch: Array) -> Array:
    with _limits():
        session = _session()
        photos, output = session.get_inputs()[0], session.get_outputs()[0].name
        if batch.dtype.kind == TYPES[photos.type].kind == "f":
            batch = batch.astype(TYPES[photos.type])
        one_by_one = photos.shape[:1] == [1]  # as many exports are
        parts = np.split(batch, len(batch)) if one_by_one else [batch]
        return np.concatenate([session.run([output], {photos.name: part})[0] for part in parts])
