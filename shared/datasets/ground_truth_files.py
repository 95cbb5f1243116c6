"""A ground truth on disk: the rows in a `.npy`, and beside it which lists they are true of.

Rows are positions in two lists, so that they are worthless for the same photos in another order:
beside `gt.npy`, `gt.json` keeps the fingerprints of both lists, and other lists are refused.

Arrays of lists of integers in `.npy` files: the ground truths of the field, read without trust.

Such a file holds a pickle, and a pickle from the internet can run any program. Here it may name
only what NumPy writes for arrays, types and numbers, and each of these names leads to a stand-in
that merely keeps its arguments. What comes out is lists of integers, or an error.
"""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from shared.datasets.dataset import Indices, list_fingerprint
from shared.errors import InvalidRequest, PlacewiseError

INTEGER_KINDS = "iub"
PADDING = -1
"""in tables of fixed width: no further positive"""


def write_integer_lists(path: Path, lists: Sequence[Indices]) -> None:
    """An object array (n,) of Python lists of ints, as `np.save` with pickles writes it."""
    rows = np.empty(len(lists), object)
    for number, found in enumerate(lists):
        rows[number] = found.tolist()
    with path.open("wb") as file:
        np.save(file, rows, allow_pickle=True)


def read_integer_lists(path: Path) -> list[Indices]:
    """One ascending array of integers, without doubles, for each row.

    Read are an object array (n,) of lists or arrays of integers, an integer array (n, k) with
    PADDING where a row is shorter, and (n,) with one integer a row. Raises InvalidRequest
    (`bad_ground_truth`) for anything else; nothing of the file is run.
    """
    try:
        with path.open("rb") as file:
            dtype, shape = _header(file)
            if dtype.kind in INTEGER_KINDS:
                file.seek(0)
                return [_row(row, path) for row in _table(np.load(file, allow_pickle=False))]
            if dtype != np.dtype(object):
                raise ValueError(f"it holds {dtype}, and lists of integers are needed")
            return [_row(value, path) for value in _unpickled(file, shape)]
    except (OSError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise _bad_list_error(path, str(error)) from error
    except (
        TypeError,
        AttributeError,
        LookupError,
        OverflowError,
        RecursionError,
        MemoryError,
    ) as error:
        # What a pickle that is no pickle, or a malicious one, makes the unpickler stumble over.
        raise _bad_list_error(path, f"its pickle is broken ({type(error).__name__})") from error


def read_names(path: Path) -> list[str]:
    """The texts of a one-dimensional `.npy` array. InvalidRequest (`bad_list`) for any other."""
    try:
        with path.open("rb") as file:
            dtype, _ = _header(file)
            if dtype.kind not in "US":
                raise ValueError(f"it holds {dtype}, and texts are needed")
            file.seek(0)
            names = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError, MemoryError) as error:
        raise InvalidRequest("bad_list", f"{path} is no .npy list of paths: {error}.") from error
    if names.ndim != 1:
        raise InvalidRequest("bad_list", f"{path} is an array {names.shape}, and no list.")
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
        raise ValueError(f"it is an array {rows.shape}, and (n, k) is needed")
    table = rows.reshape(len(rows), -1).astype(np.int64)
    return [row[row != PADDING] for row in table]


def _row(value: Any, path: Path) -> Indices:
    if isinstance(value, _Array):
        value = value.values()
    if not isinstance(value, list | tuple | np.ndarray):
        value = [value]
    plain = [one.value() if isinstance(one, _Scalar) else one for one in value]
    if not all(isinstance(one, int | np.integer) and one >= 0 for one in plain):
        raise _bad_list_error(path, "a row holds something else than indices from 0")
    return np.unique(np.array(plain, np.int64))


def _unpickled(file: BinaryIO, shape: tuple[int, ...]) -> list[Any]:
    array = _Unpickler(file, encoding="latin1").load()
    if not isinstance(array, _Array) or array.fortran or len(shape) not in (1, 2):
        raise ValueError(f"it is no list of lists but of the shape {shape}")
    values = array.values()
    if len(values) != math.prod(shape):
        raise ValueError(f"it promises {math.prod(shape)} values and has {len(values)}")
    if len(shape) == 1:
        return values
    # NumPy makes lists of one length a table, whoever meant a list of lists.
    return [values[start : start + shape[1]] for start in range(0, len(values), shape[1] or 1)]


def _bad_list_error(path: Path, fault: str) -> InvalidRequest:
    return InvalidRequest(
        "bad_ground_truth",
        f"{path} is no ground truth: {fault}. It has to be an array of lists of database indices, "
        "such as `placewise datasets ground-truth` writes.",
    )


class _Array:
    """Stands for an array until it is known to hold integers or lists."""

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
    """Stands for a type: a name such as `i8` and the byte order that comes later."""

    def __init__(self, name: str, *_: object) -> None:
        self.name = name
        self.order = "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = str(state[1])

    def integers(self) -> np.dtype[Any]:
        if not isinstance(self.name, str) or self.name[:1] not in INTEGER_KINDS:
            raise ValueError(f"an array in it holds {self.name!r} and no integers")
        return np.dtype(f"{self.order if self.order in '<>' else '='}{self.name}")


class _Scalar:
    """Stands for one of NumPy's own numbers."""

    def __init__(self, dtype: _Dtype, data: object) -> None:
        self.dtype = dtype
        self.data = data

    def value(self) -> int:
        (value,) = np.frombuffer(_as_bytes(self.data), self.dtype.integers()).tolist()
        return int(value)


def _as_bytes(data: object) -> bytes:
    if isinstance(data, str):  # as protocols before 3 write bytes
        return data.encode("latin1")
    if isinstance(data, bytes | bytearray):
        return bytes(data)
    raise ValueError("an array in it has no data")


def _encode(text: str, _: str) -> bytes:
    return text.encode("latin1")


def _no_bytes() -> bytes:
    return b""


class _Unpickler(pickle.Unpickler):
    """Finds stand-ins, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _STAND_INS:
            return _STAND_INS[module, name]
        raise pickle.UnpicklingError(f"its pickle asks for {module}.{name}, which is refused")


_STAND_INS: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _encode,
    ("builtins", "bytes"): _no_bytes,
    ("__builtin__", "bytes"): _no_bytes,  # its name in protocols before 3
    **{
        (f"numpy.{core}.multiarray", name): stand_in
        for core in ("core", "_core")
        for name, stand_in in (("_reconstruct", _Array), ("scalar", _Scalar))
    },
}


def write_ground_truth(
    path: Path,
    positives: Sequence[Indices],
    *,
    database: Sequence[str],
    queries: Sequence[str],
    rule: str,
) -> None:
    """Write rows and, beside them, what they belong to. `path` ends in `.npy`."""
    write_integer_lists(path, positives)
    said = {
        "made_by": "placewise datasets ground-truth",
        "rule": rule,
        "database": {"count": len(database), "sha256": list_fingerprint(database)},
        "queries": {"count": len(queries), "sha256": list_fingerprint(queries)},
    }
    sidecar_path(path).write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")


def read_ground_truth(
    path: Path, *, database: Sequence[str], queries: Sequence[str]
) -> tuple[list[Indices], str | None]:
    """The positives of each query, and the rule where it is known.

    The names are those of the lists, in their order. Raises InvalidRequest (`bad_ground_truth`,
    `ground_truth_of_other_lists`).
    """
    found = read_integer_lists(path)
    rule = _check_sidecar(path, database, queries)
    if len(found) != len(queries):
        raise _mismatch_error(
            path, f"it has {len(found)} rows, and there are {len(queries)} queries"
        )
    largest = max((int(row[-1]) for row in found if len(row)), default=-1)
    if largest >= len(database):
        raise _mismatch_error(
            path, f"it speaks of photo {largest}, and there are {len(database)} from 0"
        )
    return found, rule


def sidecar_path(path: Path) -> Path:
    """`gt.npy` -> `gt.json`"""
    return path.with_suffix(".json")


def _check_sidecar(path: Path, database: Sequence[str], queries: Sequence[str]) -> str | None:
    """The rule; None where nothing is said, as with every published ground truth."""
    beside = sidecar_path(path)
    try:
        said: Any = json.loads(beside.read_text(encoding="utf-8"))
        kept = {role: (said[role]["count"], said[role]["sha256"]) for role in ROLES}
        rule = str(said["rule"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InvalidRequest(
            "bad_ground_truth",
            f"{beside} does not say which lists {path.name} is true of ({error}). Make both again "
            "by `placewise datasets ground-truth`.",
        ) from error
    for role, names in zip(ROLES, (database, queries), strict=True):
        count, fingerprint = kept[role]
        if count != len(names):
            raise _mismatch_error(
                path, f"it was made for {count} {role}, and here are {len(names)}"
            )
        if fingerprint != list_fingerprint(names):
            raise _mismatch_error(path, f"the {role} are others, or in another order")
    return rule


ROLES = ("database", "queries")


def _mismatch_error(path: Path, fault: str) -> PlacewiseError:
    return InvalidRequest(
        "ground_truth_of_other_lists",
        f"{path} was made for other lists: {fault}. Take the lists that it was made for, or make "
        "one for these: placewise datasets ground-truth.",
    )
