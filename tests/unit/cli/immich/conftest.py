"""A stand-in for Immich for each test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.immich_server import ImmichServer, running_immich


@pytest.fixture
def immich() -> Iterator[ImmichServer]:
    with running_immich() as made:
        yield made
