"""What a run was and came to: the lines before it and `metrics.json` after it."""

from __future__ import annotations

import platform
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning
import pytorch_metric_learning
import torch

from services.trainer.arguments import TrainingArguments
from services.trainer.configuration import as_plain
from services.trainer.display import Display
from services.trainer.evaluation.recalls import Recalls
from services.trainer.history import History
from services.trainer.keep import KeptCheckpoints
from services.trainer.open_data import Sets, describe_set
from services.trainer.run_folder import CONFIG
from shared.datasets.shots import TrainingSet
from shared.vision.place_models.checkpoint import load_checkpoint

Json = dict[str, Any]


def show_data(places: TrainingSet | None, sets: Sets, display: Display) -> None:
    """What there is to learn from and to be measured on."""
    if places is not None:
        display.say(
            f"To learn from: {len(places.places)} places, {places.photo_count} photos, "
            f"{len(places.cities)} cities ({places.layout} in {places.root})"
        )
    for each in {one.name: one for one in (*sets.validation, *sets.test)}.values():
        display.say(
            f"{each.name}: {len(each.database)} database photos, {len(each.queries)} queries, "
            f"{len(each.without_positives)} of them without a positive ({each.rule}, "
            f"protocol {each.protocol}, {each.fingerprint[:12]})"
        )


def summarise(
    arguments: TrainingArguments,
    folder: Path,
    history: History | None,
    kept: KeptCheckpoints | None,
    sets: Sets,
    tested: dict[str, Recalls],
) -> Json:
    """The content of `metrics.json`; shares are from 0 to 1."""
    report: Json = {
        "run": str(folder),
        "config": str(folder / CONFIG),
        "arguments": as_plain(arguments),
        "sets": {each.name: describe_set(each) for each in (*sets.validation, *sets.test)},
        "test": {name: one.as_json() for name, one in tested.items()},
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "lightning": lightning.__version__,
            "pytorch_metric_learning": pytorch_metric_learning.__version__,
        },
    }
    if history is not None and kept is not None:
        report |= _of_training(arguments, history, kept)
    else:
        report["best"] = _described(Path(str(arguments.model_path)), None)
    report["next"] = _next(arguments, report)
    return report


def _of_training(arguments: TrainingArguments, history: History, kept: KeptCheckpoints) -> Json:
    best = (
        _described(kept.best_path, kept.best[0][0]) if kept.best_path is not None
        else _described(kept.last_path, None)
    )  # fmt: skip
    return {
        "training_set": history.training_set,
        "epochs": [asdict(epoch) for epoch in history.epochs],
        "monitor": arguments.monitor,
        "best": best,
        "checkpoints": [_listed(kept.folder / name, score) for score, name in kept.best],
        "last": str(kept.last_path),
        "bad_photos": history.bad_photos,
        "images": history.images,
        "images_per_second": history.images / history.seconds if history.seconds else None,
        "seconds": history.seconds,
        "share_waiting_for_data": history.seconds_waited / history.seconds
        if history.seconds
        else None,
    }


def _listed(path: Path, score: float | None) -> Json:
    return {"path": str(path), "score": score}


def _described(path: Path, score: float | None) -> Json:
    loaded = load_checkpoint(path)
    return {
        **_listed(path, score),
        "fingerprint": loaded.fingerprint,
        "dimension": loaded.model.dimension,
    }


def _next(arguments: TrainingArguments, report: Json) -> list[str]:
    """Commands that one would type now."""
    best = shlex.quote(report["best"]["path"])
    root = shlex.quote(str((arguments.eval_roots or (arguments.data_root,))[0]))
    return [
        f"placewise evaluate {root} --checkpoint {best}",
        f"placewise models add {best} --name NAME",
    ]
