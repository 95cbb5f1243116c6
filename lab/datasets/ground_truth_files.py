"""Ground truth files: positives in `.npy` files, and the sidecar that identifies their lists.

Rows are indices into two lists of photos, so they are invalid for the same photos in another order.
Beside `gt.npy`, `gt.json` stores the fingerprints of both lists; other lists are rejected.

The published ground truths are object arrays of lists, which NumPy stores as pickles, and loading
an untrusted pickle can run any program. The unpickler here accepts only the names that NumPy writes
for arrays, dtypes and scalars, and maps each of them to a stand-in class that only stores its
arguments. The result is lists of integers, or an error.
"""

from __future__ import annotations

import contextlib
import math
import pickle
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from pydantic import BaseModel

from lab.datasets.dataset import Indices, list_fingerprint
from shared.errors import InvalidRequest, PlacewiseError

INTEGER_KINDS = "iub"
PADDING = -1
"""Fills unused cells in tables of fixed width"""


def write_integer_lists(path: Path, lists: Sequence[Indices]) -> None:
    """Write an object array (n,) of Python lists of ints, as `np.save` with pickles does."""
    rows = np.empty(len(lists), object)
    for index, indices in enumerate(lists):
        rows[index] = indices.tolist()
    with path.open("wb") as file:
        np.save(file, rows, allow_pickle=True)


def read_integer_lists(path: Path) -> list[Indices]:
    """Read one ascending array of unique integers for each row, without running the file's pickle.

    Accepts an object array (n,) of lists or arrays of integers, an integer array (n, k) with
    PADDING in shorter rows, and an integer array (n,) with one integer for each row.

    Raises InvalidRequest (`bad_ground_truth`) for anything else.
    """
    with _refusing_bad_files(path):
        return [_row(value, path) for value in _stored_rows(path)]


def read_numbered_ground_truth(
    path: Path, *, database: Sequence[str], queries: Sequence[str]
) -> list[Indices]:
    """Read a ground truth of VPR-Bench, (n, 2) objects: a query's number and its database indices.

    `database` and `queries` are the names of the photos, in order; queries without a row have no
    positives. Raises InvalidRequest: `bad_ground_truth`, `ground_truth_of_other_lists`.
    """
    positives = [np.empty(0, np.int64) for _ in queries]
    with _refusing_bad_files(path):
        for number, indices in _stored_rows(path):
            (query,), rows = _row(number, path).tolist(), _row(indices, path)
            if query >= len(queries):
                raise _mismatch_error(
                    path, f"it has a row for query {query} of {len(queries)}, counted from 0"
                )
            positives[query] = rows
    _check_indices(path, positives, database)
    return positives


_BROKEN_PICKLE_ERRORS = (
    TypeError, AttributeError, LookupError, OverflowError, RecursionError, MemoryError,
)  # fmt: skip
"""What the unpickler raises for damaged and malicious pickles, beside its own errors"""


@contextlib.contextmanager
def _refusing_bad_files(path: Path) -> Iterator[None]:
    """Convert the errors of damaged and malicious files to `bad_ground_truth`."""
    try:
        yield
    except (OSError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise _bad_ground_truth_error(path, str(error)) from error
    except _BROKEN_PICKLE_ERRORS as error:
        reason = f"its pickle is broken ({type(error).__name__})"
        raise _bad_ground_truth_error(path, reason) from error


def _stored_rows(path: Path) -> list[Any]:
    with path.open("rb") as file:
        dtype, shape = _header(file)
        if dtype.kind in INTEGER_KINDS:
            file.seek(0)
            return _table(np.load(file, allow_pickle=False))
        if dtype != np.dtype(object):
            raise ValueError(f"it contains {dtype}, expected lists of integers")
        return _unpickle(file, shape)


def read_names(path: Path) -> list[str]:
    """Read a one-dimensional `.npy` array of strings.

    Raises InvalidRequest (`bad_list`) for other files.
    """
    try:
        with path.open("rb") as file:
            dtype, _ = _header(file)
            if dtype.kind not in "US":
                raise ValueError(f"it contains {dtype}, expected strings")
            file.seek(0)
            names = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError, MemoryError) as error:
        raise InvalidRequest("bad_list", f"{path} is not a .npy list of paths: {error}.") from error
    if names.ndim != 1:
        raise InvalidRequest("bad_list", f"{path} has the shape {names.shape}, expected (n,).")
    return [str(name) for name in names.astype(str).tolist()]


def _header(file: BinaryIO) -> tuple[np.dtype[Any], tuple[int, ...]]:
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    version = npy.read_magic(file)
    if version not in readers:
        raise ValueError(f"its format version {version} is unknown")
    shape, _, dtype = readers[version](file)
    return dtype, shape


def _table(rows: np.ndarray[Any, Any]) -> list[Any]:
    if rows.ndim not in (1, 2):
        raise ValueError(f"its shape is {rows.shape}, expected (n, k)")
    table = rows.reshape(len(rows), -1).astype(np.int64)
    return [row[row != PADDING] for row in table]


def _row(value: Any, path: Path) -> Indices:
    if isinstance(value, _Array):
        value = value.values()
    if not isinstance(value, list | tuple | np.ndarray):
        value = [value]
    indices = [item.value() if isinstance(item, _Scalar) else item for item in value]
    if not all(isinstance(index, int | np.integer) and index >= 0 for index in indices):
        raise _bad_ground_truth_error(path, "a row contains values that are not indices from 0")
    return np.unique(np.array(indices, np.int64))


def _unpickle(file: BinaryIO, shape: tuple[int, ...]) -> list[Any]:
    """Unpickle an object array of the shape that its header declares; return its rows."""
    array = _Unpickler(file, encoding="latin1").load()
    if not isinstance(array, _Array) or array.fortran or len(shape) not in (1, 2):
        raise ValueError(f"it is not a list of lists; its shape is {shape}")
    values = array.values()
    if len(values) != math.prod(shape):
        raise ValueError(f"it declares {math.prod(shape)} values and contains {len(values)}")
    if len(shape) == 1:
        return values
    # NumPy stores lists of equal length as a table.
    return [values[start : start + shape[1]] for start in range(0, len(values), shape[1] or 1)]


def _bad_ground_truth_error(path: Path, reason: str) -> InvalidRequest:
    return InvalidRequest(
        "bad_ground_truth",
        f"{path} is not a ground truth: {reason}. Use an array of lists of database indices, as "
        "written by `placewise datasets ground-truth`.",
    )


class _Array:
    """Stand-in for an array, until it is known to contain integers or lists."""

    def __init__(self, *_: object) -> None:
        self.data: object = []
        self.dtype: _Dtype | None = None
        self.fortran = False

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, _, self.dtype, self.fortran, self.data = state

    def values(self) -> list[Any]:
        if isinstance(self.data, list):
            return self.data
        if self.dtype is None:
            raise ValueError("an array in it has no type")
        values: list[int] = np.frombuffer(_as_bytes(self.data), self.dtype.integers()).tolist()
        return values


class _Dtype:
    """Stand-in for a dtype: a name such as `i8`, and the byte order from its state."""

    def __init__(self, name: str, *_: object) -> None:
        self.name = name
        self.order = "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = str(state[1])

    def integers(self) -> np.dtype[Any]:
        if not isinstance(self.name, str) or self.name[:1] not in INTEGER_KINDS:
            raise ValueError(f"an array in it contains {self.name!r}, expected integers")
        return np.dtype(f"{self.order if self.order in '<>' else '='}{self.name}")


class _Scalar:
    """Stand-in for a NumPy scalar."""

    def __init__(self, dtype: _Dtype, data: object) -> None:
        self.dtype = dtype
        self.data = data

    def value(self) -> int:
        (value,) = np.frombuffer(_as_bytes(self.data), self.dtype.integers()).tolist()
        return int(value)


def _as_bytes(data: object) -> bytes:
    if isinstance(data, str):  # how protocols before 3 encode bytes
        return data.encode("latin1")
    if isinstance(data, bytes | bytearray):
        return bytes(data)
    raise ValueError("an array in it has no data")


class _Unpickler(pickle.Unpickler):
    """Resolves names to stand-ins, and rejects all others."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _STAND_INS:
            return _STAND_INS[module, name]
        raise pickle.UnpicklingError(f"its pickle refers to {module}.{name}, which is not allowed")


_STAND_INS: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): lambda text, _: text.encode("latin1"),
    ("builtins", "bytes"): lambda: b"",
    ("__builtin__", "bytes"): lambda: b"",  # its name in protocols before 3
    **{
        (f"numpy.{core}.multiarray", name): stand_in
        for core in ("core", "_core")
        for name, stand_in in (("_reconstruct", _Array), ("scalar", _Scalar))
    },
}


class _ListIdentity(BaseModel):
    count: int
    sha256: str


class _Sidecar(BaseModel):
    """Content of the `.json` file beside a ground truth."""

    made_by: str = "placewise datasets ground-truth"
    rule: str
    database: _ListIdentity
    queries: _ListIdentity


def write_ground_truth(
    path: Path,
    positives: Sequence[Indices],
    *,
    database: Sequence[str],
    queries: Sequence[str],
    rule: str,
) -> None:
    """Write a ground truth, `.npy`, and its sidecar with the rule and the lists' fingerprints.

    `database` and `queries` are the names of the photos, in order.
    """
    write_integer_lists(path, positives)
    sidecar = _Sidecar(
        rule=rule,
        database=_ListIdentity(count=len(database), sha256=list_fingerprint(database)),
        queries=_ListIdentity(count=len(queries), sha256=list_fingerprint(queries)),
    )
    sidecar_path(path).write_text(sidecar.model_dump_json(indent=1) + "\n", encoding="utf-8")


def read_ground_truth(
    path: Path, *, database: Sequence[str], queries: Sequence[str]
) -> tuple[list[Indices], str]:
    """Read a ground truth and check that it belongs to these lists of names, in their order.

    Returns the positives of each query, and the rule: that of the sidecar, or `given by gt.npy`.
    Raises InvalidRequest: `bad_ground_truth`, `ground_truth_of_other_lists`.
    """
    positives = read_integer_lists(path)
    rule = _check_sidecar(path, database, queries) or f"given by {path.name}"
    if len(positives) != len(queries):
        raise _mismatch_error(path, f"it has {len(positives)} rows for {len(queries)} queries")
    _check_indices(path, positives, database)
    return positives, rule


def _check_indices(path: Path, positives: Sequence[Indices], database: Sequence[str]) -> None:
    largest = max((int(row[-1]) for row in positives if len(row)), default=-1)
    if largest >= len(database):
        raise _mismatch_error(
            path, f"it contains the index {largest}, but the database has {len(database)} photos"
        )


def sidecar_path(path: Path) -> Path:
    """Return the path of a ground truth's sidecar: `gt.npy` -> `gt.json`."""
    return path.with_suffix(".json")


def _check_sidecar(path: Path, database: Sequence[str], queries: Sequence[str]) -> str | None:
    """Return the sidecar's rule; None without one, as for all published ground truths."""
    sidecar_file = sidecar_path(path)
    try:
        sidecar = _Sidecar.model_validate_json(sidecar_file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InvalidRequest(
            "bad_ground_truth",
            f"{sidecar_file} does not identify the lists of {path.name} ({error}). Create both "
            "files again with `placewise datasets ground-truth`.",
        ) from error
    for role, stored, names in (
        ("database", sidecar.database, database),
        ("queries", sidecar.queries, queries),
    ):
        if stored.count != len(names):
            reason = f"it was created for {stored.count} {role}, but there are {len(names)}"
            raise _mismatch_error(path, reason)
        if stored.sha256 != list_fingerprint(names):
            raise _mismatch_error(path, f"the {role} differ, or have another order")
    return sidecar.rule


def _mismatch_error(path: Path, reason: str) -> PlacewiseError:
    return InvalidRequest(
        "ground_truth_of_other_lists",
        f"{path} was created for other lists: {reason}. Use the lists that it was created for, or "
        "create a new one for these: placewise datasets ground-truth.",
    )
