"""The training set and the evaluation sets that a run's arguments mean."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from services.trainer.arguments import TrainingArguments, suggest_name
from shared.datasets.dataset import EvaluationSet, TrainingSet
from shared.datasets.open_dataset import (
    evaluation_set_names,
    open_evaluation_set,
    open_training_set,
)
from shared.errors import InvalidRequest, NotFound


@dataclass(frozen=True, slots=True)
class EvaluationSets:
    """Evaluation sets of a run; a test set that the phase does not need is not opened."""

    validation: tuple[EvaluationSet, ...]
    """empty for the phase test"""
    test: tuple[EvaluationSet, ...]
    """empty for the phase train"""
    names: dict[str, tuple[str, ...]]
    """what val_set_names and test_set_names mean in this folder"""


def select_training_set(arguments: TrainingArguments) -> TrainingSet:
    """The places to learn from; cities that were not named are all that the folder has.

    Raises InvalidRequest (`data_root_missing`), and what `open_training_set` raises.
    """
    named = "cities" in arguments.model_fields_set
    return open_training_set(
        _require_data_root(arguments),
        arguments.cities if named else None,
        min_photos=arguments.min_img_per_place,
    )


def select_evaluation_sets(arguments: TrainingArguments) -> EvaluationSets:
    """The sets to validate and to test on, as far as the phase needs them.

    A set that was named must be there. Where none was, those of the default names are taken, or
    else the folder's own: for validation those with `val` in their names, for tests those with
    `test`, and all where no name says what it is for.

    Raises NotFound (`set_missing`, which lists the known ones), InvalidRequest
    (`data_root_missing`).
    """
    roots = arguments.eval_roots or (_require_data_root(arguments),)
    there: dict[str, Path] = {}
    for root in roots:
        for name in evaluation_set_names(root):
            there.setdefault(name, root)
    names = {
        "val_set_names": _resolve_set_names(arguments, "val_set_names", "val", there),
        "test_set_names": _resolve_set_names(arguments, "test_set_names", "test", there),
    }
    opened: dict[str, EvaluationSet] = {}

    def chosen(argument: str) -> tuple[EvaluationSet, ...]:
        for name in names[argument]:
            if name not in there:
                raise NotFound(
                    "set_missing",
                    f"--{argument}: there is no set {name!r} in "
                    f"{', '.join(str(root) for root in roots)}."
                    + (suggest_name(name, there) if there else " No set was recognised there."),
                )
            if name not in opened:
                opened[name] = open_evaluation_set(there[name], name)
        return tuple(opened[name] for name in names[argument])

    phase = arguments.experiment_phase
    return EvaluationSets(
        validation=chosen("val_set_names") if phase != "test" else (),
        test=chosen("test_set_names") if phase != "train" else (),
        names=names,
    )


def _resolve_set_names(
    arguments: TrainingArguments, argument: str, keyword: str, available: Iterable[str]
) -> tuple[str, ...]:
    names: tuple[str, ...] = getattr(arguments, argument)
    if argument in arguments.model_fields_set:
        return names
    return (
        tuple(name for name in names if name in available)
        or tuple(name for name in available if keyword in name)
        or tuple(available)
    )


def summarise_training_set(training_set: TrainingSet) -> dict[str, Any]:
    """What reports say of it, and what a resumed run compares."""
    return {
        "name": training_set.name,
        "layout": training_set.layout,
        "cities": list(training_set.cities),
        "places": len(training_set.places),
        "photos": training_set.photo_count,
        "fingerprint": training_set.fingerprint,
    }


def summarise_evaluation_set(evaluation_set: EvaluationSet) -> dict[str, Any]:
    """What stands beside every figure of the set."""
    return {
        "database": len(evaluation_set.database),
        "queries": len(evaluation_set.queries),
        "without_positive": len(evaluation_set.without_positives),
        "rule": evaluation_set.rule,
        "protocol": evaluation_set.protocol,
        "fingerprint": evaluation_set.fingerprint,
    }


def _require_data_root(arguments: TrainingArguments) -> Path:
    if arguments.data_root is None:
        raise InvalidRequest(
            "data_root_missing",
            "--data_root DIR is needed: the folder of the data set, as `placewise datasets check "
            "DIR` recognises it. `placewise datasets synth DIR` draws one to try things on.",
        )
    return arguments.data_root
