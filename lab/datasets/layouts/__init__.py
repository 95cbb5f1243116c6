"""Dataset layouts: how datasets are stored on disk, in the order in which they are tried.

Each layout is a `TrainingLayout` or an `EvaluationLayout` (`base`): it recognises its folders, and
reads them into the types of `lab/datasets/dataset.py`.
"""

from __future__ import annotations

from lab.datasets.layouts.base import EvaluationLayout, TrainingLayout
from lab.datasets.layouts.csv_tables import CsvTables, CsvTrainingTable
from lab.datasets.layouts.dbstruct import DbStruct
from lab.datasets.layouts.folder_pairs import FolderPairs
from lab.datasets.layouts.gsv_cities import GsvCities, GsvXs
from lab.datasets.layouts.msls import Msls
from lab.datasets.layouts.npy_lists import NpyLists
from lab.datasets.layouts.vpr_bench import VprBench

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
