"""A data set asked of a running service: its database becomes a map, its queries are uploaded."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.progress import Progress

from services.cli.connect import connect
from services.cli.upload_many import (
    RETRY_PERIOD_SECONDS,
    UPLOAD_CONCURRENCY,
    fit_vocabulary_if_needed,
)
from services.trainer.evaluation.describe import refused_photos_error
from services.trainer.evaluation.nearest import Rankings
from services.trainer.evaluation.result import EvaluationRun
from shared.client import Client, Json
from shared.datasets.sets import EvaluationSet
from shared.errors import Conflict, Unavailable, Unprocessable

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
