"""One `placewise serve` per module: starting takes seconds."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess


@pytest.fixture(scope="module")
def server(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ServerProcess]:
    """The module's own server, started with its SETTINGS.

    One photo lies in it, unless its extractor waits for a vocabulary, it is described: the
    decoders run, as `no_decoding` wants it.
    """
    settings = getattr(request.module, "SETTINGS", {})
    with ServerProcess(tmp_path_factory.mktemp("server") / "home", **settings) as started:
        if settings.get("extractor") != "test-tiny-vlad":
            started.indexed(photo_bytes(0), "first.jpg")
        yield started
