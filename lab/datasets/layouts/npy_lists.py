"""Lists of paths and a ground truth as `.npy` files: `NAME_dbImages.npy` and its companion files.

Supports the names used by gsv-cities, OpenVPRLab, sf_xs and tokyo_xs. Ground truths are lists of
database indices, or tables of integers (SPED, ESSEX, Nordland). Photos are searched for beside the
lists, in `images/`, and in the parent folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lab.datasets.dataset import Indices
from lab.datasets.ground_truth_files import read_ground_truth, read_names
from lab.datasets.layouts.base import DEFAULT_RULE, EvaluationLayout, ListedSet
from lab.datasets.photo_lists import photos_of_names
from shared.errors import InvalidRequest

QUERY_LIST_SUFFIXES = {"_dbImages": "_qImages", "_ref_image_names": "_query_image_names"}
"""Suffix of the list of queries, by the suffix of the list of the database"""
GROUND_TRUTH_SUFFIXES = (
    "_gtImages",
    "_gt",
    "_gt_25m",
    "_ground_truth",
    "_ground_truth_25m",
    "_pIdx",
)
QUERY_INDEX_SUFFIX = "_qIdx"
"""Of MSLS in gsv-cities: indices of the queries that are used; the ground truth is for these"""


class NpyLists(EvaluationLayout):
    """Evaluation sets as `.npy` lists."""

    name = "npy lists"

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        return {
            path.name.removesuffix(f"{suffix}.npy"): path.name
            for suffix in QUERY_LIST_SUFFIXES
            for path in sorted(base.glob(f"*{suffix}.npy"))
            if not path.name.startswith((".", "_"))
        }

    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        suffix = next(suffix for suffix in QUERY_LIST_SUFFIXES if key.endswith(f"{suffix}.npy"))
        name = key.removesuffix(f"{suffix}.npy")
        database = read_names(base / key)
        query_list = base / f"{name}{QUERY_LIST_SUFFIXES[suffix]}.npy"
        queries = _chosen_queries(base, name, read_names(query_list))
        folder = _folder_of(base, database)
        truth = _find_ground_truth(base, name)
        positives: list[Indices] | None = None
        rule = DEFAULT_RULE
        if truth is not None:
            positives, rule = read_ground_truth(truth, database=database, queries=queries)
        return ListedSet(
            photos_of_names(folder, database), photos_of_names(folder, queries), rule, positives
        )


def _chosen_queries(base: Path, name: str, queries: list[str]) -> list[str]:
    path = base / f"{name}{QUERY_INDEX_SUFFIX}.npy"
    if not path.is_file():
        return queries
    try:
        chosen = np.load(path, allow_pickle=False)
        return [queries[number] for number in chosen.astype(np.int64).ravel().tolist()]
    except (OSError, ValueError, EOFError, IndexError) as error:
        raise InvalidRequest(
            "bad_list", f"{path} is not a list of indices of the {len(queries)} queries: {error}."
        ) from error


def _find_ground_truth(base: Path, name: str) -> Path | None:
    paths = (base / f"{name}{suffix}.npy" for suffix in GROUND_TRUTH_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def _folder_of(base: Path, names: Sequence[str]) -> Path:
    """Return the folder of a list's photos; if none has them, `base`, so they count as missing."""
    for folder in (base, base / "images", base.parent):
        if names and (folder / names[0]).is_file():
            return folder
    return base
