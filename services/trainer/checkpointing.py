"""The checkpoints of a run: the best few by a metric, and `last.ckpt` with the full state.

Names of checkpoints and folders from templates with figures in them.

    {backbone_arch}_epoch({epoch:02d})_step({step:04d})_R1[{sfxs_val/R1:.4f}]

A field is an argument's name, `epoch`, `step` or a metric. `self.` and `model.` before it, which
the predecessor's commands write, mean the same. `R1` alone is the monitored set's.

Random numbers of the steps themselves: seeded, kept in checkpoints, restored.
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

from shared.errors import InvalidRequest

FIELD = r"\{(?P<name>[^{}:]+)(?P<format>:[^{}]*)?\}"
# With what belongs to it: `_R1[...]`, `-loss=...`.
LABELLED_FIELD = re.compile(
    rf"(?P<before>[_\-. ]?(?:[A-Za-z][A-Za-z0-9]*)?[\[(=]?)?{FIELD}(?P<after>[\])])?"
)
FIELD_ALIASES = {"encoder_arch": "backbone_arch"}


class CheckpointNameTemplate:
    """A template whose fields are known to be those that a run has.

    `dropped` are the fields that no run of these sets logs: they drop out, with the label and the
    brackets around them.
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

        def settle(match: re.Match[str]) -> str:
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

        self._template = LABELLED_FIELD.sub(settle, template)
        if not self._template.strip("_-. "):
            raise InvalidRequest(
                "bad_argument",
                f"--filename: nothing is left of {template!r}; known: {_join_names(known)}",
            )

    def format_name(self, figures: Mapping[str, Any]) -> str:
        """The name with these figures; `/` becomes `-`: a name is no path."""

        def fill(match: re.Match[str]) -> str:
            figure = _format_value(figures[match["name"]], match["format"])
            return f"{match['name']}={figure}" if self._insert_names else figure

        return safe_filename(re.sub(FIELD, fill, self._template))


def format_folder(template: str, fixed: Mapping[str, Any]) -> str:
    """A folder's path with arguments in it; InvalidRequest (`bad_argument`) for other fields."""

    def fill(match: re.Match[str]) -> str:
        name = _strip_owner(match["name"])
        if name not in fixed:
            raise InvalidRequest(
                "bad_argument", f"--default_root_dir: {name!r} is no argument of a run."
            )
        return safe_filename(_format_value(fixed[name], match["format"]))

    return re.sub(FIELD, fill, template)


def safe_filename(text: str) -> str:
    """The text as a part of a file's name on every system."""
    return re.sub(r'[/\\:*?"<>|\x00-\x1f]', "-", text)


def _strip_owner(name: str) -> str:
    name = name.strip()
    for owner in ("self.", "model."):
        name = name.removeprefix(owner)
    return FIELD_ALIASES.get(name, name)


def _format_value(value: Any, form: str | None) -> str:
    try:
        return format(value, (form or ":")[1:])
    except (ValueError, TypeError) as error:
        raise InvalidRequest(
            "bad_argument", f"--filename: {value!r} can't be written as {form!r}: {error}."
        ) from error


def _join_names(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))


LAST_CHECKPOINT = "last.ckpt"
TRAINING_STATE_KEYS = ("optimizer_states", "lr_schedulers", "loops", "callbacks", "MixedPrecision")
"""what a checkpoint of weights alone does not hold"""

SaveCheckpoint = Callable[[Path, bool], None]
"""Writes the present state to a path; True: the weights alone"""


@dataclass
class TopKCheckpoints:
    """Which checkpoints stay in `folder`. Files appear whole, or not at all."""

    folder: Path
    name: CheckpointNameTemplate
    monitor: str
    mode: str
    top_k: int
    weights_only: bool
    best: list[tuple[float, str]] = field(default_factory=list)
    """Score and file name, the best first; of equal ones the earlier"""

    def save_last(self, save: SaveCheckpoint) -> Path:
        """Write the full state from which training goes on."""
        return self._write(save, LAST_CHECKPOINT, weights_only=False)

    def save_if_best(
        self, save: SaveCheckpoint, metrics: dict[str, float], epoch: int, step: int
    ) -> bool:
        """Keep the present weights if they are among the best; whether they are.

        A score that is not a number is never among them.
        """
        score = metrics.get(self.monitor, math.nan)
        ranked = [kept for kept in self.best if not self._is_better(score, kept[0])]
        place = len(ranked)
        if math.isnan(score) or self.top_k == 0 or 0 < self.top_k <= place:
            return False
        filled = self.name.format_name({**metrics, "epoch": epoch, "step": step})
        name = self._unique_name(f"{filled}.ckpt")
        self._write(save, name, weights_only=self.weights_only)
        self.best.insert(place, (score, name))
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
        """The name, numbered where an earlier checkpoint already has it."""
        taken = {file for _, file in self.best} | {LAST_CHECKPOINT}
        free, number = name, 1
        while free in taken:
            number += 1
            free = f"{name.removesuffix('.ckpt')}-v{number}.ckpt"
        return free

    def _write(self, save: SaveCheckpoint, name: str, *, weights_only: bool) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / name
        partial = path.with_name(f"{name}.partial")
        save(partial, weights_only)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
        return path


def copy_checkpoint(source: Path, path: Path, weights_only: bool) -> None:
    """The checkpoint at another path; True: without what only training needs."""
    stored = torch.load(source, map_location="cpu", weights_only=True)
    if weights_only:
        stored = {key: value for key, value in stored.items() if key not in TRAINING_STATE_KEYS}
    torch.save(stored, path)


def seed_everything(seed: int) -> None:
    """torch's, numpy's and Python's own generators; the sampler and augmentation have theirs."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def rng_state() -> dict[str, Any]:
    """Of every generator that a step may draw from, in plain types and tensors."""
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
    """The inverse of `rng_state`; GPUs that are not there any more are left out."""
    torch.set_rng_state(state["torch"].cpu())
    if torch.cuda.is_available() and len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([each.cpu() for each in state["cuda"]])
    name, keys, position, has_gauss, gauss = state["numpy"]
    np.random.set_state((name, keys.numpy().astype(np.uint32), position, has_gauss, gauss))
    version, words, gauss_next = state["python"]
    random.setstate((version, tuple(words), gauss_next))
