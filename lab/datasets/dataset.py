"""Dataset types: photos, evaluation sets, training sets, and their fingerprints.

Every layout (`lab/datasets/layouts`) is read into these types; training, evaluation and reports
use nothing else. `lab/datasets/open_dataset.py` opens datasets.

Results are comparable only with the same protocol and fingerprint: the same photos, the same
positives, the same set of counted queries. Most differences such as "92.2 instead of 95.1" come
from different sets of the same name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]

PHOTO_TABLE_HEADER = "path,latitude,longitude,heading,place,frame,sequence"
"""First line of a CSV list of photos; all columns but `path` are optional"""

MISSING_FILE_BYTES = -1
"""Size of a missing photo in a fingerprint."""


@dataclass(frozen=True, slots=True)
class DatasetPhoto:
    """One photo of a dataset. None means unknown."""

    path: Path
    """The file to open."""
    name: str
    """Relative path in the dataset, separated by `/`; used in predictions and reports."""
    easting: float | None = None
    """metres, UTM"""
    northing: float | None = None
    zone: str | None = None
    """UTM zone, such as `32T`"""
    latitude: float | None = None
    """degrees, WGS 84"""
    longitude: float | None = None
    heading: float | None = None
    """degrees clockwise from north, in [0, 360)"""
    place: str | None = None
    frame: int | None = None
    """number along its sequence or traverse"""
    sequence: str | None = None
    captured_at: datetime | None = None
    """UTC"""


@dataclass(frozen=True)
class EvaluationSet:
    """Database photos, queries, and the positives of each query."""

    name: str
    root: Path
    database: tuple[DatasetPhoto, ...]
    queries: tuple[DatasetPhoto, ...]
    positives: tuple[Indices, ...]
    """Ascending database indices for each query; empty if it has no positives."""
    rule: str
    """The positive-match criterion, such as `radius 25 m`."""
    protocol: str
    """How the set was assembled: `placewise`, `msls-official`, `vme`."""
    paired_by: str | None = None
    """What numbers the photos of two seasons, in words; None for other sets"""

    def __post_init__(self) -> None:
        if len(self.positives) != len(self.queries):
            raise ValueError(f"{len(self.positives)} positives for {len(self.queries)} queries")

    @property
    def without_positives(self) -> Indices:
        """Ascending indices of the queries without positives."""
        empty = [index for index, rows in enumerate(self.positives) if not len(rows)]
        return np.array(empty, np.int64)

    @cached_property
    def fingerprint(self) -> str:
        """sha256 of the names and sizes in bytes of all photos, the positives and the protocol.

        Two results are comparable only if their fingerprints are equal. Reads the metadata of each
        file; a missing file has the size MISSING_FILE_BYTES.
        """
        digest = hashlib.sha256()
        for text in ("evaluation", self.protocol):
            _update_digest(digest, text)
        for role, photos in (("database", self.database), ("queries", self.queries)):
            _update_digest(digest, f"{role} {len(photos)}")
            for photo in photos:
                _update_digest(digest, f"{photo.name} {_size(photo.path)}")
        for rows in self.positives:
            _update_digest(digest, " ".join(map(str, rows.tolist())))
        return digest.hexdigest()


@dataclass(frozen=True, slots=True)
class TrainingPlace:
    """Photos of the same place."""

    place_id: int
    """Unique over all cities of the set"""
    city: str
    photos: tuple[Path, ...]


@dataclass(frozen=True)
class TrainingSet:
    """Labelled places for training, city by city."""

    name: str
    root: Path
    layout: str
    places: tuple[TrainingPlace, ...]

    @property
    def cities(self) -> tuple[str, ...]:
        """City names in the order of their places."""
        return tuple(dict.fromkeys(place.city for place in self.places))

    @property
    def photo_count(self) -> int:
        """Number of photos of all places."""
        return sum(len(place.photos) for place in self.places)

    @cached_property
    def fingerprint(self) -> str:
        """sha256 of cities, place ids and photo names, in their order.

        Sizes are not included: reading them takes minutes for half a million photos on a network
        disk.
        """
        digest = hashlib.sha256()
        _update_digest(digest, "training")
        for place in self.places:
            _update_digest(digest, f"{place.city} {place.place_id} {len(place.photos)}")
            for photo in place.photos:
                _update_digest(digest, photo.name)
        return digest.hexdigest()


def list_fingerprint(names: Iterable[str]) -> str:
    """Return the sha256 of names in their order; identifies the list of a ground truth."""
    digest = hashlib.sha256()
    for name in names:
        _update_digest(digest, name)
    return digest.hexdigest()


def _update_digest(digest: hashlib._Hash, text: str) -> None:
    # A file name may contain any character but NUL, so NUL is an unambiguous terminator.
    digest.update(text.encode("utf-8", "surrogateescape") + b"\0")


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return MISSING_FILE_BYTES
