"""Responses of the HTTP API as frozen Pydantic models. Times have a UTC offset, sizes are bytes.

The fields match the schemas of the OpenAPI description (`/openapi.json`), which a test verifies.
Fields that a newer server adds are available as attributes, too.
"""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any
from uuid import UUID

from pydantic import BaseModel, ConfigDict

from shared.errors import Unprocessable

FINISHED = ("succeeded", "failed", "cancelled")
"""The states in which a job ends."""


class Answer(BaseModel):
    """Base class of all responses."""

    model_config = ConfigDict(frozen=True, extra="allow", defer_build=True)

    def as_json(self) -> dict[str, Any]:
        """Return the response as the server sent it, for `json.dumps`."""
        return self.model_dump(mode="json", exclude_unset=True)


class Photo(Answer):
    """A stored photo. Coordinates are WGS 84 degrees; `heading` is clockwise from true north."""

    image_id: UUID
    image_path: str
    original_filename: str
    relative_path: str | None = None
    """Path in the folder or archive that it was uploaded from; None if unknown."""
    upload_time: datetime
    file_size: int
    width: int
    height: int
    metadata: dict[str, Any]
    tags: list[str]
    latitude: float | None
    longitude: float | None
    altitude: float | None
    """metres"""
    heading: float | None
    focal_length: float | None
    """of EXIF, as a multiple of the longer side"""
    captured_at: datetime | None
    place: str | None
    role: str
    image_url: str
    thumbnail_url: str
    preview_url: str = ""
    """Of a JPEG of at most 1,600 px, or of the original if that is as small; empty from a server
    that makes no previews."""


class OnePhoto(Photo):
    """A stored photo with its processing state."""

    job_id: UUID | None
    media_type: str
    sha256: str
    searchable: bool


class Uploaded(Answer):
    """Response to an upload. The job, if any, describes the photo."""

    file_id: UUID
    job_id: UUID | None
    filename: str
    file_size: int
    upload_time: datetime
    status: str
    status_url: str
    already_there: bool
    updated: list[str]
    message: str


class Deleted(Answer):
    """Response to the deletion of a photo."""

    success: bool
    message: str
    deleted_file_id: UUID


class PointPair(Answer):
    """Points of the query and of a photo that show the same spot, in pixels of the originals."""

    query: tuple[float, float]
    photo: tuple[float, float]


class SimilarPhoto(Photo):
    """A search result; scores are cosine similarities in [-1, 1]."""

    similarity_score: float
    match_probability: float | None = None
    inliers: int | None = None
    """Number of points that match the query's; None if the photo was not matched."""
    pairs: list[PointPair] | None = None
    """These points, with `explain`."""


class Matches(Answer):
    """How the local features of the query were matched with those of the best photos."""

    compared: int
    missing: int
    reason: str | None = None
    query_width: int | None = None
    """Of the upright query in pixels."""
    query_height: int | None = None


class SeenPoint(Answer):
    """A point of the map's reconstruction, and the pixel of the upright query that shows it."""

    query: tuple[float, float]
    point: tuple[float, float, float]


class PoseCamera(Answer):
    """The camera of a pose; `source` is given, exif, map or estimated."""

    focal_pixels: float
    width: int
    height: int
    source: str


class CameraPose(Answer):
    """Where the camera of a query stood and looked. Coordinates are WGS 84, angles in degrees.

    `reason` says why they or the radii are None. `enu_quaternion` (w, x, y, z) leads from forward,
    left, up to east, north, up. `position` and `quaternion` are in the component of the
    reconstruction.
    """

    latitude: float | None
    longitude: float | None
    altitude_m: float | None
    heading: float | None
    pitch: float | None
    roll: float | None
    radius_68_m: float | None
    radius_95_m: float | None
    heading_68_degrees: float | None
    heading_95_degrees: float | None
    enu_quaternion: tuple[float, float, float, float] | None
    reason: str | None
    component: int
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    inliers: int
    matches: int
    camera: PoseCamera
    seen: list[SeenPoint]


class EstimateLevel(Answer):
    """A level of an estimate: a place, or a circle around a position."""

    place: str | None = None
    latitude: float | None = None
    longitude: float | None = None
    radius_m: float | None = None
    whole_map: bool = False
    probability: float


class Estimate(Answer):
    """Estimated place of a query photo. `in_map` is None if it can't be determined."""

    headline: str
    """the answer in one sentence"""
    in_map: bool | None = None
    latitude: float | None = None
    longitude: float | None = None
    radius_m: float | None = None
    place: str | None = None
    has_place: bool = False
    confidence: float | None = None
    reason: str
    levels: list[EstimateLevel] = []
    """finest first"""
    answer_level: int | None = None
    """index in `levels` of the finest one that is certain enough"""
    certainty: float | None = None
    elsewhere: float | None = None
    not_in_map_probability: float | None = None
    radius_68_m: float | None = None
    radius_95_m: float | None = None
    calibration_source: str | None = None


class Similar(Answer):
    """Search results, best first, with the place estimate."""

    query_file_id: UUID | None
    query_filename: str
    processing_time_ms: float
    total_similar: int
    similar_images: list[SimilarPhoto]
    matches_without_place: int = 0
    estimate: Estimate
    matches: Matches | None = None
    """None if no photo was to be matched."""
    pose: CameraPose | None = None
    no_pose: str | None = None
    """Why the query has no pose; None with one, and without `pose=True`."""
    vocabulary: str
    generation_id: UUID
    rows: str = "float32"
    certificate: str
    max_z: float | None = None
    rows_scanned: int
    rows_reranked: int
    snapshot_version: int
    degraded: bool = False
    missing: list[str]


class TrackState(Answer):
    """Where the camera of a track is: `status` is converging, tracking or lost."""

    status: str
    image_id: UUID | None
    latitude: float | None
    longitude: float | None
    place: str | None
    heading: float | None
    probability: float
    levels: list[EstimateLevel]
    """finest first"""
    radius_68_m: float | None
    radius_95_m: float | None
    not_in_map_probability: float


class Track(Answer):
    """A track with the state after its last applied frame."""

    track_id: UUID
    motion: str | None
    max_speed_mps: float | None
    version: int
    """number of accepted frames"""
    pending: int
    """number of accepted frames that are not applied yet"""
    state: TrackState | None
    created_at: datetime
    updated_at: datetime
    expires_at: datetime


class TrackFrame(Answer):
    """A frame of a track: `status` is pending, applied or failed."""

    frame_id: UUID
    captured_at: datetime
    filename: str
    status: str
    state: TrackState | None
    error: dict[str, Any] | None
    job_id: UUID
    job_url: str
    frame_url: str
    version: int
    """that of the track when the frame was accepted"""


class OneTrack(Track):
    """A track with its frames, in the order of their times."""

    smoothed: bool
    frames: list[TrackFrame]


class DeletedTrack(Answer):
    """Response to the deletion of a track."""

    success: bool
    message: str
    deleted_track_id: UUID


class PhotoHeader(Answer):
    """What a photo's header says about when, where and by which camera it was taken."""

    captured_at: datetime | None
    """UTC; if `time_zone_is_known` is False, the camera's clock as if it were UTC"""
    time_zone_is_known: bool
    camera: str | None
    camera_is_unique: bool
    """`camera` contains a serial number or an owner"""
    clock_offset: timedelta | None
    """of the camera's clock from UTC, by its tag or the GPS time"""
    latitude: float | None
    longitude: float | None
    gps_error: str | None
    """why the photo may have coordinates although none are known"""
    focal_length: float | None = None
    """as a multiple of the photo's longer side"""


class Proposal(Answer):
    """Where a photo was probably taken; coordinates are None if nothing is known about it."""

    name: str
    latitude: float | None
    longitude: float | None
    radius_m: float
    probability: float
    """that it was taken within `radius_m`"""
    radius_68_m: float | None
    heading: float | None = None
    """degrees clockwise from north; None unless it rests on a pose"""
    reason: str


class Progress(Answer):
    """Progress counters of a job."""

    done: int
    total: int
    failed: int


class Component(Answer):
    """Photos that were reconstructed together, in a frame of their own."""

    number: int
    photos: int
    points: int
    mean_reprojection_error_pixels: float
    """of photos whose longer side has 640 pixels"""
    latitude: float | None
    """of the middle of its photos; None if it is not aligned"""
    longitude: float | None
    altitude_m: float | None
    metres_per_unit: float | None
    alignment_rms_m: float | None
    agreeing: int | None
    located: int | None
    is_on_line: bool | None
    not_aligned: str | None
    """why it is not aligned"""
    calibration: dict[str, Any] | None
    """errors of the poses of its own photos, in standard deviations"""


class Reconstruction(Answer):
    """The reconstruction of a map's photos; components are sorted by their number of photos."""

    reconstruction_id: UUID
    job_id: UUID
    generation_id: UUID
    map_version: int
    features_model: str
    imported: bool
    components: list[Component]
    proposals: int
    """number of `coordinate_proposals` that are not accepted"""
    created_at: datetime
    finished_at: datetime


class CoordinateProposal(Answer):
    """A photo whose coordinates disagree with the reconstruction."""

    image_id: UUID
    original_filename: str
    relative_path: str | None
    latitude: float
    """when it was reconstructed"""
    longitude: float
    proposed_latitude: float
    proposed_longitude: float
    distance_m: float
    radius_95_m: float
    """of the proposed coordinates"""
    accepted: bool
    """whether the photo has the proposed coordinates now"""


class Job(Answer):
    """A job.

    `state` is queued, running, succeeded, failed or cancelled; `error` is an RFC 9457 problem.
    """

    job_id: UUID
    kind: str
    label: str = ""
    state: str
    stage: str | None
    waiting_for: str | None
    awaited: list[str] | None
    progress: Progress
    attempts: int
    map: str = ""
    file_id: UUID | None
    filename: str | None = None
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
        """Whether the job has succeeded, failed or been cancelled."""
        return self.state in FINISHED

    @property
    def failure(self) -> str:
        """Why the job did not succeed: the detail of its error, or its state."""
        return str((self.error or {}).get("detail", f"The job {self.job_id} is {self.state}."))

    def raise_for_failure(self) -> None:
        """Raise Unprocessable with the job's `code` (or `job_ended`) if it failed."""
        if self.finished and self.state != "succeeded":
            raise Unprocessable((self.error or {}).get("code", "job_ended"), self.failure)


class Started(Answer):
    """A job that was queued; wait for it with `wait(started)`."""

    job_id: UUID
    status: str
    status_url: str
    result_url: str | None = None


class BatchStarted(Started):
    """A batch upload that was queued."""

    items_url: str


class BatchItem(Answer):
    """An item of a batch; `number` starts at 1."""

    number: int
    name: str
    state: str
    file_id: UUID | None
    job_id: UUID | None
    already_there: bool
    line: int | None
    error: dict[str, Any] | None


class Vocabulary(Answer):
    """A VLAD vocabulary of a map."""

    vocabulary_id: UUID
    origin: str
    clusters: int
    dimension: int
    sha256: str
    provenance: dict[str, Any]
    created_at: datetime


class Generation(Answer):
    """A complete set of descriptors of a map; searches use the one in the state `active`."""

    generation_id: UUID
    state: str
    extractor: str
    dimension: int
    pca_from: int | None
    rows: str = "float32"
    vocabulary_id: UUID | None
    photos: int
    spec: dict[str, Any]
    created_at: datetime
    activated_at: datetime | None
    ended_at: datetime | None


class Evaluation(Answer):
    """Retrieval metrics of a generation."""

    evaluation_id: UUID
    generation_id: UUID
    automatic: bool
    searchable: int
    figures: dict[str, Any]
    evaluated_at: datetime


class Search(Answer):
    """An entry of the search history."""

    search_id: UUID
    query_file_id: UUID | None
    query_filename: str
    generation_id: UUID
    top_k: int
    results: int
    best_score: float | None
    in_map: bool | None
    answer_level: int | None = None
    not_in_map_probability: float | None = None
    has_place: bool = False
    processing_time_ms: float
    searched_at: datetime


class MapFeatures(Answer):
    """Local features of a map's active generation."""

    model: str | None
    photos: int
    missing: int
    bytes: int
    used: bool | None


class Map(Answer):
    """A map with its counts and its active generation."""

    name: str
    extractor: str
    version: int
    photos: int
    searchable: int
    failed_photos: int = 0
    labelled_queries: int
    located: int = 0
    measurement: str = "not_measured"
    counted_at: datetime
    generation_id: UUID | None
    vocabulary: str | None
    dimension: int | None
    pca_from: int | None
    place_labels_are_paths: bool = False
    place_labels_are_automatic: bool = False
    rows: str = "float32"
    auto_fit: bool = True
    matching: str = "auto"
    elsewhere: float | None = None
    local_features: MapFeatures | None = None
    model_change_id: UUID | None = None
    next_fit_photos: int | None = None
    created_at: datetime


class DeletedMap(Answer):
    """Response to the deletion of a map."""

    success: bool
    message: str
    deleted_map: str


class Stats(Answer):
    """Statistics of a map."""

    map: str
    map_version: int
    total_images: int
    searchable_images: int
    failed_images: int = 0
    labelled_queries: int
    total_chunks: int
    total_storage_bytes: int
    feature_dimension: int | None
    max_images_per_chunk: int
    extractor: str
    device: str | None
    vocabulary: str | None
    next_fit_photos: int | None = None
    total_searches: int
    recent_uploads_24h: int
    recent_searches_24h: int
    avg_processing_time_ms: float | None
    max_processing_time_ms: float | None
    jobs: dict[str, int]
    counted_at: datetime


class AddedModel(Answer):
    """A model that was added to the server; maps refer to it as `extractor`."""

    name: str
    extractor: str
    fingerprint: str
    dimension: int
    image_size: tuple[int, int] | None
    config: dict[str, Any]
    size_bytes: int
    sha256: str
    licence: str
    note: str | None
    about: dict[str, Any]
    added_at: datetime
    maps: list[str]


class RemovedModel(Answer):
    """Response to the removal of a model."""

    success: bool
    message: str
    removed_model: str


class Key(Answer):
    """An API key without its secret; None for a limit that the server's settings decide."""

    id: UUID
    name: str
    prefix: str
    scopes: list[str]
    maps: list[str] | None = None
    """Names of the only maps that it may use; None: all maps."""
    requests_per_minute: int | None
    upload_bytes_per_day: int | None
    max_photos: int | None
    created_at: datetime
    expires_at: datetime | None
    last_used_at: datetime | None
    revoked_at: datetime | None


class CreatedKey(Key):
    """A new API key; `key` is its secret."""

    key: str
