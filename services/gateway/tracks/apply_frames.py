"""Applies the frames of a track: searches for each described photo and advances the filter.

A frame is applied once all earlier ones are, by whichever request reads the track first. Search and
filter run outside of a transaction; the result is committed if no other gateway has applied a frame
meanwhile (`Track.revision`), and is otherwise computed again.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any
from uuid import UUID

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from services.gateway.dependencies import GatewayContext
from services.gateway.similarity.execute import (
    SimilarityQuery,
    missing_log_odds,
    query_from_job,
    rank_live_photos,
)
from services.gateway.similarity.pose import find_pose
from services.gateway.tracks.catalog_graph import CatalogPhotoGraph
from services.gateway.tracks.schemas import FrameForm, TrackParams, track_state_response
from services.gateway.uploads.query_photo import query_expired_error, query_job_search_params
from shared.catalog.jobs import UNFINISHED_STATES
from shared.catalog.maps import Map
from shared.catalog.tracks import (
    Track,
    TrackFrame,
    applied_jobs_from,
    count_applied_before,
    drop_old_beliefs,
    first_pending_frame,
    last_belief,
    select_frames,
)
from shared.errors import Conflict, Gone, PlacewiseError
from shared.evaluation.places.levels import LevelScheme
from shared.jobs import Job, JobState
from shared.jobs.transitions import requeue_job_as_new
from shared.responses.tracks import TrackStateResponse
from shared.search_api.background import background_frames
from shared.search_api.protocol import MAX_MATCHED_PHOTOS, RowReference, SearchHit
from shared.tracks.belief import Belief
from shared.tracks.evidence import HITS, MAX_ACCURACY_M, FrameEvidence, PositionFix, frame_evidence
from shared.tracks.filter import TrackFilter


@dataclass(frozen=True, slots=True)
class _PendingFrame:
    track: Track
    frame: TrackFrame
    job: Job | None


def apply_pending_frames(gateway: GatewayContext, track_id: UUID, seconds: float) -> UUID | None:
    """Apply the pending frames whose photos are described, for about `seconds`.

    Returns:
        The job that the next pending frame waits for; None if no frame is pending, or time is up.

    Raises:
        PlacewiseError: Of the search; the frame stays pending.
    """
    deadline = time.monotonic() + seconds
    while True:
        pending = _read_pending(gateway, track_id)
        if pending is None:
            return None
        job = pending.job
        if job is not None and job.state in UNFINISHED_STATES:
            return job.id
        try:
            evidence = _search_evidence(gateway, pending)
        except Gone:
            assert job is not None
            _describe_again(gateway, job.id)
            continue
        except _FrameFailed as failed:
            _commit(gateway, pending, {pending.frame.id: {"error": failed.problem}})
        else:
            _commit(gateway, pending, _advance(gateway, pending, evidence))
        if time.monotonic() > deadline:
            return None


class _FrameFailed(Exception):
    """The photo of a frame could not be described."""

    def __init__(self, problem: dict[str, Any]) -> None:
        super().__init__(problem["code"])
        self.problem = problem


def _read_pending(gateway: GatewayContext, track_id: UUID) -> _PendingFrame | None:
    with gateway.catalog.read() as session:
        track = session.get(Track, track_id)
        frame = first_pending_frame(session, track_id) if track else None
        if track is None or frame is None:
            return None
        return _PendingFrame(track, frame, session.get(Job, frame.job_id))


def _search_evidence(gateway: GatewayContext, pending: _PendingFrame) -> FrameEvidence:
    """Search with the frame's photo.

    Raises:
        Gone: The descriptor belongs to a generation that no longer exists.
        _FrameFailed: The job did not succeed.
    """
    job = pending.job
    if job is None:
        raise _FrameFailed(query_expired_error().as_problem())
    if job.state == JobState.FAILED and job.error is not None:
        raise _FrameFailed(job.error)
    if job.state != JobState.SUCCEEDED:
        error: PlacewiseError = Conflict("job_cancelled", f"The job {job.id} was cancelled.")
        raise _FrameFailed(error.as_problem())
    query = query_from_job(gateway, job)
    measured = FrameForm.model_validate(pending.frame.measurements)
    with gateway.catalog.read() as session:
        photo_count = CatalogPhotoGraph(session, pending.track.map_id).photo_count
        background = _background(session, pending.frame, query.generation.id)
    hits = rank_live_photos(gateway, replace(query, background=background), HITS)
    fixes = [measured.fix(), _pose_fix(gateway, job, query, hits)]
    return frame_evidence(
        pending.frame.captured_at,
        [str(hit.photo_id) for hit in hits],
        [hit.score for hit in hits],
        photo_count,
        missing=missing_log_odds(gateway, query),
        fix=min(filter(None, fixes), key=lambda fix: fix.accuracy_m, default=None),
        odometry=measured.odometry(),
    )


def _pose_fix(
    gateway: GatewayContext, job: Job, query: SimilarityQuery, hits: Sequence[SearchHit]
) -> PositionFix | None:
    """Return where the frame's pose is, if it was requested and has coordinates."""
    first = hits[:MAX_MATCHED_PHOTOS]
    try:
        pose = find_pose(gateway, query, first, query_job_search_params(job))
    except PlacewiseError:
        return None
    if pose is None or pose.radius_68_m is None:
        return None
    assert pose.latitude is not None
    assert pose.longitude is not None
    return PositionFix(
        latitude=pose.latitude,
        longitude=pose.longitude,
        accuracy_m=min(pose.radius_68_m, MAX_ACCURACY_M),
        radius_95_m=pose.radius_95_m,
        heading=pose.heading,
    )


def _background(
    session: Session, frame: TrackFrame, generation_id: UUID
) -> tuple[RowReference, ...]:
    """Return the descriptors of the frame's background, as far as they are of this generation."""
    numbers = background_frames(count_applied_before(session, frame))
    if not numbers:
        return ()
    job_ids = applied_jobs_from(session, frame, numbers[0])
    chosen = [job_ids[number - numbers[0]] for number in numbers]
    results = {
        job.id: job.result
        for job in session.scalars(select(Job).where(Job.id.in_(chosen)))
        if job.result and job.result.get("generation_id") == str(generation_id)
    }
    return tuple(
        RowReference(object_key=result["object_key"], row=result["row"])
        for job_id in chosen
        if (result := results.get(job_id))
    )


def _advance(
    gateway: GatewayContext, pending: _PendingFrame, evidence: FrameEvidence
) -> dict[UUID, dict[str, Any]]:
    """Compute the new values of the frame, and of the applied ones that were taken after it."""
    frame = pending.frame
    with gateway.catalog.read() as session:
        before = last_belief(session, frame.track_id, frame.captured_at)
        later = session.scalars(
            select_frames(frame.track_id, with_evidence=True).where(
                TrackFrame.captured_at > frame.captured_at, TrackFrame.evidence.is_not(None)
            )
        ).all()
        track_filter = _open_filter(gateway, session, pending.track)
        belief = None if before is None else Belief.from_bytes(before)
        changed: dict[UUID, dict[str, Any]] = {}
        for frame_id, each in [(frame.id, evidence), *((f.id, _evidence_of(f)) for f in later)]:
            belief = track_filter.advance(belief, each)
            state = track_state_response(track_filter.state(belief), each.fix)
            changed[frame_id] = {
                "state": state.model_dump(mode="json"),
                "belief": belief.to_bytes(),
            }
    changed[frame.id]["evidence"] = evidence.model_dump(mode="json")
    return changed


def _commit(
    gateway: GatewayContext, pending: _PendingFrame, changed: dict[UUID, dict[str, Any]]
) -> None:
    """Store the new values of frames, unless the track was deleted or advanced meanwhile."""
    with gateway.catalog.write() as session:
        track = session.get(Track, pending.track.id, with_for_update=True)
        if track is None or track.revision != pending.track.revision:
            return
        for frame_id, values in changed.items():
            session.execute(update(TrackFrame).where(TrackFrame.id == frame_id).values(**values))
        drop_old_beliefs(session, track.id)
        track.revision += 1
    for status in (
        "failed" if "error" in values else values["state"]["status"] for values in changed.values()
    ):
        gateway.track_frames.labels(status).inc()


def _describe_again(gateway: GatewayContext, job_id: UUID) -> None:
    with gateway.catalog.write() as session:
        job = session.get(Job, job_id, with_for_update=True)
        if job is not None and job.state == JobState.SUCCEEDED:
            requeue_job_as_new(job)
    gateway.wakeups.send()


def smooth_states(
    gateway: GatewayContext, track: Track, frames: Sequence[TrackFrame]
) -> dict[UUID, TrackStateResponse]:
    """Compute the states of the applied frames given all of them, earlier and later.

    `frames` have their evidence, and are in the order of their times.
    """
    applied = [frame for frame in frames if frame.state is not None]
    if not applied:
        return {}
    with gateway.catalog.read() as session:
        evidence = [_evidence_of(frame) for frame in applied]
        states = _open_filter(gateway, session, track).smoothed_states(evidence)
        return {
            frame.id: track_state_response(state, each.fix)
            for frame, state, each in zip(applied, states, evidence, strict=True)
        }


def _evidence_of(frame: TrackFrame) -> FrameEvidence:
    return FrameEvidence.model_validate(frame.evidence)


def _open_filter(gateway: GatewayContext, session: Session, track: Track) -> TrackFilter:
    map_ = session.get_one(Map, track.map_id)
    scheme = LevelScheme(
        labels_are_paths=map_.place_labels_are_paths, radii_m=gateway.settings.level_radii_m
    )
    motion = TrackParams.model_validate(track.params).motion_model()
    return TrackFilter(CatalogPhotoGraph(session, track.map_id), motion, scheme)
