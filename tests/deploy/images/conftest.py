"""The images, each built when the first test needs it."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.deploy.images.image import Builder, Image

BuildImage = Callable[[str], Image]


@pytest.fixture(scope="session")
def image() -> Iterator[BuildImage]:
    """The image of a service."""
    with tempfile.TemporaryDirectory(prefix="pw-images-", ignore_cleanup_errors=True) as folder:
        yield functools.cache(Builder(Path(folder)).build)
