"""What a server answers, as frozen objects. Times carry an offset, sizes are bytes.

Field for field the schemas of the API's description (`/openapi.json`; a test compares them). What a
newer server says beyond that is kept as an attribute, too.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

from pydantic import BaseModel, ConfigDict

from shared.client import FINISHED


class Answer(BaseModel):
    model_config = ConfigDict(frozen=True, extra="allow")


class Photo(Answer):
    """A stored photo. Degrees are WGS 84; `heading` is clockwise from north."""

    image_id: UUID
    image_path: str
    original_filename: str
    upload_time: datetime
    file_size: int
    width: int
    height: int
    metadata: dict[str, Any]
    tags: list[str]
    latitude: float | None
    longitude: float | None
    heading: float | None
    captured_at: datetime | None
    place: str | None
    role: str
    image_url: str
    thumbnail_url: str


class OnePhoto(Photo):
    """A stored photo, with what becomes of it."""

    job_id: UUID | None
    media_type: str
    sha256: str
    searchable: bool


class Uploaded(Answer):
    """A photo that is stored; its job, if any, describes it."""

    file_id: UUID
    job_id: UUID | None
    filename: str
    file_size: int
    upload_time: datetime
    status: str
    status_url: str
    already_there: bool
    message: str


class Deleted(Answer):
    success: bool
    message: str
    deleted_file_id: UUID


class ClusterShare(Answer):
    cluster: int
    share: float


class Explanation(Answer):
    """Where a similarity comes from: shares that add up to it. `overlay` is a data URI."""

    clusters: list[ClusterShare] | None
    rows: int
    columns: int
    overlay: str
    full_share: float


class SimilarPhoto(Photo):
    """A photo of an answer; scores are cosines in [-1, 1]."""

    similarity_score: float
    weighted_score: float | None = None
    rerank_score: float | None = None
    explanation: Explanation | None = None


class Estimate(Answer):
    """The place that an answer points to. `in_map` is None where that can't be told."""

    in_map: bool | None = None
    latitude: float | None = None
    longitude: float | None = None
    radius_m: float | None = None
    place: str | None = None
    confidence: float | None = None
    calibration: str = "uncalibrated"
    reason: str


class Similar(Answer):
    """The most similar photos, best first."""

    query_file_id: UUID | None
    query_filename: str
    processing_time_ms: float
    total_similar: int
    similar_images: list[SimilarPhoto]
    estimate: Estimate
    vocabulary: str
    word_weights: str
    generation_id: UUID
    certificate: str
    certified_k: int = 0
    max_z: float | None = None
    rows_scanned: int
    rows_reranked: int
    snapshot_version: int
    degraded: bool = False
    missing: list[str]


class Progress(Answer):
    done: int
    total: int
    failed: int


class Job(Answer):
    """`state` is queued, running, succeeded, failed or cancelled; `error` an RFC 9457 problem."""

    job_id: UUID
    kind: str
    state: str
    stage: str | None
    waiting_for: str | None
    awaited: list[str] | None
    progress: Progress
    attempts: int
    file_id: UUID | None
    result: dict[str, Any] | None
    error: dict[str, Any] | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    status_url: str
    result_url: str | None
    request_id: str | None

    @property
    def finished(self) -> bool:
        return self.state in FINISHED


class Started(Answer):
    """Work that is queued: `wait(started.job_id)`."""

    job_id: UUID
    status: str
    status_url: str
    result_url: str | None = None


class BatchStarted(Started):
    items_url: str


class BatchItem(Answer):
    """One photo of a batch, by its number from 1."""

    number: int
    name: str
    state: str
    file_id: UUID | None
    job_id: UUID | None
    already_there: bool
    line: int | None
    error: dict[str, Any] | None


class Vocabulary(Answer):
    vocabulary_id: UUID
    origin: str
    clusters: int
    dimension: int
    sha256: str
    provenance: dict[str, Any]
    created_at: datetime


class Generation(Answer):
    """One complete set of descriptors; the one whose `state` is `active` answers."""

    generation_id: UUID
    state: str
    extractor: str
    dimension: int
    pca_from: int | None
    vocabulary_id: UUID | None
    photos: int
    spec: dict[str, Any]
    created_at: datetime
    activated_at: datetime | None
    ended_at: datetime | None


class Evaluation(Answer):
    evaluation_id: UUID
    generation_id: UUID
    automatic: bool
    searchable: int
    figures: dict[str, Any]
    evaluated_at: datetime


class Search(Answer):
    """A question that was asked."""

    search_id: UUID
    query_file_id: UUID | None
    query_filename: str
    generation_id: UUID
    top_k: int
    results: int
    best_score: float | None
    in_map: bool | None
    processing_time_ms: float
    searched_at: datetime


class Map(Answer):
    name: str
    extractor: str
    version: int
    photos: int
    searchable: int
    labelled_queries: int
    counted_at: datetime
    generation_id: UUID | None
    vocabulary: str | None
    dimension: int | None
    pca_from: int | None
    created_at: datetime


class Stats(Answer):
    map: str
    map_version: int
    total_images: int
    searchable_images: int
    labelled_queries: int
    total_chunks: int
    total_storage_bytes: int
    feature_dimension: int | None
    max_images_per_chunk: int
    extractor: str
    vocabulary: str | None
    total_searches: int
    recent_uploads_24h: int
    recent_searches_24h: int
    avg_processing_time_ms: float | None
    max_processing_time_ms: float | None
    jobs: dict[str, int]
    counted_at: datetime
