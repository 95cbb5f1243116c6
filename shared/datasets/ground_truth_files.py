"""A ground truth on disk: the rows in a `.npy`, and beside it which lists they are true of.

Rows are positions in two lists, so that they are worthless for the same photos in another order:
beside `gt.npy`, `gt.json` keeps the fingerprints of both lists, and other lists are refused.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from shared.datasets.integer_lists import read_integer_lists, write_integer_lists
from shared.datasets.shots import Indices, list_fingerprint
from shared.errors import InvalidRequest, PlacewiseError


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
