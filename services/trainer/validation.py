"""The evaluation sets of a run, measured as `placewise evaluate` measures them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from services.trainer.arguments import TrainingArguments
from services.trainer.evaluation.describe_model import ModelDescriber
from services.trainer.evaluation.recalls import Recalls, evaluate_recall
from services.trainer.stop import StopRequest
from shared.datasets.shots import EvaluationSet

BATCH_PHOTOS = 32

ProgressCallback = Callable[[str, int, int], None]


class Validator:
    """Measures a network on sets, one after the other.

    Validation photos have the size that the training's have; `for_tests` uses `test_image_size`.
    """

    def __init__(
        self,
        arguments: TrainingArguments,
        device: torch.device,
        on_progress: ProgressCallback,
        stop: StopRequest,
    ) -> None:
        self._arguments = arguments
        self._device = device
        self._told = on_progress
        self._stop = stop

    def measure(
        self, model: torch.nn.Module, sets: Sequence[EvaluationSet], *, for_tests: bool = False
    ) -> dict[str, Recalls]:
        """By the sets' names. Raises RunStopped, and what describing and searching raise."""
        size = self._test_size() if for_tests else self._arguments.image_size
        describe = ModelDescriber(
            model, self._device, size, batch_photos=1 if size is None else BATCH_PHOTOS
        )
        found = {}
        for each in sets:

            def told(what: str, done: int, most: int, name: str = each.name) -> None:
                self._stop.check()
                self._told(f"{name}: {what}", done, most)

            asked = evaluate_recall(
                describe, each, faiss_gpu=self._arguments.faiss_gpu, on_progress=told
            )
            found[each.name] = asked.recalls
        return found

    def sanity_check(
        self, model: torch.nn.Module, sets: Sequence[EvaluationSet], batches: int
    ) -> None:
        """Measure the first batches of each set, -1: all, so that a fault in them shows early."""
        most = batches * BATCH_PHOTOS if batches >= 0 else None
        begun = [
            replace(
                each,
                database=each.database[:most],
                queries=each.queries[:most],
                positives=tuple(
                    found if most is None else found[found < most]
                    for found in each.positives[:most]
                ),
            )
            for each in sets
        ]
        if batches:
            self.measure(model, begun)

    def _test_size(self) -> tuple[int, int] | None:
        size = self._arguments.test_image_size
        if size == "same":
            return self._arguments.image_size
        return None if size == "native" else size


def flatten_recalls(recalls_by_set: dict[str, Recalls]) -> dict[str, float]:
    """`SET/R1`, `SET/R5` ... -> shares from 0 to 1; a query without a positive counts as missed."""
    return {
        f"{name}/R{k}": share
        for name, one in recalls_by_set.items()
        for k, share in one.recall_all.items()
    }
