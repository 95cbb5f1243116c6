"""`placewise evaluate --data DIR`: evaluate a model or rows of descriptors. Imports torch."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from lab.cli.evaluation.commands import ReportOptions
from lab.cli.evaluation.describers import Describer, checkpoint_describer, extractor_describer
from lab.cli.evaluation.results import check_output_folders, evaluate_rankings, output_results
from lab.datasets.dataset import EvaluationSet
from lab.datasets.ground_truth_files import read_ground_truth
from lab.datasets.open_dataset import evaluation_set_names, open_evaluation_set
from lab.evaluation.exact_knn import Rankings, exact_knn
from lab.evaluation.places import measure_places
from lab.evaluation.ranking import Rows, describe_evaluation_set, describe_to_matrix
from lab.evaluation.results import EvaluationResult, EvaluationRun, load_matrix, read_comparable_run
from services.cli.environment import read_settings
from services.cli.output import progress_bar, stage_bars
from shared.config.settings import Settings
from shared.errors import InvalidRequest, NotFound
from shared.evaluation.places.evidence import EVIDENCE_DEPTH
from shared.evaluation.places.levels import LevelScheme

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class EvaluationTarget:
    """The model to evaluate."""

    checkpoint: Path | None
    image_size: str | tuple[int, int]
    extractor: str | None
    rows: tuple[Path, Path] | None
    """`.npy` files with the descriptors of the database and of the queries"""
    vocabulary: Path | None
    fit_vocabulary: bool

    def check(self) -> None:
        """Check that exactly one target is given.

        Raises InvalidRequest: `options_contradict`, `no_model`.
        """
        if len([one for one in (self.checkpoint, self.extractor, self.rows) if one]) > 1:
            raise InvalidRequest(
                "options_contradict", "--checkpoint, --extractor and --rows exclude each other."
            )
        if self.extractor is None and (self.vocabulary is not None or self.fit_vocabulary):
            raise InvalidRequest(
                "options_contradict", "--vocabulary and --fit-vocabulary require --extractor."
            )
        if self.vocabulary is not None and self.fit_vocabulary:
            raise InvalidRequest(
                "options_contradict", "--vocabulary and --fit-vocabulary exclude each other."
            )
        if not (self.checkpoint or self.extractor or self.rows):
            raise InvalidRequest(
                "no_model",
                "Specify what to evaluate: --checkpoint F.ckpt, --extractor NAME, or --rows "
                "DATABASE.npy QUERIES.npy.",
            )


def evaluate_sets(
    data: Path,
    names: Sequence[str] | None,
    protocol: str | None,
    rule: str | None,
    ground_truth: Path | None,
    target: EvaluationTarget,
    options: ReportOptions,
) -> None:
    """Evaluate a target on the named sets below `data`, or on all of them.

    `ground_truth` is a file that replaces the ground truth of the only set, or None.

    Raises NotFound (`no_evaluation_set`), InvalidRequest (`options_contradict`, `no_model`,
    `which_set`), Misconfigured (`out_unwritable`), and errors of opening sets and models.
    """
    target.check()
    check_output_folders(options.out, options.pairs)
    settings = read_settings()
    set_names = names or evaluation_set_names(data)
    if not set_names:
        raise NotFound("no_evaluation_set", f"{data} contains no evaluation set.")
    evaluation_sets = [
        open_evaluation_set(data, name, protocol=protocol, rule=rule) for name in set_names
    ]
    if len(evaluation_sets) > 1 and (ground_truth or target.rows):
        option = "--ground-truth" if ground_truth else "--rows"
        raise InvalidRequest(
            "which_set",
            f"{option} belongs to one set. Pass --set with one of: {', '.join(set_names)}.",
        )
    if ground_truth is not None:
        evaluation_sets = [_replace_ground_truth(evaluation_sets[0], ground_truth)]
    if options.against is not None:  # refused before minutes of work
        for each in evaluation_sets:
            read_comparable_run(options.against, each)
    results: list[EvaluationResult] = []
    run: EvaluationRun | None = None
    with progress_bar() as progress:
        for evaluation_set in evaluation_sets:
            if target.rows is not None:
                with _open_rows(evaluation_set, target.rows) as (database, queries):
                    result = _evaluate_rows(
                        evaluation_set, database, queries, options, settings, progress
                    )
                run = EvaluationRun(target.rows[0].stem, None, {"rows": target.rows[0].name})
            else:
                describer = make_describer(evaluation_set, target, settings, progress)
                result = _evaluate_describer(evaluation_set, describer, options, settings, progress)
                run = EvaluationRun(describer.name, describer.fingerprint, describer.about)
            results.append(result)
    assert run is not None, "at least one set was evaluated"
    output_results(run, results, options)


def _replace_ground_truth(evaluation_set: EvaluationSet, path: Path) -> EvaluationSet:
    positives, rule = read_ground_truth(
        path,
        database=[photo.name for photo in evaluation_set.database],
        queries=[photo.name for photo in evaluation_set.queries],
    )
    return replace(evaluation_set, positives=tuple(positives), rule=rule)


def make_describer(
    evaluation_set: EvaluationSet, target: EvaluationTarget, settings: Settings, progress: Progress
) -> Describer:
    """Create the describer of a checkpoint or an extractor."""
    if target.checkpoint is not None:
        return checkpoint_describer(target.checkpoint, target.image_size, settings)
    assert target.extractor is not None
    return extractor_describer(
        target.extractor,
        target.vocabulary,
        evaluation_set,
        settings,
        progress,
        fit=target.fit_vocabulary,
    )


def _evaluate_describer(
    evaluation_set: EvaluationSet,
    describer: Describer,
    options: ReportOptions,
    settings: Settings,
    progress: Progress,
) -> EvaluationResult:
    on_progress = stage_bars(progress, f"{evaluation_set.name}: ")
    describer.describe.on_lookup = functools.partial(on_progress, "cached descriptors")
    with describe_evaluation_set(describer.describe, evaluation_set, on_progress) as rows:
        milliseconds = describer.describe.milliseconds_a_photo()
        return _evaluate_rows(evaluation_set, *rows, options, settings, progress, milliseconds)


def _evaluate_rows(
    evaluation_set: EvaluationSet,
    database: Rows,
    queries: Rows,
    options: ReportOptions,
    settings: Settings,
    progress: Progress,
    describe_ms_a_photo: float | None = None,
) -> EvaluationResult:
    """Rank the (m, D) rows of the database for the (n, D) of the queries, and measure."""
    on_progress = stage_bars(progress, f"{evaluation_set.name}: ")
    scheme = LevelScheme(
        labels_are_paths=options.place_labels_are_paths, radii_m=settings.level_radii_m
    )
    depth, search = max(options.depth, EVIDENCE_DEPTH), functools.partial(on_progress, "search")
    ranked = exact_knn(queries, database, depth, faiss_gpu=options.faiss_gpu, on_progress=search)
    places = measure_places(evaluation_set, database, ranked, scheme, settings.estimate_radius_m)
    figures: dict[str, Any] = {
        "dimension": database.shape[1],
        "bytes_a_photo": settings.stored_bytes(database.shape[1]),
        "describe_ms_a_photo": describe_ms_a_photo,
    }
    shown = Rankings(ranked.indices[:, : options.depth], ranked.scores[:, : options.depth])
    return evaluate_rankings(
        evaluation_set, shown, options, has_scores=True, about=figures, places=places
    )


ROWS_BLOCK_BYTES = 64_000_000  # size of the float32 rows that are read at once


@contextlib.contextmanager
def _open_rows(
    evaluation_set: EvaluationSet, files: tuple[Path, Path]
) -> Iterator[tuple[Rows, Rows]]:
    """Read a set's descriptors into L2-normalised matrices, valid inside the `with` block."""
    with contextlib.ExitStack() as stack:
        matrices: list[Rows] = []
        for file, role in zip(files, ("database", "queries"), strict=True):
            photos = getattr(evaluation_set, role)
            rows = load_matrix(file, "fiu", "bad_rows", "a (photos, D) array of numbers")
            if len(rows) != len(photos):
                raise InvalidRequest(
                    "bad_rows",
                    f"{file} has {len(rows)} rows for the {len(photos)} photos of the {role} of "
                    f"{evaluation_set.name}. Write one row per photo, in the order of: placewise "
                    f"datasets list {evaluation_set.root} --set {evaluation_set.name}",
                )
            paths = [photo.path for photo in photos]
            normalised = functools.partial(_normalised_blocks, file, rows)
            matrices.append(stack.enter_context(describe_to_matrix(normalised, paths)))
        database, queries = matrices
        if database.shape[1] != queries.shape[1]:
            raise InvalidRequest(
                "bad_rows",
                f"{files[0]} has {database.shape[1]} columns and {files[1]} {queries.shape[1]}.",
            )
        yield database, queries


def _normalised_blocks(file: Path, rows: NDArray[Any], photos: Sequence[Path]) -> Iterator[Rows]:
    height = max(1, ROWS_BLOCK_BYTES // (4 * max(1, rows.shape[1])))
    for begin in range(0, len(photos), height):
        block = np.asarray(rows[begin : begin + height], np.float64)
        norms = np.linalg.norm(block, axis=1, keepdims=True)
        bad = np.flatnonzero(~(np.isfinite(norms) & (norms > 0)))
        if len(bad):
            raise InvalidRequest(
                "bad_rows",
                f"Row {begin + bad[0]} of {file} is zero, or has values that are not finite.",
            )
        yield (block / norms).astype(np.float32)
