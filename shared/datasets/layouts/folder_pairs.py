"""Two folders, `database/` and `queries/`: alone, or in `train/`, `val/` and `test/` each.

Positions stand in `@UTM@` file names, or in EXIF where no name has one. Photos in folders of their
own below `database/` and `queries/` have the folder as their place. Beside a folder `NAME` there
may be a list `NAME_images_paths.txt`, one path a line from the data set on: then it is the set, in
its order. (VPR-methods-evaluation, deep-visual-geo-localization-benchmark)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from shared.datasets.dataset import DatasetPhoto
from shared.datasets.layouts.base import DEFAULT_RULE, PLACEWISE_PROTOCOL, ListedSet, photos_below
from shared.datasets.photo_lists import add_exif_positions, photo_from_filename
from shared.datasets.utm_coordinates import add_utm_positions
from shared.errors import InvalidRequest

SPLITS = ("train", "val", "test")
VME_PROTOCOL = "vme"
"""VPR-methods-evaluation's: metres of different zones are compared as if they were of one"""


class FolderPairs:
    """`sets` names a pair after its folder and its split."""

    name = "database and queries folders"
    protocols = (PLACEWISE_PROTOCOL, VME_PROTOCOL)

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        found = {f"{prefix}_{split}": split for split in SPLITS if _is_pair(base / split)}
        return {prefix: ".", **found} if _is_pair(base) else found

    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        folder = base / key
        database, queries = (_shots(folder / name, base) for name in ("database", "queries"))
        if protocol == VME_PROTOCOL:
            database, queries = (
                tuple(replace(shot, zone=None) for shot in shots) for shots in (database, queries)
            )
        return ListedSet(database, queries, _natural_rule(database + queries))


def _is_pair(folder: Path) -> bool:
    return (folder / "database").is_dir() and (folder / "queries").is_dir()


def _natural_rule(shots: tuple[DatasetPhoto, ...]) -> str:
    """Photos that nobody has placed on a map may still lie in folders of places."""
    if all(shot.easting is None for shot in shots) and any(shot.place for shot in shots):
        return "place-label"
    return DEFAULT_RULE


def _shots(folder: Path, base: Path) -> tuple[DatasetPhoto, ...]:
    shots = [
        photo_from_filename(path, path.relative_to(base).as_posix(), _place(path, folder))
        for path in _paths(folder)
    ]
    if any(shot.easting is not None for shot in shots):
        return tuple(shots)
    return add_utm_positions(add_exif_positions(shots))


def _place(path: Path, folder: Path) -> str | None:
    place = path.parent.relative_to(folder).as_posix()
    return None if place == "." else place


def _paths(folder: Path) -> list[Path]:
    listing = folder.with_name(f"{folder.name}_images_paths.txt")
    if not listing.is_file():
        return photos_below(folder)
    lines = [line.strip() for line in listing.read_text(encoding="utf-8").splitlines()]
    roots = (folder.parent, folder, folder.parent.parent)
    named = [line for line in lines if line]
    for root in roots:
        if named and (root / named[0]).exists():
            return [root / line for line in named]
    raise InvalidRequest(
        "bad_list",
        f"{listing}: its first path, {named[0] if named else 'nothing'}, is in none of "
        f"{', '.join(map(str, roots))}. Correct the list, or take it away: then all photos of "
        f"{folder} count.",
    )
