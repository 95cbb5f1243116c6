"""A GPU without the memory for one certain photo, on machines that have none."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from shared.descriptors.extractor import Extractor
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import get_preprocessing
from tests.support.photos import photo_bytes


def make_too_heavy(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """From now on each pass with `photo_bytes(number)`, preprocessed by `square32`, runs out of
    memory."""
    real = Extractor.features
    heavy = decode_photo(photo_bytes(number), get_preprocessing("square32"), 10**9).pixels

    def features(made: Extractor, pixels: Any) -> torch.Tensor:
        if any((one == heavy).all() for one in pixels):
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return real(made, pixels)

    monkeypatch.setattr(Extractor, "features", features)
