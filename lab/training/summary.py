"""Summary of a run: data set statistics before training, `metrics.json` after it."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning
import pytorch_metric_learning
import torch

from lab.datasets.dataset import EvaluationSet, TrainingSet
from lab.evaluation.ranking import RecallEvaluation
from lab.evaluation.results import predictions_path
from lab.training.arguments import TrainingArguments, to_plain_dict
from lab.training.checkpointing import TopKCheckpoints
from lab.training.data import EvaluationSets
from lab.training.run_control import Display
from lab.training.run_folder import CONFIG_FILE, TrainingHistory
from shared.config.command_line import command_line
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.config import is_own_module

Json = dict[str, Any]


def print_data_sets(
    training_set: TrainingSet | None, sets: EvaluationSets, display: Display
) -> None:
    """Show the size of the training set and of each evaluation set."""
    if training_set is not None:
        cities = len(training_set.cities)
        display.info(
            f"Training set: {len(training_set.places)} places, {training_set.photo_count} photos, "
            f"{cities} {'city' if cities == 1 else 'cities'} "
            f"({training_set.layout} in {training_set.root})"
        )
    for each in {each.name: each for each in (*sets.validation, *sets.test)}.values():
        display.info(
            f"{each.name}: {len(each.database)} database photos, {len(each.queries)} queries, "
            f"{len(each.without_positives)} of them without a positive ({each.rule}, "
            f"protocol {each.protocol}, {each.fingerprint[:12]})"
        )


def build_summary(
    arguments: TrainingArguments,
    folder: Path,
    history: TrainingHistory | None,
    checkpoints: TopKCheckpoints | None,
    sets: EvaluationSets,
    tests: Mapping[str, RecallEvaluation],
) -> Json:
    """Build the content of `metrics.json`; recalls are from 0 to 1.

    `history` and `checkpoints` are None in the phase test.
    """
    report: Json = {
        "run": str(folder),
        "config": str(folder / CONFIG_FILE),
        "arguments": to_plain_dict(arguments),
        "sets": {
            each.name: _summarise_evaluation_set(each) for each in (*sets.validation, *sets.test)
        },
        "test": {name: evaluation.recalls.as_json() for name, evaluation in tests.items()},
        "predictions": {name: str(predictions_path(folder, name)) for name in tests},
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "lightning": lightning.__version__,
            "pytorch_metric_learning": pytorch_metric_learning.__version__,
        },
    }
    if history is not None and checkpoints is not None:
        report |= _training_summary(arguments, history, checkpoints)
    else:
        report["best"] = _checkpoint_details(Path(str(arguments.model_path)), None)
    report["next"] = _next_commands(arguments, sets, report)
    return report


def _summarise_evaluation_set(evaluation_set: EvaluationSet) -> Json:
    return {
        "database": len(evaluation_set.database),
        "queries": len(evaluation_set.queries),
        "without_positive": len(evaluation_set.without_positives),
        "rule": evaluation_set.rule,
        "protocol": evaluation_set.protocol,
        "fingerprint": evaluation_set.fingerprint,
    }


def _training_summary(
    arguments: TrainingArguments, history: TrainingHistory, checkpoints: TopKCheckpoints
) -> Json:
    score = checkpoints.best[0][0] if checkpoints.best else None
    speed = history.images / history.seconds if history.seconds else None
    waited = history.seconds_waited / history.seconds if history.seconds else None
    return {
        "training_set": history.training_set.model_dump(),
        "epochs": [epoch.model_dump() for epoch in history.epochs],
        "monitor": arguments.monitor,
        "best": _checkpoint_details(checkpoints.best_path or checkpoints.last_path, score),
        "checkpoints": [
            {"path": str(checkpoints.folder / name), "score": score}
            for score, name in checkpoints.best
        ],
        "last": str(checkpoints.last_path),
        "bad_photos": history.bad_photos,
        "images": history.images,
        "images_per_second": speed,
        "seconds": history.seconds,
        "share_waiting_for_data": waited,
    }


def _checkpoint_details(path: Path, score: float | None) -> Json:
    loaded = load_checkpoint(path)
    return {
        "path": str(path),
        "score": score,
        "fingerprint": loaded.fingerprint,
        "dimension": loaded.model.dimension,
    }


def _next_commands(arguments: TrainingArguments, sets: EvaluationSets, report: Json) -> list[str]:
    """Return commands that show predictions, and evaluate and register the best checkpoint."""
    best = Path(report["best"]["path"])
    root = (arguments.eval_roots or (arguments.data_root,))[0]
    assert root is not None  # the sets were found there
    show_predictions = [
        command_line(
            *("evaluate", "--predictions", Path(predictions)),
            *("--data", Path(sets.roots[name]), "--set", name, "--out", "report"),
        )
        for name, predictions in list(report["predictions"].items())[:1]
    ]
    if is_own_module(arguments.backbone_arch) or is_own_module(arguments.agg_arch):
        return show_predictions  # only training imports the network's code
    return [
        *show_predictions,
        command_line("evaluate", "--data", root, "--checkpoint", best),
        command_line("models", "add", best, "--name", "NAME"),
    ]
