"""The runs of a grid, as its YAML file says them.

    base: {lr: 0.0002}                   # arguments of every run
    grid:                                # every combination
      agg_arch: [AVG, GeM]
      loss: [{loss_name: NTXentLoss}, {loss_name: FastAPLoss, miner_name: AngularMiner}]
    runs:                                # or one by one
      - {name: baseline, agg_arch: GeM, published: {sfxs_val/R1: 63.59}}
    fingerprints: {sfxs_val: 0123...}    # of the sets that the published figures were made on

A value of an axis that is a mapping sets several arguments; then the axis's own name is only a
label.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from services.trainer.checkpoint_names import safe
from services.trainer.configuration import (
    known_keys,
    known_name,
    make_arguments,
    nearest,
    read_mapping,
)
from services.trainer.losses import make_loss
from services.trainer.make_model import model_config
from services.trainer.miners import make_miner
from shared.errors import InvalidRequest, PlacewiseError

KEYS = ("base", "grid", "runs", "fingerprints")
NOT_OF_A_RUN = ("default_root_dir", "run_name")
"""which the grid gives to each run itself"""


@dataclass(frozen=True, slots=True)
class PlannedRun:
    name: str
    arguments: dict[str, Any]
    published: dict[str, float] = field(default_factory=dict)
    """SET/R1 -> per cent, of somebody else's run with these settings"""


@dataclass(frozen=True, slots=True)
class GridPlan:
    runs: tuple[PlannedRun, ...]
    fingerprints: dict[str, str]
    """of the sets on which the published figures were made; empty: not known"""


def read_plan(path: Path, overrides: Mapping[str, Any]) -> GridPlan:
    """The plan in a YAML file, with arguments that override every run's.

    Every run's arguments and names are checked before the first begins. Raises NotFound
    (`config_not_found`), InvalidRequest (`bad_grid`, `unknown_argument`, `bad_argument`), and what
    an unknown backbone, aggregator, loss or miner is.
    """
    stored = read_mapping(path)
    for key in stored:
        if key not in KEYS:
            raise _bad(path, f"there is no key {key!r}.{nearest(key, KEYS)}")
    base = known_keys(_mapping(path, "base", stored.get("base")), f"{path}, base")
    runs = [
        _planned(path, name, {**base, **arguments, **overrides}, published)
        for name, arguments, published in (
            *_combined(path, _mapping(path, "grid", stored.get("grid"))),
            *_listed(path, stored.get("runs") or []),
        )
    ]
    if not runs:
        raise _bad(path, "it has neither `grid` nor `runs`: there is nothing to train")
    names = [run.name for run in runs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise _bad(path, f"several runs are called {', '.join(twice)}: give each a name of its own")
    fingerprints = _mapping(path, "fingerprints", stored.get("fingerprints"))
    return GridPlan(tuple(runs), {name: str(value) for name, value in fingerprints.items()})


def _combined(path: Path, axes: dict[str, Any]) -> list[tuple[str, dict[str, Any], Any]]:
    options: list[list[tuple[str, dict[str, Any]]]] = []
    for axis, values in axes.items():
        if not isinstance(values, list) or not values:
            raise _bad(path, f"grid, {axis}: a list of values is needed")
        options.append([_option(path, axis, value) for value in values])
    found: list[tuple[str, dict[str, Any], Any]] = []
    for chosen in itertools.product(*options) if options else ():
        arguments: dict[str, Any] = {}
        for _, values in chosen:
            arguments |= values
        found.append(("-".join(label for label, _ in chosen), arguments, {}))
    return found


def _option(path: Path, axis: str, value: Any) -> tuple[str, dict[str, Any]]:
    if isinstance(value, dict):
        arguments = known_keys(value, f"{path}, grid, {axis}")
        label = "-".join(
            str(each) for each in arguments.values() if not isinstance(each, (dict, list))
        )
        return label or axis, arguments
    return str(value), {known_name(axis): value}


def _listed(path: Path, runs: Any) -> list[tuple[str, dict[str, Any], Any]]:
    found = []
    for number, entry in enumerate(runs if isinstance(runs, list) else [runs], start=1):
        values = dict(_mapping(path, f"runs, {number}", entry))
        name = str(values.pop("name", f"{number:02d}"))
        published = _mapping(path, f"{name}, published", values.pop("published", None))
        found.append((name, known_keys(values, f"{path}, runs, {name}"), published))
    return found


def _planned(path: Path, name: str, values: dict[str, Any], published: Any) -> PlannedRun:
    given = [key for key in NOT_OF_A_RUN if key in values]
    if given:
        raise _bad(path, f"{', '.join(given)} can't be given: each run has its folder in --out")
    try:
        arguments = make_arguments(values)
        model_config(arguments)
        make_loss(arguments.loss_name)
        make_miner(arguments.miner_name, arguments.miner_margin)
        figures = {str(key): float(value) for key, value in published.items()}
    except PlacewiseError as error:
        raise type(error)(error.code, f"{path}, {name}: {error.detail}") from error
    except (TypeError, ValueError) as error:
        raise _bad(path, f"{name}, published: numbers are needed") from error
    return PlannedRun(safe(name), values, figures)


def _mapping(path: Path, where: str, value: Any) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise _bad(path, f"{where}: names with values are needed")
    return value


def _bad(path: Path, detail: str) -> InvalidRequest:
    return InvalidRequest("bad_grid", f"{path}: {detail}.")
