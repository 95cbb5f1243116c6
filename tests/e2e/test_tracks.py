"""A ride as a user follows it: on the command line, with the client, and across kills."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

import placewise
from shared.config.embedded_home import find_running_server
from tests.support.photos import photo_bytes
from tests.support.server import CommandLine, ServerProcess

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)
STREET = range(1, 6)
FRAMES = (1, 2, 3)
DEGREES_APART = 0.001


def connected(server: ServerProcess) -> placewise.Client:
    running = find_running_server(server.home)
    assert running is not None
    return placewise.connect(running.url, key=running.key)


@pytest.fixture
def street(server: ServerProcess) -> Iterator[placewise.Client]:
    """A map of a street, one photo every hundred metres to the north."""
    with connected(server) as client:
        for number in STREET:
            server.indexed(
                photo_bytes(number), f"{number}.jpg", latitude=number * DEGREES_APART, longitude=7
            )
        yield client


def test_a_folder_of_photos_becomes_a_track_and_its_files(
    server: ServerProcess, street: placewise.Client, tmp_path: Path
) -> None:
    (tmp_path / "ride").mkdir()
    for number in FRAMES:
        (tmp_path / "ride" / f"{number}.jpg").write_bytes(photo_bytes(number))
    (tmp_path / "ride" / "4.jpg").write_bytes(photo_bytes(4)[:300])
    options = ["--every", "10", "--max-speed", "20"]
    command = CommandLine(tmp_path, server.home)
    run = command("track", "ride", *options, "--out=ride.gpx", "--json")
    track = run.json()
    assert "4.jpg" in run.stderr, "the photo that can't be read is named"
    statuses = [frame["status"] for frame in track["frames"]]
    assert statuses == ["applied"] * 3
    assert track["frames"][2]["state"]["latitude"] == pytest.approx(3 * DEGREES_APART, abs=1e-4)
    assert (tmp_path / "ride.gpx").stat().st_size > 100
    assert "tracking" in command("track", "ride", *options).stdout
    refused = command("track", "ride", "--motion", "swim")
    assert (refused.code, "invalid_field" in refused.stderr) == (1, True)
    assert command("track", "ride", "--max-speed", "0").code == 2
    assert len(list(street.tracks())) == 2
    street.delete_track(track["track_id"])
    assert len(list(street.tracks())) == 1


def test_no_acknowledged_frame_is_lost_when_the_server_is_killed_between_two(
    server: ServerProcess, street: placewise.Client, tmp_path: Path
) -> None:
    photo = tmp_path / "frame.jpg"
    track_id = street.begin_track(max_speed_mps=20).track_id
    for number in FRAMES:
        photo.write_bytes(photo_bytes(number))
        time = NOON + timedelta(seconds=10 * number)
        with connected(server) as client:
            frame = client.add_frame(track_id, photo, time, wait=False, expected_version=number - 1)
        server.kill()
        server.start()
        with connected(server) as client:
            again = client.add_frame(track_id, photo, time)
        assert (again.frame_id, again.version) == (frame.frame_id, number)
        assert again.status == "applied"
    with connected(server) as client:
        track = client.track(track_id)
    assert [one.status for one in track.frames] == ["applied"] * 3
    assert (track.version, track.pending) == (3, 0)
    assert track.state is not None
    assert track.state.latitude == pytest.approx(3 * DEGREES_APART, abs=1e-4)
