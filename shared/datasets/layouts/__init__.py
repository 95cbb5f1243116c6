"""How data sets lie on disk: one module for each way; `registry.py` lists them.

Each is a `TrainingLayout` or an `EvaluationLayout` (`layout.py`): it tells its folders from others,
and reads them into the types of `shared/datasets/dataset.py`.

The layouts that are known, in the order in which they are asked.
"""

from __future__ import annotations

from shared.datasets.layouts.base import EvaluationLayout, TrainingLayout
from shared.datasets.layouts.csv_tables import CsvTables, CsvTrainingTable
from shared.datasets.layouts.dbstruct import DbStruct
from shared.datasets.layouts.folder_pairs import FolderPairs
from shared.datasets.layouts.gsv_cities import GsvCities, GsvXs
from shared.datasets.layouts.msls import Msls
from shared.datasets.layouts.npy_lists import NpyLists

TRAINING_LAYOUTS: tuple[TrainingLayout, ...] = (GsvXs(), GsvCities(), CsvTrainingTable())
# Lists come before folders: where both are there, the lists bring the ground truth.
EVALUATION_LAYOUTS: tuple[EvaluationLayout, ...] = (
    NpyLists(),
    DbStruct(),
    Msls(),
    CsvTables(),
    FolderPairs(),
)
