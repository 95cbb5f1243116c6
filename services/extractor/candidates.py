"""Local features of compared photos: kept in the object store, or made from their pixels."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from uuid import UUID

import torch

from services.extractor.decoding import DecoderPool
from services.extractor.target import ResolvedGeneration
from shared.catalog.photos import Photo
from shared.errors import NotFound, PlacewiseError, StorageFull
from shared.objects import ObjectStore
from shared.objects.keys import local_features_key
from shared.settings import Settings
from shared.vision.extractors import Extractor, not_finite_error
from shared.vision.local_features import LocalFeatures
from shared.vision.passes import PhotoTooLargeForGpu
from shared.vision.resample import Pixels

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
