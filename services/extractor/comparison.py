"""Compare jobs: rerank the photos of a search result by local features, and explain similarities.

One job compares one query, in one step:

    prepare    resolve the generation and decode the query, while the previous batch is described
    compare    compute local features of the query and, to rerank, of the candidates in batches;
               to explain, read the candidates' descriptors
    publish    store the result as an object, then end the job

Photos that were deleted meanwhile are left out of the result. A worker whose lease was taken over
stores the same result, but can't end the job.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from uuid import UUID

import numpy as np
import torch

from services.extractor.decoder_pool import DecoderPool
from services.extractor.generation_resolver import ResolvedGeneration, resolve_generation
from services.extractor.model_registry import ModelRegistry
from services.extractor.prepare import read_stored_rows
from services.extractor.publish import PublishResult
from shared.catalog.database.session import Catalog
from shared.catalog.photos import Photo, get_live_photos, get_photo
from shared.config.settings import Settings
from shared.descriptors.explanation import SimilarityShares, draw_overlay, explain_similarities
from shared.descriptors.extractor import Extractor, not_finite_error
from shared.descriptors.inference import PhotoTooLargeForGpu
from shared.descriptors.reranking import LocalFeatures, rerank_score
from shared.errors import Gone, NotFound, PlacewiseError, StorageFull
from shared.imaging.decode import DecodedPhoto
from shared.imaging.preprocessing import Pixels
from shared.jobs import Job
from shared.jobs.leases import get_lease_token, lock_leased_jobs
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
from shared.search_api.protocol import SearchHit
from shared.storage import ObjectStore
from shared.storage.keys import comparison_key, local_features_key, query_key

log = logging.getLogger(__name__)


class _CandidateFeatures:
    """Computes candidates' local features, and stores them with LOCAL_FEATURES=keep.

    Stored features are the objects under `features/`.
    """

    def __init__(self, store: ObjectStore, decoders: DecoderPool, settings: Settings) -> None:
        self._store = store
        self._decoders = decoders
        self._store_enabled = settings.local_features == "keep"
        self._batch_size = settings.batch_photos

    def load(
        self, target: ResolvedGeneration, photos: Sequence[Photo]
    ) -> Iterator[tuple[UUID, LocalFeatures]]:
        """Yield each photo's local features, in any order; at most one batch is held in memory.

        Photos are left out, and logged by their ids, if they can't be read or decoded, are too
        large for the GPU's memory, or have features that are not finite.
        """
        for begin in range(0, len(photos), self._batch_size):
            missing = []
            for photo in photos[begin : begin + self._batch_size]:
                stored = self._read_stored(target, photo.id) if self._store_enabled else None
                if stored is None:
                    missing.append(photo)
                else:
                    yield photo.id, stored
            for photo_id, features in self._compute(target, missing):
                if self._store_enabled:
                    self._write_stored(target, photo_id, features)
                yield photo_id, features

    def _read_stored(self, target: ResolvedGeneration, photo_id: UUID) -> LocalFeatures | None:
        key = local_features_key(target.generation.id, photo_id)
        try:
            data = self._store.get(key)
        except NotFound:
            return None
        try:
            return LocalFeatures.decode(data, target.extractor.backbone.width)
        except ValueError as error:
            log.error("the object %s is damaged (%s) and is computed again", key, error)
            return None

    def _compute(
        self, target: ResolvedGeneration, photos: Sequence[Photo]
    ) -> Iterator[tuple[UUID, LocalFeatures]]:
        photo_ids = []

        def read_photos() -> Iterator[bytes]:
            for photo in photos:
                try:
                    data = self._store.get(photo.object_key)
                except NotFound:
                    log.warning("the photo %s is not compared: its object is missing", photo.id)
                    continue
                photo_ids.append(photo.id)
                yield data

        extractor = target.extractor
        decoded = []
        outcomes = self._decoders.decode(read_photos(), extractor.preprocessing)
        for photo_id, outcome in zip(photo_ids, outcomes, strict=True):
            if isinstance(outcome, PlacewiseError):
                _log_skipped(photo_id, outcome)
            else:
                decoded.append((photo_id, outcome.pixels))
        features = _features_that_fit_memory(extractor, decoded)
        for (photo_id, pixels), tensor in zip(decoded, features, strict=True):
            local_features = LocalFeatures.from_features(
                tensor, extractor.backbone.grid(*pixels.shape[:2])
            )
            if local_features.finite:
                yield photo_id, local_features
            else:
                _log_skipped(photo_id, not_finite_error())

    def _write_stored(
        self, target: ResolvedGeneration, photo_id: UUID, features: LocalFeatures
    ) -> None:
        try:
            self._store.put(local_features_key(target.generation.id, photo_id), features.encode())
        except StorageFull as error:  # only a cache: it is computed again the next time
            log.warning("local features are not stored: %s", error.detail)


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


@dataclass(frozen=True, slots=True)
class PreparedComparison:
    """A claimed compare job with its decoded query."""

    job: Job
    request: CompareRequest
    target: ResolvedGeneration
    query: DecodedPhoto
    seconds: dict[str, float] = field(default_factory=dict)


class ComparisonRunner:
    """Runs compare jobs."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        models: ModelRegistry,
        decoders: DecoderPool,
        settings: Settings,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._models = models
        self._decoders = decoders
        self._candidates = _CandidateFeatures(store, decoders, settings)

    def prepare(self, job: Job) -> PreparedComparison:
        """Resolve the generation and decode the query; PlacewiseError if the job can't be done."""
        request = CompareRequest.model_validate(job.params["request"])
        target = resolve_generation(self._catalog, self._store, self._models, job)
        assert target is not None, "a compare job names an existing generation"
        if request.rerank:
            check_rerankable(target.extractor.config)
        if request.explain:
            check_explainable(target.extractor.config, target.generation.spec)
        data = self._read_query(job, request)
        (query,) = self._decoders.decode([data], target.extractor.preprocessing)
        if isinstance(query, PlacewiseError):
            raise query
        return PreparedComparison(job, request, target, query)

    def run(self, prepared: PreparedComparison) -> PublishResult:
        """Compare, store the result and end the job."""
        started = time.perf_counter()
        job, result = prepared.job, self._compare(prepared)
        prepared.seconds["compare"] = time.perf_counter() - started
        self._store.put(comparison_key(job.id), result.model_dump_json().encode())
        with self._catalog.write() as session:
            owned = lock_leased_jobs(session, get_lease_token(job), [job])
            for leased_job in owned:
                succeed_job(leased_job, {"candidates": len(result.candidates)})
        return PublishResult(succeeded=len(owned), lost=1 - len(owned))

    def _read_query(self, job: Job, request: CompareRequest) -> bytes:
        if request.query_photo_id is None:
            assert request.query_job_id is not None, "a query is a photo or a describe job"
            try:
                return self._store.get(query_key(request.query_job_id))
            except NotFound as error:
                raise query_expired_error() from error
        with self._catalog.read() as session:
            photo = get_photo(session, job.map_id, request.query_photo_id)
        return self._store.get(photo.object_key)

    def _compare(self, prepared: PreparedComparison) -> CompareResult:
        request, target = prepared.request, prepared.target
        (features,) = target.extractor.local_features([prepared.query.pixels])
        if not bool(features.isfinite().all()):
            raise not_finite_error()
        grid = target.extractor.backbone.grid(*prepared.query.pixels.shape[:2])
        with self._catalog.read() as session:
            live = get_live_photos(session, [each.photo_id for each in request.candidates])
        candidates = [candidate for candidate in request.candidates if candidate.photo_id in live]
        to_rerank, rest = candidates[: request.rerank], candidates[request.rerank :]
        query = LocalFeatures.from_features(features, grid)
        photos = [live[candidate.photo_id] for candidate in to_rerank]
        scores = self._rerank(target, query, to_rerank, photos)
        # The sort is stable: photos with equal scores, or without one, stay sorted by similarity.
        to_rerank.sort(key=lambda candidate: -scores.get(candidate.photo_id, -np.inf))
        ordered = [candidate.photo_id for candidate in to_rerank + rest]
        shares = self._explain(target, features, ordered[: request.explain], request.word_weights)
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

    def _rerank(
        self,
        target: ResolvedGeneration,
        query: LocalFeatures,
        candidates: Sequence[SearchHit],
        photos: Sequence[Photo],
    ) -> dict[UUID, float]:
        """Return the rerank scores of the candidates that can be read, by photo."""
        similarity = {candidate.photo_id: candidate.ranked_by for candidate in candidates}
        device = target.extractor.backbone.device
        return {
            photo_id: rerank_score(similarity[photo_id], query, features, device)
            for photo_id, features in self._candidates.load(target, photos)
        }

    def _explain(
        self,
        target: ResolvedGeneration,
        features: torch.Tensor,
        photo_ids: Sequence[UUID],
        word_weights: Sequence[float],
    ) -> dict[UUID, SimilarityShares]:
        """Return the similarity shares of each photo."""
        if not photo_ids:
            return {}
        generation_id = target.generation.id
        stored = read_stored_rows(self._catalog, self._store, generation_id, photo_ids)
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
