"""Dataset layouts: how datasets are stored on disk, in the order in which they are tried.

Each layout is a `TrainingLayout` or an `EvaluationLayout` (`base`): it recognises its folders, and
reads them into the types of `shared/datasets/dataset.py`.
"""

from __future__ import annotations

from shared.datasets.layouts.base import EvaluationLayout, TrainingLayout
from shared.datasets.layouts.csv_tables import CsvTables, CsvTrainingTable
from shared.datasets.layouts.dbstruct import DbStruct
from shared.datasets.layouts.folder_pairs import FolderPairs
from shared.datasets.layouts.gsv_cities import GsvCities, GsvXs
from shared.datasets.layouts.msls import Msls
from shared.datasets.layouts.npy_lists import NpyLists
from shared.datasets.layouts.vpr_bench import VprBench

TRAINING_LAYOUTS: tuple[TrainingLayout, ...] = (GsvXs(), GsvCities(), CsvTrainingTable())
# Lists come before folders: if a dataset has both, the lists have the ground truth.
EVALUATION_LAYOUTS: tuple[EvaluationLayout, ...] = (
    NpyLists(),
    DbStruct(),
    Msls(),
    CsvTables(),
    FolderPairs(),
    VprBench(),
)
