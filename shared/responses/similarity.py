"""Responses about photos, and to similarity searches: matches, estimates and poses."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from pydantic import ConfigDict, Field

from shared.enums import PhotoRole, RowType
from shared.responses import OPEN, ResponseModel


class PointPair(ResponseModel):
    """Two points that show the same spot, in pixels of the upright photos."""

    model_config = ConfigDict(extra="ignore")  # of a newer search worker, too

    query: tuple[float, float]
    photo: tuple[float, float]


class SeenPoint(ResponseModel):
    """A point of a reconstruction that a query shows."""

    model_config = ConfigDict(extra="ignore")  # of a newer search worker, too

    query: tuple[float, float]
    """in pixels of the upright query"""
    point: tuple[float, float, float]
    """in the component's frame"""


class DeniedPlace(ResponseModel):
    """A place of an answer where a photo was not taken, as a person says."""

    latitude: float | None
    longitude: float | None
    radius_m: float | None
    place: str | None


class GivenPlace(ResponseModel):
    """What a place rests on that was given to a photo with `POST /places`."""

    model_config = ConfigDict(extra="ignore")

    probability: float | None = Field(description="of the proposal; null if a person chose it")
    reason: str
    given_at: datetime
    denied: DeniedPlace | None = Field(None, description="set if the photo was given no place")


class PhotoResponse(ResponseModel):
    """A stored photo."""

    image_id: UUID = Field(validation_alias="id")
    image_path: str = Field(description="URL path of the image on this server")
    original_filename: str = Field(validation_alias="filename")
    relative_path: str | None = Field(
        description="path in the folder or archive that it was uploaded from; null if unknown"
    )
    upload_time: datetime = Field(validation_alias="uploaded_at")
    file_size: int = Field(validation_alias="size_bytes")
    width: int
    height: int
    metadata: dict[str, Any] = Field(validation_alias="attributes")
    tags: list[str]
    latitude: float | None
    longitude: float | None
    altitude: float | None = Field(description="metres")
    heading: float | None
    focal_length: float | None = Field(
        description="of EXIF, as a multiple of the longer side; null if unknown"
    )
    captured_at: datetime | None
    place: str | None
    given_place: GivenPlace | None = Field(
        None, description="if the place was given here: what it rests on, until it is undone"
    )
    role: Annotated[PhotoRole, OPEN]
    image_url: str
    thumbnail_url: str
    preview_url: str


class PhotoDetailResponse(PhotoResponse):
    """A stored photo with the state of its job."""

    job_id: UUID | None
    media_type: str
    sha256: str
    searchable: bool = Field(description="whether the active generation has its descriptor")


class SimilarPhotoResponse(PhotoResponse):
    similarity_score: float = Field(description="cosine similarity in [-1, 1]")
    match_probability: float | None = Field(
        None,
        description="probability that the photo shows the query's place, at the finest of the "
        "estimate's `levels`; null without levels, and for photos without a place",
    )
    inliers: int | None = Field(
        None,
        description="number of points that match the query's and agree with one camera motion; "
        "null if the photo was not matched, or has no local features",
    )
    pairs: list[PointPair] | None = Field(
        None,
        description="with `explain=true`: the matching points, most similar first, in pixels of "
        "the upright originals",
    )


class MatchesResponse(ResponseModel):
    """How the local features of the query were matched with those of the best photos."""

    compared: int = Field(description="number of photos that were matched")
    missing: int = Field(
        description="number of photos that should have been, but have no local features (yet), "
        "unreadable ones, or those of another model than the query's"
    )
    reason: str | None = Field(description="why no photo was matched; null if some were")
    query_width: int | None = Field(description="of the upright query in pixels, to draw `pairs`")
    query_height: int | None


class EstimateLevelResponse(ResponseModel):
    """A level of an estimate: a place, or a circle around a position."""

    place: str | None = Field(None, description="label of the place, or the start of its path")
    latitude: float | None = Field(None, description="centre of the circle, degrees")
    longitude: float | None = None
    radius_m: float | None = None
    whole_map: bool = Field(False, description="the level is the whole map: 'in this map'")
    probability: float = Field(description="probability that the query was taken there")


class EstimateResponse(ResponseModel):
    """Estimate of the place that the query photo shows, with a confidence."""

    headline: str = Field(description="the answer in one sentence")
    in_map: bool | None = Field(
        None,
        description="true: `certainty` is reached; false: 'not in this map' is more probable; "
        "null: neither, or not known yet",
    )
    latitude: float | None = Field(
        None,
        description="position of the pose, if there is one, else of the answered level, or of the "
        "finest one as a guess; null if `in_map` is false",
    )
    longitude: float | None = None
    radius_m: float | None = Field(
        None, description="the place is right if the true position is within so many metres"
    )
    place: str | None = Field(None, description="label of that level")
    has_place: bool = Field(False, description="whether there is a place: an answer or a guess")
    confidence: float | None = Field(
        None, description="probability that the place is right; null without levels"
    )
    reason: str
    levels: list[EstimateLevelResponse] = Field(
        [],
        description="levels of the estimate, finest first; each contains the finer ones and is at "
        "least as probable; the last one is the whole map, and adds up to 1 with "
        "`not_in_map_probability`; empty before the first evaluation of 20 or more photos with "
        "a place",
    )
    answer_level: int | None = Field(
        None,
        description="index in `levels` of the finest one that is certain enough; null if none is",
    )
    certainty: float | None = Field(
        None, description="share of the answers that must be right, as requested"
    )
    elsewhere: float | None = Field(
        None, description="prior probability that a query is from elsewhere, as requested"
    )
    not_in_map_probability: float | None = Field(
        None, description="probability that the query is from elsewhere"
    )
    radius_68_m: float | None = Field(
        None,
        description="radius in metres around the position that contains the true one with a "
        "probability of 68 %; null without coordinates, or if it exceeds the largest level",
    )
    radius_95_m: float | None = Field(None, description="the same with 95 %")
    new_to_map: bool = Field(
        False,
        description="whether the map's last searches are less similar to it than the photos that "
        "its probabilities were measured on; `reason` says so",
    )
    calibration_source: str | None = Field(
        None,
        description="what determines the probabilities most: `own_photos` or `labelled_queries` of "
        "this map, or the `prior` of other maps, near which a map of fewer than 2,000 evaluated "
        "photos stays; null without levels",
    )


class PoseCameraResponse(ResponseModel):
    """The camera that a pose was computed with."""

    focal_pixels: float = Field(description="focal length in pixels of the upright photo")
    width: int = Field(description="of the upright photo in pixels, to draw `seen`")
    height: int
    source: str = Field(
        description="where the focal length comes from: `given` with the request, `exif` of the "
        "photo, `map`: of the same photo in the reconstruction, or `estimated` with the pose"
    )


class CameraPoseResponse(ResponseModel):
    """Where the camera of the query stood, where it looked, and how far off that may be."""

    latitude: float | None = Field(
        description="degrees, WGS 84; null if the component has no coordinates (`reason`)"
    )
    longitude: float | None
    altitude_m: float | None = Field(
        description="metres, as the altitudes of the map's photos; null if too few have one"
    )
    heading: float | None = Field(
        description="viewing direction, degrees clockwise from north, in [0, 360)"
    )
    pitch: float | None = Field(description="degrees that the camera looks up, in [-90, 90]")
    roll: float | None = Field(
        description="degrees that the camera is turned clockwise about its viewing direction"
    )
    radius_68_m: float | None = Field(
        description="radius in metres that contains the true position with a probability of 68 %, "
        "calibrated on the map's own photos; null with a `reason`"
    )
    radius_95_m: float | None = Field(description="the same with 95 %")
    heading_68_degrees: float | None = Field(
        description="the true heading differs by at most this with a probability of 68 %"
    )
    heading_95_degrees: float | None = Field(description="the same with 95 %")
    enu_quaternion: tuple[float, float, float, float] | None = Field(
        description="w, x, y, z of the rotation from the camera's axes forward, left and up to "
        "east, north and up, as in OGC GeoPose and ROS"
    )
    reason: str | None = Field(description="why fields above are null; null if none is missing")
    component: int = Field(description="number of the component in the reconstruction")
    position: tuple[float, float, float] = Field(
        description="centre of the camera in the component's frame"
    )
    quaternion: tuple[float, float, float, float] = Field(
        description="w, x, y, z of the rotation from the component's frame to the camera, whose "
        "axes are x to the right, y down and z forward, as in COLMAP"
    )
    inliers: int = Field(description="number of points that agree with the pose")
    matches: int = Field(description="number of points that were matched")
    camera: PoseCameraResponse
    seen: list[SeenPoint] = Field(
        description="at most 300 of the points that agree: pixel in the upright query (`query`) "
        "and position in the component's frame (`point`)"
    )


class SimilarityResponse(ResponseModel):
    """The most similar photos, best first, without the query itself."""

    query_file_id: UUID | None = Field(description="null when the query photo is not stored")
    query_filename: str
    processing_time_ms: float
    total_similar: int
    similar_images: list[SimilarPhotoResponse]
    matches_without_place: int = Field(
        0,
        description="how many of `similar_images` have neither coordinates nor a label; the "
        "estimate is that of the photos that have",
    )
    estimate: EstimateResponse
    matches: MatchesResponse | None = Field(None, description="null if no photo was to be matched")
    pose: CameraPoseResponse | None = Field(
        None, description="with `pose=true`; null if the query has none (`no_pose`)"
    )
    no_pose: str | None = Field(
        None, description="with `pose=true`: why the query has no pose; null with one"
    )
    vocabulary: str = Field(
        description="`own`: fitted on this map's photos; `provisional`: fitted on fewer than 50 of "
        "them; `foreign`: fitted on other photos; `pending`: descriptors are GeM-pooled until the "
        "map has a vocabulary; `none`: the extractor uses none"
    )
    generation_id: UUID
    rows: Annotated[RowType, OPEN] = Field(
        description="type of the stored descriptors, for which scores are exact: `float32` or "
        "`float16`"
    )
    certificate: str = Field(
        description="`exhaustive`: every row was compared exactly; `statistical`: no skipped "
        "row can be in the result, with an error probability of 1e-8; `none`: a part of the map "
        "could not be searched (`missing`)"
    )
    max_z: float | None = Field(
        None,
        description="largest error of a similarity estimated from codes, in standard deviations; "
        "null without codes",
    )
    rows_scanned: int
    rows_reranked: int
    snapshot_version: int
    degraded: bool = Field(
        False, description="true: `missing` names parts of the map that could not be searched"
    )
    missing: list[str] = Field(
        description="what could not be searched: chunks (`chunks/....npy`) that are unreadable, or "
        "still to be written to the search engine"
    )
