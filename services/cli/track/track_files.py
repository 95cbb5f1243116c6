"""Files of a track: JSON, CSV, GPX, GeoJSON and pictures, by the extension of their names."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from placewise.answers import OneTrack, Photo, TrackFrame, TrackState
from services.cli.output import Json, atomic_write, check_output_path, printable_path
from shared.errors import InvalidRequest, Misconfigured
from shared.ingest.photo_metadata import escape_csv_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes


GPX_NAMESPACE = "http://www.topografix.com/GPX/1/1"
COLUMNS = (
    "captured_at",
    "filename",
    "status",
    "latitude",
    "longitude",
    "place",
    "heading",
    "probability",
    "radius_68_m",
    "radius_95_m",
    "not_in_map_probability",
    "image_id",
)
STATE_COLUMNS = COLUMNS[3:]
TEXT_COLUMNS = ("filename", "place")
PICTURE_SUFFIXES = (".png", ".jpg")
INCHES = (8.0, 8.0)
DPI = 150
COLOR_OF_STATUS = {"tracking": "#1f5fd0", "converging": "#d98200", "lost": "#c02a2a"}
MAP_COLOR = "#b4b4ac"
METRES_PER_DEGREE = 111_195.0  # of latitude, on the sphere of shared.geodesy

LocatedFrame = tuple[TrackFrame, TrackState]


def check_track_files(files: Sequence[Path]) -> None:
    """Check the output paths before the track is computed.

    Raises:
        InvalidRequest: `bad_out`.
        Misconfigured: `no_matplotlib`.
    """
    for file in files:
        if file.suffix.lower() not in WRITERS:
            raise InvalidRequest(
                "bad_out",
                f"{printable_path(file)}: the file name must end in one of {', '.join(WRITERS)}.",
            )
        check_output_path(file, file.suffix, "a track")
        if file.suffix.lower() in PICTURE_SUFFIXES and find_spec("matplotlib") is None:
            raise Misconfigured(
                "no_matplotlib",
                f"Drawing {printable_path(file)} needs matplotlib. Install the extra "
                "`tracks`: uv pip install '.[tracks]' in the repository.",
            )


def write_track_file(file: Path, track: OneTrack, photos: Sequence[Photo]) -> None:
    """Write a track in the format of the file's extension.

    Args:
        photos: The photos of the map, for a picture.
    """
    content = WRITERS[file.suffix.lower()](track, photos)
    with atomic_write(file) as out:
        out.write(content)


def track_row(frame: TrackFrame) -> dict[str, Any]:
    """Return the values of COLUMNS of a frame; None for unknown ones."""
    row: dict[str, Any] = {
        "captured_at": frame.captured_at.isoformat(),
        "filename": frame.filename,
        "status": frame.status if frame.state is None else frame.state.status,
    }
    return row | {name: getattr(frame.state, name, None) for name in STATE_COLUMNS}


def located_segments(track: OneTrack) -> list[list[LocatedFrame]]:
    """Split a track where it is lost; each segment has its frames with a position, in order."""
    states = [(frame, frame.state) for frame in track.frames if frame.state is not None]
    groups = groupby(states, lambda each: each[1].latitude is not None and each[1].status != "lost")
    return [list(group) for located, group in groups if located]


def _to_json(track: OneTrack, photos: Sequence[Photo]) -> bytes:
    return json.dumps(track.as_json(), ensure_ascii=False, indent=2).encode()


def _to_csv(track: OneTrack, photos: Sequence[Photo]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for frame in track.frames:
        row = track_row(frame)
        texts = {name: escape_csv_text(row[name]) for name in TEXT_COLUMNS if row[name]}
        writer.writerow(row | texts)
    return text.getvalue().encode()


def _to_gpx(track: OneTrack, photos: Sequence[Photo]) -> bytes:
    """One GPX 1.1 track with a segment for each part that is not lost."""
    root = ElementTree.Element(
        "gpx", {"xmlns": GPX_NAMESPACE, "version": "1.1", "creator": "Placewise"}
    )
    element = ElementTree.SubElement(root, "trk")
    ElementTree.SubElement(element, "name").text = str(track.track_id)
    for segment in located_segments(track):
        points = ElementTree.SubElement(element, "trkseg")
        for frame, state in segment:
            position = {"lat": f"{state.latitude:.7f}", "lon": f"{state.longitude:.7f}"}
            point = ElementTree.SubElement(points, "trkpt", position)
            time = frame.captured_at.isoformat().replace("+00:00", "Z")
            ElementTree.SubElement(point, "time").text = time
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))


def _to_geojson(track: OneTrack, photos: Sequence[Photo]) -> bytes:
    """A line for each part that is not lost, and a point for each frame."""
    features: list[Json] = [
        _feature(
            "LineString",
            [[state.longitude, state.latitude] for _, state in segment],
            {"kind": "track", "track_id": str(track.track_id)},
        )
        for segment in located_segments(track)
        if len(segment) > 1
    ]
    for frame in track.frames:
        row = track_row(frame)
        position = [row["longitude"], row["latitude"]]
        properties = {name: _plain(value) for name, value in row.items()}
        features.append(
            _feature(
                "Point", None if None in position else position, {"kind": "frame", **properties}
            )
        )
    collection = {"type": "FeatureCollection", "features": features}
    return json.dumps(collection, ensure_ascii=False, indent=1).encode()


def _feature(kind: str, coordinates: list[Any] | None, properties: Json) -> Json:
    geometry = None if coordinates is None else {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _plain(value: Any) -> Any:
    return value if isinstance(value, (int, float)) or value is None else str(value)


def _draw_track(track: OneTrack, photos: Sequence[Photo], *, image_format: str) -> bytes:
    """Draw the frames by their positions if any has one, otherwise by their places."""
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


WRITERS: dict[str, Callable[[OneTrack, Sequence[Photo]], bytes]] = {
    ".json": _to_json,
    ".csv": _to_csv,
    ".gpx": _to_gpx,
    ".geojson": _to_geojson,
    ".png": partial(_draw_track, image_format="png"),
    ".jpg": partial(_draw_track, image_format="jpeg"),
}
