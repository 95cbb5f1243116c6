"""What a data set is, once it has been read: photos, where they were taken, what shows what.

Every layout (`shared/datasets/layouts`) becomes these types, and whatever trains, evaluates or
reports takes nothing else. `shared/datasets/open_dataset.py` opens them.

Published figures, each with the set that it was measured on.

A figure is comparable only where protocol and fingerprint are the same: the same photos, the same
positives, the same queries counted. Reports of "92.2 instead of 95.1" mostly compare two sets of
one name. The lists of the published sets can't be shipped, so a fingerprint joins this table when
someone has the set and has checked it against the publication; until then nothing is placed beside
a result.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]

MISSING_FILE_BYTES = -1
"""the size that a fingerprint takes for a photo that is not there"""


@dataclass(frozen=True, slots=True)
class DatasetPhoto:
    """One photo of a set. None means "not said"."""

    path: Path
    """To open it."""
    name: str
    """As the set names it, relative and separated by `/`: what predictions and reports say."""
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


@dataclass(frozen=True)
class EvaluationSet:
    """Database photos, queries, and which database photos are right for each query."""

    name: str
    root: Path
    database: tuple[DatasetPhoto, ...]
    queries: tuple[DatasetPhoto, ...]
    positives: tuple[Indices, ...]
    """Ascending database indices, of each query; empty where it has none."""
    rule: str
    """Who is a positive, in words such as `radius 25 m`."""
    protocol: str
    """How the set was put together: `placewise`, `msls-official`, `vme`."""

    def __post_init__(self) -> None:
        if len(self.positives) != len(self.queries):
            raise ValueError(f"{len(self.positives)} positives for {len(self.queries)} queries")

    @property
    def without_positives(self) -> Indices:
        """Ascending indices of the queries that no database photo is right for."""
        empty = [number for number, found in enumerate(self.positives) if not len(found)]
        return np.array(empty, np.int64)

    @cached_property
    def fingerprint(self) -> str:
        """sha256 over names and sizes in bytes of all photos, positives and protocol.

        Two results are comparable only where it is the same. It takes one look at each file; a
        file that is not there counts as of size NO_FILE.
        """
        digest = hashlib.sha256()
        for text in ("evaluation", self.protocol):
            _update_digest(digest, text)
        for role, shots in (("database", self.database), ("queries", self.queries)):
            _update_digest(digest, f"{role} {len(shots)}")
            for shot in shots:
                _update_digest(digest, f"{shot.name} {_size(shot.path)}")
        for found in self.positives:
            _update_digest(digest, " ".join(map(str, found.tolist())))
        return digest.hexdigest()


@dataclass(frozen=True, slots=True)
class TrainingPlace:
    """Photos that show one place."""

    place_id: int
    """unique over the cities of its set"""
    city: str
    photos: tuple[Path, ...]


@dataclass(frozen=True)
class TrainingSet:
    """Places to learn from, city after city."""

    name: str
    root: Path
    layout: str
    places: tuple[TrainingPlace, ...]

    @property
    def cities(self) -> tuple[str, ...]:
        """In the order of their places."""
        return tuple(dict.fromkeys(place.city for place in self.places))

    @property
    def photo_count(self) -> int:
        return sum(len(place.photos) for place in self.places)

    @cached_property
    def fingerprint(self) -> str:
        """sha256 over cities, place numbers and photo names in their order, not over sizes: half
        a million photos on a disk far away would take minutes."""
        digest = hashlib.sha256()
        _update_digest(digest, "training")
        for place in self.places:
            _update_digest(digest, f"{place.city} {place.place_id} {len(place.photos)}")
            for photo in place.photos:
                _update_digest(digest, photo.name)
        return digest.hexdigest()


def list_fingerprint(names: Iterable[str]) -> str:
    """sha256 over the names of a list in their order: what a ground truth is true of."""
    digest = hashlib.sha256()
    for name in names:
        _update_digest(digest, name)
    return digest.hexdigest()


def _update_digest(digest: hashlib._Hash, text: str) -> None:
    # A name may hold any character but NUL, so that NUL ends it beyond doubt.
    digest.update(text.encode("utf-8", "surrogateescape") + b"\0")


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return MISSING_FILE_BYTES


@dataclass(frozen=True, slots=True)
class PublishedResult:
    protocol: str
    fingerprint: str
    """`EvaluationSet.fingerprint` of the very set"""
    method: str
    recall: dict[int, float]
    """by k, 0 to 1"""
    source: str

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"recall": {str(k): share for k, share in self.recall.items()}}


PUBLISHED_RESULTS: tuple[PublishedResult, ...] = ()


def find_published_results(
    evaluation: EvaluationSet, known: tuple[PublishedResult, ...] = PUBLISHED_RESULTS
) -> tuple[PublishedResult, ...]:
    """What has been published of exactly this set."""
    return tuple(
        found
        for found in known
        if (found.protocol, found.fingerprint) == (evaluation.protocol, evaluation.fingerprint)
    )
