"""Local features of the photos of a batch: copied from the active generation, or detected.

A photo whose features can't be computed has none; it is described all the same.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

from services.extractor.generation_resolver import ResolvedGeneration
from services.extractor.handlers import ExtractorContext, JobBatch
from shared.catalog.chunks import find_descriptor_rows
from shared.catalog.database.session import Catalog
from shared.catalog.generations import active_generation
from shared.catalog.maps import Matching
from shared.catalog.reconstructions import find_reconstruction
from shared.errors import Misconfigured, NotFound
from shared.imaging.decode import DecodedPhoto
from shared.jobs import Job, JobKind
from shared.matching.features import LocalFeatures
from shared.matching.xfeat import XFeatDetector
from shared.storage import ObjectStore
from shared.storage.chunks import features_key
from shared.storage.feature_files import FeatureRows, read_feature_index, read_feature_rows

log = logging.getLogger(__name__)


@dataclass(slots=True)
class BatchFeatures:
    """Encoded local features of the photos of a batch."""

    detector: XFeatDetector
    missing: set[UUID]
    """Jobs whose features have to be detected."""
    encoded: dict[UUID, bytes]
    """Features by job."""
    _photos: dict[UUID, DecodedPhoto] = field(default_factory=dict)

    def add_photo(self, job: Job, decoded: DecodedPhoto) -> None:
        """Keep the decoded photo for `detect`, if its features are missing."""
        if job.id in self.missing:
            self._photos[job.id] = decoded

    def detect(self) -> None:
        """Detect the features of the photos added."""
        if not self._photos:
            return
        photos = list(self._photos.values())
        found = self.detector.detect(
            [photo.detection_pixels for photo in photos if photo.detection_pixels is not None],
            [photo.size for photo in photos],
        )
        for job_id, features in zip(self._photos, found, strict=True):
            self.encoded[job_id] = features.encode()
        self._photos.clear()

    def rows(self, jobs: Sequence[Job]) -> FeatureRows:
        """Return the features of the jobs' photos; empty where there are none."""
        return FeatureRows(self.detector.model, [self.encoded.get(job.id, b"") for job in jobs])


def prepare_features(
    context: ExtractorContext, batch: JobBatch, target: ResolvedGeneration
) -> BatchFeatures | None:
    """Load the detector, and copy the features that the active generation has of reindexed photos.

    Returns None if the photos get no features, or if those of a query can't be computed.

    Raises:
        Misconfigured: as `load_detector`, for photos that are stored.
    """
    if target.matching == Matching.OFF:
        return None
    map_id, is_query = batch.jobs[0].map_id, batch.kind == JobKind.DESCRIBE
    with context.catalog.read() as session:
        source = active_generation(session, map_id) if batch.kind == JobKind.REINDEX else None
        is_reconstructed = is_query and find_reconstruction(session, map_id) is not None
    uses_matches = target.generation.uses_matches
    if is_query:
        missing = {job.id for job in batch.jobs if _is_matched(job, uses_matches, is_reconstructed)}
    elif target.matching == Matching.ON or uses_matches is not False:
        missing = {job.id for job in batch.jobs}
    else:
        return None
    if not missing:
        return None
    try:
        detector = context.models.detector()
    except Misconfigured as error:
        if not is_query:
            raise
        log.error("queries are not matched: %s", error.detail)
        return None
    encoded: dict[UUID, bytes] = {}
    if source is not None:
        with batch.timed("read"):
            stored = read_stored_features(
                context.catalog,
                context.store,
                source.id,
                [job.photo_id for job in batch.jobs if job.photo_id],
                detector.model,
            )
        encoded = {job.id: stored[job.photo_id] for job in batch.jobs if job.photo_id in stored}
    return BatchFeatures(detector, missing - encoded.keys(), encoded)


def _is_matched(job: Job, uses_matches: bool | None, is_reconstructed: bool) -> bool:
    """Return whether the search of a query photo will match it, or compute its pose."""
    params: dict[str, Any] = job.params.get("search_params", {})
    by_default = uses_matches or params.get("explain")
    matches = params.get("matches")
    is_matched = params.get("rerank") or (by_default if matches is None else matches)
    return bool(is_matched or (is_reconstructed and params.get("pose")))


def read_stored_features(
    catalog: Catalog, store: ObjectStore, generation_id: UUID, photo_ids: Sequence[UUID], model: str
) -> dict[UUID, bytes]:
    """Return the encoded features, by this model, of the photos in the generation.

    Those that can't be read are left out and logged.
    """
    with catalog.read() as session:
        rows_by_chunk = find_descriptor_rows(
            session, generation_id, photo_ids, features_model=model
        )
    found: dict[UUID, bytes] = {}
    for object_key, rows in rows_by_chunk.items():
        key = features_key(object_key)
        try:
            index = read_feature_index(store, key)
            encoded = read_feature_rows(store, key, index, [row for row, _ in rows])
            for data in encoded.values():
                LocalFeatures.decode(data)
        except (NotFound, ValueError) as error:
            log.error("the local features %s can't be read: %s", key, error)
            continue
        found |= {photo_id: encoded[row] for row, photo_id in rows if row in encoded}
    return found
