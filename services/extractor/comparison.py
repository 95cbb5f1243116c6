"""Handler of `compare` jobs: reranks a search result by local features, and explains similarities.

Photos that were deleted meanwhile are left out of the result. A worker whose lease was taken over
stores the same result, but can't end the job.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from uuid import UUID

import numpy as np
import torch

from services.extractor.describe import read_stored_rows
from services.extractor.generation_resolver import ResolvedGeneration, resolve_generation
from services.extractor.handlers import ExtractorContext, JobBatch, handles
from shared.catalog.photos import Photo, get_live_photos, get_photo
from shared.descriptors.explanation import SimilarityShares, draw_overlay, explain_similarities
from shared.descriptors.extractor import Extractor, not_finite_error
from shared.descriptors.inference import PhotoTooLargeForGpu
from shared.descriptors.reranking import LocalFeatures, rerank_score
from shared.errors import Gone, NotFound, PlacewiseError
from shared.imaging.preprocessing import Pixels
from shared.jobs import Job, JobKind
from shared.jobs.leases import lock_leased_job
from shared.jobs.transitions import succeed_job
from shared.search_api.comparison import (
    ClusterContribution,
    CompareRequest,
    CompareResult,
    RerankedCandidate,
    SimilarityExplanation,
    check_explainable,
    check_rerankable,
    query_expired_error,
)
from shared.storage.keys import comparison_key, query_key

log = logging.getLogger(__name__)


@handles(JobKind.COMPARE)
def compare_photos(context: ExtractorContext, batch: JobBatch) -> Iterator[None]:
    """Prepare and compare the query of a claimed job; PlacewiseError if that can't be done."""
    job = batch.jobs[0]
    request = CompareRequest.model_validate(job.params["request"])
    target = resolve_generation(context, job)
    assert target is not None, "a compare job names an existing generation"
    if request.rerank:
        check_rerankable(target.extractor.config)
    if request.explain:
        check_explainable(target.extractor.config, target.generation.spec)
    data = _read_query(context, job, request)
    (query,) = context.decoders.decode([data], target.extractor.preprocessing)
    if isinstance(query, PlacewiseError):
        raise query
    yield
    with batch.timed("compare"):
        result = _compare(context, request, target, query.pixels)
    context.store.put(comparison_key(job.id), result.model_dump_json().encode())
    with context.catalog.write() as session:
        leased = lock_leased_job(session, job)
        if leased is not None:
            succeed_job(leased, {"candidates": len(result.candidates)})
    batch.outcomes["lost" if leased is None else "succeeded"] = 1


def _read_query(context: ExtractorContext, job: Job, request: CompareRequest) -> bytes:
    if request.query_photo_id is None:
        assert request.query_job_id is not None, "a query is a photo or a describe job"
        try:
            return context.store.get(query_key(request.query_job_id))
        except NotFound as error:
            raise query_expired_error() from error
    with context.catalog.read() as session:
        photo = get_photo(session, job.map_id, request.query_photo_id)
    return context.store.get(photo.object_key)


def _compare(
    context: ExtractorContext, request: CompareRequest, target: ResolvedGeneration, pixels: Pixels
) -> CompareResult:
    (features,) = target.extractor.local_features([pixels])
    if not bool(features.isfinite().all()):
        raise not_finite_error()
    grid = target.extractor.backbone.grid(*pixels.shape[:2])
    with context.catalog.read() as session:
        live = get_live_photos(session, [each.photo_id for each in request.candidates])
    candidates = [candidate for candidate in request.candidates if candidate.photo_id in live]
    to_rerank, rest = candidates[: request.rerank], candidates[request.rerank :]
    query = LocalFeatures.from_features(features, grid)
    similarity = {candidate.photo_id: candidate.ranked_by for candidate in to_rerank}
    photos = [live[photo_id] for photo_id in similarity]
    scores = {  # of the photos that can be read
        photo_id: rerank_score(similarity[photo_id], query, found, features.device)
        for photo_id, found in _load_features(context, target, photos)
    }
    # The sort is stable: photos with equal scores, or without one, stay sorted by similarity.
    to_rerank.sort(key=lambda candidate: -scores.get(candidate.photo_id, -np.inf))
    ordered = [candidate.photo_id for candidate in to_rerank + rest]
    explained = ordered[: request.explain]
    shares = _explain(context, target, features, explained, request.word_weights)
    return CompareResult(
        candidates=tuple(
            RerankedCandidate(
                photo_id=photo_id,
                rerank_score=scores.get(photo_id),
                explanation=_build_explanation(shares[photo_id], grid)
                if photo_id in shares
                else None,
            )
            for photo_id in ordered
        )
    )


def _load_features(
    context: ExtractorContext, target: ResolvedGeneration, photos: Sequence[Photo]
) -> Iterator[tuple[UUID, LocalFeatures]]:
    """Yield each photo's local features, in any order; at most one batch is held in memory.

    Photos are left out, and logged by their ids, if they can't be read or decoded, are too large
    for the GPU's memory, or have features that are not finite.
    """
    batch_photos = context.settings.batch_photos
    for begin in range(0, len(photos), batch_photos):
        yield from _compute_features(context, target, photos[begin : begin + batch_photos])


def _compute_features(
    context: ExtractorContext, target: ResolvedGeneration, photos: Sequence[Photo]
) -> Iterator[tuple[UUID, LocalFeatures]]:
    photo_ids = []

    def read_photos() -> Iterator[bytes]:
        for photo in photos:
            try:
                data = context.store.get(photo.object_key)
            except NotFound:
                log.warning("the photo %s is not compared: its object is missing", photo.id)
                continue
            photo_ids.append(photo.id)
            yield data

    extractor = target.extractor
    decoded = []
    outcomes = context.decoders.decode(read_photos(), extractor.preprocessing)
    for photo_id, outcome in zip(photo_ids, outcomes, strict=True):
        if isinstance(outcome, PlacewiseError):
            _log_skipped(photo_id, outcome)
        else:
            decoded.append((photo_id, outcome.pixels))
    features = _features_that_fit_memory(extractor, decoded)
    for (photo_id, pixels), tensor in zip(decoded, features, strict=True):
        grid = extractor.backbone.grid(*pixels.shape[:2])
        local_features = LocalFeatures.from_features(tensor, grid)
        if local_features.finite:
            yield photo_id, local_features
        else:
            _log_skipped(photo_id, not_finite_error())


def _features_that_fit_memory(
    extractor: Extractor, decoded: list[tuple[UUID, Pixels]]
) -> list[torch.Tensor]:
    """Local features of `decoded`, from which photos too large for the GPU's memory are removed."""
    while True:
        try:
            return extractor.local_features([pixels for _, pixels in decoded])
        except PhotoTooLargeForGpu as error:
            photo_id, _ = decoded.pop(error.place)
            _log_skipped(photo_id, error)


def _log_skipped(photo_id: UUID, error: PlacewiseError) -> None:
    log.warning("the photo %s is not compared: %s", photo_id, error.detail)


def _explain(
    context: ExtractorContext,
    target: ResolvedGeneration,
    features: torch.Tensor,
    photo_ids: Sequence[UUID],
    word_weights: Sequence[float],
) -> dict[UUID, SimilarityShares]:
    """Return the similarity shares of each photo."""
    if not photo_ids:
        return {}
    generation_id = target.generation.id
    stored = read_stored_rows(context.catalog, context.store, generation_id, photo_ids)
    if not stored:
        raise Gone(
            "query_expired",
            f"The descriptors of these photos in generation {generation_id} have been "
            "deleted. Search again.",
        )
    rows = np.stack(list(stored.values()))
    shares = explain_similarities(
        target.extractor.config, features, target.centres, rows, word_weights
    )
    return dict(zip(stored, shares, strict=True))


def _build_explanation(shares: SimilarityShares, grid: tuple[int, int]) -> SimilarityExplanation:
    overlay, full_share = draw_overlay(shares.patches.reshape(grid))
    clusters = None
    if shares.clusters is not None:
        by_share = np.argsort(-shares.clusters, kind="stable")
        clusters = tuple(
            ClusterContribution(cluster=int(cluster), share=float(shares.clusters[cluster]))
            for cluster in by_share
            if shares.clusters[cluster]
        )
    return SimilarityExplanation(
        clusters=clusters,
        rows=grid[0],
        columns=grid[1],
        overlay=overlay,
        full_share=full_share,
    )
