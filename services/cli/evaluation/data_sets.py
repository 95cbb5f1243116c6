"""`placewise evaluate --data DIR`: a checkpoint, an extractor or a server asked about data sets.

Imports torch.

A data set asked of a running service: its database becomes a map, its queries are uploaded.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.progress import Progress

from services.cli.client import connect
from services.cli.environment import read_settings
from services.cli.evaluation.commands import ReportOptions
from services.cli.evaluation.describers import Describer, checkpoint_describer, extractor_describer
from services.cli.evaluation.results import check_output_folders, evaluate_rankings, output_results
from services.cli.ingest.upload import (
    RETRY_PERIOD_SECONDS,
    UPLOAD_CONCURRENCY,
    fit_vocabulary_if_needed,
)
from services.cli.output import progress_bar
from shared.client import Client, Json
from shared.config.settings import Settings
from shared.datasets.open_dataset import EvaluationSet, evaluation_set_names, open_evaluation_set
from shared.errors import Conflict, InvalidRequest, NotFound, Unavailable, Unprocessable
from shared.evaluation.exact_knn import Rankings
from shared.evaluation.ranking import (
    DEFAULT_KS,
    ProgressCallback,
    evaluate_recall,
    refused_photos_error,
)
from shared.evaluation.results import EvaluationResult, EvaluationRun
from shared.extractor_config.configs import get_extractor_config

Done = TypeVar("Done")


def evaluate_server(
    evaluation_set: EvaluationSet,
    server: str | None,
    map_name: str | None,
    key: str | None,
    depth: int,
    progress: Progress,
) -> tuple[Rankings, EvaluationRun, dict[str, Any]]:
    """Rank the database for each query, over HTTP.

    The photos go into the map `map_name`, or else into one named after the set; one that is not
    there is made. It may hold nothing else (Conflict, `map_holds_others`), and asking again uploads
    the same photos again and describes none twice. Only pixels are sent, no position: what is found
    is found by looks.
    """
    name = (
        map_name or f"evaluate-{re.sub(r'[^a-z0-9]+', '-', evaluation_set.name.lower()).strip('-')}"
    )
    with connect(server, None, key) as anywhere:
        if name not in {there["name"] for there in anywhere.maps()}:
            anywhere.create_map(name)
    with connect(server, name, key) as client:
        patient = client.patient(RETRY_PERIOD_SECONDS, lambda error, seconds: None)
        of_file = _upload_database(patient, evaluation_set, name, progress)
        bar = progress.add_task(f"{evaluation_set.name}: asking", total=len(evaluation_set.queries))

        def ask(photo: Path) -> tuple[Json, float]:
            begun = time.perf_counter()
            answer = patient.similar_to_file(photo, top_k=min(depth, len(of_file)))
            progress.advance(bar)
            return answer, time.perf_counter() - begun

        answers = _map_concurrently(ask, [shot.path for shot in evaluation_set.queries])
        generation = next((g for g in client.generations() if g["state"] == "active"), {})
    k = min(depth, len(evaluation_set.database))
    ranked = Rankings(
        np.empty((len(answers), k), np.int64), np.empty((len(answers), k), np.float32)
    )
    for query, (answer, _) in enumerate(answers):
        _fill_ranking(ranked, query, answer, of_file, evaluation_set.queries[query].name)
    run = EvaluationRun(
        f"map {name}",
        None,
        {
            "extractor": generation.get("extractor"),
            "vocabulary": generation.get("vocabulary_id"),
            "generation": generation.get("generation_id"),
        },
    )
    seconds = [took for _, took in answers]
    return (
        ranked,
        run,
        {
            "dimension": generation.get("dimension"),
            "answer_ms_median": 1000 * float(np.median(seconds)),
        },
    )


def _upload_database(
    client: Client, evaluation_set: EvaluationSet, name: str, progress: Progress
) -> dict[str, list[int]]:
    """The database in the map: the indices of the photos of each file id. Photos of the same bytes
    are one file."""
    bar = progress.add_task(f"{evaluation_set.name}: uploading", total=len(evaluation_set.database))

    def upload(number: int) -> Json:
        shot = evaluation_set.database[number]
        answer = client.upload(shot.path, filename=Path(shot.name).name)
        progress.advance(bar)
        return answer

    uploaded = _map_concurrently(upload, range(len(evaluation_set.database)))
    of_file: dict[str, list[int]] = {}
    for number, answer in enumerate(uploaded):
        of_file.setdefault(answer["file_id"], []).append(number)
    stats, _ = fit_vocabulary_if_needed(client, client.stats(), progress)
    if stats["total_images"] != len(of_file):
        raise Conflict(
            "map_holds_others",
            f"The map {name} holds {stats['total_images']} photos, {evaluation_set.name} has "
            f"{len(of_file)}: they would be found, too. Take another --map, or delete this one.",
        )
    bar = progress.add_task(f"{evaluation_set.name}: describing", total=len(of_file))
    failed = []
    for number, answer in enumerate(uploaded):
        if answer.get("job_id") is None or of_file[answer["file_id"]][0] != number:
            continue
        job = client.wait_for(answer["job_id"])
        progress.advance(bar)
        if job["state"] != "succeeded":
            reason = Unprocessable("not_described", str((job["error"] or {}).get("detail")))
            failed.append((evaluation_set.database[number].path, reason))
    if failed:
        raise refused_photos_error(failed, len(evaluation_set.database))
    return of_file


def _map_concurrently(do: Callable[[Any], Done], things: Sequence[Any]) -> list[Done]:
    """What `do` returns of each thing, in their order; the first error ends it."""
    with ThreadPoolExecutor(UPLOAD_CONCURRENCY) as pool:
        return list(pool.map(do, things))


def _fill_ranking(
    ranked: Rankings, query: int, answer: Json, of_file: dict[str, list[int]], name: str
) -> None:
    k = ranked.indices.shape[1]
    found = [
        (number, image["similarity_score"])
        for image in answer["similar_images"]
        for number in of_file[image["image_id"]]
    ][:k]
    if len(found) < k:
        raise Unavailable(
            "answer_short",
            f"The server found {len(found)} of {k} photos for {name}. Is a shard of its search "
            "away? Ask again.",
        )
    ranked.indices[query] = [number for number, _ in found]
    ranked.scores[query] = [score for _, score in found]


@dataclass(frozen=True, slots=True)
class EvaluationTarget:
    """Who is asked."""

    checkpoint: Path | None
    image_size: str | tuple[int, int]
    extractor: str | None
    vocabulary: Path | None
    fit_vocabulary: bool
    server: str | None
    map_name: str | None
    key: str | None

    def check(self) -> None:
        """Exactly one; InvalidRequest (`options_contradict`, `no_model`)."""
        if self.checkpoint is not None and self.extractor is not None:
            raise InvalidRequest("options_contradict", "--checkpoint and --extractor: give one.")
        if self.extractor is None and (self.vocabulary is not None or self.fit_vocabulary):
            raise InvalidRequest(
                "options_contradict", "--vocabulary, --fit-vocabulary: only with --extractor."
            )
        if self.vocabulary is not None and self.fit_vocabulary:
            raise InvalidRequest("options_contradict", "--vocabulary and --fit-vocabulary: one.")
        if self.checkpoint is None and self.extractor is None and self.server is None:
            raise InvalidRequest(
                "no_model",
                "Say what is to be evaluated: --checkpoint F.ckpt, --extractor NAME or "
                "--server URL.",
            )


def evaluate_sets(
    data: Path,
    names: Sequence[str] | None,
    protocol: str | None,
    rule: str | None,
    target: EvaluationTarget,
    options: ReportOptions,
) -> None:
    """Evaluate the named sets below `data`, or all of them. Raises as what it calls does."""
    target.check()
    check_output_folders(options)
    settings = read_settings()
    chosen = names or evaluation_set_names(data)
    if not chosen:
        raise NotFound("no_evaluation_set", f"{data} holds no set to evaluate on.")
    asked = [open_evaluation_set(data, n, protocol=protocol, rule=rule) for n in chosen]
    results: list[EvaluationResult] = []
    run: EvaluationRun | None = None
    with progress_bar() as progress:
        for one in asked:
            if target.checkpoint is None and target.extractor is None:
                result, run = _evaluate_on_server(one, target, options, progress)
            else:
                describer = _make_describer(one, target, settings, progress)
                result = _evaluate_describer(one, describer, options, progress)
                run = EvaluationRun(describer.name, describer.fingerprint, describer.about)
            results.append(result)
    assert run is not None, "there is a set"
    output_results(run, results, options)


def _make_describer(
    evaluation_set: EvaluationSet, target: EvaluationTarget, settings: Settings, progress: Progress
) -> Describer:
    if target.checkpoint is not None:
        return checkpoint_describer(target.checkpoint, target.image_size, settings)
    assert target.extractor is not None
    recipe = get_extractor_config(
        target.extractor, allow_test_extractors=settings.allow_test_extractors
    )
    return extractor_describer(
        recipe,
        target.vocabulary,
        [shot.path for shot in evaluation_set.database],
        settings,
        progress,
        fit=target.fit_vocabulary,
    )


def _evaluate_describer(
    evaluation_set: EvaluationSet, describer: Describer, options: ReportOptions, progress: Progress
) -> EvaluationResult:
    told = progress_bars(progress, evaluation_set.name)
    describer.describe.on_lookup = lambda done, most: told("known photos", done, most)
    found = evaluate_recall(
        describer.describe,
        evaluation_set,
        ks=[*(k for k in DEFAULT_KS if k <= options.depth), options.depth],
        faiss_gpu=options.faiss_gpu,
        on_progress=told,
    )
    about: dict[str, Any] = {
        "dimension": found.dimension,
        "bytes_a_photo": 4 * found.dimension,
        "describe_ms_a_photo": describer.describe.milliseconds_a_photo(),
    }
    return evaluate_rankings(evaluation_set, found.ranked, options, has_scores=True, about=about)


def _evaluate_on_server(
    evaluation_set: EvaluationSet,
    target: EvaluationTarget,
    options: ReportOptions,
    progress: Progress,
) -> tuple[EvaluationResult, EvaluationRun]:
    ranked, run, about = evaluate_server(
        evaluation_set, target.server, target.map_name, target.key, options.depth, progress
    )
    return evaluate_rankings(evaluation_set, ranked, options, has_scores=True, about=about), run


def progress_bars(progress: Progress, name: str) -> ProgressCallback:
    """Bars for each thing that is done about a set."""
    bars: dict[str, Any] = {}

    def told(what: str, done: int, most: int) -> None:
        if what not in bars:
            bars[what] = progress.add_task(f"{name}: {what}", total=most)
        progress.update(bars[what], completed=done, total=most)

    return told
