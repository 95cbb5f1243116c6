"""The layouts that are known, in the order in which they are asked."""

from __future__ import annotations

from shared.datasets.layouts.dbstruct import DbStruct
from shared.datasets.layouts.folder_pairs import FolderPairs
from shared.datasets.layouts.gsv_cities import GsvCities
from shared.datasets.layouts.gsv_xs import GsvXs
from shared.datasets.layouts.layout import EvaluationLayout, TrainingLayout
from shared.datasets.layouts.msls import Msls
from shared.datasets.layouts.npy_lists import NpyLists
from shared.datasets.layouts.plain_tables import CsvTables, CsvTrainingTable

TRAINING_LAYOUTS: tuple[TrainingLayout, ...] = (GsvXs(), GsvCities(), CsvTrainingTable())
# Lists come before folders: where both are there, the lists bring the ground truth.
EVALUATION_LAYOUTS: tuple[EvaluationLayout, ...] = (
    NpyLists(),
    DbStruct(),
    Msls(),
    CsvTables(),
    FolderPairs(),
)
