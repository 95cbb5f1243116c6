"""The checkpoints of a run: the best few by a metric, and `last.ckpt` with the full state."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch

from services.trainer.checkpoint_names import CheckpointNameTemplate

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
