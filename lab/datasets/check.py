"""Dataset checks: what a folder contains, and undecodable photos.

`inspect_dataset` opens every set in a folder and collects problems, for `placewise datasets check`.

`find_undecodable_photos` decodes every photo completely, on all cores.
"""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from lab.datasets.dataset import EvaluationSet, TrainingSet
from lab.datasets.ground_truth import PositiveRule, find_positives
from lab.datasets.open_dataset import (
    find_evaluation_sets,
    find_training_layout,
    open_evaluation_set,
    open_training_set,
)
from lab.datasets.utm_coordinates import has_position
from shared.errors import NotFound, PlacewiseError, Unprocessable
from shared.imaging.file_formats import PHOTO_READ_ERRORS, check_pixel_count
from shared.imaging.file_structure import open_photo

MAX_DECODED_PIXELS = 100_000_000
"""Maximum of width x height of a decoded photo; larger ones would exhaust memory."""


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
    """A problem of a dataset, with the number of its occurrences."""

    code: str
    count: int
    detail: str
    examples: tuple[str, ...] = ()
    """At most MAX_EXAMPLES"""


@dataclass(frozen=True)
class DatasetReport:
    """The sets at or below a folder; sets that can't be opened are listed as problems."""

    root: Path
    training: TrainingSet | None
    evaluation: tuple[EvaluationSet, ...]
    layouts: tuple[str, ...]
    """Layout names: of the training set, if there is one, then of each evaluation set"""
    problems: list[DatasetProblem]

    def photos(self) -> tuple[Path, ...]:
        """Return all photos of all sets, in order and without duplicates."""
        places = self.training.places if self.training else ()
        paths = [path for place in places for path in place.photos]
        for opened in self.evaluation:
            paths += [photo.path for photo in (*opened.database, *opened.queries)]
        return tuple(dict.fromkeys(paths))


def inspect_dataset(
    root: Path, *, protocol: str | None = None, rule: str | None = None, min_photos: int = 2
) -> DatasetReport:
    """Open all sets at or below a folder and collect their problems.

    `protocol` and `rule` are those of the evaluation sets, None for their own. Training places with
    fewer than `min_photos` are left out. Raises NotFound (`no_data_set`).
    """
    discovered = find_evaluation_sets(root)
    layout = find_training_layout(root)
    if not discovered and layout is None:
        raise NotFound(
            "no_data_set",
            f"No dataset was recognised in {root}. See docs/how-to/data-sets.md for all layouts.",
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
    for candidate in discovered:
        layouts.append(candidate.layout.name)
        try:
            opened = open_evaluation_set(root, candidate.name, protocol=protocol, rule=rule)
        except PlacewiseError as error:
            problems.append(DatasetProblem(error.code, 1, f"{candidate.name}: {error.detail}"))
        else:
            evaluation.append(opened)
            problems += _find_problems(opened)
    report = DatasetReport(root, training, tuple(evaluation), tuple(layouts), problems)
    missing = [str(path) for path in report.photos() if not path.is_file()]
    if missing:
        problems.append(_problem("missing_photo", missing, "listed photos do not exist"))
    return report


def find_undecodable_photos(
    report: DatasetReport, on_progress: Callable[[int], None] = lambda count: None
) -> list[DatasetProblem]:
    """Decode every photo of a report completely and return the problem, if there is one.

    `on_progress` is called with the number of photos done since the last call.
    """
    photos = report.photos()
    existing = [path for path in photos if path.is_file()]
    on_progress(len(photos) - len(existing))  # missing photos are reported already
    broken = []
    # Threads suffice, because Pillow releases the GIL while decoding. Its warnings about unusual
    # EXIF are ignored around all threads, because warning filters are process-wide.
    with warnings.catch_warnings(), ThreadPoolExecutor(os.cpu_count()) as pool:
        warnings.simplefilter("ignore")
        for path, reason in zip(existing, pool.map(_decode_error, existing), strict=True):
            on_progress(1)
            if reason is not None:
                broken.append(f"{path}: {reason}")
    return [_problem("undecodable_photo", broken, "photos can't be decoded")] if broken else []


def _find_problems(evaluation: EvaluationSet) -> Iterator[DatasetProblem]:
    name = evaluation.name
    for role, photos in (("database", evaluation.database), ("queries", evaluation.queries)):
        counts = Counter(photo.name for photo in photos)
        duplicates = [name for name, count in counts.items() if count > 1]
        if duplicates:
            yield _problem(
                "listed_twice", duplicates, f"photos are listed twice in {name}'s {role}"
            )
    database_paths = {photo.path for photo in evaluation.database}
    shared = [photo.name for photo in evaluation.queries if photo.path in database_paths]
    if shared:
        yield _problem("query_in_database", shared, f"queries of {name} are also database photos")
    differing = _differing_positives(evaluation)
    if differing:
        yield _problem(
            "ground_truth_differs",
            differing,
            f"of {len(evaluation.queries)} queries of {name} have other positives by "
            f"{RADIUS_RULE} than in the ground truth of the set",
        )


def _differing_positives(evaluation: EvaluationSet) -> list[str]:
    """Return the queries whose given positives differ from those within 25 m, if both exist."""
    photos = (*evaluation.queries, *evaluation.database)
    if not evaluation.rule.startswith("given ") or not all(has_position(photo) for photo in photos):
        return []
    computed = find_positives(RADIUS_RULE, evaluation.queries, evaluation.database)
    return [
        query.name
        for query, given, within_radius in zip(
            evaluation.queries, evaluation.positives, computed, strict=True
        )
        if given.tolist() != within_radius.tolist()
    ]


def _problem(code: str, examples: Sequence[str], what: str) -> DatasetProblem:
    return DatasetProblem(
        code, len(examples), f"{len(examples)} {what}.", tuple(examples[:MAX_EXAMPLES])
    )
