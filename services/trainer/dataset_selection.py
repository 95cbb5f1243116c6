"""Selection of the training set and the evaluation sets from a run's arguments."""

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
    """Evaluation sets of a run. Sets that the phase does not use are not opened."""

    validation: tuple[EvaluationSet, ...]
    """empty in the phase test"""
    test: tuple[EvaluationSet, ...]
    """empty in the phase train"""
    roots: dict[str, Path]
    """name of each available set -> the folder of the arguments that it is in"""
    names: dict[str, tuple[str, ...]]
    """resolved values of val_set_names and test_set_names"""


def select_training_set(arguments: TrainingArguments) -> TrainingSet:
    """Open the training set; without explicit `cities`, all cities of the folder.

    Raises:
        InvalidRequest: `data_root_missing`; also raises what `open_training_set` raises.
    """
    is_explicit = "cities" in arguments.model_fields_set
    return open_training_set(
        _require_data_root(arguments),
        arguments.cities if is_explicit else None,
        min_photos=arguments.min_img_per_place,
    )


def select_evaluation_sets(arguments: TrainingArguments) -> EvaluationSets:
    """Open the validation and test sets that the phase uses.

    Sets that are named explicitly must exist. Otherwise the sets with the default names are used;
    if there are none, those with `val` in their names for validation and `test` for tests; if there
    are none of these either, all sets of the folder.

    Raises:
        NotFound: `set_missing`; the message lists the available sets.
        InvalidRequest: `data_root_missing`.
    """
    roots = arguments.eval_roots or (_require_data_root(arguments),)
    available: dict[str, Path] = {}
    for root in roots:
        for name in evaluation_set_names(root):
            available.setdefault(name, root)
    names = {
        "val_set_names": _resolve_set_names(arguments, "val_set_names", "val", available),
        "test_set_names": _resolve_set_names(arguments, "test_set_names", "test", available),
    }
    opened: dict[str, EvaluationSet] = {}

    def open_sets(argument: str) -> tuple[EvaluationSet, ...]:
        for name in names[argument]:
            if name not in available:
                raise NotFound(
                    "set_missing",
                    f"--{argument}: there is no set {name!r} in "
                    f"{', '.join(str(root) for root in roots)}."
                    + (
                        suggest_name(name, available)
                        if available
                        else " No evaluation set was recognised there."
                    ),
                )
            if name not in opened:
                opened[name] = open_evaluation_set(available[name], name)
        return tuple(opened[name] for name in names[argument])

    phase = arguments.experiment_phase
    return EvaluationSets(
        validation=open_sets("val_set_names") if phase != "test" else (),
        test=open_sets("test_set_names") if phase != "train" else (),
        names=names,
        roots=available,
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
    """Return the training set's entry in reports; a resumed run compares its fingerprint."""
    return {
        "name": training_set.name,
        "layout": training_set.layout,
        "cities": list(training_set.cities),
        "places": len(training_set.places),
        "photos": training_set.photo_count,
        "fingerprint": training_set.fingerprint,
    }


def summarise_evaluation_set(evaluation_set: EvaluationSet) -> dict[str, Any]:
    """Return the metadata that is reported with every metric of the set."""
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
            "--data_root DIR is required: the folder of the data set, in a layout that `placewise "
            "datasets check DIR` recognises. `placewise datasets synth DIR` generates a data set "
            "for a first try.",
        )
    return arguments.data_root
