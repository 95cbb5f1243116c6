"""Fixtures of the extractor's tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shared.descriptors.extractor import Extractor
from shared.imaging.preprocessing import Pixels
from shared.jobs import JobState
from tests.integration.extractor.model_changes import PHOTOS
from tests.integration.harness import Harness

Describe = Callable[..., NDArray[np.float32]]


@pytest.fixture
def before_describing(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., None]], None]:
    """Has a function called with the pixels of each batch before its forward pass."""
    real: Describe = Extractor.describe

    def hook(do: Callable[..., None]) -> None:
        def describe(self: Extractor, pixels: list[Pixels], *made_with: Any) -> NDArray[np.float32]:
            do(pixels)
            return real(self, pixels, *made_with)

        monkeypatch.setattr(Extractor, "describe", describe)

    return hook


Hook = Callable[[Callable[..., None]], None]


@pytest.fixture
def fitted(vlads: Harness) -> Harness:
    """A map with a vocabulary and PHOTOS described photos."""
    vlads.upload(*range(PHOTOS))
    job = vlads.fit()
    assert job.state == JobState.SUCCEEDED
    assert vlads.searchable() == PHOTOS
    return vlads
