"""Strange and broken photos by the path of every upload, decoding children and the real network:
the right descriptor, or an error that says what is wrong. Never a descriptor of something else.
"""

from __future__ import annotations

import importlib.util
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from services.extractor.decoder_pool import DecoderPool
from shared.config.settings import Settings
from shared.descriptors.extractor import Extractor
from shared.descriptors.vocabulary import ClusterCentres
from shared.errors import PlacewiseError
from shared.extractor_config.configs import get_extractor_config
from tests.support.photos import encoded, turned_photo

Row = NDArray[np.float32]


@pytest.fixture(scope="module")
def pool() -> Iterator[DecoderPool]:
    made = DecoderPool(Settings.model_construct(decode_processes=1))
    yield made
    made.close()


@pytest.fixture(scope="module")
def extractors() -> dict[str, Extractor]:
    """By preprocessing: EfficientNet-Lite0 with its own weights, one copy for all."""
    made: dict[str, Extractor] = {}
    for name in ("square224", "demo1024", "paper480x640", "round14"):
        config = get_extractor_config(
            f"efficientnet-lite0-vlad:preprocessing={name}", allow_test_extractors=False
        )
        loaded = made["square224"].backbone if made else None
        made[name] = Extractor(config, torch.device("cpu"), backbone=loaded)
    return made


@pytest.fixture(scope="module")
def centres(extractors: dict[str, Extractor]) -> ClusterCentres:
    shipped = extractors["square224"].shipped_vocabulary()
    assert shipped is not None
    return shipped[0]


class Describing:
    """What becomes of a photo's bytes."""

    def __init__(self, pool: DecoderPool, extractor: Extractor, centres: ClusterCentres) -> None:
        self._pool, self._extractor, self._centres = pool, extractor, centres

    def row(self, data: bytes) -> Row:
        (decoded,) = self._pool.decode([data], self._extractor.preprocessing)
        assert not isinstance(decoded, PlacewiseError), decoded
        row: Row = self._extractor.describe([decoded.pixels], self._centres)[0]
        assert np.linalg.norm(row) == pytest.approx(1.0, abs=1e-5)
        return row


@pytest.fixture
def service(
    pool: DecoderPool, extractors: dict[str, Extractor], centres: ClusterCentres
) -> Describing:
    return Describing(pool, extractors["square224"], centres)


def alike(one: Row, other: Row) -> float:
    return float(one @ other)


def photograph() -> Image.Image:
    spec = importlib.util.find_spec("sklearn")
    assert spec is not None
    assert spec.origin is not None
    path = Path(spec.origin).parent / "datasets" / "images" / "china.jpg"
    return Image.open(path).convert("RGB").resize((320, 214))


def png16(samples: NDArray[np.uint16]) -> bytes:
    """A PNG of 16-bit samples (H, W, 3) or (H, W), which Pillow reads but can't write."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    height, width = samples.shape[:2]
    header = struct.pack(">IIBBBBB", width, height, 16, 2 if samples.ndim == 3 else 0, 0, 0, 0)
    lines = samples.astype(">u2").reshape(height, -1)
    body = zlib.compress(b"".join(b"\0" + line.tobytes() for line in lines))
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    )


# --- the right descriptor --------------------------------------------------------------------


def test_turned_photo_has_the_descriptor_of_the_upright_one(service: Describing) -> None:
    upright = service.row(encoded(photograph(), "PNG"))
    turned = service.row(turned_photo(photograph(), 6, "PNG"))
    np.testing.assert_allclose(turned, upright, atol=1e-6)
    as_jpeg = service.row(turned_photo(photograph(), 6, "JPEG", quality=95))
    assert alike(as_jpeg, upright) > 0.9
    inverted = service.row(encoded(Image.eval(photograph(), lambda v: 255 - v), "PNG"))
    assert alike(inverted, upright) < 0.8, "or else this could not tell"


@pytest.mark.parametrize("channels", [1, 3])
def test_16_bit_png_has_the_descriptor_of_its_upper_eight_bits(
    service: Describing, channels: int
) -> None:
    eight = np.asarray(photograph() if channels == 3 else photograph().convert("L"))
    rng = np.random.default_rng(0)
    below = rng.integers(0, 256, eight.shape, dtype=np.uint16)
    sixteen: NDArray[np.uint16] = eight.astype(np.uint16) * np.uint16(256) + below
    expected = service.row(encoded(Image.fromarray(eight), "PNG"))
    np.testing.assert_allclose(service.row(png16(sixteen)), expected, atol=1e-6)


def test_very_long_photo_has_the_descriptor_of_what_it_shows_squeezed(
    service: Describing,
    pool: DecoderPool,
    extractors: dict[str, Extractor],
    centres: ClusterCentres,
) -> None:
    strip = photograph().resize((20_000, 10))
    squeezed = strip.resize((224, 224), Image.Resampling.BILINEAR)
    np.testing.assert_allclose(
        service.row(encoded(strip, "PNG")), service.row(encoded(squeezed, "PNG")), atol=1e-6
    )
    paper = Describing(pool, extractors["paper480x640"], centres)
    assert np.isfinite(paper.row(encoded(strip, "PNG"))).all()


# --- photos of many sizes --------------------------------------------------------------------


@pytest.mark.parametrize("name", ["square224", "demo1024", "round14"])
def test_neither_the_batch_nor_its_other_sizes_change_a_descriptor(
    pool: DecoderPool, extractors: dict[str, Extractor], centres: ClusterCentres, name: str
) -> None:
    """By a cosine of 1e-4 at most: sums in another order may send a patch that lies between two
    centres to the other one.
    """
    sizes = [(320, 214), (214, 320), (320, 214), (150, 150), (320, 214)]
    photos = [
        encoded(photograph().rotate(20 * n).resize(size), "PNG") for n, size in enumerate(sizes)
    ]
    extractor = extractors[name]
    pixels = [
        outcome.pixels
        for outcome in pool.decode(photos, extractor.preprocessing)
        if not isinstance(outcome, PlacewiseError)
    ]
    assert len(pixels) == len(photos)
    alone = [extractor.describe([one], centres)[0] for one in pixels]
    for size in (2, 3, 5):
        together = np.concatenate(
            [extractor.describe(pixels[i : i + size], centres) for i in range(0, 5, size)]
        )
        for one, other in zip(together, alone, strict=True):
            assert alike(one, other) > 1 - 1e-4
    between = [alike(alone[0], other) for other in alone[1:]]
    assert max(between) < 0.95, "or else a mixed-up order would not show"
