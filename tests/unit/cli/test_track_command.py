"""`placewise track` without a server: times of frames, videos, and the files of a track."""

from __future__ import annotations

import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import UUID
from xml.etree import ElementTree

import av
import numpy as np
import pytest
from PIL import Image

from placewise.answers import OneTrack
from services.cli.track.command import _print_track
from services.cli.track.frame_sources import FrameTiming, read_photo_frames, read_video_frames
from services.cli.track.gpx import GPX_NAMESPACE, located_segments, to_gpx
from shared.errors import InvalidRequest, Misconfigured
from tests.support.photos import camera_exif, photo_bytes

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)
UNKNOWN = FrameTiming(every_seconds=2.0, begin=None)
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def taken_at(number: int, time: datetime | None) -> bytes:
    return photo_bytes(number, exif=camera_exif(time, offset="+00:00" if time else None))


def test_photos_are_in_the_order_of_their_times_and_no_two_times_are_equal(tmp_path: Path) -> None:
    times = {"c.jpg": 0, "a.jpg": 5, "b.jpg": 5, "sub/d.jpg": 9}
    (tmp_path / "sub").mkdir()
    for number, (name, seconds) in enumerate(times.items()):
        photo = taken_at(number, NOON + timedelta(seconds=seconds))
        (tmp_path / name).write_bytes(photo)
    frames = read_photo_frames(tmp_path, UNKNOWN)
    assert [frame.name for frame in frames] == ["c.jpg", "a.jpg", "b.jpg", "sub/d.jpg"]
    assert [(frame.captured_at - NOON).total_seconds() for frame in frames] == [0, 5, 5.001, 9]


def test_photos_without_a_time_are_in_the_order_of_their_names(tmp_path: Path) -> None:
    for number, name in enumerate(("b.jpg", "a.jpg")):
        (tmp_path / name).write_bytes(photo_bytes(number))
    (tmp_path / "c.jpg").write_bytes(b"no photo")
    frames = read_photo_frames(tmp_path, UNKNOWN)
    assert [frame.name for frame in frames] == ["a.jpg", "b.jpg", "c.jpg"]
    assert [(frame.captured_at - EPOCH).total_seconds() for frame in frames] == [0, 2, 4]
    later = FrameTiming(1.0, NOON + timedelta(days=1))
    assert read_photo_frames(tmp_path, later)[1].captured_at == NOON + timedelta(days=1, seconds=1)


def write_video(path: Path, recorded: datetime | None = None) -> Path:
    """Three seconds with ten frames each, brighter from second to second."""
    with av.open(str(path), "w") as container:
        if recorded is not None:
            container.metadata["creation_time"] = recorded.isoformat()
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(30):
            picture = np.full((48, 64, 3), 40 + 60 * (number // 10), dtype=np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_video(tmp_path / "ride.mp4")


@pytest.mark.parametrize(
    ("recorded", "begin", "first", "words"),
    [
        (None, None, EPOCH, "1970-01-01 00:00:00 UTC: their time is unknown"),
        (NOON, None, NOON, "2026-05-01 12:00:00 UTC, when it was recorded"),
        (NOON, EPOCH, EPOCH, r"1970-01-01 00:00:00 UTC (--begin)"),
    ],
)
def test_a_video_has_its_own_clock_which_is_named(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    recorded: datetime | None,
    begin: datetime | None,
    first: datetime,
    words: str,
) -> None:
    path = write_video(tmp_path / "copied.mp4", recorded)
    frames = list(read_video_frames(path, FrameTiming(1.0, begin), tmp_path))
    assert [frame.captured_at for frame in frames] == [
        first + timedelta(seconds=seconds) for seconds in range(3)
    ]
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(("every", "seconds"), [(1.0, [0, 1, 2]), (1.25, [0, 1.3, 2.5])])
def test_a_video_gives_a_frame_every_so_many_seconds(
    video: Path, tmp_path: Path, every: float, seconds: list[float]
) -> None:
    frames = read_video_frames(video, FrameTiming(every, NOON), tmp_path)
    shown = [(f.captured_at - NOON, np.asarray(Image.open(f.path)).mean()) for f in frames]
    assert [time.total_seconds() for time, _ in shown] == pytest.approx(seconds)
    assert [shade for _, shade in shown] == pytest.approx([40, 100, 160], abs=8)
    assert list(tmp_path.iterdir()) == [video], "a frame is deleted once it was sent"


@pytest.mark.parametrize(("rotation", "turns"), [(0, 0), (90, 1), (-90, 3), (180, 2), (-180, 2)])
def test_frames_are_turned_as_the_display_matrix_of_the_video_says(
    tmp_path: Path, rotation: int, turns: int
) -> None:
    """`rotation` is counterclockwise, as FFmpeg counts it."""
    shown = np.zeros((48, 64, 3), np.uint8)
    shown[:24, :32], shown[:24, 32:] = 250, 120  # brightest at the top left
    path = tmp_path / "turned.mp4"
    with av.open(str(path), "w") as container:
        stored = np.ascontiguousarray(np.rot90(shown, -turns))
        stream = container.add_stream("mpeg4", rate=10)
        stream.height, stream.width = stored.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.set_display_rotation(rotation) if rotation else None
        container.mux(stream.encode(av.VideoFrame.from_ndarray(stored, format="rgb24")))
        container.mux(stream.encode())
    frame = next(read_video_frames(path, UNKNOWN, tmp_path))
    found = np.asarray(Image.open(frame.path)).astype(int)
    assert found.shape == shown.shape
    assert abs(found - shown).mean() < 12


def test_raw_stream_without_times_is_refused_with_the_way_to_give_it_some(tmp_path: Path) -> None:
    path = tmp_path / "raw.h264"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.mux(stream.encode(av.VideoFrame(64, 48, "yuv420p")))
        container.mux(stream.encode())
    with pytest.raises(InvalidRequest, match=r"ffmpeg -framerate 30 -i raw\.h264 -c copy"):
        list(read_video_frames(path, UNKNOWN, tmp_path))


def test_unreadable_videos_and_a_missing_decoder_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "notes.txt").write_text("no video")
    (tmp_path / "photo.JPG").write_bytes(photo_bytes(1))
    for name in ("notes.txt", "photo.JPG"):
        with pytest.raises(InvalidRequest, match=name) as refusal:
            list(read_video_frames(tmp_path / name, UNKNOWN, tmp_path))
        assert refusal.value.code == "unreadable_video"
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(Misconfigured, match=r"uv pip install '\.\[tracks\]'"):
        list(read_video_frames(tmp_path / "notes.txt", UNKNOWN, tmp_path))


def state(status: str, latitude: float | None) -> dict[str, Any]:
    return {
        "status": status,
        "image_id": UUID(int=1),
        "latitude": latitude,
        "longitude": None if latitude is None else 7.0,
        "place": None,
        "heading": 90.0,
        "probability": 0.9,
        "levels": [],
        "radius_68_m": None if latitude is None else 12.0,
        "radius_95_m": None,
        "not_in_map_probability": 0.01,
    }


def track_of(*states: dict[str, Any] | None) -> OneTrack:
    frames = [
        {
            "frame_id": UUID(int=number),
            "captured_at": NOON + timedelta(seconds=number),
            "filename": f"{number}.jpg",
            "status": "failed" if one is None else "applied",
            "state": one,
            "error": None,
            "job_id": UUID(int=number),
            "job_url": "",
            "frame_url": "",
            "version": number,
        }
        for number, one in enumerate(states)
    ]
    about = {"track_id": UUID(int=9), "motion": "walk", "max_speed_mps": None, "version": 1}
    times = dict.fromkeys(("created_at", "updated_at", "expires_at"), NOON)
    return OneTrack(**about, **times, pending=0, state=states[-1], smoothed=True, frames=frames)


RIDE = track_of(
    state("converging", 45.0),
    state("tracking", 45.001),
    state("lost", 45.9),
    None,
    state("tracking", 45.002),
)


def test_a_map_that_tells_no_place_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    _print_track(track_of(state("lost", None) | {"probability": 0.0}), None)
    printed = capsys.readouterr()
    assert "The map has no coordinates, place labels or times" in printed.err
    assert str(UUID(int=1)) in printed.out, "the photo of the map that is nearest"


def test_a_gpx_track_has_a_segment_for_each_part_that_is_not_lost() -> None:
    gpx = ElementTree.fromstring(to_gpx(RIDE))
    space = {"g": GPX_NAMESPACE}
    segments = gpx.findall("g:trk/g:trkseg", space)
    assert [len(segment) for segment in segments] == [2, 1]
    first = segments[0].find("g:trkpt", space)
    assert first is not None
    assert first.attrib == {"lat": "45.0000000", "lon": "7.0000000"}
    assert first.findtext("g:time", namespaces=space) == "2026-05-01T12:00:00Z"
    assert located_segments(track_of(None)) == []
