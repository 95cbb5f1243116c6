"""Files of a track: CSV and GPX, by the extension of their names."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from placewise.answers import OneTrack, TrackFrame, TrackState
from services.cli.output import atomic_write, check_output_path, printable_path
from shared.errors import InvalidRequest
from shared.ingest.photo_metadata import escape_csv_text

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

LocatedFrame = tuple[TrackFrame, TrackState]


def check_track_files(files: Sequence[Path]) -> None:
    """Check the output paths before the track is computed.

    Raises:
        InvalidRequest: `bad_out`.
    """
    for file in files:
        if file.suffix.lower() not in WRITERS:
            raise InvalidRequest(
                "bad_out",
                f"{printable_path(file)}: the file name must end in one of {', '.join(WRITERS)}.",
            )
        check_output_path(file, file.suffix, "a track")


def write_track_file(file: Path, track: OneTrack) -> None:
    """Write a track in the format of the file's extension."""
    content = WRITERS[file.suffix.lower()](track)
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


def _to_csv(track: OneTrack) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for frame in track.frames:
        row = track_row(frame)
        texts = {name: escape_csv_text(row[name]) for name in TEXT_COLUMNS if row[name]}
        writer.writerow(row | texts)
    return text.getvalue().encode()


def _to_gpx(track: OneTrack) -> bytes:
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


WRITERS: dict[str, Callable[[OneTrack], bytes]] = {
    ".csv": _to_csv,
    ".gpx": _to_gpx,
}
