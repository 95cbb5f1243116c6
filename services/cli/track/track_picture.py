"""Draws a track with matplotlib: positions over the photos of the map, or places over time."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

from placewise.answers import OneTrack, Photo, TrackFrame, TrackState

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INCHES = (8.0, 8.0)
DPI = 150
COLOR_OF_STATUS = {"tracking": "#1f5fd0", "converging": "#d98200", "lost": "#c02a2a"}
MAP_COLOR = "#b4b4ac"
METRES_PER_DEGREE = 111_195.0  # of latitude, on the sphere of shared.geodesy

LocatedFrame = tuple[TrackFrame, TrackState]


def located_segments(track: OneTrack) -> list[list[LocatedFrame]]:
    """Split a track where it is lost; each segment has its frames with a position, in order."""
    states = [(frame, frame.state) for frame in track.frames if frame.state is not None]
    groups = groupby(states, lambda each: each[1].latitude is not None and each[1].status != "lost")
    return [list(group) for located, group in groups if located]


def draw_track(track: OneTrack, photos: Sequence[Photo], *, image_format: str) -> bytes:
    """Draw a track.

    Args:
        track: The track. Its frames are drawn by their positions if any has one, otherwise by their
            places.
        photos: The photos of the map.
        image_format: `png` or `jpeg`.

    Returns:
        The bytes of the picture.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=INCHES, dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    states = [(frame, frame.state) for frame in track.frames if frame.state is not None]
    if any(state.latitude is not None for _, state in states):
        _draw_positions(axes, track, photos)
    else:
        _draw_places(axes, states)
        figure.autofmt_xdate()
    axes.legend()
    picture = io.BytesIO()
    figure.savefig(picture, format=image_format)
    return picture.getvalue()


def _draw_positions(axes: Axes, track: OneTrack, photos: Sequence[Photo]) -> None:
    """Draw the photos of the map, the circles of 68 %, the line, and the frames."""
    from matplotlib.patches import Ellipse

    on_map = [_position(photo) for photo in photos if photo.latitude is not None]
    _scatter(axes, on_map, MAP_COLOR, "photos of the map", size=6)
    stretch = 1.0
    for segment in located_segments(track):
        points = [_position(state) for _, state in segment]
        stretch = 1 / max(math.cos(math.radians(points[0][1])), 0.01)
        axes.plot(*zip(*points, strict=True), color=COLOR_OF_STATUS["tracking"], linewidth=1)
        for (_, state), point in zip(segment, points, strict=True):
            height = 2 * (state.radius_68_m or 0.0) / METRES_PER_DEGREE
            color = COLOR_OF_STATUS[state.status]
            axes.add_patch(Ellipse(point, height * stretch, height, color=color, alpha=0.08, lw=0))
    states = [frame.state for frame in track.frames if frame.state is not None]
    for status, color in COLOR_OF_STATUS.items():
        _scatter(
            axes,
            [_position(s) for s in states if s.status == status and s.latitude is not None],
            color,
            status,
        )
    axes.set_xlabel("longitude")
    axes.set_ylabel("latitude")
    axes.ticklabel_format(useOffset=False)
    axes.set_aspect(stretch, adjustable="datalim")


def _draw_places(axes: Axes, states: Sequence[LocatedFrame]) -> None:
    for status, color in COLOR_OF_STATUS.items():
        points = [
            (frame.captured_at, state.place or "unknown")
            for frame, state in states
            if state.status == status
        ]
        _scatter(axes, points, color, status)
    axes.set_xlabel("time")
    axes.set_ylabel("place")


def _position(located: Photo | TrackState) -> tuple[float, float]:
    assert located.longitude is not None
    assert located.latitude is not None
    return located.longitude, located.latitude


def _scatter(
    axes: Axes, points: Sequence[tuple[Any, Any]], color: str, label: str, size: float = 14
) -> None:
    if points:
        x, y = zip(*points, strict=True)
        axes.scatter(x, y, s=size, color=color, label=label, zorder=3)
