"""NetVLAD's `dbStruct` in MATLAB files: the layout of Pitts30k and Pitts250k.

Its fields, in their order: whichSet, database names, database UTM, query names, query UTM, two
counts, the radius in metres. (Arandjelovic et al., NetVLAD, 2016; its Pittsburgh files)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lab.datasets.dataset import DatasetPhoto
from lab.datasets.layouts.base import EvaluationLayout, ListedSet
from shared.errors import InvalidRequest, Misconfigured

FIELDS = 8
"""From whichSet to posDistThr; later fields are not used"""
DATABASE_FOLDERS = (".", "images", "database", "..")
QUERY_FOLDERS = ("queries_real", ".", "images", "queries", "../queries_real", "..")


class DbStruct(EvaluationLayout):
    """Evaluation sets as dbStruct files."""

    name = "dbStruct .mat"

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        return {path.stem: path.name for path in sorted(base.glob("*.mat"))}

    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        path = base / key
        fields = list(_struct(path).values())
        if len(fields) < FIELDS:
            raise _bad_struct_error(
                path, f"its dbStruct has {len(fields)} fields, expected at least {FIELDS}"
            )
        try:
            radius = float(fields[7])
            database = _read_photos(base, DATABASE_FOLDERS, fields[1], fields[2])
            queries = _read_photos(base, QUERY_FOLDERS, fields[3], fields[4])
        except (TypeError, ValueError) as error:
            raise _bad_struct_error(path, str(error)) from error
        return ListedSet(database, queries, f"radius {radius:g} m")


def _struct(path: Path) -> dict[str, Any]:
    try:
        from scipy.io import loadmat
    except ImportError as error:
        raise Misconfigured(
            "lab_missing",
            f"Reading {path} requires SciPy, which is not installed. "
            "Run `make setup`, or in the repository: uv pip install '.[lab]'.",
        ) from error
    try:
        struct = loadmat(path, simplify_cells=True).get("dbStruct")
    except (OSError, ValueError, TypeError, NotImplementedError) as error:
        raise _bad_struct_error(path, str(error)) from error
    if not isinstance(struct, dict):
        raise _bad_struct_error(path, "it has no dbStruct")
    return struct


def _read_photos(
    base: Path, folders: Sequence[str], names: Any, utm: Any
) -> tuple[DatasetPhoto, ...]:
    listed = [str(name) for name in np.atleast_1d(names).tolist()]
    metres = np.asarray(utm, np.float64).reshape(2, -1)
    if metres.shape[1] != len(listed):
        raise ValueError(f"it has {len(listed)} names, but {metres.shape[1]} positions")
    folder = next(
        (base / name for name in folders if listed and (base / name / listed[0]).is_file()), base
    )
    return tuple(
        DatasetPhoto(folder / name, name, easting=east, northing=north)
        for name, (east, north) in zip(listed, metres.T.tolist(), strict=True)
    )


def _bad_struct_error(path: Path, reason: str) -> InvalidRequest:
    return InvalidRequest("bad_dbstruct", f"{path} can't be read as a dbStruct: {reason}.")
