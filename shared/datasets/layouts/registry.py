"""The layouts that are known, in the order in which they are asked."""

from __future__ import annotations

from shared.datasets.layouts.folder_pairs import FolderPairs
from shared.datasets.layouts.gsv_xs import GsvXs
from shared.datasets.layouts.layout import EvaluationLayout, TrainingLayout

TRAINING_LAYOUTS: tuple[TrainingLayout, ...] = (GsvXs(),)
EVALUATION_LAYOUTS: tuple[EvaluationLayout, ...] = (FolderPairs(),)
