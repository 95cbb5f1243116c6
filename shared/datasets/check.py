"""What a folder holds, as `placewise datasets check` tells it: sets, figures, and what is wrong.

Photos that don't decode, found by decoding them all: on all cores, each to its last pixel.

Answers that a ground truth calls wrong although they may be right.

A confident first match just outside the rule, 30 m away say, or in the right spot but looking
another way, often shows the place: whoever made the ground truth should look at it. Users of
published sets have found whole figures wrong for such labels.
"""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shared.datasets.dataset import DatasetPhoto, EvaluationSet, Indices, TrainingSet
from shared.datasets.ground_truth import (
    PositiveRule,
    find_positives,
    heading_differences,
    parse_rule,
)
from shared.datasets.open_dataset import (
    find_evaluation_sets,
    find_training_layout,
    open_evaluation_set,
    open_training_set,
)
from shared.datasets.utm_coordinates import has_position, pairwise_distances_m
from shared.errors import InvalidRequest, NotFound, PlacewiseError, Unprocessable
from shared.imaging.file_formats import PHOTO_READ_ERRORS, check_pixel_count, open_photo

MAX_DECODED_PIXELS = 100_000_000
"""Of a photo that is decoded: more is an attack on memory, or no photo of a street."""
PHOTOS_PER_TASK = 1024


def find_undecodable(
    paths: Sequence[Path], on_progress: Callable[[int], None] = lambda count: None
) -> list[tuple[Path, str]]:
    """Each photo that can't be decoded, with what is wrong; `on_progress` is told of each photo."""
    broken = []
    # Pillow decodes without the lock. Its warnings, of strange EXIF, are ignored around all threads
    # at once: the filters are the process's, not a thread's.
    with warnings.catch_warnings(), ThreadPoolExecutor(os.cpu_count()) as pool:
        warnings.simplefilter("ignore")
        for start in range(0, len(paths), PHOTOS_PER_TASK):
            some = paths[start : start + PHOTOS_PER_TASK]
            for path, fault in zip(some, pool.map(_decode_error, some), strict=True):
                on_progress(1)
                if fault is not None:
                    broken.append((path, fault))
    return broken


def _decode_error(path: Path) -> str | None:
    try:
        with path.open("rb") as file, open_photo(file) as image:
            check_pixel_count(image.width, image.height, MAX_DECODED_PIXELS)
            image.load()
    except Unprocessable as error:
        return error.detail
    except PHOTO_READ_ERRORS as error:
        return str(error) or type(error).__name__
    return None


MAX_EXAMPLES = 5
RADIUS_RULE = PositiveRule("radius")


@dataclass(frozen=True, slots=True)
class DatasetProblem:
    """Something that is wrong with a data set, and how often."""

    code: str
    count: int
    detail: str
    examples: tuple[str, ...] = ()
    """at most MOST_EXAMPLES"""


@dataclass(frozen=True)
class DatasetReport:
    """What was found at or below a folder; what could not be opened is among the problems."""

    root: Path
    training: TrainingSet | None
    evaluation: tuple[EvaluationSet, ...]
    layouts: tuple[str, ...]
    """of the training set, if there is one, and then of each evaluation set"""
    problems: tuple[DatasetProblem, ...]

    def photos(self) -> tuple[Path, ...]:
        """Every photo of every set, once, in order."""
        return tuple(dict.fromkeys(_photos(self.training, self.evaluation)))


def inspect_dataset(
    root: Path, *, protocol: str | None = None, rule: str | None = None, min_photos: int = 2
) -> DatasetReport:
    """Open whatever there is. `protocol` and `rule` are those of the evaluation sets.

    Raises NotFound (`no_data_set`) where there is nothing to open at all.
    """
    found = find_evaluation_sets(root)
    layout = find_training_layout(root)
    if not found and layout is None:
        raise NotFound(
            "no_data_set",
            f"No data set was recognised in {root}. docs/how-to/data-sets.md shows every layout.",
        )
    problems: list[DatasetProblem] = []
    training: TrainingSet | None = None
    layouts: list[str] = []
    if layout is not None:
        layouts.append(layout[0].name)
        try:
            training = open_training_set(root, min_photos=min_photos)
        except PlacewiseError as error:
            problems.append(DatasetProblem(error.code, 1, error.detail))
    evaluation = []
    for one in found:
        layouts.append(one.layout.name)
        try:
            opened = open_evaluation_set(root, one.name, protocol=protocol, rule=rule)
        except PlacewiseError as error:
            problems.append(DatasetProblem(error.code, 1, f"{one.name}: {error.detail}"))
        else:
            evaluation.append(opened)
            problems += _find_problems(opened)
    recognised = DatasetReport(root, training, tuple(evaluation), tuple(layouts), tuple(problems))
    return _add_missing_files(recognised)


def find_undecodable_photos(
    report: DatasetReport, done: Callable[[int], None] = lambda count: None
) -> list[DatasetProblem]:
    """Open every photo to its last pixel; `done` is told how many more have been."""
    photos = report.photos()
    there = [path for path in photos if path.is_file()]
    done(len(photos) - len(there))  # these are among the problems already
    broken = [f"{path}: {fault}" for path, fault in find_undecodable(there, done)]
    return [_problem("undecodable_photo", broken, "photos can't be decoded")] if broken else []


def _add_missing_files(recognised: DatasetReport) -> DatasetReport:
    missing = [str(path) for path in recognised.photos() if not path.is_file()]
    if not missing:
        return recognised
    problem = _problem("missing_photo", missing, "photos are named, and are not there")
    return DatasetReport(
        recognised.root,
        recognised.training,
        recognised.evaluation,
        recognised.layouts,
        (*recognised.problems, problem),
    )


def _find_problems(evaluation: EvaluationSet) -> Iterator[DatasetProblem]:
    name = evaluation.name
    for role, shots in (("database", evaluation.database), ("queries", evaluation.queries)):
        twice = _duplicates(shot.name for shot in shots)
        if twice:
            yield _problem("listed_twice", twice, f"photos stand twice in {name}'s {role}")
    both = {shot.path for shot in evaluation.database}
    shared = [shot.name for shot in evaluation.queries if shot.path in both]
    if shared:
        yield _problem("query_in_database", shared, f"queries of {name} are database photos, too")
    differing = _differing_positives(evaluation)
    if differing:
        yield _problem(
            "ground_truth_differs",
            differing,
            f"of {len(evaluation.queries)} queries of {name} have other positives by "
            f"{RADIUS_RULE} than "
            f"in the ground truth that the set brings",
        )


def _differing_positives(evaluation: EvaluationSet) -> list[str]:
    """Queries whose given positives are not those of 25 m, where both are known."""
    shots = (*evaluation.queries, *evaluation.database)
    if not evaluation.rule.startswith("given ") or not all(has_position(shot) for shot in shots):
        return []
    computed = find_positives(RADIUS_RULE, evaluation.queries, evaluation.database)
    return [
        query.name
        for query, given, found in zip(
            evaluation.queries, evaluation.positives, computed, strict=True
        )
        if given.tolist() != found.tolist()
    ]


def _duplicates(names: Iterable[str]) -> list[str]:
    return [name for name, count in Counter(names).items() if count > 1]


def _problem(code: str, examples: Sequence[str], what: str) -> DatasetProblem:
    return DatasetProblem(
        code, len(examples), f"{len(examples)} {what}.", tuple(examples[:MAX_EXAMPLES])
    )


def _photos(training: TrainingSet | None, evaluation: Iterable[EvaluationSet]) -> Iterator[Path]:
    for place in training.places if training else ():
        yield from place.photos
    for one in evaluation:
        for shot in (*one.database, *one.queries):
            yield shot.path


MAX_RULE_MULTIPLE = 4.0
"""How far outside of the rule a match is still worth a look."""


@dataclass(frozen=True, slots=True)
class SuspectLabel:
    """A query whose confident first match counts as wrong."""

    query: int
    """index"""
    database: int
    query_name: str
    database_name: str
    score: float | None
    metres: float | None
    """between them; None where one has no position"""
    degrees: float | None
    """between the ways they look, 0 to 180; None where one has no heading"""


def find_suspect_labels(
    evaluation: EvaluationSet,
    ranked: Indices,
    scores: NDArray[np.float32] | None = None,
    *,
    min_score: float | None = None,
) -> list[SuspectLabel]:
    """First matches that are no positives, are confident, and lie just outside the set's rule.

    `ranked` is (queries, k) database indices and `scores` (queries, k), the higher the better. A
    match is confident from `min_score` on; left out, from the median score of the first matches
    that are right. Without scores every first match is. "Just outside" is TIMES_THE_RULE its
    metres or frames, whatever the heading; where the set's rule is unknown or of labels, its 25 m
    count. Most confident first.

    Raises InvalidRequest (`predictions_of_other_queries`).
    """
    if len(ranked) != len(evaluation.queries) or (
        scores is not None and len(scores) != len(ranked)
    ):
        raise InvalidRequest(
            "predictions_of_other_queries",
            f"There are {len(ranked)} predictions for {len(evaluation.queries)} queries"
            + ("." if scores is None else f", with {len(scores)} rows of scores."),
        )
    if not ranked.size:
        return []
    first = ranked[:, 0]
    right = np.array(
        [found in positives for found, positives in zip(first, evaluation.positives, strict=True)],
        dtype=bool,
    )
    confident = ~right
    if scores is not None:
        if min_score is None:
            min_score = float(np.median(scores[right, 0])) if right.any() else -np.inf
        confident &= scores[:, 0] >= min_score
    suspects = _near(evaluation, first, np.flatnonzero(confident), scores)
    return sorted(suspects, key=lambda one: (-(one.score or 0.0), one.query))


def _near(
    evaluation: EvaluationSet, first: Indices, asked: Indices, scores: NDArray[np.float32] | None
) -> list[SuspectLabel]:
    queries = [evaluation.queries[number] for number in asked]
    matches = [evaluation.database[number] for number in first[asked]]
    rule = _rule_of(evaluation)
    metres = pairwise_distances_m(queries, matches)
    suspects = []
    for number, query, match, away in zip(asked.tolist(), queries, matches, metres, strict=True):
        if _is_just_outside(rule, query, match, float(away)):
            suspects.append(
                SuspectLabel(
                    number,
                    int(first[number]),
                    query.name,
                    match.name,
                    None if scores is None else float(scores[number, 0]),
                    None if np.isnan(away) else float(away),
                    _degrees(query, match),
                )
            )
    return suspects


def _is_just_outside(
    rule: PositiveRule, query: DatasetPhoto, match: DatasetPhoto, metres: float
) -> bool:
    if rule.kind == "frames":
        if query.frame is None or match.frame is None:
            return False
        return abs(query.frame - match.frame) <= MAX_RULE_MULTIPLE * max(rule.frames, 1)
    return metres <= MAX_RULE_MULTIPLE * rule.radius_m  # never of NaN


def _rule_of(evaluation: EvaluationSet) -> PositiveRule:
    try:
        return parse_rule(evaluation.rule)
    except InvalidRequest:  # a ground truth of unknown making, named after its file
        return PositiveRule("radius")


def _degrees(query: DatasetPhoto, match: DatasetPhoto) -> float | None:
    if query.heading is None or match.heading is None:
        return None
    return float(heading_differences(np.array([match.heading]), query.heading)[0])
