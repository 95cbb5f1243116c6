"""`placewise evaluate --predictions P.npy --ground-truth GT.npy`: what was found before, judged."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from services.cli.evaluate import ReportOptions
from services.cli.evaluate_output import check_output_folders, evaluate_rankings, output_results
from services.trainer.evaluation.nearest import Rankings
from services.trainer.evaluation.predictions import check_predictions, read_predictions
from services.trainer.evaluation.result import EvaluationRun
from shared.datasets.ground_truth_files import read_ground_truth
from shared.datasets.integer_lists import read_integer_lists
from shared.datasets.photo_lists import read_photo_list
from shared.datasets.sets import DatasetPhoto, EvaluationSet
from shared.errors import InvalidRequest

PREDICTIONS_PROTOCOL = "predictions file"


def evaluate_predictions(
    predictions: Path,
    ground_truth: Path,
    database: Path | None,
    queries: Path | None,
    photos: Path | None,
    sets: Sequence[str] | None,
    options: ReportOptions,
) -> None:
    """`photos` is the folder in which the lists' names are looked for; left out: that of the lists.

    Raises InvalidRequest: `one_list`, `which_set`, and what reading the files raises.
    """
    if (database is None) != (queries is None):
        raise InvalidRequest("one_list", "Give both lists, --database and --queries, or none.")
    if sets and len(sets) > 1:
        raise InvalidRequest("which_set", "A predictions file is of one set: give --set once.")
    check_output_folders(options)
    ranked = read_predictions(predictions)
    name = sets[0] if sets else ground_truth.stem
    rule = None
    shots: tuple[tuple[DatasetPhoto, ...], tuple[DatasetPhoto, ...]]
    if database is not None and queries is not None:
        shots = read_photo_list(database, photos), read_photo_list(queries, photos)
        there, asked_for = ([shot.name for shot in role] for role in shots)
        positives, rule = read_ground_truth(ground_truth, database=there, queries=asked_for)
        check_predictions(predictions, ranked, positives, len(there))
    else:
        positives = read_integer_lists(ground_truth)
        check_predictions(predictions, ranked, positives, None)
        # Nothing is known of them but their numbers.
        numbered = tuple(
            DatasetPhoto(Path(f"query {q}"), f"query {q}") for q in range(len(positives))
        )
        shots = (), numbered
    asked = EvaluationSet(
        name=name,
        root=photos or predictions.parent,
        database=shots[0],
        queries=shots[1],
        positives=tuple(positives),
        rule=rule or f"given by {ground_truth.name}",
        protocol=PREDICTIONS_PROTOCOL,
    )
    kept = ranked[:, : options.depth]
    found = Rankings(kept, np.zeros(kept.shape, np.float32))
    result = evaluate_rankings(asked, found, options, has_scores=False, about={})
    run = EvaluationRun(predictions.stem, None, {"predictions": predictions.name})
    output_results(run, [result], options)
