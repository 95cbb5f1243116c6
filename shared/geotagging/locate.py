"""Proposes positions for photos: what a search, photos of known times and a GPX track say.

The command, the API and the page use this; they differ in where photos come from and go to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from shared.geotagging.evidence import (
    DatedPhoto,
    KnownPosition,
    PictureEvidence,
    PosePosition,
    ProbableCircle,
    SimilarPosition,
    TimeNeighbours,
    interpolate_position,
)
from shared.geotagging.fusion import Proposal, propose_position
from shared.responses.similarity import CameraPoseResponse, EstimateResponse, SimilarityResponse
from shared.tracks.motion import MotionModel

SIMILAR_PHOTOS = 50
"""Number of similar photos that a search for the position of a photo asks for"""


@dataclass(frozen=True, slots=True)
class PositionFinder:
    """Locates photos among others of one collection."""

    neighbours: TimeNeighbours
    track: Sequence[KnownPosition]
    """points of a GPX track, in the order of their times"""
    motion: MotionModel
    radius_m: float
    """of the circle that the probability of a proposal is for"""

    def propose(
        self, photo: DatedPhoto, picture: PictureEvidence | None
    ) -> tuple[Proposal | None, str]:
        """Return the proposal, and the reason for it or for the lack of one."""
        speed = self.motion.max_speed_mps
        by_time = self.neighbours.position_of(photo, speed)
        on_track = None
        if photo.time is not None and photo.time_zone_is_known:
            on_track = interpolate_position(self.track, photo.time, speed)
        proposal = propose_position(picture, by_time, on_track, self.radius_m)
        if proposal is None:
            return None, self.neighbours.why_unknown(photo, picture)
        return proposal, proposal.reason


def search_for_position(
    search: Callable[[], SimilarityResponse],
    search_located: Callable[[], SimilarityResponse],
) -> SimilarityResponse:
    """Search a map for the position of a photo.

    Args:
        search: Searches all photos of the map.
        search_located: Searches those with coordinates, which similar photos without any may hide.
    """
    answer = search()
    if answer.matches_without_place and (located := search_located().similar_images):
        return answer.model_copy(update={"similar_images": located})
    return answer


def picture_evidence(answer: SimilarityResponse, photo_count: int) -> PictureEvidence:
    """Return what a search says about the position.

    Args:
        photo_count: Number of photos of the map.
    """
    estimate = answer.estimate
    is_unlocated = not (estimate.has_place or estimate.levels)
    stated = (estimate.not_in_map_probability, estimate.elsewhere)
    return PictureEvidence(
        [
            SimilarPosition(
                photo.latitude,
                photo.longitude,
                photo.similarity_score,
                photo.relative_path or photo.original_filename,
            )
            for photo in answer.similar_images
            if photo.latitude is not None and photo.longitude is not None and not is_unlocated
        ],
        [
            ProbableCircle(level.latitude, level.longitude, level.radius_m, level.probability)
            for level in estimate.levels
            if level.latitude is not None
            and level.longitude is not None
            and level.radius_m is not None
        ],
        next((share for share in stated if share is not None), 1.0),
        photo_count,
        _pose_position(answer.pose),
        estimate.headline,
    )


def probable_label(estimate: EstimateResponse) -> tuple[str | None, float | None]:
    """Return the finest label of an estimate and its probability; None if it has none."""
    named = () if estimate.in_map is False else estimate.levels
    level = next((each for each in named if each.place), None)
    return (level.place, level.probability) if level else (None, None)


def _pose_position(pose: CameraPoseResponse | None) -> PosePosition | None:
    if pose is None or pose.latitude is None or pose.longitude is None:
        return None
    if pose.radius_68_m is None or pose.heading is None:
        return None
    return PosePosition(pose.latitude, pose.longitude, pose.radius_68_m, pose.heading)
