"""Opens datasets of any layout: training sets and evaluation sets.

Searches a folder, its subfolders, and `images/` in each of them, so that the same functions open
one dataset or a folder of several.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lab.datasets.dataset import PHOTO_TABLE_HEADER, EvaluationSet, TrainingSet
from lab.datasets.ground_truth import find_positives, parse_rule
from lab.datasets.layouts.base import EvaluationLayout, TrainingLayout
from lab.datasets.layouts.csv_tables import CsvTables, CsvTrainingTable
from lab.datasets.layouts.dbstruct import DbStruct
from lab.datasets.layouts.folder_pairs import RIDES, SEASONS, FolderPairs
from lab.datasets.layouts.gsv_cities import GsvCities, GsvXs
from lab.datasets.layouts.msls import Msls
from lab.datasets.layouts.npy_lists import NpyLists
from lab.datasets.layouts.vpr_bench import VprBench
from shared.errors import InvalidRequest, NotFound

# In the order in which they are tried. Lists come before folders: if a dataset has both, the lists
# have the ground truth.
TRAINING_LAYOUTS: tuple[TrainingLayout, ...] = (GsvXs(), GsvCities(), CsvTrainingTable())
EVALUATION_LAYOUTS: tuple[EvaluationLayout, ...] = (
    NpyLists(), DbStruct(), Msls(), CsvTables(), FolderPairs(), VprBench(),
)  # fmt: skip
PART_FOLDERS = frozenset(
    {
        *("database", "queries", "queries_v1", "queries_v2"),
        *("ref", "query"),
        *("train", "val", "test", "train_val", "images"),
        *(RIDES, *SEASONS),
    }
)
"""Subfolders of datasets that are never datasets of their own"""
LAYOUTS_HELP = "See docs/how-to/data-sets.md for all layouts."


@dataclass(frozen=True, slots=True)
class DiscoveredSet:
    """An evaluation set that was found in a folder."""

    name: str
    layout: EvaluationLayout
    base: Path
    key: str


def find_training_layout(root: Path) -> tuple[TrainingLayout, Path] | None:
    """Return the layout of the training set at or below `root`, and its folder."""
    for _, bases in _candidate_folders(root):
        for base in bases:
            for layout in TRAINING_LAYOUTS:
                if layout.recognises(base):
                    return layout, base
    return None


def open_training_set(
    root: Path, cities: Sequence[str] | None = None, *, min_photos: int = 2
) -> TrainingSet:
    """Open the training set at or below `root`, without opening photos.

    The i-th city's place ids are its own plus `i * 10**5`. If any city has ids of 100,000 or more,
    the step of all cities is the next power of ten.

    Args:
        root: Folder of the dataset, or of several.
        cities: Cities to open, in this order, case-insensitive; None opens all, sorted by name.
            Only their tables are read.
        min_photos: Places with fewer photos are left out.

    Raises:
        NotFound: `no_training_set`, `city_missing`.
        InvalidRequest: `missing_column`, `bad_table`, `no_places`.
    """
    located = find_training_layout(_existing_folder(root))
    if located is None:
        raise NotFound(
            "no_training_set",
            f"{root} contains no training set: neither gsv_xs (train/CITY and "
            f"dataframes/CITY.csv) nor GSV-Cities (Images/CITY and Dataframes/CITY.csv) nor a "
            f"train.csv. {LAYOUTS_HELP}",
        )
    layout, base = located
    opened = layout.open(base, cities, min_photos)
    if not opened.places:
        raise InvalidRequest(
            "no_places",
            f"No place of {base} ({', '.join(cities or layout.cities(base))}) has {min_photos} "
            "photos or more. Lower the minimum of photos per place.",
        )
    return opened


def find_evaluation_sets(root: Path) -> tuple[DiscoveredSet, ...]:
    """Find all evaluation sets at or below `root`, sorted by name.

    If two layouts of the same dataset define a set of the same name, the first one wins: lists
    before folders. Sets of the same name in different datasets get a number: `city`, `city_2`.
    """
    sets: dict[str, DiscoveredSet] = {}
    for home, bases in _candidate_folders(_existing_folder(root)):
        folder_sets: dict[str, DiscoveredSet] = {}
        prefix = _set_prefix(home.resolve().name)
        for base in bases:
            for layout in EVALUATION_LAYOUTS:
                for name, key in layout.sets(base, prefix).items():
                    folder_sets.setdefault(name, DiscoveredSet(name, layout, base, key))
        for name, discovered in folder_sets.items():
            numbered = (name if n == 1 else f"{name}_{n}" for n in itertools.count(1))
            unique = next(each for each in numbered if each not in sets)
            sets[unique] = replace(discovered, name=unique)
    return tuple(sets[name] for name in sorted(sets))


def evaluation_set_names(root: Path) -> tuple[str, ...]:
    """Return the names of all evaluation sets at or below `root`, sorted."""
    return tuple(discovered.name for discovered in find_evaluation_sets(root))


def open_evaluation_set(
    root: Path, name: str | None = None, *, protocol: str | None = None, rule: str | None = None
) -> EvaluationSet:
    """Open an evaluation set; photos are opened only to read a missing position from EXIF.

    Args:
        root: Folder of the dataset, or of several.
        name: Name of the set; optional if there is only one.
        protocol: One of the layout's protocols; None for its first one.
        rule: `radius 25`, `heading 25 40`, `frames 5` or `place-label` (see `parse_rule`); None for
            the ground truth of the set, or else 25 m.

    Raises:
        NotFound: `no_evaluation_set`, `set_missing`.
        InvalidRequest: `which_set`, `unknown_protocol`, `unknown_rule`, `no_positions`,
            `ground_truth_of_other_lists` and others.
    """
    chosen = _choose_set(root, find_evaluation_sets(root), name)
    protocols = chosen.layout.protocols
    if protocol is not None and protocol not in protocols:
        raise InvalidRequest(
            "unknown_protocol",
            f"{chosen.name} ({chosen.layout.name}) has no protocol {protocol!r}. "
            f"Valid protocols: {', '.join(protocols)}.",
        )
    given_rule = parse_rule(rule) if rule is not None else None
    listed = chosen.layout.open(chosen.base, chosen.key, protocol or protocols[0])
    for role, photos in (("database photo", listed.database), ("query", listed.queries)):
        if not photos:
            raise InvalidRequest("empty_set", f"{chosen.name} in {chosen.base} has no {role}.")
    queries, positives, applied_rule = listed.queries, listed.positives, listed.rule
    if given_rule is not None or positives is None:
        computed_rule = given_rule or parse_rule(listed.rule)
        positives = find_positives(computed_rule, queries, listed.database)
        applied_rule = str(computed_rule)
    if listed.drops_queries:
        kept = [index for index, rows in enumerate(positives) if len(rows)]
        queries = tuple(queries[index] for index in kept)
        positives = [positives[index] for index in kept]
    return EvaluationSet(
        name=chosen.name,
        root=chosen.base,
        database=listed.database,
        queries=queries,
        positives=tuple(positives),
        rule=applied_rule,
        protocol=protocol or protocols[0],
        paired_by=listed.paired_by,
    )


def _choose_set(root: Path, sets: Sequence[DiscoveredSet], name: str | None) -> DiscoveredSet:
    names = ", ".join(discovered.name for discovered in sets)
    if not sets:
        raise NotFound(
            "no_evaluation_set",
            f"{root} contains no evaluation set: neither database/ and queries/ nor ref/, "
            "query/ and ground_truth_new.npy nor .npy lists nor database.csv and queries.csv "
            f"({PHOTO_TABLE_HEADER}) nor another known layout. {LAYOUTS_HELP}",
        )
    if name is None:
        if len(sets) > 1:
            raise InvalidRequest(
                "which_set", f"{root} contains several evaluation sets: {names}. Name one of them."
            )
        return sets[0]
    for discovered in sets:
        if discovered.name == name:
            return discovered
    raise NotFound("set_missing", f"{root} has no evaluation set {name}. Available: {names}.")


def _candidate_folders(root: Path) -> Iterator[tuple[Path, list[Path]]]:
    """Yield folders that may be a dataset, each with the folders to search for its parts."""
    children = sorted(
        child
        for child in root.iterdir()
        if child.is_dir() and child.name not in PART_FOLDERS and not child.name.startswith(".")
    )
    for home in (root, *children):
        images = home / "images"
        yield home, [home, images] if images.is_dir() else [home]


def _set_prefix(name: str) -> str:
    """Return the prefix of a folder's set names: `SF_XS` -> `sfxs`, as in lists of that dataset."""
    return re.sub(r"[^a-z0-9]", "", name.lower()) or "set"


def _existing_folder(root: Path) -> Path:
    if not root.is_dir():
        raise NotFound("no_data_set", f"The folder {root} does not exist.")
    return root
