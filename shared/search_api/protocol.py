"""Messages and protocol of the search tier: `SearchRequest`, `SearchResponse`, `SearchStatus`.

A query is a reference to one descriptor row in the object store, never the vector itself, so no
vector passes through the gateway. `SearchBackend` is implemented in process by
`services.search.worker.SearchWorker`, and over HTTP by `shared.search_api.client.HttpSearchClient`.
"""

from __future__ import annotations

from typing import Any, Protocol
from uuid import UUID

from pydantic import BaseModel, ConfigDict, Field

from shared.geometry.colmap_model import ColmapCamera
from shared.responses.similarity import PointPair, SeenPoint
from shared.search_api.photo_filter import NO_FILTER, PhotoFilter

EXHAUSTIVE = "exhaustive"  # every row was compared exactly
STATISTICAL = "statistical"  # no other row can be among them, but with odds of about 1 in 10^8
APPROXIMATE = "approximate"  # chosen by an approximate index, or within the engine's limit
NONE = "none"  # a part of the map is missing: better rows may exist

CERTIFICATES = (EXHAUSTIVE, STATISTICAL, APPROXIMATE, NONE)
"""Guarantees of a result's completeness, strongest first."""


class _Message(BaseModel):
    # Unknown fields of a response are ignored: a newer worker may add some.
    model_config = ConfigDict(frozen=True)


class RowReference(_Message):
    """Reference to a descriptor: row `row` of the object `object_key`."""

    object_key: str
    row: int = Field(ge=0)


class SearchRequest(_Message):
    """Request for the `k` rows of a generation that are most similar to one stored row.

    The query is row `row` of the object `object_key`; only photos that pass the filter `photos` are
    returned.

    The worker first catches up with `min_version` of the map, so that a photo whose indexing or
    deletion the caller has seen is taken into account. `exclude` names photos to leave out of the
    result, usually the query itself.

    The mean of the rows of `background` is subtracted from the query first
    (`shared.search_api.background`); scores are the cosines to what is left. Rows that no longer
    exist are left out of the mean.
    """

    # Unknown fields of a request are refused: ignoring a filter would give a wrong result.
    model_config = ConfigDict(extra="forbid")

    generation_id: UUID
    object_key: str
    row: int = Field(ge=0)
    min_version: int = Field(ge=0)
    k: int = Field(ge=1)
    photos: PhotoFilter = NO_FILTER
    exclude: tuple[UUID, ...] = ()
    background: tuple[RowReference, ...] = ()


class SearchHit(_Message):
    """One photo of a search result."""

    photo_id: UUID
    score: float
    """Cosine similarity in [-1, 1]."""


class SearchResponse(_Message):
    """Result of a search: `hits` sorted by `score` descending, ties by photo id."""

    hits: tuple[SearchHit, ...]
    certificate: str
    """Guarantee of the result's completeness, one of CERTIFICATES."""
    rows_scanned: int
    rows_reranked: int
    """Number of the scanned rows that were compared exactly, by their full descriptors."""
    max_z: float | None = None
    """Largest error of a sign-code estimate, in standard deviations; None if none was made."""
    snapshot_version: int
    missing: tuple[str, ...] = ()
    """Objects that could not be read or are not in the engine yet; their photos are not in the
    result."""
    filling: bool = False
    """Whether some of them are still to be written to the engine."""


class ReplicationLag(_Message):
    """Lag of a snapshot behind its map: versions, and seconds since it was last current."""

    versions: int
    seconds: float
    answers: bool
    """Whether the generation is active, and so serves queries; False while it is being built."""


class SearchStatus(_Message):
    """State of a worker: rows and bytes in memory, and the loaded version of each generation.

    For several workers together: that of the most advanced one.
    """

    rows: int
    resident_bytes: int
    mapped_bytes: int = 0
    """Bytes of mapped files that are not resident."""
    versions: dict[UUID, int]
    incomplete: tuple[UUID, ...] = ()
    """Generations with a chunk that can't be searched."""
    missing: tuple[str, ...]
    """Object keys of unreadable chunks."""
    unwritten: int = 0
    """Chunks that are still to be written to Milvus."""
    disk_full: bool = False
    """Whether some are unreadable only because a worker's cache is on a full disk."""
    lags: dict[UUID, ReplicationLag] = {}
    """Replication lag by generation; empty for a worker that does not follow the catalog."""
    recalls: dict[UUID, float] = {}
    """Measured recall of the generations that are searched by an approximate index"""

    @property
    def loaded(self) -> dict[UUID, int]:
        """Versions of the generations that are loaded completely."""
        return {key: value for key, value in self.versions.items() if key not in self.incomplete}


MAX_MATCHED_PHOTOS = 50  # of a query


class FeatureReference(RowReference):
    """Reference to the local features of a photo: row `row` of the feature file `object_key`."""


class MatchRequest(_Message):
    """Request to match the local features of a query with those of photos, and to verify them.

    The features of all must come from the same model.
    """

    model_config = ConfigDict(extra="forbid")

    query: FeatureReference
    candidates: tuple[FeatureReference, ...]
    with_pairs: bool = False
    """whether the inliers themselves are returned"""


class PhotoMatches(_Message):
    """The matches of a query with one photo."""

    matches: int
    """pairs of keypoints that are most similar to each other"""
    inliers: int
    """those that agree with one camera motion"""
    pairs: tuple[PointPair, ...] = ()
    """the inliers, most similar first, if they were requested"""


class MatchResponse(_Message):
    """Result of a match request."""

    candidates: tuple[PhotoMatches | None, ...]
    """by candidate; None where its features are missing, damaged, or of another model"""
    query_size: tuple[int, int] | None = None
    """width and height of the upright query in pixels; None if it has no features"""
    reason: str | None = None
    """why the query itself can't be matched; then all candidates are None"""


MAX_SEEN_POINTS = 300  # of a pose, spread over its inliers


class PoseCandidate(FeatureReference):
    """The local features of a photo of the map that may show what a query shows."""

    photo_id: UUID
    focal_length: float | None = None
    """of its EXIF, as a multiple of its longer side"""


class PoseComponent(_Message):
    """A component of a reconstruction, with what leads from its frame to coordinates."""

    object_key: str
    alignment: dict[str, Any] | None = None
    """a `shared.geometry.frames.Alignment` as JSON; None if it is not aligned"""
    calibration: dict[str, Any] | None = None
    """a `shared.geometry.radius.PoseCalibration`; None if it could not be measured"""


class PoseRequest(_Message):
    """Request to compute where a query was taken, and in which direction, in a reconstruction."""

    model_config = ConfigDict(extra="forbid")

    query: FeatureReference
    candidates: tuple[PoseCandidate, ...]
    """most similar first"""
    features_model: str
    """`Detector.model` of the reconstruction; features of another one are left out"""
    components: tuple[PoseComponent, ...]
    focal_length: float | None = Field(None, gt=0, allow_inf_nan=False)
    """as a multiple of the query's longer side; None if it has to be estimated"""
    camera_source: str
    """where `focal_length` comes from: a `shared.geometry.cameras.CameraSource`. A focal length of
    EXIF that a candidate has, too, is that of its camera, which was refined with the model"""
    camera: ColmapCamera | None = None
    """that took the query, if its parameters were sent with it"""
    camera_key: str | None = None
    """`PhotoHeader.camera_key` of the query"""
    quarter_turns: int = 0
    """clockwise, by which the query was turned upright"""
    leave_out: tuple[UUID, ...] = ()
    """photos whose own points are not used: the query, if it is one of the map"""


class GeographicPose(_Message):
    """A pose on the earth: a `shared.geometry.radius.GeoPose`."""

    latitude: float
    longitude: float
    altitude_m: float | None
    heading: float
    pitch: float
    roll: float
    radius_68_m: float
    radius_95_m: float
    heading_68_degrees: float
    heading_95_degrees: float
    enu_quaternion: tuple[float, float, float, float]
    """(w, x, y, z) of `shared.geometry.frames.geopose_rotation`"""


class ComponentPose(_Message):
    """The pose of a query in the frame of a component: a `shared.geometry.localise.LocalPose`."""

    component: int
    """index in the request's components"""
    position: tuple[float, float, float]
    """centre of the camera"""
    quaternion: tuple[float, float, float, float]
    """(w, x, y, z) of the rotation from the component to the camera's axes"""
    inliers: int
    matches: int
    width: int
    """of the upright query in pixels"""
    height: int
    focal_pixels: float
    camera_source: str
    seen: tuple[SeenPoint, ...]
    """at most MAX_SEEN_POINTS of the inliers"""
    geographic: GeographicPose | None
    """None if the component is not aligned or not calibrated"""


class PoseResponse(_Message):
    """Result of a pose request."""

    pose: ComponentPose | None = None
    reason: str | None = None
    """why there is no pose, as a sentence; None with one"""


class SearchBackend(Protocol):
    """The search tier as its callers use it.

    Raises `Unavailable` when it can't reach the requested version in time.
    """

    def search(self, request: SearchRequest) -> SearchResponse:
        """Return the hits of one search."""

    def match(self, request: MatchRequest) -> MatchResponse:
        """Match local features, on any one worker: they are read from the object store."""

    def estimate_pose(self, request: PoseRequest) -> PoseResponse:
        """Compute the pose of a query in a reconstruction, on any one worker."""

    def status(self) -> SearchStatus:
        """Return the state of the workers."""
