"""A track as GPX 1.1."""

from __future__ import annotations

from itertools import groupby
from xml.etree import ElementTree

from placewise.answers import OneTrack, TrackFrame, TrackState

GPX_NAMESPACE = "http://www.topografix.com/GPX/1/1"


def located_segments(track: OneTrack) -> list[list[tuple[TrackFrame, TrackState]]]:
    """Split a track where it is lost; each segment has its frames with a position, in order."""
    states = [(frame, frame.state) for frame in track.frames if frame.state is not None]
    groups = groupby(states, lambda each: each[1].latitude is not None and each[1].status != "lost")
    return [list(group) for located, group in groups if located]


def to_gpx(track: OneTrack) -> bytes:
    """Return one GPX track with a segment for each part that is not lost."""
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
