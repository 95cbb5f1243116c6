"""The decoder pool: a poisonous photo harms itself alone, whatever it does to its process.

The poison is carried by the preprocessing, which runs in the child right after the decoder.
"""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import resource
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from services.extractor.decoder_pool import (
    DECODE_MEMORY_BYTES,
    DECODE_TIMEOUT_SECONDS,
    SCHEDULED_PER_PROCESS,
    DecoderPool,
)
from services.extractor.decoder_process import decode_into_memory
from shared.config.settings import Settings
from shared.errors import PlacewiseError, Unavailable, Unprocessable
from shared.imaging.decode import DecodedPhoto
from shared.imaging.file_formats import Previews
from shared.imaging.preprocessing import Pixels, Preprocessing, get_preprocessing
from tests.support.photos import photo_bytes

SQUARE = get_preprocessing("square32")
GOOD = photo_bytes(1)
CRASHES, HANGS = (255, 0, 0), (0, 255, 0)


def photo_of(colour: tuple[int, int, int], side: int = 8) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (side, side), colour).save(buffer, "PNG")
    return buffer.getvalue()


class Poisoned(Preprocessing):
    """Does to its process what a fault in a decoder could do, if the photo's colour says so."""

    def apply(self, image: Image.Image) -> Pixels:
        colour: Any = image.getpixel((0, 0))
        if colour == CRASHES:
            os.kill(os.getpid(), signal.SIGSEGV)
        while colour == HANGS:
            pass
        return super().apply(image)


POISONED = Poisoned(
    "poisoned", 1, SQUARE.upright, SQUARE.max_pixels, SQUARE.typical_size, SQUARE.resize
)


@contextlib.contextmanager
def pool_with(
    settings: Settings,
    timeout_seconds: float = DECODE_TIMEOUT_SECONDS,
    memory_bytes: int = DECODE_MEMORY_BYTES,
    **changes: Any,
) -> Iterator[DecoderPool]:
    changed = settings.model_copy(update={"decode_processes": 1, **changes})
    pool = DecoderPool(changed, timeout_seconds, memory_bytes)
    try:
        yield pool
    finally:
        pool.close()


@pytest.fixture
def pool(settings: Settings) -> Iterator[DecoderPool]:
    with pool_with(settings) as made:
        yield made


def in_child(pool: DecoderPool, expression: str) -> Any:
    """What the child process makes of a Python expression."""
    return pool._pool.schedule(eval, args=[expression]).result()


def is_good(outcome: DecodedPhoto | PlacewiseError) -> bool:
    assert isinstance(outcome, DecodedPhoto), outcome
    return outcome.pixels.shape == (32, 32, 3)


def refusal(outcome: DecodedPhoto | PlacewiseError) -> str:
    assert isinstance(outcome, Unprocessable)
    assert outcome.code == "undecodable_photo"
    return outcome.detail


def test_good_photos_are_decoded_beside_bad_ones_in_their_order(pool: DecoderPool) -> None:
    huge = photo_of((9, 9, 9), side=64)
    photos = [GOOD, b"no photo", photo_of((1, 2, 3)), GOOD[:300], huge, photo_bytes(2)]
    outcomes = pool.decode(photos, SQUARE)
    first, text, third, truncated, fifth, last = outcomes
    assert is_good(first)
    assert is_good(last)
    assert "can't be decoded" in refusal(text)
    assert refusal(truncated)
    for outcome, colour in ((third, [1, 2, 3]), (fifth, [9, 9, 9])):
        assert isinstance(outcome, DecodedPhoto)
        assert outcome.pixels[0, 0].tolist() == colour
    assert not np.array_equal(first.pixels, last.pixels)  # type: ignore[union-attr]
    assert pool.decode([], SQUARE) == []


@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_of_200_megapixels_is_decoded_within_the_memory_limit(
    settings: Settings, progressive: bool
) -> None:
    limits = Settings.model_fields
    with pool_with(
        settings,
        max_image_pixels=limits["max_image_pixels"].default,
        timeout_seconds=500.0,
    ) as pool:
        buffer = io.BytesIO()
        stripes = Image.effect_noise((200, 200), 50).resize((20_000, 10_000)).convert("RGB")
        stripes.save(buffer, "JPEG", quality=60, progressive=progressive)
        (outcome,) = pool.decode([buffer.getvalue()], SQUARE, previews=Previews.ALL)
        assert is_good(outcome)
        # Not ru_maxrss, which a child has from the process that started it.
        peak_kib = int(
            in_child(pool, "open('/proc/self/status').read()").split("VmHWM:")[1].split()[0]
        )
    assert 1024 * peak_kib < DECODE_MEMORY_BYTES


def test_photos_are_read_as_they_are_decoded(
    pool: DecoderPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    finished: list[DecodedPhoto | PlacewiseError] = []
    result = pool._result

    def counted(*arguments: Any) -> DecodedPhoto | PlacewiseError:
        finished.append(result(*arguments))
        return finished[-1]

    def photos() -> Iterator[bytes]:
        for number in range(12):
            assert number - len(finished) <= SCHEDULED_PER_PROCESS
            yield GOOD

    monkeypatch.setattr(pool, "_result", counted)
    assert len(pool.decode(photos(), SQUARE)) == 12


def test_too_many_pixels_are_refused_by_the_settings_limit(settings: Settings) -> None:
    with pool_with(settings, max_image_pixels=100) as pool:
        (outcome,) = pool.decode([GOOD], SQUARE)
    assert isinstance(outcome, Unprocessable)
    assert outcome.code == "too_many_pixels"


@pytest.mark.parametrize(("colour", "reason"), [(CRASHES, "crashed"), (HANGS, "within 2 s")])
def test_photo_that_crashes_its_decoder_process_or_takes_too_long_fails_alone(
    settings: Settings, colour: tuple[int, int, int], reason: str
) -> None:
    with pool_with(settings, timeout_seconds=2.0) as pool:
        first, poison, last = pool.decode([GOOD, photo_of(colour), GOOD], POISONED)
        assert reason in refusal(poison)
        assert all(is_good(good) for good in [first, last, *pool.decode([GOOD], POISONED)])


def test_photo_that_exceeds_the_decoders_memory_limit_fails_alone(
    settings: Settings,
) -> None:
    buffer = io.BytesIO()
    Image.new("L", (7000, 7000)).save(buffer, "PNG", compress_level=1)
    with pool_with(settings, memory_bytes=250_000_000) as pool:
        first, large, last = pool.decode([GOOD, buffer.getvalue(), GOOD], SQUARE)
    assert "memory" in refusal(large)
    assert is_good(first)
    assert is_good(last)


def test_photos_of_a_decoder_that_the_system_kills_are_decoded_by_another(
    pool: DecoderPool,
) -> None:
    before = in_child(pool, "__import__('os').getpid()")
    os.kill(before, signal.SIGKILL)
    try:
        outcomes = pool.decode([GOOD] * 3, SQUARE)
    except Unavailable as error:  # the jobs are given back, and no photo is to blame
        assert error.code == "decoders_broke"  # noqa: PT017
        outcomes = pool.decode([GOOD] * 3, SQUARE)
    assert all(is_good(outcome) for outcome in outcomes)
    assert in_child(pool, "__import__('os').getpid()") != before


def test_process_whose_photo_nobody_waits_for_writes_to_no_other_file(
    pool: DecoderPool, tmp_path: Path
) -> None:
    other = tmp_path / "catalog.db"
    other.write_bytes(b"rows")
    with other.open("rb") as file:
        path = f"/proc/{os.getpid()}/fd/{file.fileno()}"
        arguments = [bytes, GOOD, 9.0, path, "photo-of-before"]
        with pytest.raises(FileNotFoundError, match="photo-of-before"):
            pool._pool.schedule(decode_into_memory, args=arguments).result()
    assert other.read_bytes() == b"rows"


def test_pixels_pass_through_temporary_files_where_there_are_none_in_memory(
    pool: DecoderPool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("os.memfd_create")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert is_good(pool.decode([GOOD], SQUARE)[0])
    assert not list(tmp_path.iterdir())


def test_memory_is_released_when_a_batch_ends_early(pool: DecoderPool) -> None:
    def photos() -> Iterator[bytes]:
        yield GOOD
        raise Unavailable("store_unavailable", "The object store is away.")

    pool.decode([GOOD], SQUARE)
    with pytest.raises(Unavailable, match="away"):
        pool.decode(photos(), SQUARE)
    files = [str(file.resolve()) for file in Path("/proc/self/fd").iterdir()]
    assert not [file for file in files if "photo-" in file]


def test_broken_decoder_pool_is_replaced(pool: DecoderPool) -> None:
    pool.close()
    assert is_good(pool.decode([GOOD], SQUARE)[0])


def test_decoder_processes_have_a_memory_limit_and_import_no_torch_nor_start_a_thread(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The memory of NumPy's threads, one for each of 64 processors, would exceed the limit."""
    monkeypatch.delenv("OMP_NUM_THREADS")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    with pool_with(settings) as pool:
        pool.decode([GOOD], SQUARE)
        modules = in_child(pool, "sorted(__import__('sys').modules)")
        status = in_child(pool, "open('/proc/self/status').read()")
        limit = in_child(pool, f"__import__('resource').getrlimit({resource.RLIMIT_DATA})")
    assert "shared.imaging.decode" in modules, "the question went to another process"
    assert {"torch", "torchvision", "timm", "pydantic", "sqlalchemy"}.isdisjoint(modules)
    assert "Threads:\t1\n" in status
    assert limit == (2_000_000_000, 2_000_000_000)


def test_closing_the_pool_ends_its_processes(settings: Settings) -> None:
    with pool_with(settings) as pool:
        child = in_child(pool, "__import__('os').getpid()")
    assert child not in {process.pid for process in multiprocessing.active_children()}
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)
