"""The folder of one run: where it lies, what is in it.

config.yaml       every argument, as it was meant
history.json      what was measured so far
metrics.json      the summary at the end
checkpoints/      the best ones, and last.ckpt
csv/  tensorboard/

What a run has come to so far, beside its checkpoints: `history.json`.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from services.trainer.arguments import TrainingArguments, build_arguments, load_yaml, to_plain_dict
from services.trainer.checkpointing import format_folder, safe_filename
from shared.errors import Conflict, Misconfigured, NotFound, Unprocessable

CHECKPOINTS_FOLDER = "checkpoints"
CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.json"

# A run that went on with another of these would be another run.
IMMUTABLE_ARGUMENTS = (
    "batch_size", "img_per_place", "min_img_per_place", "shuffle_all",
    "random_sample_from_each_place", "image_size", "reload_dataloaders_every_n_epochs", "cities",
    "backbone_arch", "layers_to_freeze", "layers_to_crop", "agg_arch", "agg_config", "optimizer",
    "loss_name", "miner_name", "seed",
)  # fmt: skip


def create_run_folder(arguments: TrainingArguments) -> Path:
    """An empty folder for a run that begins.

    Raises Conflict (`run_exists`) for a name that is taken, Misconfigured (`out_unwritable`).
    """
    root = Path(format_folder(arguments.default_root_dir, to_plain_dict(arguments)))
    if arguments.run_name is not None:
        folder = root / safe_filename(arguments.run_name)
        if folder.is_dir() and any(folder.iterdir()):
            raise Conflict(
                "run_exists",
                f"{folder} holds a run already. Go on with it by --resume {folder}, or give "
                "another --run_name.",
            )
        return _make_folder(folder, exist_ok=True)
    # Local time: the name is for whoever looks into the folder.
    began = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    stem = safe_filename(
        f"{began}-{arguments.backbone_arch}-{arguments.agg_arch}-{arguments.loss_name}"
    )
    number = 1
    while True:
        name = stem if number == 1 else f"{stem}-{number}"
        try:
            return _make_folder(root / name, exist_ok=False)
        except FileExistsError:
            number += 1


def find_run(resume: Path) -> tuple[Path, Path]:
    """A run's folder, or one of its checkpoints with the full state -> folder and checkpoint.

    Raises NotFound (`run_not_found`).
    """
    if resume.is_dir():
        folder, checkpoint = resume, resume / CHECKPOINTS_FOLDER / "last.ckpt"
    else:
        folder, checkpoint = resume.parent.parent, resume
    for needed in (folder / CONFIG_FILE, checkpoint):
        if not needed.is_file():
            raise NotFound(
                "run_not_found",
                f"--resume {resume}: there is no {needed}. Name the folder of a run, in which "
                f"{CONFIG_FILE} and {CHECKPOINTS_FOLDER}/last.ckpt lie; a run that ended "
                "before its first "
                "step has none.",
            )
    return folder, checkpoint


def load_resumed_arguments(folder: Path, changes: dict[str, Any]) -> TrainingArguments:
    """What the run was told, with changes. Conflict (`run_differs`) for a change that would make
    it another run."""
    stored = load_yaml(folder / CONFIG_FILE)
    before, after = build_arguments(stored), build_arguments(stored, changes)
    differing = [
        name for name in IMMUTABLE_ARGUMENTS if getattr(before, name) != getattr(after, name)
    ]
    if differing:
        raise Conflict(
            "run_differs",
            f"--resume goes on with the run as it was: {', '.join(differing)} can't change. Begin "
            "a new run (--model_path takes the weights of this one).",
        )
    return after


def _make_folder(folder: Path, *, exist_ok: bool) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=exist_ok)
    except FileExistsError:
        raise
    except OSError as error:
        raise Misconfigured(
            "out_unwritable", f"Can't make the run's folder {folder}: {error.strerror}."
        ) from error
    if not os.access(folder, os.W_OK):
        raise Misconfigured("out_unwritable", f"The run's folder {folder} can't be written.")
    return folder.resolve()


HISTORY_FILE = "history.json"


@dataclass
class EpochRecord:
    number: int
    """from 0"""
    step: int
    """after it"""
    loss: float
    """of the last step"""
    figures: dict[str, float]
    """SET/R1 ...: shares from 0 to 1"""


@dataclass
class TrainingHistory:
    """Grows with the run; saved when a checkpoint is."""

    training_set: dict[str, Any]
    epochs: list[EpochRecord] = field(default_factory=list)
    """those that were measured"""
    best: list[tuple[float, str]] = field(default_factory=list)
    """score and file name of the best checkpoints, the best first"""
    bad_photos: dict[str, str] = field(default_factory=dict)
    """path -> why it does not decode"""
    images: int = 0
    """that were learned from"""
    seconds: float = 0.0
    """spent on steps, validation left out"""
    seconds_waited: float = 0.0
    """of them, for photos to be read"""

    def save(self, folder: Path) -> None:
        path = folder / HISTORY_FILE
        partial = path.with_name(f"{HISTORY_FILE}.partial")
        partial.write_text(json.dumps(asdict(self), indent=1) + "\n")
        partial.replace(path)

    @classmethod
    def load(cls, folder: Path) -> TrainingHistory:
        """Unprocessable (`run_unreadable`) where the folder's file can't be read."""
        try:
            stored = json.loads((folder / HISTORY_FILE).read_text())
            stored["epochs"] = [EpochRecord(**epoch) for epoch in stored["epochs"]]
            stored["best"] = [(score, name) for score, name in stored["best"]]
            return cls(**stored)
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise Unprocessable(
                "run_unreadable",
                f"{folder / HISTORY_FILE} can't be read: {error}. Begin a new run.",
            ) from error
