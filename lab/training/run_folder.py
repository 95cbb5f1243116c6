"""Layout of a run's folder, and the training history that is stored in it.

config.yaml           every argument, resolved
history.json          metrics of the epochs so far; `--resume` needs it
metrics.json          summary, written at the end
run.lock              locked while a process trains
checkpoints/          the best checkpoints, and last.ckpt
predictions_SET.npy   (queries, 20) database indices of each test set, best first
predictions/epochNN/  the same of each validation, with `save_val_predictions`
csv/  tensorboard/    output of the loggers
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Self

from filelock import FileLock, Timeout
from pydantic import BaseModel

from lab.training.arguments import TrainingArguments, build_arguments, load_yaml, to_plain_dict
from lab.training.checkpointing import format_folder, safe_filename
from shared.errors import Conflict, Misconfigured, NotFound, Unprocessable

CHECKPOINTS_FOLDER = "checkpoints"
CONFIG_FILE = "config.yaml"
LOCK_FILE = "run.lock"
METRICS_FILE = "metrics.json"
PREDICTIONS_FOLDER = "predictions"
VALIDATION_KS = (1, 5, 10, 15, 20)
"""k of the recalls in `metrics.json`, in checkpoint names and as `monitor`"""

# Arguments that --resume may change: the length of the run, the machine, evaluation and output. All
# others determine the training itself, and `metrics.json` states them for the whole run.
RESUMABLE_ARGUMENTS = {
    "max_epochs", "max_steps",
    "accelerator", "devices", "precision", "compile", "num_workers", "faiss_gpu", "weights",
    "on_bad_image",
    "data_root", "eval_roots", "val_set_names", "test_set_names", "test_image_size",
    "check_val_every_n_epoch", "num_sanity_val_steps", "save_val_predictions", "experiment_phase",
    "default_root_dir", "run_name", "logger", "log_every_n_steps", "show_data_stats",
    "fast_dev_run", "save_top_k", "save_weights_only", "filename", "auto_insert_metric_name",
}  # fmt: skip


def create_run_folder(arguments: TrainingArguments) -> Path:
    """Create the folder of a new run: `run_name`, or a unique name with a timestamp.

    Raises:
        Conflict: `run_exists`, if the folder of `run_name` is not empty.
        Misconfigured: `out_unwritable`.
    """
    root = Path(format_folder(arguments.default_root_dir, to_plain_dict(arguments)))
    if arguments.run_name is not None:
        folder = root / safe_filename(arguments.run_name)
        if folder.is_dir() and any(folder.iterdir()):
            raise Conflict(
                "run_exists",
                f"{folder} already holds a run. Resume it with --resume {folder}, or choose "
                "another --run_name.",
            )
        return _make_folder(folder, exist_ok=True)
    # Local time, because the name is read by people.
    timestamp = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    stem = safe_filename(
        f"{timestamp}-{arguments.backbone_arch}-{arguments.agg_arch}-{arguments.loss_name}"
    )
    number = 1
    while True:
        name = stem if number == 1 else f"{stem}-{number}"
        try:
            return _make_folder(root / name, exist_ok=False)
        except FileExistsError:
            number += 1


def find_run(resume: Path) -> tuple[Path, Path]:
    """Find the folder and the checkpoint of a run, given either of them, to resume from.

    Raises NotFound: `run_not_found`.
    """
    if resume.is_dir():
        folder, checkpoint = resume, resume / CHECKPOINTS_FOLDER / "last.ckpt"
    else:
        folder, checkpoint = resume.parent.parent, resume
    for required in (folder / CONFIG_FILE, checkpoint):
        if not required.is_file():
            raise NotFound(
                "run_not_found",
                f"--resume {resume}: there is no {required}. Give a run's folder, which contains "
                f"{CONFIG_FILE} and {CHECKPOINTS_FOLDER}/last.ckpt. A run that ended before its "
                "first step has no checkpoint.",
            )
    return folder, checkpoint


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock the folder of a run or grid for this process while the block runs.

    Raises Conflict (`run_in_use`), Misconfigured (`out_unwritable`).
    """
    lock = FileLock(folder / LOCK_FILE, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise Conflict(
            "run_in_use", f"Another process trains in {folder}. Wait for it, or stop it."
        ) from None
    except OSError as error:
        raise _unwritable_error(folder, error.strerror) from error
    try:
        yield
    finally:
        lock.release()


def load_resumed_arguments(folder: Path, changes: dict[str, Any]) -> TrainingArguments:
    """Load a run's arguments and apply changes.

    Raises Conflict: `run_differs`, for a change of an argument not in `RESUMABLE_ARGUMENTS`.
    """
    stored = load_yaml(folder / CONFIG_FILE)
    arguments = build_arguments(stored, changes)
    differing = _list_differences(to_plain_dict(build_arguments(stored)), arguments)
    if differing:
        raise Conflict(
            "run_differs",
            f"--resume cannot change {differing}. Start a new run instead (--model_path takes the "
            "weights of this one).",
        )
    return arguments


def check_trained_arguments(
    arguments: TrainingArguments, trained: Mapping[str, Any], checkpoint: Path
) -> None:
    """Check that a checkpoint was trained with the arguments of the run that resumes from it.

    Raises Conflict (`run_differs`), naming each argument that decides the training and differs.
    """
    differing = _list_differences(trained, arguments)
    if differing:
        raise Conflict(
            "run_differs",
            f"{checkpoint} was trained with other arguments than {CONFIG_FILE} has: {differing}. "
            f"Restore {CONFIG_FILE}, or start a new run (--model_path takes the weights of the "
            "checkpoint).",
        )


def _list_differences(stored: Mapping[str, Any], arguments: TrainingArguments) -> str:
    plain = to_plain_dict(arguments)
    return ", ".join(
        f"{name} ({value} -> {plain[name]})"
        for name, value in stored.items()
        if name not in RESUMABLE_ARGUMENTS and name in plain and value != plain[name]
    )


def _make_folder(folder: Path, *, exist_ok: bool) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=exist_ok)
    except FileExistsError:
        raise
    except OSError as error:
        raise _unwritable_error(folder, error.strerror) from error
    if not os.access(folder, os.W_OK):
        raise _unwritable_error(folder, "permission denied")
    return folder.resolve()


def _unwritable_error(folder: Path, reason: str | None) -> Misconfigured:
    return Misconfigured("out_unwritable", f"Can't write to {folder}: {reason}.")


HISTORY_FILE = "history.json"


class EpochRecord(BaseModel):
    """Metrics of one validated epoch."""

    number: int
    """epoch, from 0"""
    step: int
    """global step at the end of the epoch"""
    loss: float
    """loss of the last step"""
    figures: dict[str, float]
    """metric (SET/R1 ...) -> value from 0 to 1"""


class TrainingSetSummary(BaseModel):
    """The training set of a run; a resumed run compares its fingerprint."""

    name: str
    layout: str
    cities: list[str]
    places: int
    photos: int
    fingerprint: str


class TrainingHistory(BaseModel):
    """Metrics and counters of a run, saved as `history.json` with each checkpoint."""

    training_set: TrainingSetSummary
    epochs: list[EpochRecord] = []
    """the validated epochs"""
    best: list[tuple[float, str]] = []
    """score and file name of the best checkpoints, best first"""
    bad_photos: dict[str, str] = {}
    """path -> why the photo cannot be decoded"""
    images: int = 0
    """number of photos trained on"""
    seconds: float = 0.0
    """training time without validation"""
    seconds_waited: float = 0.0
    """part of `seconds` spent waiting for the data loader"""

    def save(self, folder: Path) -> None:
        """Write `history.json` atomically."""
        partial = folder / f"{HISTORY_FILE}.partial"
        partial.write_text(self.model_dump_json(indent=1) + "\n")
        partial.replace(folder / HISTORY_FILE)

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Load `history.json` of a run's folder.

        Raises Unprocessable: `run_unreadable`.
        """
        try:
            return cls.model_validate_json((folder / HISTORY_FILE).read_text())
        except (OSError, ValueError) as error:
            raise Unprocessable(
                "run_unreadable",
                f"Can't read {folder / HISTORY_FILE}: {error}. Start a new run.",
            ) from error
