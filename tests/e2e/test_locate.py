"""`placewise locate` as a user runs it: a folder, a map that knows the places, sidecars, undo."""

from __future__ import annotations

from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

import pytest

from tests.support.photos import camera_exif, encoded, photo_bytes, photo_image, sidecar_position
from tests.support.server import CommandLine, ServerProcess

NOON = datetime(2026, 5, 1, 12)  # noqa: DTZ001 the clock of a camera
DEGREES_APART = 0.001
LONGITUDE = 7.0


def taken(number: int, seconds: float, latitude: float | None = None) -> bytes:
    """The photo `number` so many seconds after noon."""
    position = None if latitude is None else (latitude, LONGITUDE)
    clock = NOON + timedelta(seconds=seconds)
    exif = camera_exif(clock, position, model="Camera", serial="1")  # all are of one camera
    return encoded(photo_image(number), "JPEG", quality=90, exif=exif)


def test_a_folder_is_located_by_the_map_and_by_time_written_and_undone(
    server: ServerProcess, tmp_path: Path
) -> None:
    for number in range(1, 21):
        server.indexed(
            photo_bytes(number),
            f"{number}.jpg",
            latitude=number * DEGREES_APART,
            longitude=LONGITUDE,
        )
    trip = tmp_path / "trip"
    trip.mkdir()
    (trip / "known.jpg").write_bytes(taken(3, 0, 3 * DEGREES_APART))
    (trip / "of the map.jpg").write_bytes(taken(3, 5))
    (trip / "later.jpg").write_bytes(taken(900, 10))
    (trip / "broken.jpg").write_bytes(taken(4, 0)[:300])
    (trip / "empty.jpg").touch()
    before = {path.name: path.read_bytes() for path in trip.iterdir()}

    locate = partial(CommandLine(tmp_path, server.home), "locate", "trip")
    answer = locate("--accept", "0.9", "--json").json(1)  # a photo could not be read
    assert (answer["photos"], answer["with_coordinates"]) == (5, 1)
    proposals = {each["filename"]: each for each in answer["proposals"]}
    assert "its header is cut off" in proposals["broken.jpg"]["error"]
    assert proposals["broken.jpg"]["position"] is None
    assert proposals["empty.jpg"]["error"] == "The file is empty."
    by_both = proposals["of the map.jpg"]
    assert by_both["accepted"]
    assert by_both["position"]["latitude"] == pytest.approx(3 * DEGREES_APART, abs=2e-4)
    assert by_both["position"]["reason"] == "looks like 3.jpg; taken 5 s after known.jpg"
    by_time = proposals["later.jpg"]["position"]
    assert by_time["latitude"] == pytest.approx(3 * DEGREES_APART, abs=4e-4)
    assert by_time["probability"] < by_both["position"]["probability"]

    for unreadable in ("broken.jpg", "empty.jpg"):
        (trip / unreadable).unlink()
        del before[unreadable]
    written = locate("--accept", "0.9", "--write")
    assert written.code == 0, written.stderr
    assert "of the map.jpg" in written.stdout
    position = sidecar_position((trip / "of the map.jpg.xmp").read_bytes())
    assert position == pytest.approx((by_both["position"]["latitude"], LONGITUDE), abs=1e-4)
    undone = locate("--undo")
    assert undone.code == 0, undone.stderr
    assert {path.name: path.read_bytes() for path in trip.iterdir()} == before
