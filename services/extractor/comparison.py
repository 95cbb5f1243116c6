"""COMPARE: look closely at the photos that a search has found. One job, one query, no slices.

    prepare    which generation, and the query's pixels      beside the batch before
    compare    local features of the query and, to rerank, of the candidates, a few at a time;
               to explain, the candidates' descriptors       on the model
    publish    the result as an object, then the job's end

What was deleted meanwhile is left out of the result. One that another worker has taken over stores
the same result, and can't end the job.

Local features of compared photos: kept in the object store, or made from their pixels.
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
from shared.catalog.photos import Photo, get_live_photos, get_photo
from shared.catalog.session import Catalog
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
    RerankCandidate,
    RerankedCandidate,
    SimilarityExplanation,
    check_explainable,
    check_rerankable,
    query_expired_error,
)
from shared.storage import ObjectStore
from shared.storage.keys import comparison_key, local_features_key, query_key

log = logging.getLogger(__name__)


class CandidateFeatures:
    """Reads and, with LOCAL_FEATURES=keep, writes what lies under `features/`."""

    def __init__(self, store: ObjectStore, decoders: DecoderPool, settings: Settings) -> None:
        self._store = store
        self._decoders = decoders
        self._store_enabled = settings.local_features == "keep"
        self._batch_size = settings.batch_photos

    def load(
        self, target: ResolvedGeneration, photos: Sequence[Photo]
    ) -> Iterator[tuple[UUID, LocalFeatures]]:
        """Each photo's features, in any order; left out, and logged by their ids, are photos that
        can't be read or decoded any more, that the GPU can't hold, or whose features are not
        finite. No more are held than a batch has."""
        for begin in range(0, len(photos), self._batch_size):
            missing = []
            for photo in photos[begin : begin + self._batch_size]:
                kept = self._read_stored(target, photo.id) if self._store_enabled else None
                if kept is None:
                    missing.append(photo)
                else:
                    yield photo.id, kept
            for photo_id, made in self._compute(target, missing):
                if self._store_enabled:
                    self._write_stored(target, photo_id, made)
                yield photo_id, made

    def _read_stored(self, target: ResolvedGeneration, photo_id: UUID) -> LocalFeatures | None:
        key = local_features_key(target.generation.id, photo_id)
        try:
            data = self._store.get(key)
        except NotFound:
            return None
        try:
            return LocalFeatures.decode(data, target.extractor.backbone.width)
        except ValueError as error:
            log.error("the object %s is damaged (%s) and is made anew", key, error)
            return None

    def _compute(
        self, target: ResolvedGeneration, photos: Sequence[Photo]
    ) -> Iterator[tuple[UUID, LocalFeatures]]:
        there, data = [], []
        for photo in photos:
            try:
                data.append(self._store.get(photo.object_key))
                there.append(photo.id)
            except NotFound:
                log.warning("the photo %s is not compared: it was deleted, or is lost", photo.id)
        extractor = target.extractor
        decoded = []
        for photo_id, outcome in zip(
            there, self._decoders.decode(data, extractor.preprocessing), strict=True
        ):
            if isinstance(outcome, PlacewiseError):
                _log_skipped(photo_id, outcome)
            else:
                decoded.append((photo_id, outcome.pixels))
        features = _features_that_fit_memory(extractor, decoded)
        for (photo_id, pixels), one in zip(decoded, features, strict=True):
            made = LocalFeatures.from_features(one, extractor.backbone.grid(*pixels.shape[:2]))
            if made.finite:
                yield photo_id, made
            else:
                _log_skipped(photo_id, not_finite_error())

    def _write_stored(
        self, target: ResolvedGeneration, photo_id: UUID, made: LocalFeatures
    ) -> None:
        try:
            self._store.put(local_features_key(target.generation.id, photo_id), made.encode())
        except StorageFull as error:  # it is only made again the next time
            log.warning("local features are not kept: %s", error.detail)


def _features_that_fit_memory(
    extractor: Extractor, decoded: list[tuple[UUID, Pixels]]
) -> list[torch.Tensor]:
    """Local features of each of `decoded`, which photos that the GPU can't hold have left."""
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
    """A claimed compare job whose query is decoded."""

    job: Job
    request: CompareRequest
    target: ResolvedGeneration
    query: DecodedPhoto
    seconds: dict[str, float] = field(default_factory=dict)


class ComparisonRunner:
    """Does compare jobs."""

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
        self._candidates = CandidateFeatures(store, decoders, settings)

    def prepare(self, job: Job) -> PreparedComparison:
        """PlacewiseError when the job can't be done: what it needs is gone, or was never there."""
        asked = CompareRequest.model_validate(job.params["request"])
        target = resolve_generation(self._catalog, self._store, self._models, job)
        assert target is not None, "a compare job names a generation that has answered"
        if asked.rerank:
            check_rerankable(target.extractor.recipe)
        if asked.explain:
            check_explainable(target.extractor.recipe, target.generation.spec)
        data = self._read_query(job, asked)
        (query,) = self._decoders.decode([data], target.extractor.preprocessing)
        if isinstance(query, PlacewiseError):
            raise query
        return PreparedComparison(job, asked, target, query)

    def run(self, prepared: PreparedComparison) -> PublishResult:
        """Compare, store the result and end the job."""
        started = time.perf_counter()
        job, result = prepared.job, self._compare(prepared)
        prepared.seconds["compare"] = time.perf_counter() - started
        self._store.put(comparison_key(job.id), result.model_dump_json().encode())
        with self._catalog.write() as session:
            mine = lock_leased_jobs(session, get_lease_token(job), [job])
            for own in mine:
                succeed_job(own, {"candidates": len(result.candidates)})
        return PublishResult(succeeded=len(mine), lost=1 - len(mine))

    def _read_query(self, job: Job, request: CompareRequest) -> bytes:
        if request.query_photo_id is None:
            assert request.query_job_id is not None, "a query is one or the other"
            try:
                return self._store.get(query_key(request.query_job_id))
            except NotFound as error:
                raise query_expired_error() from error
        with self._catalog.read() as session:
            photo = get_photo(session, job.map_id, request.query_photo_id)
        return self._store.get(photo.object_key)

    def _compare(self, prepared: PreparedComparison) -> CompareResult:
        asked, target = prepared.request, prepared.target
        (features,) = target.extractor.local_features([prepared.query.pixels])
        if not bool(features.isfinite().all()):
            raise not_finite_error()
        grid = target.extractor.backbone.grid(*prepared.query.pixels.shape[:2])
        with self._catalog.read() as session:
            live = get_live_photos(session, [found.photo_id for found in asked.candidates])
        there = [found for found in asked.candidates if found.photo_id in live]
        first, rest = there[: asked.rerank], there[asked.rerank :]
        query = LocalFeatures.from_features(features, grid)
        scores = self._rerank(target, query, first, [live[one.photo_id] for one in first])
        # The sort is stable: of equal scores, and without one, the more similar photo comes first.
        first.sort(key=lambda one: -scores.get(one.photo_id, -np.inf))
        ordered = [one.photo_id for one in first + rest]
        shares = self._explain(target, features, ordered[: asked.explain], asked.word_weights)
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
        candidates: Sequence[RerankCandidate],
        photos: Sequence[Photo],
    ) -> dict[UUID, float]:
        """The rerank score of each candidate that can be read, by its photo."""
        similarity = {one.photo_id: one.ranked_by for one in candidates}
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
        """The shares of each of the photos; of none when none is asked for."""
        if not photo_ids:
            return {}
        generation_id = target.generation.id
        found = read_stored_rows(self._catalog, self._store, generation_id, photo_ids)
        if not found:
            raise Gone(
                "query_expired",
                f"Nothing is left of these descriptors in the generation {generation_id} that "
                "answered. Ask again.",
            )
        rows = np.stack(list(found.values()))
        shares = explain_similarities(
            target.extractor.recipe, features, target.centres, rows, word_weights
        )
        return dict(zip(found, shares, strict=True))


def _build_explanation(shared: SimilarityShares, grid: tuple[int, int]) -> SimilarityExplanation:
    overlay, full_share = draw_overlay(shared.patches.reshape(grid))
    clusters = None
    if shared.clusters is not None:
        strongest = np.argsort(-shared.clusters, kind="stable")
        clusters = tuple(
            ClusterContribution(cluster=int(cluster), share=float(shared.clusters[cluster]))
            for cluster in strongest
            if shared.clusters[cluster]
        )
    return SimilarityExplanation(
        clusters=clusters,
        rows=grid[0],
        columns=grid[1],
        overlay=overlay,
        full_share=full_share,
    )
