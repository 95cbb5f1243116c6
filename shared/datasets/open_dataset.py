"""Open a data set, whatever its layout: places to learn from, and sets to be measured on.

Looked at are the folder itself and the folders in it, and `images/` in each of these: so the same
call opens one data set, and a folder of several.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shared.datasets.dataset import DatasetPhoto, EvaluationSet, TrainingPlace, TrainingSet
from shared.datasets.ground_truth import find_positives, parse_rule
from shared.datasets.layouts import EVALUATION_LAYOUTS, TRAINING_LAYOUTS
from shared.datasets.layouts.base import EvaluationLayout, ListedSet, TrainingLayout
from shared.errors import InvalidRequest, NotFound

__all__ = [
    "DatasetPhoto",
    "DiscoveredSet",
    "EvaluationSet",
    "TrainingPlace",
    "TrainingSet",
    "evaluation_set_names",
    "find_evaluation_sets",
    "find_training_layout",
    "open_evaluation_set",
    "open_training_set",
]

PART_FOLDERS = frozenset({"database", "queries", "train", "val", "test", "train_val", "images"})
"""folders of a data set that are never a data set of their own"""
LAYOUTS_HELP = "docs/how-to/data-sets.md shows every layout."


@dataclass(frozen=True, slots=True)
class DiscoveredSet:
    """An evaluation set that is there to be opened."""

    name: str
    layout: EvaluationLayout
    base: Path
    key: str


def find_training_layout(root: Path) -> tuple[TrainingLayout, Path] | None:
    """The layout of the places to learn from, and the folder at or below `root` that has it."""
    for _, bases in _candidate_folders(root):
        for base in bases:
            for layout in TRAINING_LAYOUTS:
                if layout.recognises(base):
                    return layout, base
    return None


def open_training_set(
    root: Path, cities: Sequence[str] | None = None, *, min_photos: int = 2
) -> TrainingSet:
    """The places below `root` that have at least `min_photos` photos; no photo is opened.

    Cities in the order asked (upper or lower case is the same), all by name when None; only their
    tables are read. The i-th city's place numbers are its own plus `i * 10**5`; a city with
    numbers of 100,000 or more widens that step, for all cities, to the next power of ten.

    Raises NotFound (`no_training_set`, `city_missing`), InvalidRequest (`missing_column`,
    `bad_table`, `no_places`).
    """
    found = find_training_layout(_existing_folder(root))
    if found is None:
        raise NotFound(
            "no_training_set",
            f"{root} holds no places to learn from: neither gsv_xs (train/CITY and "
            f"dataframes/CITY.csv) nor GSV-Cities (Images/CITY and Dataframes/CITY.csv) nor a "
            f"train.csv. {LAYOUTS_HELP}",
        )
    layout, base = found
    opened = layout.open(base, cities, min_photos)
    if not opened.places:
        raise InvalidRequest(
            "no_places",
            f"No place of {base} ({', '.join(cities or layout.cities(base))}) has {min_photos} "
            "photos or more. Ask for fewer photos per place.",
        )
    return opened


def find_evaluation_sets(root: Path) -> tuple[DiscoveredSet, ...]:
    """Every evaluation set at or below `root`, by name.

    Of two layouts of one name in the same data set the first is taken: lists before folders. Data
    sets that share a name are told apart by a number: `city`, `city_2`.
    """
    found: dict[str, DiscoveredSet] = {}
    for home, bases in _candidate_folders(_existing_folder(root)):
        here: dict[str, DiscoveredSet] = {}
        prefix = set_prefix(home.resolve().name)
        for base in bases:
            for layout in EVALUATION_LAYOUTS:
                for name, key in layout.sets(base, prefix).items():
                    here.setdefault(name, DiscoveredSet(name, layout, base, key))
        for name, one in here.items():
            free = next(n for n in _numbered(name) if n not in found)
            found[free] = replace(one, name=free)
    return tuple(found[name] for name in sorted(found))


def evaluation_set_names(root: Path) -> tuple[str, ...]:
    """What `open_evaluation_set` takes as a name, in order."""
    return tuple(found.name for found in find_evaluation_sets(root))


def open_evaluation_set(
    root: Path, name: str | None = None, *, protocol: str | None = None, rule: str | None = None
) -> EvaluationSet:
    """One evaluation set; `name` may be left out where there is only one. No photo is opened,
    but for the EXIF of those whose position nothing else says.

    `rule` is `radius 25`, `heading 25 40`, `frames 5` or `place-label` (`parse_rule`); left out, it
    is the ground truth that the set brings, or else 25 m.

    Raises NotFound (`no_evaluation_set`, `set_missing`), InvalidRequest (`which_set`,
    `unknown_protocol`, `unknown_rule`, `no_positions`, `ground_truth_of_other_lists`, ...).
    """
    chosen = _choose_set(root, find_evaluation_sets(root), name)
    protocols = chosen.layout.protocols
    if protocol is not None and protocol not in protocols:
        raise InvalidRequest(
            "unknown_protocol",
            f"{chosen.name} ({chosen.layout.name}) has no protocol {protocol!r}. "
            f"Known are: {', '.join(protocols)}.",
        )
    meant = protocol or protocols[0]
    asked = parse_rule(rule) if rule is not None else None
    listed = chosen.layout.open(chosen.base, chosen.key, meant)
    for role, shots in (("database photo", listed.database), ("query", listed.queries)):
        if not shots:
            raise InvalidRequest("empty_set", f"{chosen.name} in {chosen.base} has no {role}.")
    return _make_evaluation_set(chosen, listed, meant, str(asked) if asked else None)


def _make_evaluation_set(
    chosen: DiscoveredSet, listed: ListedSet, protocol: str, rule: str | None
) -> EvaluationSet:
    if rule is None and listed.positives is not None:
        meant, positives = listed.rule, listed.positives
    else:
        asked = parse_rule(rule or listed.rule)
        meant = str(asked)
        positives = tuple(find_positives(asked, listed.queries, listed.database))
    queries = listed.queries
    if listed.drops_queries:
        kept = [number for number, found in enumerate(positives) if len(found)]
        queries = tuple(queries[number] for number in kept)
        positives = tuple(positives[number] for number in kept)
    return EvaluationSet(
        name=chosen.name,
        root=chosen.base,
        database=listed.database,
        queries=queries,
        positives=tuple(found.astype(np.int64, copy=False) for found in positives),
        rule=meant,
        protocol=protocol,
    )


def _choose_set(root: Path, found: Sequence[DiscoveredSet], name: str | None) -> DiscoveredSet:
    names = ", ".join(one.name for one in found)
    if not found:
        raise NotFound(
            "no_evaluation_set",
            f"{root} holds no set to measure on: neither database/ and queries/ nor lists as "
            f".npy nor another layout that is known. {LAYOUTS_HELP}",
        )
    if name is None:
        if len(found) > 1:
            raise InvalidRequest("which_set", f"{root} holds several sets: {names}. Name one.")
        return found[0]
    for one in found:
        if one.name == name:
            return one
    raise NotFound("set_missing", f"{root} has no set {name}. There are: {names}.")


def _candidate_folders(root: Path) -> Iterator[tuple[Path, list[Path]]]:
    """Folders that may be a data set, each with the folders in which its parts may lie."""
    children = sorted(
        child
        for child in root.iterdir()
        if child.is_dir() and child.name not in PART_FOLDERS and not child.name.startswith(".")
    )
    for home in (root, *children):
        images = home / "images"
        yield home, [home, images] if images.is_dir() else [home]


def _numbered(name: str) -> Iterator[str]:
    yield name
    for number in itertools.count(2):
        yield f"{name}_{number}"


def set_prefix(name: str) -> str:
    """`SF_XS` -> `sfxs`: so a folder's sets are called as the lists of the same data set are."""
    return re.sub(r"[^a-z0-9]", "", name.lower()) or "set"


def _existing_folder(root: Path) -> Path:
    if not root.is_dir():
        raise NotFound("no_data_set", f"There is no folder {root}.")
    return root
