"""Responses about maps: their generations, models, evaluations, statistics and keys."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from pydantic import Field

from shared.enums import GenerationState, Matching, RowType, Scope, VocabularyOrigin
from shared.responses import OPEN, ResponseModel

AUTO_FIT = (
    "whether a vocabulary is fitted automatically: at 50 photos, and whenever the map has doubled "
    "since the last fit. Importing or choosing a vocabulary sets it to false"
)
ELSEWHERE = "share of its queries that are from elsewhere, where a request has none; 0.33 at first"
MATCHING = (
    "whether local features of its photos are computed and matched: `on`, `off`, or `auto`: until "
    "an evaluation finds that matches do not improve the answers"
)
Measurement = Literal["measured", "running", "due", "not_measured", "too_few_photos"]


class LocalFeaturesResponse(ResponseModel):
    model: str | None = Field(description="detector and its version, `xfeat@0f5187fd7bed`")
    photos: int = Field(description="photos with local features; deleted ones may be among them")
    missing: int = Field(description="searchable photos without")
    bytes: int
    used: bool | None = Field(
        description="whether searches use matches as evidence; null until an evaluation decides it"
    )


class MapResponse(ResponseModel):
    name: str
    extractor: str
    version: int = Field(description="incremented by every change of the searchable photos")
    photos: int
    searchable: int
    failed_photos: int = Field(
        description="stored photos that can't be searched for, because their description failed: "
        "GET /search?failed=true lists them, and the next model change describes them again"
    )
    labelled_queries: int
    located: int = Field(description="searchable photos with coordinates or a label")
    measurement: Annotated[Measurement, OPEN] = Field(
        description="whether it is known how certain the map's estimates are: `measured` by an "
        "evaluation; `running`: it is being evaluated; `due`: an evaluation will start by itself; "
        "`not_measured`: start one (POST /evaluations); `too_few_photos`: it takes 20 with "
        "coordinates or a label"
    )
    counted_at: datetime = Field(description="when the four counts above were computed")
    generation_id: UUID | None
    vocabulary: str | None = Field(
        description="`own`, `provisional`, `foreign`, `pending` or `none`; null before the first "
        "photo"
    )
    dimension: int | None = Field(
        description="dimension of its descriptors; null before the first photo"
    )
    pca_from: int | None = Field(description="dimension before PCA; null without PCA")
    place_labels_are_paths: bool = Field(
        description="whether `/` separates the levels of place labels"
    )
    place_labels_are_automatic: bool = Field(
        description="whether evaluations decide that by the labels"
    )
    rows: Annotated[RowType, OPEN] = Field(
        validation_alias="row_type",
        description="type of the stored descriptors, `float32` or `float16`, of new generations; "
        "GET /generations has the one of each generation",
    )
    auto_fit: bool = Field(description=AUTO_FIT)
    matching: Annotated[Matching, OPEN] = Field(description=MATCHING)
    elsewhere: float = Field(description=ELSEWHERE)
    local_features: LocalFeaturesResponse | None = Field(
        description="local features of the active generation; null before the first photo"
    )
    model_change_id: UUID | None = Field(description="job of the running model change")
    next_fit_photos: int | None = Field(
        description="number of photos from which the next vocabulary is fitted automatically; null "
        "if none is"
    )
    created_at: datetime


class DeletedMapResponse(ResponseModel):
    success: bool
    message: str
    deleted_map: str


class VocabularyResponse(ResponseModel):
    vocabulary_id: UUID = Field(validation_alias="id")
    origin: Annotated[VocabularyOrigin, OPEN]
    clusters: int
    dimension: int
    sha256: str
    provenance: dict[str, Any] = Field(
        description="features that it was fitted on: `backbone`, `backbone_fingerprint`, `layer`, "
        "`facet`, `preprocessing`, and for a fit `photos`, `seed` and more; `learnt_with: unknown` "
        "if the imported file does not contain them"
    )
    created_at: datetime


class GenerationResponse(ResponseModel):
    generation_id: UUID = Field(validation_alias="id")
    state: Annotated[GenerationState, OPEN]
    extractor: str
    dimension: int = Field(description="of its descriptors, after PCA if there is one")
    pca_from: int | None = Field(description="dimension before PCA; null without PCA")
    rows: Annotated[RowType, OPEN] = Field(
        validation_alias="row_type",
        description="type of its stored descriptors: `float32` or `float16`",
    )
    vocabulary_id: UUID | None
    photos: int = Field(description="live photos with a descriptor in this generation")
    spec: dict[str, Any]
    created_at: datetime
    activated_at: datetime | None
    ended_at: datetime | None


class EvaluationResponse(ResponseModel):
    evaluation_id: UUID = Field(validation_alias="id")
    generation_id: UUID
    automatic: bool = Field(description="started automatically after a change of the map")
    searchable: int = Field(description="number of searchable photos at that time")
    figures: dict[str, Any] = Field(
        description="`leave_one_out`: queries with the map's own photos, each without itself, "
        "which flatters; `leave_one_out_without_sequence`: each without the photos that were taken "
        "within 60 s of it, or whose names differ by one number only, at most 60 apart; "
        "`labelled_queries`: queries with the photos of role `query`; R@k is the share of queries "
        "with a right photo among the first k, of those that have a right photo in the map"
    )
    evaluated_at: datetime


class SearchHistoryEntry(ResponseModel):
    search_id: UUID = Field(validation_alias="id")
    query_file_id: UUID | None = Field(
        validation_alias="query_photo_id", description="null when the query photo is not stored"
    )
    query_filename: str
    generation_id: UUID
    top_k: int
    results: int
    best_score: float | None
    in_map: bool | None = Field(description="`estimate.in_map` of the response")
    answer_level: int | None = Field(description="`estimate.answer_level` of the response")
    not_in_map_probability: float | None = Field(
        description="`estimate.not_in_map_probability` of the response; null if it had no levels"
    )
    has_place: bool = Field(description="`estimate.has_place` of the response")
    processing_time_ms: float = Field(validation_alias="processing_ms")
    searched_at: datetime


class StatsResponse(ResponseModel):
    map: str
    map_version: int
    total_images: int = Field(validation_alias="photos")
    searchable_images: int = Field(validation_alias="searchable")
    failed_images: int = Field(
        validation_alias="failed_photos",
        description="stored photos that can't be searched for, because their description failed",
    )
    labelled_queries: int
    total_chunks: int
    total_storage_bytes: int
    feature_dimension: int | None
    max_images_per_chunk: int
    extractor: str
    device: str | None = Field(
        description="where extractors compute, `cpu` or `cuda`; null while none is running"
    )
    vocabulary: str | None
    next_fit_photos: int | None = Field(
        description="number of photos from which the next vocabulary is fitted automatically; null "
        "if none is"
    )
    total_searches: int = Field(validation_alias="searches")
    recent_uploads_24h: int = Field(validation_alias="uploads_24h")
    recent_searches_24h: int = Field(validation_alias="searches_24h")
    avg_processing_time_ms: float | None = Field(validation_alias="average_ms")
    max_processing_time_ms: float | None = Field(validation_alias="longest_ms")
    jobs: dict[str, int]
    counted_at: datetime = Field(description="when the statistics were computed")


class ModelResponse(ResponseModel):
    name: str = Field(validation_alias="added_name")
    extractor: str = Field(
        description="extractor name that maps use: gsv:NAME, torchscript:NAME:OPTIONS"
    )
    fingerprint: str = Field(description="SHA-256 of its configuration and weights")
    dimension: int = Field(description="dimension of its descriptors, or of a patch's feature")
    image_size: tuple[int, int] | None = Field(
        description="height and width that photos are resized to; null: their own"
    )
    config: dict[str, Any] = Field(
        description="configuration of backbone and aggregator; of a TorchScript or ONNX file the "
        "name of the extractor"
    )
    size_bytes: int = Field(description="size of its file in the object store")
    sha256: str = Field(description="SHA-256 of that file")
    licence: str
    note: str | None
    about: dict[str, Any] = Field(
        validation_alias="card", description="source file and training details"
    )
    added_at: datetime
    maps: list[str] = Field(description="maps that use it")


class RemovedModelResponse(ResponseModel):
    success: bool
    message: str
    removed_model: str


class KeyResponse(ResponseModel):
    id: UUID
    name: str
    prefix: str = Field(description="first characters of the key")
    scopes: list[Annotated[Scope, OPEN]]
    maps: list[str] | None = Field(description="the only maps that it may use; null: all maps")
    requests_per_minute: int | None
    max_photos: int | None
    created_at: datetime
    expires_at: datetime | None
    last_used_at: datetime | None = Field(description="accurate to a minute")
    revoked_at: datetime | None


class CreatedKeyResponse(KeyResponse):
    key: str = Field(description="the secret key; it is shown only once")
