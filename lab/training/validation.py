"""Validation: recall@k of a network on evaluation sets, by the code of `placewise evaluate`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from lab.datasets.dataset import EvaluationSet
from lab.evaluation.exact_knn import has_faiss_gpu
from lab.evaluation.ranking import RecallEvaluation, evaluate_recall
from lab.evaluation.results import predictions_path
from lab.training.arguments import TrainingArguments
from lab.training.describing import ModelDescriber
from lab.training.run_control import StopRequest
from lab.training.run_folder import VALIDATION_KS

BATCH_PHOTOS = 32

ProgressCallback = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Validator:
    """Computes the recalls of a network on evaluation sets.

    Validation photos are resized to `val_image_size`, test photos to `test_image_size`.
    """

    arguments: TrainingArguments
    device: torch.device
    on_progress: ProgressCallback
    stop: StopRequest

    def measure(
        self, model: torch.nn.Module, sets: Sequence[EvaluationSet], *, for_tests: bool = False
    ) -> dict[str, RecallEvaluation]:
        """Return rankings and recalls of the network, (B, 3, H, W) float32 -> (B, D), by set name.

        Its training mode is restored afterwards. `for_tests` selects `test_image_size` instead of
        `val_image_size`. Raises RunStopped, and what describing and searching raise.
        """
        size = self._test_size() if for_tests else self.arguments.evaluation_size
        describe = ModelDescriber(
            model,
            self.device,
            size,
            interpolation=self.arguments.interpolation,
            batch_photos=1 if size is None else BATCH_PHOTOS,
        )
        evaluations = {}
        for each in sets:

            def on_progress(what: str, done: int, total: int, name: str = each.name) -> None:
                self.stop.check()
                self.on_progress(f"{name}: {what}", done, total)

            evaluations[each.name] = evaluate_recall(
                describe,
                each,
                ks=VALIDATION_KS,
                faiss_gpu=self.arguments.faiss_gpu and has_faiss_gpu(),
                on_progress=on_progress,
            )
        return evaluations

    def sanity_check(
        self, model: torch.nn.Module, sets: Sequence[EvaluationSet], batches: int
    ) -> None:
        """Evaluate the first `batches` of each set (-1: all), to find errors before training."""
        limit = batches * BATCH_PHOTOS if batches >= 0 else None
        truncated = [
            replace(
                each,
                database=each.database[:limit],
                queries=each.queries[:limit],
                positives=tuple(
                    rows if limit is None else rows[rows < limit] for rows in each.positives[:limit]
                ),
            )
            for each in sets
        ]
        if batches:
            self.measure(model, truncated)

    def _test_size(self) -> tuple[int, int] | None:
        size = self.arguments.test_image_size
        if size == "same":
            return self.arguments.evaluation_size
        return None if size == "native" else size


def write_predictions(folder: Path, evaluations: Mapping[str, RecallEvaluation]) -> None:
    """Write `predictions_SET.npy` of each set: (queries, k) int64 database indices, best first."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, evaluation in evaluations.items():
        np.save(predictions_path(folder, name), evaluation.ranked.indices)


def flatten_recalls(evaluations: Mapping[str, RecallEvaluation]) -> dict[str, float]:
    """Return recalls as metrics `SET/R1`, `SET/R5` ..., from 0 to 1.

    A query without a positive counts as a miss.
    """
    return {
        f"{name}/R{k}": recall
        for name, evaluation in evaluations.items()
        for k, recall in evaluation.recalls.recall_all.items()
    }
