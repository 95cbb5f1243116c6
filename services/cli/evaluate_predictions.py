"""`placewise evaluate --predictions P.npy --ground-truth GT.npy`: what was found before, judged."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from services.cli.evaluate import Wanted
from services.cli.evaluate_output import check_out, finish, result_of
from services.trainer.evaluation.nearest import Ranked
from services.trainer.evaluation.predictions import check_predictions, read_predictions
from services.trainer.evaluation.result import Run
from shared.datasets.ground_truth_files import read_ground_truth
from shared.datasets.integer_lists import read_integer_lists, read_names
from shared.datasets.layouts.named_photos import shot_of
from shared.datasets.sets import EvaluationSet, Shot
from shared.errors import InvalidRequest

PROTOCOL = "predictions file"


def evaluate_predictions(
    predictions: Path,
    ground_truth: Path,
    database: Path | None,
    queries: Path | None,
    photos: Path | None,
    sets: Sequence[str] | None,
    wanted: Wanted,
) -> None:
    """`photos` is the folder in which the lists' names are looked for; left out: that of the lists.

    Raises InvalidRequest: `one_list`, `which_set`, and what reading the files raises.
    """
    if (database is None) != (queries is None):
        raise InvalidRequest("one_list", "Give both lists, --database and --queries, or none.")
    if sets and len(sets) > 1:
        raise InvalidRequest("which_set", "A predictions file is of one set: give --set once.")
    check_out(wanted)
    ranked = read_predictions(predictions)
    name = sets[0] if sets else ground_truth.stem
    rule = None
    if database is not None and queries is not None:
        there, names = _read_list(database), _read_list(queries)
        positives, rule = read_ground_truth(ground_truth, database=there, queries=names)
        check_predictions(predictions, ranked, positives, len(there))
        shots = _shots(photos or database.parent, there), _shots(photos or queries.parent, names)
    else:
        positives = read_integer_lists(ground_truth)
        check_predictions(predictions, ranked, positives, None)
        # Nothing is known of them but their numbers.
        numbered = tuple(Shot(Path(f"query {q}"), f"query {q}") for q in range(len(positives)))
        shots = (), numbered
    asked = EvaluationSet(
        name=name,
        root=photos or predictions.parent,
        database=shots[0],
        queries=shots[1],
        positives=tuple(positives),
        rule=rule or f"given by {ground_truth.name}",
        protocol=PROTOCOL,
    )
    kept = ranked[:, : wanted.depth]
    found = Ranked(kept, np.zeros(kept.shape, np.float32))
    result = result_of(asked, found, wanted, has_scores=False, about={})
    run = Run(predictions.stem, None, {"predictions": predictions.name})
    finish(run, [result], wanted)


def _read_list(path: Path) -> list[str]:
    """Names of photos: a `.npy` array of texts, or a text with one a line."""
    if path.suffix == ".npy":
        return read_names(path)
    try:
        return [line for line in path.read_text(encoding="utf-8").splitlines() if line]
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidRequest("bad_list", f"{path} is no list of paths: {error}.") from error


def _shots(folder: Path, names: Sequence[str]) -> tuple[Shot, ...]:
    return tuple(shot_of(folder / name.lstrip("/"), name) for name in names)
