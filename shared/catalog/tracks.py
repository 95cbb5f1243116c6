"""Tracks: sequences of frames that a filter follows through a map (`shared.tracks`).

A frame's row and its `describe` job are inserted in one transaction, so an acknowledged frame has
both. The frame is *pending* until it is applied: its evidence and state are stored, or the error of
its job. Any gateway may apply it; `Track.revision` is the optimistic lock.

Frames are ordered by the time at which they were taken, which is unique in a track. The belief
after a frame is stored for the last frames only (MAX_LATE_FRAMES), so that a late frame can be
inserted there and the later ones recomputed.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any
from uuid import UUID

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, Session, aliased, defer, mapped_column

from shared.catalog.database.base import (
    Condition,
    Entity,
    JsonValue,
    UtcDateTime,
    count_rows,
    db_now,
    get_in_map,
    insert_row,
    partial_index,
)
from shared.errors import Conflict, NotFound

MAX_TRACK_FRAMES = 10_000
RETENTION_DAYS = 30.0  # after the last frame; as long as finished jobs
MAX_SMOOTHED_FRAMES = 3000  # a request takes about a minute
MAX_LATE_FRAMES = 50
"""A frame may be inserted before at most so many frames of its track."""


class Track(Entity):
    """A track. `params` has the motion model and the start."""

    __tablename__ = "tracks"

    map_id: Mapped[UUID] = mapped_column(sa.Uuid, sa.ForeignKey("maps.id"))
    params: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    version: Mapped[int] = mapped_column(sa.Integer, default=0)
    """Number of accepted frames."""
    revision: Mapped[int] = mapped_column(sa.Integer, default=0)
    """Number of applied frames."""
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    updated_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    """When the last frame was accepted."""
    key_id: Mapped[UUID | None] = mapped_column(sa.Uuid)
    """The API key that began it, if any."""

    __table_args__ = (
        sa.Index("ix_tracks_map_id", "map_id", "id"),
        sa.Index("ix_tracks_updated_at", "updated_at"),
        partial_index("ix_tracks_key", "key_id", only=key_id.is_not(None)),
    )


class TrackFrame(Entity):
    """A frame of a track. It is pending while `state` and `error` are both None."""

    __tablename__ = "track_frames"

    track_id: Mapped[UUID] = mapped_column(sa.Uuid, sa.ForeignKey("tracks.id"))
    captured_at: Mapped[datetime] = mapped_column(UtcDateTime)
    version: Mapped[int] = mapped_column(sa.Integer)
    """That of the track when the frame was accepted."""
    job_id: Mapped[UUID] = mapped_column(sa.Uuid, index=True)
    filename: Mapped[str] = mapped_column(sa.Text)
    sha256: Mapped[str] = mapped_column(sa.String(64))
    measurements: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    """Position fix and odometry, as sent."""
    evidence: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)
    state: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)
    error: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)
    belief: Mapped[bytes | None] = mapped_column(sa.LargeBinary)
    key_id: Mapped[UUID | None] = mapped_column(sa.Uuid)
    """The API key that sent it, if any."""

    __table_args__ = (
        sa.UniqueConstraint("track_id", "captured_at"),
        partial_index(
            "ix_track_frames_pending",
            "track_id",
            "captured_at",
            only=sa.and_(state.is_(None), error.is_(None)),
        ),
        partial_index(
            "ix_track_frames_belief", "track_id", "captured_at", only=belief.is_not(None)
        ),
        partial_index("ix_track_frames_key", "key_id", only=key_id.is_not(None)),
    )

    @property
    def pending(self) -> bool:
        """Whether the frame waits for its job, for an earlier frame, or to be applied."""
        return self.state is None and self.error is None


def is_pending() -> Condition:
    """Condition for pending frames."""
    return sa.and_(TrackFrame.state.is_(None), TrackFrame.error.is_(None))


def get_track(session: Session, map_id: UUID, track_id: UUID, *, lock: bool = False) -> Track:
    """Return a track of the map; NotFound (`track_not_found`)."""
    return get_in_map(session, Track, map_id, track_id, lock=lock)


def get_frame(session: Session, track_id: UUID, frame_id: UUID) -> TrackFrame:
    """Return a frame of the track; NotFound (`frame_not_found`)."""
    frame = session.scalar(
        sa.select(TrackFrame).where(TrackFrame.id == frame_id, TrackFrame.track_id == track_id)
    )
    if frame is None:
        raise NotFound("frame_not_found", f"There is no frame {frame_id} in this track.")
    return frame


def select_frames(track_id: UUID, *, with_evidence: bool = False) -> sa.Select[TrackFrame]:
    """Select the frames of the track in the order of their times, without their beliefs."""
    unread = (TrackFrame.belief,) if with_evidence else (TrackFrame.belief, TrackFrame.evidence)
    return (
        sa.select(TrackFrame)
        .where(TrackFrame.track_id == track_id)
        .order_by(TrackFrame.captured_at)
        .options(*(defer(column, raiseload=True) for column in unread))
    )


def first_pending_frame(session: Session, track_id: UUID) -> TrackFrame | None:
    """Return the pending frame that is applied next: the earliest one."""
    return session.scalar(select_frames(track_id).where(is_pending()).limit(1))


def last_belief(session: Session, track_id: UUID, before: datetime) -> bytes | None:
    """Return the belief after the last applied frame before a time; None if there is none."""
    return session.scalar(
        sa.select(TrackFrame.belief)
        .where(
            TrackFrame.track_id == track_id,
            TrackFrame.captured_at < before,
            TrackFrame.belief.is_not(None),
        )
        .order_by(TrackFrame.captured_at.desc())
        .limit(1)
    )


def _applied_before(frame: TrackFrame) -> Condition:
    return sa.and_(
        TrackFrame.track_id == frame.track_id,
        TrackFrame.captured_at < frame.captured_at,
        TrackFrame.state.is_not(None),
    )


def count_applied_before(session: Session, frame: TrackFrame) -> int:
    """Count the applied frames of the same track before a frame; failed ones do not count."""
    return count_rows(session, sa.select(TrackFrame.id).where(_applied_before(frame)))


def applied_jobs_from(session: Session, frame: TrackFrame, first: int) -> Sequence[UUID]:
    """Return the jobs of the applied frames before a frame, from number `first` on, counted from 0.

    They are in the order of their times.
    """
    return session.scalars(
        sa.select(TrackFrame.job_id)
        .where(_applied_before(frame))
        .order_by(TrackFrame.captured_at)
        .offset(first)
    ).all()


def drop_old_beliefs(session: Session, track_id: UUID) -> None:
    """Delete the beliefs that no late frame can follow."""
    old = (
        sa.select(TrackFrame.id)
        .where(TrackFrame.track_id == track_id, TrackFrame.belief.is_not(None))
        .order_by(TrackFrame.captured_at.desc())
        .offset(MAX_LATE_FRAMES + 1)
    )
    session.execute(
        sa.update(TrackFrame)
        .where(TrackFrame.id.in_(old.scalar_subquery()))
        .values(belief=None)
        .execution_options(synchronize_session=False)
    )


def add_frame(
    session: Session, track: Track, frame: TrackFrame, expected_version: int | None
) -> TrackFrame:
    """Add a frame to a locked track, or return the frame that it repeats.

    Args:
        frame: The new frame; its `version` is set. The caller also adds its job, unless the frame
            is repeated.
        expected_version: Version that the track must have; None for any.

    Raises:
        Conflict: `frame_differs`: the track has another photo of this time; `track_changed`: it has
            another version; `frame_too_late`; `track_full`.
    """
    of_track = sa.select(TrackFrame).where(TrackFrame.track_id == track.id)
    same_time = session.scalar(of_track.where(TrackFrame.captured_at == frame.captured_at))
    if same_time is not None:
        if same_time.sha256 == frame.sha256:
            return same_time
        raise Conflict(
            "frame_differs",
            f"The track has another photo of {frame.captured_at.isoformat()}. Two frames need two "
            "times.",
            frame_id=str(same_time.id),
        )
    if expected_version not in (None, track.version):
        raise Conflict(
            "track_changed",
            f"The track has the version {track.version}, not {expected_version}: another client "
            "has added a frame. Read the track, then continue with its version.",
            version=track.version,
        )
    if track.version >= MAX_TRACK_FRAMES:
        raise Conflict(
            "track_full", f"The track has {MAX_TRACK_FRAMES} frames. Begin another track."
        )
    later = of_track.where(TrackFrame.captured_at > frame.captured_at)
    if count_rows(session, later, MAX_LATE_FRAMES + 1) > MAX_LATE_FRAMES:
        raise Conflict(
            "frame_too_late",
            f"The track has more than {MAX_LATE_FRAMES} frames that were taken after "
            f"{frame.captured_at.isoformat()}.",
            max_late_frames=MAX_LATE_FRAMES,
        )
    track.version += 1
    track.updated_at = db_now()
    frame.version = track.version
    return insert_row(session, frame)


def latest_states(session: Session, track_ids: list[UUID]) -> dict[UUID, TrackFrame]:
    """Return the last frame with a state of each track, by the track's id."""
    frame = aliased(TrackFrame)
    last = (
        sa.select(frame.id)
        .where(frame.track_id == Track.id, frame.state.is_not(None))
        .order_by(frame.captured_at.desc())
        .limit(1)
        .correlate(Track)
        .scalar_subquery()
    )
    frames = session.scalars(
        sa.select(TrackFrame)
        .join(Track, TrackFrame.id == last)
        .where(Track.id.in_(track_ids))
        .options(
            defer(TrackFrame.belief, raiseload=True), defer(TrackFrame.evidence, raiseload=True)
        )
    )
    return {frame.track_id: frame for frame in frames}


def delete_tracks(session: Session, condition: Condition) -> None:
    """Delete the tracks that match the condition, with their frames."""
    matching = sa.select(Track.id).where(condition)
    session.execute(sa.delete(TrackFrame).where(TrackFrame.track_id.in_(matching)))
    session.execute(sa.delete(Track).where(condition))
