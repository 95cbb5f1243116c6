"""Lists of paths and a ground truth as `.npy` files: `NAME_dbImages.npy` and its companions.

The same idea has gone by several names (gsv-cities, OpenVPRLab, sf_xs and tokyo_xs): each is known
here. Ground truths are lists of database indices, or tables of integers (SPED, ESSEX, Nordland).
Photos lie beside the lists, in `images/`, or in the folder above.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from shared.datasets.dataset import DatasetPhoto, Indices
from shared.datasets.ground_truth_files import read_ground_truth, read_names
from shared.datasets.layouts.base import DEFAULT_RULE, PLACEWISE_PROTOCOL, ListedSet
from shared.datasets.photo_lists import photo_from_filename
from shared.errors import InvalidRequest

QUERY_LIST_SUFFIXES = {"_dbImages": "_qImages", "_ref_image_names": "_query_image_names"}
"""the end of a list of queries, by that of its list of the database"""
GROUND_TRUTH_SUFFIXES = (
    "_gtImages",
    "_gt",
    "_gt_25m",
    "_ground_truth",
    "_ground_truth_25m",
    "_pIdx",
)
QUERY_INDEX_SUFFIX = "_qIdx"
"""of MSLS in gsv-cities: which queries of the list are asked; the ground truth is of these"""


class NpyLists:
    name = "npy lists"
    protocols = (PLACEWISE_PROTOCOL,)

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        return {
            path.name.removesuffix(f"{end}.npy"): path.name
            for end in QUERY_LIST_SUFFIXES
            for path in sorted(base.glob(f"*{end}.npy"))
            if not path.name.startswith((".", "_"))
        }

    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        end = next(end for end in QUERY_LIST_SUFFIXES if key.endswith(f"{end}.npy"))
        name = key.removesuffix(f"{end}.npy")
        database = read_names(base / key)
        queries = _listed_queries(
            base, name, read_names(_existing_file(base / f"{name}{QUERY_LIST_SUFFIXES[end]}.npy"))
        )
        folder = _folder_of(base, database)
        truth = _find_ground_truth(base, name)
        positives: tuple[Indices, ...] | None = None
        rule = DEFAULT_RULE
        if truth is not None:
            rows, said = read_ground_truth(truth, database=database, queries=queries)
            positives, rule = tuple(rows), said or f"given by {truth.name}"
        return ListedSet(_shots(folder, database), _shots(folder, queries), rule, positives)


def _listed_queries(base: Path, name: str, queries: list[str]) -> list[str]:
    path = base / f"{name}{QUERY_INDEX_SUFFIX}.npy"
    if not path.is_file():
        return queries
    try:
        chosen = np.load(path, allow_pickle=False)
        return [queries[number] for number in chosen.astype(np.int64).ravel().tolist()]
    except (OSError, ValueError, EOFError, IndexError) as error:
        raise InvalidRequest(
            "bad_list", f"{path} does not choose of {len(queries)} queries: {error}."
        ) from error


def _find_ground_truth(base: Path, name: str) -> Path | None:
    paths = (base / f"{name}{end}.npy" for end in GROUND_TRUTH_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def _existing_file(path: Path) -> Path:
    if not path.is_file():
        raise InvalidRequest("bad_list", f"There is no list of queries {path}.")
    return path


def _folder_of(base: Path, names: Sequence[str]) -> Path:
    """Where the photos of the list are; beside it, where they are nowhere: so they are missed."""
    for folder in (base, base / "images", base.parent):
        if names and (folder / names[0]).is_file():
            return folder
    return base


def _shots(folder: Path, names: Sequence[str]) -> tuple[DatasetPhoto, ...]:
    # Joined as paths: a list's names may or may not begin with a slash, and no folder needs to end
    # in one.
    return tuple(photo_from_filename(folder / name.lstrip("/"), name) for name in names)
