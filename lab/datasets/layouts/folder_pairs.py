"""Folder layout: `database/` and `queries/`, also in each of `train/`, `val/` and `test/`.

Several query sets share a database as `queries_v1/`, `queries_v2/` (SF-XL). Beside `database/`,
`rides/` may have one folder for each sequence: the set `NAME_rides`. Two folders of seasons, such
as `summer/` and `winter/`, are two rides along the same way, as in Nordland (Suenderhauf et al.
2013): the first is the database, and photos of about the same number show the same place. That is
the number in their names where both seasons have it, or else the position in the sorted folder. In
`database/` and `queries/` with as many photos each, without positions, labels and numbers in file
names, photos are numbered as well, for the rule `frames 10`.

Positions come from `@UTM@` file names, or from EXIF if no name has one. Subfolders of `database/`
and `queries/` are place labels. An optional list `NAME_images_paths.txt` beside a folder `NAME`,
one path per line relative to the dataset, defines the set and its order. (VPR-methods-evaluation,
deep-visual-geo-localization-benchmark)
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lab.datasets.dataset import DatasetPhoto
from lab.datasets.layouts.base import (
    DEFAULT_RULE,
    PLACEWISE_PROTOCOL,
    EvaluationLayout,
    ListedSet,
    photos_below,
)
from lab.datasets.photo_lists import locate_photos, photo_from_filename, read_lines
from shared.errors import InvalidRequest

SPLITS = ("train", "val", "test")
RIDES = "rides"
SEASONS = ("summer", "spring", "fall", "autumn", "winter")
"""Names of folders of one season each; the database is the first one that exists"""
SAME_INDEX_RULE = "frames 10"
MIN_COMMON_SHARE = 0.5
"""Share of the shorter season's numbers that the other one has, too; counters of days differ"""
VME_PROTOCOL = "vme"
"""Protocol of VPR-methods-evaluation: compares metres of different zones as if of one zone"""


class FolderPairs(EvaluationLayout):
    """Evaluation sets as pairs of folders, named by dataset folder, split and query version."""

    name = "database and queries folders"
    protocols = (PLACEWISE_PROTOCOL, VME_PROTOCOL)

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        homes = {prefix: base, **{f"{prefix}_{split}": base / split for split in SPLITS}}
        pairs = {
            f"{name}{queries.name.removeprefix('queries')}": queries.relative_to(base).as_posix()
            for name, home in homes.items()
            if (home / "database").is_dir()
            for queries in (home / "queries", *sorted(home.glob("queries_v[0-9]*")))
            if queries.is_dir()
        }
        if (base / "database").is_dir() and (base / RIDES).is_dir():
            pairs[f"{prefix}_{RIDES}"] = RIDES
        return pairs | {f"{prefix}_{season}": season for season in _seasons(base)[1:]}

    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        if key == RIDES:
            photos = _read_photos(base / "database", base)
            return ListedSet(photos, _read_rides(base), _default_rule(photos))
        if key in SEASONS:
            pair = (_seasons(base)[0], key)
            return _pair_seasons(*(_read_photos(base / season, base) for season in pair))
        folder = base / key
        database, queries = (
            _read_photos(photos, base) for photos in (folder.with_name("database"), folder)
        )
        if len(database) == len(queries) and not any(map(_is_placed, database + queries)):
            database, queries = _number(database), _number(queries)
        if protocol == VME_PROTOCOL:
            database, queries = (
                tuple(replace(photo, zone=None) for photo in photos)
                for photos in (database, queries)
            )
        return ListedSet(database, queries, _default_rule(database + queries))


def _is_placed(photo: DatasetPhoto) -> bool:
    """Whether a photo has a position, a label, or a number in its file name."""
    return any(value is not None for value in (photo.easting, photo.place, photo.frame))


def _seasons(base: Path) -> list[str]:
    return [season for season in SEASONS if (base / season).is_dir()]


def _read_rides(base: Path) -> tuple[DatasetPhoto, ...]:
    """Read the folders of rides: frames in the order of capture time, or else of name."""
    frames: list[DatasetPhoto] = []
    for folder in sorted(path for path in (base / RIDES).iterdir() if path.is_dir()):
        photos = [replace(photo, place=None) for photo in _read_photos(folder, base)]
        if all(photo.captured_at is not None for photo in photos):
            photos.sort(key=lambda photo: str(photo.captured_at))
        frames += [replace(photo, sequence=folder.name) for photo in _number(photos)]
    return tuple(frames)


def _number(
    photos: Sequence[DatasetPhoto], numbers: Sequence[int] = ()
) -> tuple[DatasetPhoto, ...]:
    """Number photos by their order if there are no `numbers`."""
    pairs = zip(photos, numbers or range(len(photos)), strict=True)
    return tuple(replace(photo, frame=number) for photo, number in pairs)


def _pair_seasons(before: Sequence[DatasetPhoto], after: Sequence[DatasetPhoto]) -> ListedSet:
    """Number the photos of two seasons by their names, or by their positions."""
    pairs = itertools.product(_name_numbers(before), _name_numbers(after))
    best = max(pairs, key=lambda pair: len(set(pair[0]).intersection(pair[1])), default=((), ()))
    common = len(set(best[0]).intersection(best[1]))
    if not common or common < MIN_COMMON_SHARE * min(len(before), len(after)):
        best, paired_by = ((), ()), "their positions in the sorted folders"
    else:
        paired_by = "the number in their names"
        first, *others = sorted({*best[0], *best[1]})
        # Names may count in tens or in milliseconds; a rule counts frames.
        step = math.gcd(*(number - first for number in others)) or 1
        best = (
            tuple((number - first) // step for number in best[0]),
            tuple((number - first) // step for number in best[1]),
        )
    numbered = _number(before, best[0]), _number(after, best[1])
    return ListedSet(*numbered, SAME_INDEX_RULE, paired_by=paired_by)


def _name_numbers(photos: Sequence[DatasetPhoto]) -> Iterator[tuple[int, ...]]:
    """Yield the first, the second, ... numbers in the photos' names, if each photo has its own."""
    found = [re.findall(r"\d{1,15}", photo.path.stem) for photo in photos]
    for column in zip(*found, strict=False):  # as far as all names have numbers
        numbers = tuple(map(int, column))
        if len(set(numbers)) == len(photos):
            yield numbers


def _default_rule(photos: tuple[DatasetPhoto, ...]) -> str:
    """Use place labels if no photo has a position but some have a label."""
    if all(photo.easting is None for photo in photos) and any(photo.place for photo in photos):
        return "place-label"
    return DEFAULT_RULE


def _read_photos(folder: Path, base: Path) -> tuple[DatasetPhoto, ...]:
    photos = [
        photo_from_filename(path, path.relative_to(base).as_posix(), _place(path, folder))
        for path in _paths(folder)
    ]
    # EXIF is read only if no name has a position: it takes long on a network disk
    has_positions = any(photo.easting is not None for photo in photos)
    return tuple(photos) if has_positions else locate_photos(photos)


def _place(path: Path, folder: Path) -> str | None:
    place = path.parent.relative_to(folder).as_posix()
    return None if place == "." else place


def _paths(folder: Path) -> list[Path]:
    listing = folder.with_name(f"{folder.name}_images_paths.txt")
    if not listing.is_file():
        return photos_below(folder)
    roots = (folder.parent, folder, folder.parent.parent)
    paths = read_lines(listing)
    for root in roots:
        if paths and (root / paths[0]).exists():
            return [root / line for line in paths]
    raise InvalidRequest(
        "bad_list",
        f"{listing}: its first path, {paths[0] if paths else 'nothing'}, is in none of "
        f"{', '.join(map(str, roots))}. Correct the list, or remove it to use all photos of "
        f"{folder}.",
    )
