"""Checkpointing: top-k checkpoints by a metric, `last.ckpt`, name templates, and RNG state.

`last.ckpt` holds the full training state, including the state of every random number generator
that a step may use, so that a resumed run continues exactly.

Names of checkpoints and run folders are templates with fields in braces:

    {backbone_arch}_epoch({epoch:02d})_step({step:04d})_R1[{sfxs_val/R1:.4f}]

A field is the name of an argument, `epoch`, `step` or a metric. A prefix `self.` or `model.`, as in
the GSV-Cities commands, is ignored. `R1` without a set is the monitored set's.

Lightning's `ModelCheckpoint` belongs to its `Trainer`; the training loop is a plain one.
"""

from __future__ import annotations

import math
import os
import random
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from shared.descriptors.weight_files import TENSOR_READ_ERRORS, first_error_line
from shared.errors import InvalidRequest, Unprocessable

FIELD = r"\{(?P<name>[^{}:]+)(?P<format>:[^{}]*)?\}"
# A field with its label and brackets: `_R1[...]`, `-loss=...`.
LABELLED_FIELD = re.compile(
    rf"(?P<before>[_\-. ]?(?:[A-Za-z][A-Za-z0-9]*)?[\[(=]?)?{FIELD}(?P<after>[\])])?"
)
FIELD_ALIASES = {"encoder_arch": "backbone_arch"}


class CheckpointNameTemplate:
    """Name template of checkpoints, with its fields checked against the run's metrics.

    Args:
        template: text with fields in braces, each with an optional format: `{epoch:02d}`.
        fixed: the run's arguments, which are filled in at once.
        metrics: names of the metrics that the run logs, such as `sfxs_val/R1`.
        monitored_set: the set of metrics without a set's name.
        insert_names: write `name=value` instead of the value.

    `dropped_fields` are those that the run does not log; they are removed with their label and
    brackets. Raises InvalidRequest (`bad_argument`) if no field and no text remains, or a format
    does not fit.
    """

    def __init__(
        self,
        template: str,
        fixed: Mapping[str, Any],
        metrics: Iterable[str],
        *,
        monitored_set: str = "",
        insert_names: bool = False,
    ) -> None:
        known = {"epoch", "step", *metrics}
        self.dropped_fields: list[str] = []
        self._insert_names = insert_names

        def resolve_field(match: re.Match[str]) -> str:
            name = _strip_owner(match["name"])
            if f"{monitored_set}/{name}" in known:
                name = f"{monitored_set}/{name}"
            before, after = match["before"] or "", match["after"] or ""
            if name in known:
                return f"{before}{{{name}{match['format'] or ''}}}{after}"
            if name in fixed:
                return (
                    f"{before}{safe_filename(_format_value(fixed[name], match['format']))}{after}"
                )
            self.dropped_fields.append(match["name"])
            return ""

        self._template = LABELLED_FIELD.sub(resolve_field, template)
        if not self._template.strip("_-. "):
            raise InvalidRequest(
                "bad_argument",
                f"--filename {template!r} has no known field. Known: {', '.join(sorted(known))}.",
            )

    def format_name(self, values: Mapping[str, Any]) -> str:
        """Fill in metrics, `epoch` and `step`. Path separators become `-`."""

        def fill(match: re.Match[str]) -> str:
            text = _format_value(values[match["name"]], match["format"])
            return f"{match['name']}={text}" if self._insert_names else text

        return safe_filename(re.sub(FIELD, fill, self._template))


def format_folder(template: str, fixed: Mapping[str, Any]) -> str:
    """Fill arguments into the template of a folder's path.

    Raises InvalidRequest: `bad_argument` for a field that is not an argument.
    """

    def fill(match: re.Match[str]) -> str:
        name = _strip_owner(match["name"])
        if name not in fixed:
            raise InvalidRequest(
                "bad_argument", f"--default_root_dir: {name!r} is not a training argument."
            )
        return safe_filename(_format_value(fixed[name], match["format"]))

    return re.sub(FIELD, fill, template)


def safe_filename(text: str) -> str:
    """Replace the characters that are not allowed in a file name on every platform by `-`."""
    return re.sub(r'[/\\:*?"<>|\x00-\x1f]', "-", text)


def _strip_owner(name: str) -> str:
    name = name.strip()
    for owner in ("self.", "model."):
        name = name.removeprefix(owner)
    return FIELD_ALIASES.get(name, name)


def _format_value(value: Any, spec: str | None) -> str:
    try:
        return format(value, (spec or ":")[1:])
    except (ValueError, TypeError) as error:
        raise InvalidRequest(
            "bad_argument", f"--filename: cannot format {value!r} as {spec!r}: {error}."
        ) from error


LAST_CHECKPOINT = "last.ckpt"

SaveCheckpoint = Callable[[Path, bool], None]
"""Called with a path and `weights_only`; writes the current state"""


@dataclass
class TopKCheckpoints:
    """Keeps the `top_k` best checkpoints in a folder, and `last.ckpt`.

    Files are written atomically: to a temporary name, synced, then renamed.
    """

    folder: Path
    name: CheckpointNameTemplate
    monitor: str
    mode: str
    top_k: int
    weights_only: bool
    best: list[tuple[float, str]] = field(default_factory=list)
    """Score and file name, best first; ties keep the order of saving"""

    def save_last(self, save: SaveCheckpoint) -> Path:
        """Write the full training state to `last.ckpt`, for resuming."""
        return self._write(save, LAST_CHECKPOINT, weights_only=False)

    def save_if_best(
        self, save: SaveCheckpoint, metrics: dict[str, float], epoch: int, step: int
    ) -> bool:
        """Save a checkpoint if its score is among the `top_k` best, and remove the worst.

        Returns whether it was saved; a score of NaN never is.
        """
        score = metrics.get(self.monitor, math.nan)
        rank = sum(not self._is_better(score, stored) for stored, _ in self.best)
        if math.isnan(score) or self.top_k == 0 or 0 < self.top_k <= rank:
            return False
        stem = self.name.format_name({**metrics, "epoch": epoch, "step": step})
        name = self._unique_name(f"{stem}.ckpt")
        self._write(save, name, weights_only=self.weights_only)
        self.best.insert(rank, (score, name))
        while 0 < self.top_k < len(self.best):
            (self.folder / self.best.pop()[1]).unlink(missing_ok=True)
        return True

    @property
    def best_path(self) -> Path | None:
        return self.folder / self.best[0][1] if self.best else None

    @property
    def last_path(self) -> Path:
        return self.folder / LAST_CHECKPOINT

    def _is_better(self, score: float, than: float) -> bool:
        return score > than if self.mode == "max" else score < than

    def _unique_name(self, name: str) -> str:
        """Append a version number if the name is taken."""
        taken = {file for _, file in self.best} | {LAST_CHECKPOINT}
        candidate, version = name, 1
        while candidate in taken:
            version += 1
            candidate = f"{name.removesuffix('.ckpt')}-v{version}.ckpt"
        return candidate

    def _write(self, save: SaveCheckpoint, name: str, *, weights_only: bool) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / name
        partial = path.with_name(f"{name}.partial")
        save(partial, weights_only)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
        return path


REQUIRED_STATE = {
    "state_dict", "hyper_parameters", "optimizer_states", "MixedPrecision", "rng_state",
    "global_step", "last_loss",
}  # fmt: skip


def load_training_state(path: Path) -> dict[str, Any]:
    """Load a checkpoint that holds the full training state, to resume from.

    Raises Unprocessable: `checkpoint_unreadable` if it is damaged or holds weights alone.
    """
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except TENSOR_READ_ERRORS as error:
        reason = f"it is damaged ({first_error_line(error)})"
        raise _not_resumable_error(path, reason) from error
    if not isinstance(stored, dict) or not stored.keys() >= REQUIRED_STATE:
        raise _not_resumable_error(path, "it does not hold the full training state")
    return stored


def _not_resumable_error(path: Path, reason: str) -> Unprocessable:
    return Unprocessable(
        "checkpoint_unreadable",
        f"--resume can't continue from {path}: {reason}. Resume from another checkpoint with the "
        "full state, or start a new run (--model_path takes the weights of a checkpoint).",
    )


def rng_state() -> dict[str, Any]:
    """Return the state of the global generators, in plain types and tensors."""
    name, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)
    version, words, gauss_next = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "numpy": [str(name), torch.from_numpy(np.asarray(keys).astype(np.int64)), int(position),
                  int(has_gauss), float(gauss)],
        "python": [version, list(words), gauss_next],
    }  # fmt: skip


def restore_rng_state(state: dict[str, Any]) -> None:
    """Restore what `rng_state` returned.

    CUDA generators are restored only if the number of GPUs is the same.
    """
    torch.set_rng_state(state["torch"].cpu())
    if torch.cuda.is_available() and len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([each.cpu() for each in state["cuda"]])
    name, keys, position, has_gauss, gauss = state["numpy"]
    np.random.set_state((name, keys.numpy().astype(np.uint32), position, has_gauss, gauss))
    version, words, gauss_next = state["python"]
    random.setstate((version, tuple(words), gauss_next))
