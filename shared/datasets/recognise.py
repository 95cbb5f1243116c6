"""What a folder holds, as `placewise datasets check` tells it: sets, figures, and what is wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from shared.datasets.decode_check import find_undecodable
from shared.datasets.distances import has_position
from shared.datasets.ground_truth import find_positives
from shared.datasets.rules import PositiveRule
from shared.datasets.sets import (
    find_evaluation_sets,
    find_training_layout,
    open_evaluation_set,
    open_training_set,
)
from shared.datasets.shots import EvaluationSet, TrainingSet
from shared.errors import NotFound, PlacewiseError

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
            f"of {len(evaluation.queries)} queries of {name} have other positives by {RADIUS_RULE} than "
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
