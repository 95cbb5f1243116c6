"""`placewise locate` without a server: times, cameras, GPX tracks, and what is written."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from urllib.parse import parse_qs, urlsplit

import pyexiv2
import pytest
from PIL.ExifTags import Base
from typer.testing import CliRunner, Result

from services.cli.locate import folder as locate_folder
from services.cli.locate import preview
from services.cli.locate.folder import read_folder, read_gpx
from services.cli.locate.sidecars import NEW_SIDECAR, add_position
from services.cli.main import build_app
from shared.errors import InvalidRequest
from tests.support.api_responses import PHOTO, POSE, SIMILAR, STATS
from tests.support.fake_server import FakeServer
from tests.support.photos import camera_exif, encoded, photo_image

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)
LATITUDE, LONGITUDE = 45.0691, 7.6853
SIDECAR = NEW_SIDECAR.replace(b"Placewise", b"darktable")
DEGREES_PER_M = 1 / 111_195


def photo(
    seconds: float | None,
    north_m: float | None = None,
    *,
    camera: str = "X100",
    offset: str | None = "+02:00",
    serial: str = "1",
) -> bytes:
    """A JPEG that was taken so many seconds after noon UTC; the camera's clock is two ahead."""
    position = None if north_m is None else (LATITUDE + north_m * DEGREES_PER_M, LONGITUDE)
    clock = None if seconds is None else NOON + timedelta(hours=2, seconds=seconds)
    exif = camera_exif(
        clock, position, offset=offset if clock else None, model=camera, serial=serial
    )
    exif[Base.Make] = "Maker"
    return encoded(photo_image(1), "JPEG", exif=exif)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three photos of one camera, 20 s and 20 m apart; the second has no coordinates."""
    root = tmp_path / "trip"
    (root / "day 1").mkdir(parents=True)
    (root / "1.jpg").write_bytes(photo(0, 0))
    (root / "day 1" / "2.jpg").write_bytes(photo(20))
    (root / "3.jpg").write_bytes(photo(40, 40))
    (root / "4.jpg").write_bytes(photo(25, camera="another"))
    return root


def run(*arguments: str | Path, picture: bool = False) -> Result:
    options = [] if picture else ["--no-picture"]
    return CliRunner().invoke(build_app(["locate"]), ["locate", *map(str, arguments), *options])


def proposals(*arguments: str | Path, picture: bool = False) -> dict[str, dict[str, Any]]:
    result = run(*arguments, "--json", picture=picture)
    assert result.exit_code == 0, result.output
    return {each["filename"]: each for each in json.loads(result.stdout)["proposals"]}


def contents(root: Path) -> dict[str, bytes]:
    files = [path for path in root.rglob("*") if path.is_file()]
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


def write_gpx(path: Path, points: Sequence[tuple[float, float]]) -> Path:
    """A track of (seconds, metres to the north)."""
    rows = "".join(
        f'<trkpt lat="{LATITUDE + north * DEGREES_PER_M}" lon="{LONGITUDE}">'
        f"<time>{NOON + timedelta(seconds=seconds):%Y-%m-%dT%H:%M:%SZ}</time></trkpt>"
        for seconds, north in points
    )
    namespace = "http://www.topografix.com/GPX/1/1"
    path.write_text(f'<gpx xmlns="{namespace}"><trk><trkseg>{rows}</trkseg></trk></gpx>')
    return path


def test_cameras_that_travelled_together_are_neighbours_of_each_other(folder: Path) -> None:
    assert proposals(folder, "--together")["4.jpg"]["accepted"]
    (folder / "5.jpg").write_bytes(photo(30, offset=None, camera="third"))
    refusal = run(folder, "--together")
    assert refusal.exit_code == 1
    assert "unknown_time_zone" in refusal.stderr
    assert "5.jpg" in refusal.stderr
    found = proposals(folder, "--together", "--time-zone", "Europe/Paris")
    assert found["5.jpg"]["captured_at"] == "2026-05-01T12:00:30+00:00"


def test_times_of_one_camera_are_compared_without_a_zone_but_not_with_a_track(
    tmp_path: Path,
) -> None:
    root = tmp_path / "trip"
    root.mkdir()
    for name, seconds, north in (("1.jpg", 0.0, 0.0), ("2.jpg", 5.0, None)):
        (root / name).write_bytes(photo(seconds, north, offset=None))
    assert proposals(root)["2.jpg"]["accepted"]
    track = write_gpx(tmp_path / "track.gpx", [(0, 0), (60, 60)])
    refusal = run(root, "--gpx", track)
    assert (refusal.exit_code, "unknown_time_zone" in refusal.stderr) == (1, True)
    assert "--time-zone" in refusal.stderr
    found = proposals(root, "--gpx", track, "--time-zone", "+02:00")
    assert "GPX track" in found["2.jpg"]["position"]["reason"]
    assert "bad_time_zone" in run(root, "--time-zone", "Mars").stderr


def test_a_clock_that_was_ahead_is_put_right(folder: Path, tmp_path: Path) -> None:
    track = write_gpx(tmp_path / "track.gpx", [(-3600 + s, s) for s in range(0, 100, 10)])
    assert proposals(folder, "--gpx", track)["4.jpg"]["position"] is None
    found = proposals(folder, "--gpx", track, "--clock-offset", "3600")["4.jpg"]
    expected = pytest.approx(LATITUDE + 25 * DEGREES_PER_M, abs=2e-5)
    assert found["position"]["latitude"] == expected


def test_tracks_without_times_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "track.gpx"
    early = '<gpx><trkpt lat="1" lon="1"><time>0001-01-01T00:00:00+02:00</time></trkpt></gpx>'
    no_longitude = '<gpx><trkpt lat="1"><time>2026-05-01</time></trkpt></gpx>'
    for text in ("no XML", "<gpx/>", no_longitude, early):
        path.write_text(text)
        with pytest.raises(InvalidRequest) as refusal:
            read_gpx(path)
        assert refusal.value.code == "bad_gpx"


def test_a_photo_whose_gps_tag_is_not_understood_is_named_and_never_written(folder: Path) -> None:
    unread = folder / "day 1" / "2.jpg"
    with pyexiv2.Image(str(unread)) as image:
        image.modify_exif({"Exif.GPSInfo.GPSLatitude": "45/1 4/1 12/1"})
    (folder / "4.jpg.xmp").write_bytes(b"no XML")
    before = contents(folder)
    result = run(folder, "--together", "--write")
    assert "day 1/2.jpg: its latitude has no letter N or S" in result.stderr
    assert "4.jpg: its XMP is damaged" in result.stderr
    assert before.items() <= contents(folder).items()
    as_json = json.loads(run(folder, "--json").stdout)
    assert (as_json["with_coordinates"], as_json["proposals"]) == (2, [])
    assert [each["filename"] for each in as_json["not_understood"]] == ["4.jpg", "day 1/2.jpg"]


def test_null_island_is_no_neighbour(folder: Path) -> None:
    for name, seconds in (("1.jpg", 0), ("3.jpg", 40)):
        zeroed = photo(seconds, -LATITUDE / DEGREES_PER_M)
        (folder / name).write_bytes(zeroed)
        with pyexiv2.Image(str(folder / name)) as image:
            image.modify_exif({"Exif.GPSInfo.GPSLongitude": "0/1 0/1 0/1"})
    found = proposals(folder)
    assert found.keys() == {"1.jpg", "day 1/2.jpg", "3.jpg", "4.jpg"}
    assert {each["position"] for each in found.values()} == {None}


def test_a_clock_without_a_zone_is_named_with_the_way_to_give_it(folder: Path) -> None:
    (folder / "5.jpg").write_bytes(photo(30, offset=None, camera="third"))
    assert "Pass it: --time-zone +02:00" in run(folder).stderr


def test_proposals_are_listed_and_nothing_is_written_unless_it_is_requested(folder: Path) -> None:
    before = contents(folder)
    result = run(folder)
    assert result.exit_code == 0
    assert "Nothing is written" in result.stderr
    assert contents(folder) == before
    rows = [line.split("\t") for line in result.stdout.splitlines()]
    assert rows[0] == ["photo", "latitude", "longitude", "within", "prob.", "reason"]
    assert rows[1][0] == "4.jpg"
    assert rows[1][5] == "nothing is known about its place"
    assert rows[2][3:] == ["100 m", rows[2][4], "taken 20 s after 1.jpg"]


def test_a_sidecar_keeps_its_owner_group_mode_and_attributes(folder: Path) -> None:
    path = folder / "day 1" / "2.jpg.xmp"
    path.write_bytes(SIDECAR)
    if os.geteuid() == 0:
        os.chown(path, 10001, 10002)
    else:
        os.chown(path, -1, os.getgroups()[-1])
    path.chmod(0o640)
    with contextlib.suppress(OSError):  # a file system without extended attributes
        os.setxattr(path, "user.note", b"kept")

    def attributes() -> object:
        status = path.stat()
        names = os.listxattr(path)
        return status.st_uid, status.st_gid, status.st_mode, [os.getxattr(path, n) for n in names]

    before, content = attributes(), path.read_bytes()
    assert run(folder, "--write").exit_code == 0
    assert path.read_bytes() != content
    assert attributes() == before
    assert run(folder, "--undo").exit_code == 0
    assert (path.read_bytes(), attributes()) == (content, before)


def test_a_sidecar_whose_owner_would_change_is_left_as_it_is(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "day 1" / "2.jpg.xmp").write_bytes(SIDECAR)
    before = contents(folder)
    mine = Path.stat

    def of_another_user(path: Path, **options: Any) -> os.stat_result:
        status = mine(path, **options)
        return os.stat_result([*status[:4], status.st_uid + (path.suffix == ".xmp"), *status[5:]])

    monkeypatch.setattr(Path, "stat", of_another_user)
    monkeypatch.setattr("os.chown", Mock(side_effect=PermissionError))
    result = run(folder, "--write")
    assert result.exit_code == 1
    assert "belongs to user" in result.stderr
    assert contents(folder) == before


def test_a_name_that_is_too_long_for_a_sidecar_stops_only_its_own_photo(folder: Path) -> None:
    (folder / f"{'x' * 249}.jpg").write_bytes(photo(30))
    result = run(folder, "--write")
    assert result.exit_code == 1
    assert "xxx.jpg.xmp: File name too long" in result.stderr
    assert (folder / "day 1" / "2.jpg.xmp").exists()


def test_what_is_no_regular_file_is_never_opened(folder: Path) -> None:
    os.mkfifo(folder / "day 1" / "2.jpg.xmp")
    os.mkfifo(folder / "5.jpg")
    result = run(folder, "--write")  # it would wait for ever
    assert result.exit_code == 1
    assert "2.jpg.xmp is not a regular file" in result.stderr
    assert "5.jpg" not in result.stdout
    assert run(folder, "--undo").exit_code == 1  # nothing was written


def test_control_characters_of_names_do_not_reach_the_terminal(folder: Path) -> None:
    name = "\x1b]0;title\x9b31m\nfake\trow.jpg"
    (folder / name).write_bytes(photo(30))
    os.mkfifo(folder / f"{name}.xmp")
    result = run(folder, "--write")
    shown = "\ufffd]0;title\ufffd31m"
    assert not set("\x1b\x9b") & set(result.output)
    (row,) = [line for line in result.stdout.splitlines() if "title" in line]
    assert row.startswith(f"{shown} fake row.jpg\t")
    assert f"skipped {shown}\ufffdfake\ufffdrow.jpg:" in result.stderr
    as_json = run(folder, "--json")
    assert not set("\x1b\x9b") & set(as_json.output)
    assert name in {each["filename"] for each in json.loads(as_json.stdout)["proposals"]}


def answer(**changes: Any) -> dict[str, Any]:
    similar = {**PHOTO, "latitude": LATITUDE, "longitude": LONGITUDE, "similarity_score": 0.9}
    levels = [
        {"latitude": LATITUDE, "longitude": LONGITUDE, "radius_m": radius, "probability": 0.97}
        for radius in (25.0, 100.0)
    ]
    return {**SIMILAR, "similar_images": [similar], "estimate": estimate(0.01, levels), **changes}


def estimate(
    not_in_map: float | None, levels: list[dict[str, Any]], **fields: Any
) -> dict[str, Any]:
    stated = {"levels": levels, "not_in_map_probability": not_in_map, "has_place": True}
    return {"headline": "", "reason": "", **stated, **fields}


def will_find(server: FakeServer, *answers: dict[str, Any]) -> None:
    """Answer the searches of one command."""
    for each in ({**STATS, "searchable_images": 10}, *answers):
        server.will_answer(200, each)


def searched(server: FakeServer, *arguments: str | Path) -> Result:
    return run(*arguments, "--server", server.url, picture=True)


def searched_proposals(server: FakeServer, *arguments: str | Path) -> dict[str, dict[str, Any]]:
    return proposals(*arguments, "--server", server.url, picture=True)


def test_a_photo_of_the_map_without_coordinates_does_not_hide_the_others(
    folder: Path, server: FakeServer
) -> None:
    (folder / "day 1" / "2.jpg").unlink()
    unlocated = {**PHOTO, "latitude": None, "longitude": None, "place": None}
    first = answer(similar_images=[{**unlocated, "similarity_score": 1.0}], matches_without_place=1)
    will_find(server, first, answer())
    found = searched_proposals(server, folder)["4.jpg"]["position"]
    assert found["reason"] == "looks like Day 2/street.jpg"
    _, first_search, second_search = (path for _, path, _ in server.requests)
    assert "box" not in first_search
    assert parse_qs(urlsplit(second_search).query)["box"] == ["-90,-180,90,180"]


def test_a_photo_that_the_estimate_names_no_place_for_has_its_headline_instead_of_a_position(
    folder: Path, server: FakeServer
) -> None:
    (folder / "day 1" / "2.jpg").unlink()
    level = {"latitude": LATITUDE, "longitude": LONGITUDE, "radius_m": 25.0, "probability": 0.2}
    outside = estimate(0.8, [level], has_place=False, headline="Probably not in this map: 80 %")
    unlocated = estimate(None, [], has_place=False, headline="The photos have no coordinates.")
    for told in (outside, unlocated):
        will_find(server, answer(estimate=told))
        found = searched_proposals(server, folder)["4.jpg"]
        assert (found["position"], found["place"]) == (None, None)
        assert found["why_unknown"] == told["headline"]
    will_find(server, answer(estimate=estimate(None, [], elsewhere=0.33)))
    unmeasured = searched_proposals(server, folder)["4.jpg"]["position"]
    assert 0.3 < unmeasured["probability"] <= 0.67, "no surer than that it is of the map at all"


def test_what_a_preview_has_shown_is_written_although_the_map_answers_differently_since(
    folder: Path, server: FakeServer
) -> None:
    will_find(server, answer(), answer())
    shown = searched_proposals(server, folder)
    (folder / "new.jpg").write_bytes(photo(None))
    sure = [{"latitude": 44.0, "longitude": 7.0, "radius_m": 25.0, "probability": 1.0}]
    will_find(server, answer(estimate=estimate(0.0, sure)))
    written = searched(server, folder, "--write")
    assert written.exit_code == 0, written.output
    assert "1 proposals are not as they were accepted then" in written.stderr
    assert written.stderr.rstrip().endswith(": new.jpg")
    again = run(folder, "--write", "--server", server.url, picture=True)
    assert "All proposals are as they were then" in again.stderr, "those that are left"
    written_now = read_folder(folder, None, 0.0)
    latitudes = {
        each.name: each.latitude for each in written_now if (folder / f"{each.id}.xmp").exists()
    }
    for name, each in shown.items():
        assert latitudes.pop(name) == pytest.approx(each["position"]["latitude"], abs=1e-6)
    assert latitudes == {"new.jpg": pytest.approx(44.0)}


def test_no_photo_of_a_preview_is_searched_again_unless_it_has_changed_or_a_day_has_passed(
    folder: Path, server: FakeServer
) -> None:
    will_find(server, answer(), answer())
    shown = searched(server, folder)
    requests = len(server.requests)
    written = searched(server, folder, "--write")
    assert written.exit_code == 0, written.output
    assert len(server.requests) == requests
    assert written.stdout == shown.stdout
    assert "All proposals are as they were then." in written.stderr
    assert run(folder, "--undo").exit_code == 0
    (folder / "4.jpg").write_bytes(photo(26, camera="another"))
    will_find(server, answer(estimate=estimate(None, [])))
    written = searched(server, folder, "--write")
    assert written.stderr.rstrip().endswith(": 4.jpg")
    assert run(folder, "--undo").exit_code == 0
    old = datetime.now(UTC) - preview.KEPT_FOR
    for file in (Path(os.environ["PLACEWISE_HOME"]) / "locate").iterdir():
        kept = preview.PREVIEW.validate_json(file.read_bytes())
        file.write_bytes(preview.PREVIEW.dump_json(replace(kept, searched_at=old)))
    will_find(server, answer(), answer())
    assert "The searches are those of" not in searched(server, folder, "--write").stderr


def test_a_map_with_labels_only_gives_places(folder: Path, server: FakeServer) -> None:
    levels: list[dict[str, Any]] = [
        {"place": "tower/floor 7", "probability": 0.96}, {"place": "tower", "probability": 1},
    ]  # fmt: skip
    unlocated = {**PHOTO, "latitude": None, "place": "tower/floor 7", "similarity_score": 0.9}
    by_label = answer(similar_images=[unlocated], estimate=estimate(0.0, levels))
    will_find(server, by_label, by_label)
    found = searched_proposals(server, folder)["4.jpg"]
    assert (found["place"], found["accepted"], found["position"]) == ("tower/floor 7", True, None)
    result = searched(server, folder, "--write")
    assert (result.exit_code, "which --json prints" in result.stderr) == (1, True)


def test_heading_and_position_of_a_pose_are_written(folder: Path, server: FakeServer) -> None:
    north = 30 * DEGREES_PER_M
    posed = answer(pose={**POSE, "latitude": LATITUDE + north, "longitude": LONGITUDE})
    will_find(server, posed, posed)
    found = searched_proposals(server, folder)["day 1/2.jpg"]["position"]
    assert all("pose=true" in path for _, path, _ in server.requests if "similarity" in path)
    assert (found["heading"], "pose to 0.4 m" in found["reason"]) == (POSE["heading"], True)
    assert found["latitude"] == pytest.approx(LATITUDE + north, abs=0.1 * DEGREES_PER_M)
    assert found["radius_68_m"] < 1
    assert searched(server, folder, "--write").exit_code == 0
    sidecar = (folder / "day 1" / "2.jpg.xmp").read_text()
    assert 'GPSImgDirection="33804/100"' in sidecar


def test_a_sidecar_that_is_changed_while_it_is_written_keeps_the_change(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sidecar = folder / "day 1" / "2.jpg.xmp"

    def add_slowly(*arguments: Any) -> bytes:
        sidecar.write_bytes(SIDECAR)
        return add_position(*arguments)

    monkeypatch.setattr(locate_folder, "add_position", add_slowly)
    result = run(folder, "--write")
    assert (result.exit_code, "changed the file meanwhile" in result.stderr) == (1, True)
    assert sidecar.read_bytes() == SIDECAR
