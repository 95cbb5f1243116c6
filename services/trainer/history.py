"""What a run has come to so far, beside its checkpoints: `history.json`."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from shared.errors import Unprocessable

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
