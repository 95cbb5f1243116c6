"""Fingerprints of weights that were computed before: gigabytes need not be read for each list.

One JSON file in the user's cache folder (`$XDG_CACHE_HOME/placewise`, as other tools have theirs).
It may be deleted at any time.
"""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class WeightsRecord:
    """What reading or loading the weights has shown."""

    fingerprint: str
    """As `backbone_fingerprint` in an extractor spec."""
    size_bytes: int


def load_record(key: str) -> WeightsRecord | None:
    """What `remember` was given for that key; None when it is not known any more."""
    try:
        return WeightsRecord(**_load_cache()[key])
    except (KeyError, TypeError):
        return None


def save_record(key: str, record: WeightsRecord) -> None:
    """Keep it for the next command."""
    path = _cache_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    everything = {**_load_cache(), key: asdict(record)}
    # Another command may be reading.
    with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False) as file:
        json.dump(everything, file, indent=1)
    Path(file.name).replace(path)


def file_key(extractor: str, path: Path) -> str:
    """A key that changes with the file."""
    there = path.stat()
    return f"{extractor} {path} {there.st_size} {there.st_mtime_ns}"


def _load_cache() -> dict[str, Any]:
    try:
        found = json.loads(_cache_path().read_text())
    except (FileNotFoundError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _cache_path() -> Path:
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache, "placewise", "fingerprints.json")
