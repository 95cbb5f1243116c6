"""`placewise evaluate --data DIR`: evaluate a model, rows of descriptors or a server on data sets.

A server is evaluated over HTTP: the set's database photos are uploaded to a map, and its queries
are sent as unstored query photos. Imports torch.
"""

from __future__ import annotations

import contextlib
import functools
import re
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar
from uuid import UUID

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
from lab.evaluation.ranking import (
    Rows,
    describe_evaluation_set,
    describe_to_matrix,
    refused_photos_error,
)
from lab.evaluation.results import EvaluationResult, EvaluationRun, load_matrix, read_comparable_run
from placewise.answers import Similar, Uploaded
from placewise.client import Client
from services.cli.client import active_generation, connect
from services.cli.environment import read_settings
from services.cli.ingest.upload import (
    RETRY_PERIOD_SECONDS,
    UPLOAD_CONCURRENCY,
    wait_for_automatic_fit,
    wait_until_described,
)
from services.cli.output import progress_bar, stage_bars
from shared.config.settings import Settings
from shared.errors import Conflict, InvalidRequest, NotFound, Unavailable, Unprocessable
from shared.evaluation.places.evidence import EVIDENCE_DEPTH
from shared.evaluation.places.levels import LevelScheme

Result = TypeVar("Result")


def _evaluate_server(
    evaluation_set: EvaluationSet, target: EvaluationTarget, depth: int, progress: Progress
) -> tuple[Rankings, EvaluationRun, dict[str, Any]]:
    """Rank the database photos for each query through a server's HTTP API.

    The map, by default one named after the set, is created if it does not exist. A repeated
    evaluation describes no photo twice. No positions are sent: results depend on the images only.
    """
    set_name = re.sub(r"[^a-z0-9]+", "-", evaluation_set.name.lower()).strip("-")
    name = target.map_name or f"evaluate-{set_name}"
    with connect(target.server, None, target.key) as client:
        if name not in {map_.name for map_ in client.maps()}:
            client.create_map(name)
    with connect(target.server, name, target.key) as client:
        retrying_client = client.with_patience(RETRY_PERIOD_SECONDS, lambda error, seconds: None)
        indices_by_file = _upload_database(retrying_client, evaluation_set, name, progress)
        bar = progress.add_task(
            f"{evaluation_set.name}: querying", total=len(evaluation_set.queries)
        )

        def query(photo: Path) -> tuple[Similar, float]:
            started = time.perf_counter()
            k = min(depth, len(indices_by_file))
            response = retrying_client.similar(photo, top_k=k, history=False)
            progress.advance(bar)
            return response, time.perf_counter() - started

        responses = _map_concurrently(query, [photo.path for photo in evaluation_set.queries])
        active = active_generation(client)
    generation = active.as_json() if active else {}
    k = min(depth, len(evaluation_set.database))
    ranked = Rankings(
        np.empty((len(responses), k), np.int64), np.empty((len(responses), k), np.float32)
    )
    for row, (response, _) in enumerate(responses):
        _fill_ranking(ranked, row, response, indices_by_file, evaluation_set.queries[row].name)
    run = EvaluationRun(
        f"map {name}",
        None,
        {
            "extractor": generation.get("extractor"),
            "vocabulary": generation.get("vocabulary_id"),
            "generation": generation.get("generation_id"),
        },
    )
    seconds = [duration for _, duration in responses]
    median_ms = 1000 * float(np.median(seconds))
    return ranked, run, {"dimension": generation.get("dimension"), "answer_ms_median": median_ms}


def _upload_database(
    client: Client, evaluation_set: EvaluationSet, name: str, progress: Progress
) -> dict[UUID, list[int]]:
    """Upload the database photos; returns the database indices by file id, the same for twins."""
    bar = progress.add_task(f"{evaluation_set.name}: uploading", total=len(evaluation_set.database))

    def upload(index: int) -> Uploaded:
        photo = evaluation_set.database[index]
        response = client.upload(photo.path, filename=Path(photo.name).name)
        progress.advance(bar)
        return response

    uploaded = _map_concurrently(upload, range(len(evaluation_set.database)))
    indices_by_file: dict[UUID, list[int]] = {}
    for index, response in enumerate(uploaded):
        indices_by_file.setdefault(response.file_id, []).append(index)
    for response in uploaded:
        if response.job_id is not None:
            wait_until_described(client, response.job_id)
    fit = wait_for_automatic_fit(client, progress)
    if fit is not None:
        fit.raise_for_failure()
    stats = client.stats()
    if stats.total_images != len(indices_by_file):
        raise Conflict(
            "map_holds_others",
            f"Map {name} contains {stats.total_images} photos instead of the "
            f"{len(indices_by_file)} of {evaluation_set.name}. Other photos would change the "
            "results. Use another --map, or delete this one.",
        )
    bar = progress.add_task(f"{evaluation_set.name}: describing", total=len(indices_by_file))
    failed = []
    for index, response in enumerate(uploaded):
        if response.job_id is None or indices_by_file[response.file_id][0] != index:
            continue
        try:
            client.wait(response)
        except Unprocessable as error:
            failed.append((evaluation_set.database[index].path, error))
        progress.advance(bar)
    if failed:
        raise refused_photos_error(failed, len(evaluation_set.database))
    return indices_by_file


def _map_concurrently(function: Callable[[Any], Result], items: Sequence[Any]) -> list[Result]:
    """Apply a function to each item in parallel threads; results are in the order of the items."""
    with ThreadPoolExecutor(UPLOAD_CONCURRENCY) as pool:
        return list(pool.map(function, items))


def _fill_ranking(
    ranked: Rankings, row: int, response: Similar, indices_by_file: dict[UUID, list[int]], name: str
) -> None:
    k = ranked.indices.shape[1]
    matches = [
        (index, image.similarity_score)
        for image in response.similar_images
        for index in indices_by_file[image.image_id]
    ][:k]
    if len(matches) < k:
        raise Unavailable(
            "answer_short",
            f"The server returned {len(matches)} of {k} photos for {name}. Check that all search "
            "shards are available, and try again.",
        )
    ranked.indices[row] = [index for index, _ in matches]
    ranked.scores[row] = [score for _, score in matches]


@dataclass(frozen=True, slots=True)
class EvaluationTarget:
    """The model or server to evaluate."""

    checkpoint: Path | None
    image_size: str | tuple[int, int]
    extractor: str | None
    rows: tuple[Path, Path] | None
    """`.npy` files with the descriptors of the database and of the queries"""
    vocabulary: Path | None
    fit_vocabulary: bool
    server: str | None
    map_name: str | None
    key: str | None

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
        if not (self.checkpoint or self.extractor or self.rows or self.server):
            raise InvalidRequest(
                "no_model",
                "Specify what to evaluate: --checkpoint F.ckpt, --extractor NAME, --rows "
                "DATABASE.npy QUERIES.npy, or --server URL.",
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
    described = target.checkpoint or target.extractor or target.rows
    if options.place_labels_are_paths and not described:
        raise InvalidRequest(
            "options_contradict",
            "--place-labels-are-paths requires --checkpoint, --extractor or --rows: with --server, "
            "levels are not measured. To measure those of a map: placewise evaluate --map NAME.",
        )
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
            elif not described:
                ranked, run, figures = _evaluate_server(
                    evaluation_set, target, options.depth, progress
                )
                result = evaluate_rankings(
                    evaluation_set, ranked, options, has_scores=True, about=figures
                )
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
