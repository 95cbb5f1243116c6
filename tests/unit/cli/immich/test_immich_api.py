"""Calls of Immich's API: pages, errors, rate limits, and what is left out of a library."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from filelock import FileLock

from placewise.protocol import RetryPolicy
from services.cli.immich import api
from services.cli.immich.api import ImmichApi
from services.cli.immich.library import ImmichLibrary
from services.cli.locate.library import LocatedPhoto
from shared.errors import (
    Conflict,
    Forbidden,
    InvalidRequest,
    NotFound,
    PlacewiseError,
    TooManyRequests,
    Unauthorized,
    Unavailable,
    Unprocessable,
)
from shared.geotagging.fusion import Proposal
from tests.support.immich_server import KEY, NOON, PARTNER, ImmichServer, refused
from tests.support.photos import photo_bytes

HERE = (45.0691, 7.6853)


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds that calls would have waited; threads of other tests sleep as ever."""
    slept: list[float] = []
    monkeypatch.setattr(api, "time", SimpleNamespace(sleep=slept.append, monotonic=time.monotonic))
    return slept


@pytest.fixture
def client(immich: ImmichServer) -> Iterator[ImmichApi]:
    made = ImmichApi(immich.url, KEY)
    yield made
    made.close()


def library(immich: ImmichServer, folder: Path, **clocks: Any) -> ImmichLibrary:
    return ImmichLibrary(ImmichApi(f"{immich.url}/api/", KEY), folder, **clocks)


def test_all_pages_are_listed_and_only_own_images(immich: ImmichServer, tmp_path: Path) -> None:
    immich.page_size = 2
    names = [f"{number}.jpg" for number in range(5)]
    for number, name in enumerate(names):
        immich.add(name, photo_bytes(number), seconds=number)
    immich.add("clip.mp4", b"", type="VIDEO")
    immich.add("of a partner.jpg", b"", ownerId=PARTNER)
    immich.add("in the trash.jpg", b"", isTrashed=True)
    immich.add("locked.jpg", b"", visibility="locked")
    found = library(immich, tmp_path).list_photos()
    assert sorted(photo.name for photo in found) == names
    assert immich.calls["POST /api/search/metadata"] == 4


def test_names_begin_with_the_album_and_are_unique(immich: ImmichServer, tmp_path: Path) -> None:
    immich.add("a.jpg", photo_bytes(1), album="Sommer 2025")
    second = immich.add("b.jpg", photo_bytes(2), seconds=-1)
    first = immich.add("b.jpg", photo_bytes(3))
    names = {photo.id: photo.name for photo in library(immich, tmp_path).list_photos()}
    assert set(names.values()) == {"Sommer 2025/a.jpg", "b.jpg", f"{second}/b.jpg"}
    assert names[first] == "b.jpg"


def test_a_clock_without_a_time_zone_is_that_of_the_camera(
    immich: ImmichServer, tmp_path: Path
) -> None:
    zoned, unzoned, undated = (immich.add(f"{n}.jpg", photo_bytes(n)) for n in range(3))
    immich.assets[unzoned]["exifInfo"]["timeZone"] = None
    immich.assets[unzoned]["exifInfo"]["make"] = None
    immich.assets[undated]["exifInfo"] = {}
    photos = {photo.id: photo for photo in library(immich, tmp_path).list_photos()}
    assert (photos[zoned].time, photos[zoned].time_zone_is_known) == (NOON, True)
    assert photos[zoned].clock_offset == timedelta(hours=2)
    assert photos[unzoned].time == NOON + timedelta(hours=2)
    assert not photos[unzoned].time_zone_is_known
    assert (photos[unzoned].camera, photos[zoned].camera) == ("X100", "Maker X100")
    assert (photos[undated].time, photos[undated].camera) == (None, None)
    told = library(immich, tmp_path, time_zone="+02:00").list_photos()
    assert {photo.time for photo in told if photo.id == unzoned} == {NOON}


def test_an_edited_picture_has_another_state_and_coordinates_of_zero_are_none(
    immich: ImmichServer, tmp_path: Path
) -> None:
    asset = immich.add("1.jpg", photo_bytes(1), (0.0, 0.0))
    (before,) = library(immich, tmp_path).list_photos()
    assert before.is_unlocated
    immich.assets[asset].update(isEdited=True, thumbhash="2")
    (after,) = library(immich, tmp_path).list_photos()
    assert after.state != before.state


@pytest.mark.parametrize(
    ("answer", "kind", "code", "words"),
    [
        (refused(401, "Invalid API key"), Unauthorized, "immich_refused", "IMMICH_API_KEY"),
        (
            refused(403, "Missing required permission: asset.read"),
            Forbidden, "immich_refused", "asset.read. Add it to the API key",
        ),
        (refused(404, "Asset media not found"), NotFound, "immich_refused", "Asset media"),
        (refused(400, ["a", "b"]), InvalidRequest, "immich_refused", "a; b"),
        ((500, b"<html>", {}), PlacewiseError, "immich_refused", "500"),
        ((200, b"<html>", {}), Unprocessable, "immich_refused", "Is it the address of Immich?"),
    ],
)  # fmt: skip
def test_each_error_says_what_happened_and_what_to_do(
    immich: ImmichServer, client: ImmichApi, answer: Any, kind: type[PlacewiseError], code: str,
    words: str,
) -> None:  # fmt: skip
    immich.busy = [answer]
    with pytest.raises(kind) as error:
        client.user_id()
    assert (error.value.code, words in error.value.detail) == (code, True)


def test_a_wrong_key_or_address_is_named(immich: ImmichServer) -> None:
    with pytest.raises(Unauthorized):
        ImmichApi(immich.url, "wrong").user_id()
    with pytest.raises(InvalidRequest):
        ImmichApi("immich:2283", KEY)


def test_a_busy_server_is_called_again_when_it_says(
    immich: ImmichServer, client: ImmichApi, waits: list[float]
) -> None:
    immich.busy = [
        refused(429, "Too many requests", **{"Retry-After": "7"}),
        refused(503, "Starting"),
    ]
    assert client.version() == "3.2.2"
    assert (waits[0], len(waits)) == (7, 2)


def test_a_server_that_stays_away_is_given_up(
    immich: ImmichServer, client: ImmichApi, waits: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "_retries", RetryPolicy(0.0))
    for status, kind in ((502, Unavailable), (429, TooManyRequests)):
        immich.busy = [refused(status, "no")]
        with pytest.raises(kind):
            client.version()
    immich.shutdown()
    immich.server_close()
    with pytest.raises(Unavailable, match="does not answer"):
        client.version()
    assert waits == []


def test_writes_keep_a_distance(
    immich: ImmichServer, client: ImmichApi, waits: list[float]
) -> None:
    assets = [immich.add(f"{number}.jpg", photo_bytes(number)) for number in range(3)]
    client.set_coordinates(assets[:2], HERE)
    client.set_coordinates(assets[2:], HERE)
    assert 0 < waits[-1] <= api.WRITE_INTERVAL_SECONDS
    assert [immich.position(each) for each in assets] == [HERE] * 3


def test_photos_of_one_position_are_written_with_one_call_and_a_refusal_stops_nothing(
    immich: ImmichServer, tmp_path: Path, waits: list[float]
) -> None:
    for number in range(4):
        immich.add(f"{number}.jpg", photo_bytes(number), seconds=number)
    found = library(immich, tmp_path)
    photos = {photo.name: photo for photo in found.list_photos()}
    positions = {"0.jpg": HERE, "1.jpg": (30.0, 40.0), "2.jpg": (10.0, 20.0), "3.jpg": HERE}
    proposals = [
        LocatedPhoto(photos[name], Proposal(*at, 100, 0.99, 20, ""), None, None, None)
        for name, at in positions.items()
    ]

    def refuse_the_second(method: str, path: str) -> None:
        if method == "PUT" and immich.calls["PUT /api/assets"] == 2:
            immich.busy = [refused(400, "Not found or no asset.update access")]

    immich.before = refuse_the_second
    report = found.write(proposals)
    assert (len(report.written), len(report.skipped), len(immich.updates)) == (3, 1, 2)
    assert "no asset.update access" in next(iter(report.skipped.values()))
    assert max(len(update["ids"]) for update in immich.updates) == 2


def test_the_journal_holds_the_former_values_and_undo_cannot_take_coordinates_away(
    immich: ImmichServer, tmp_path: Path, waits: list[float]
) -> None:
    empty = immich.add("empty.jpg", photo_bytes(1))
    zero = immich.add("zero.jpg", photo_bytes(2), (0.0, 0.0))
    gone = immich.add("gone.jpg", photo_bytes(3))
    found = library(immich, tmp_path)
    found.write(
        [
            LocatedPhoto(photo, Proposal(*HERE, 100, 0.99, 20, ""), None, None, None)
            for photo in found.list_photos()
        ]
    )
    assert immich.position(empty) == immich.position(zero) == HERE
    immich.delete(gone)
    undone = found.undo()
    assert (undone.removed, undone.restored) == (["empty.jpg"], ["zero.jpg"])
    assert immich.position(empty) == immich.position(zero) == (0.0, 0.0)
    assert all(photo.is_unlocated for photo in found.list_photos())
    immich.move(empty, None, None)
    with pytest.raises(NotFound):
        found.undo()


def test_the_journal_survives_a_kill_is_refused_when_damaged_and_belongs_to_one_process(
    immich: ImmichServer, tmp_path: Path, waits: list[float]
) -> None:
    for number in (1, 2):
        immich.add(f"{number}.jpg", photo_bytes(number))
    found = library(immich, tmp_path)
    first, second = (
        LocatedPhoto(photo, Proposal(*HERE, 100, 0.99, 20, ""), None, None, None)
        for photo in found.list_photos()
    )
    found.write([first])
    (journal,) = tmp_path.rglob("*.jsonl")
    with journal.open("ab") as file:
        file.write(b'{"id": "a line of a killed proce')
    found.write([second])
    intact = journal.read_bytes()
    assert intact.count(b"\n") == 2
    journal.write_bytes(b"{}\n" + intact)
    with pytest.raises(Unprocessable) as damaged:
        found.undo()
    assert damaged.value.code == "journal_damaged"
    with FileLock(journal.with_suffix(".lock")), pytest.raises(Conflict) as locked:
        found.write([second])
    assert locked.value.code == "locate_in_progress"
    assert not any(photo.is_unlocated for photo in found.list_photos())
    journal.write_bytes(intact)
    assert sorted(found.undo().removed) == ["1.jpg", "2.jpg"]
