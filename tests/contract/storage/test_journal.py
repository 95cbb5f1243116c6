"""The journal on both databases, in a folder and in a bucket."""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import delete, select, update

from shared.catalog.database.session import Catalog
from shared.catalog.installation import Installation
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.errors import Unavailable
from shared.ids import new_id
from shared.journal import outbox, segments
from shared.journal.outbox import catalog_lag, write_journal
from shared.journal.segments import Line, last_states, list_segments, read_segment
from shared.rebuild.rows import LatestStates
from shared.storage import FolderStore, ObjectStore
from shared.storage.s3 import S3Store
from tests.support.catalog_rows import add_map, add_photo
from tests.support.catalog_rows import delete as delete_photo
from tests.support.servers import S3Server


@pytest.fixture
def store(catalog_kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> ObjectStore:
    """A folder beside SQLite and a bucket beside PostgreSQL, unless the test names one."""
    beside = "folder" if catalog_kind == "sqlite" else "s3"
    if getattr(request, "param", beside) == "folder":
        return FolderStore(tmp_path / "objects")
    server: S3Server = request.getfixturevalue("s3")
    return S3Store(server.new_bucket())


@pytest.fixture
def newer(migrated_sqlite: Path, tmp_path: Path) -> Iterator[Catalog]:
    """Another catalog, which has written more into the same store."""
    opened = Catalog(f"sqlite:///{shutil.copy(migrated_sqlite, tmp_path / 'newer.sqlite')}")
    yield opened
    opened.close()


def journaled(store: ObjectStore) -> dict[UUID, Line]:
    """The last state of each row that the store's journal holds."""
    lines = [line for one in list_segments(store) for line in read_segment(store, one.key).lines]
    return {line.id: line for line in last_states(lines)}


def sequence(catalog: Catalog) -> int:
    with catalog.read() as session:
        return session.scalar(select(Installation.journal_sequence)) or 0


def filled(catalog: Catalog) -> tuple[UUID, UUID]:
    """A map with a photo; their ids."""
    with catalog.write() as session:
        map_id = add_map(session).id
        photo = add_photo(session, map_id)
        photo.tags, photo.place = ["night", "rain"], "Żółw 🐢"
        photo.latitude, photo.longitude = 45.123456789, 7.7
        return map_id, photo.id


def test_every_change_of_a_photo_and_a_map_is_in_the_journal(
    catalog: Catalog, store: ObjectStore
) -> None:
    map_id, photo_id = filled(catalog)
    assert write_journal(catalog, store).lines == 2
    row = journaled(store)[photo_id].row
    assert (row["tags"], row["place"], row["latitude"]) == (
        ["night", "rain"],
        "Żółw 🐢",
        45.123456789,
    )
    assert row["deleted_at"] is None
    assert write_journal(catalog, store).lines == 0, "nothing has changed"

    with catalog.write() as session:  # through the ORM, as a PATCH does
        session.get_one(Photo, photo_id).place = "hall"
    assert write_journal(catalog, store).lines == 1
    assert journaled(store)[photo_id].row["place"] == "hall"

    delete_photo(catalog, map_id, photo_id)  # by an UPDATE
    write_journal(catalog, store)
    assert journaled(store)[photo_id].row["deleted_at"] is not None
    assert sequence(catalog) == len(list_segments(store)) == 3
    assert catalog_lag(catalog, store) is None


def test_rows_of_before_the_journal_are_pending(catalog: Catalog, store: ObjectStore) -> None:
    _, photo_id = filled(catalog)
    with catalog.write() as session:  # as the migration leaves them
        session.execute(update(Photo).values(revision=1, journaled_revision=0))
    write_journal(catalog, store)
    assert photo_id in journaled(store)


def test_a_writer_that_dies_before_its_commit_is_no_lag_and_nothing_is_lost(
    catalog: Catalog, store: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, photo_id = filled(catalog)

    def die(*_: Any, **__: Any) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(outbox, "_commit", die)
        with pytest.raises(KeyboardInterrupt):
            write_journal(catalog, store)
    assert len(list_segments(store)) == 1
    assert sequence(catalog) == 0
    assert catalog_lag(catalog, store) is None
    with catalog.write() as session:
        session.get_one(Photo, photo_id).place = "later"
    assert catalog_lag(catalog, store) is None, "its rows are known, in a newer state"
    assert write_journal(catalog, store).lines == 2
    assert sequence(catalog) == 2, "the number of the segment that was left is not used again"
    assert journaled(store)[photo_id].row["place"] == "later"


def test_what_changes_while_it_is_written_is_written_again(
    catalog: Catalog, store: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, photo_id = filled(catalog)
    real = segments.put_segment

    def change_meanwhile(*arguments: Any) -> str:
        monkeypatch.setattr(outbox, "put_segment", real)
        with catalog.write() as session:
            session.get_one(Photo, photo_id).place = "meanwhile"
        return real(*arguments)

    monkeypatch.setattr(outbox, "put_segment", change_meanwhile)
    write_journal(catalog, store)
    assert journaled(store)[photo_id].row["place"] == "Żółw 🐢"
    assert write_journal(catalog, store).lines == 1
    assert journaled(store)[photo_id].row["place"] == "meanwhile"


def test_two_stewards_at_once_lose_no_state(
    catalog: Catalog, store: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The slower one has read an older state of the photo, and writes it last."""
    _, photo_id = filled(catalog)
    real = segments.put_segment

    def overtaken(*arguments: Any) -> str:
        monkeypatch.setattr(outbox, "put_segment", real)
        with catalog.write() as session:
            session.get_one(Photo, photo_id).place = "newer"
        assert write_journal(catalog, store).lines == 2
        return real(*arguments)

    monkeypatch.setattr(outbox, "put_segment", overtaken)
    assert write_journal(catalog, store).lines == 0
    assert journaled(store)[photo_id].row["place"] == "newer"
    assert len(list_segments(store)) == sequence(catalog) == 1
    assert write_journal(catalog, store).lines == 0


def test_many_segments_become_one_with_the_last_states(
    catalog: Catalog, store: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (outbox, segments):
        monkeypatch.setattr(module, "MIN_SEGMENTS_TO_MERGE", 4)
    _, photo_id = filled(catalog)
    for number in range(9):
        with catalog.write() as session:
            session.get_one(Photo, photo_id).place = f"place {number}"
        write_journal(catalog, store)
        assert len(list_segments(store)) < 4
    merged = list_segments(store)[0]
    assert (merged.first, merged.last) == (1, 7)
    assert journaled(store)[photo_id].row["place"] == "place 8"
    assert len(journaled(store)) == 2
    assert catalog_lag(catalog, store) is None


def test_an_older_catalog_is_behind_and_writes_nothing(
    catalog: Catalog, newer: Catalog, store: ObjectStore
) -> None:
    filled(newer)
    write_journal(newer, store)
    assert catalog_lag(newer, store) is None
    _, photo_id = filled(catalog)
    lag = catalog_lag(catalog, store)
    assert lag is not None
    assert (lag.segments, lag.since) == (1, list_segments(store)[0].modified_at)
    assert "verify --repair" in lag.detail
    written = write_journal(catalog, store)
    assert (written.lines, written.lag) == (0, lag)
    assert len(list_segments(store)) == 1
    assert photo_id not in journaled(store)


BACK: dict[str, Callable[[UUID], Any]] = {
    "photo not there yet": lambda id_: delete(Photo).where(Photo.id == id_),
    "older state": lambda id_: (
        update(Photo).where(Photo.id == id_).values(revision=1, journaled_revision=1)
    ),
    "another state of the same revision": lambda id_: (
        update(Photo).where(Photo.id == id_).values(place="never written", revision=Photo.revision)
    ),
    "map not there yet": lambda id_: update(Map).values(revision=0, journaled_revision=0),
}


@pytest.mark.parametrize("store", ["folder"], indirect=True)
@pytest.mark.parametrize("back", BACK.values(), ids=BACK.keys())
def test_a_restored_state_of_before_is_behind(
    catalog: Catalog, store: ObjectStore, back: Callable[[UUID], Any]
) -> None:
    _, photo_id = filled(catalog)
    with catalog.write() as session:
        session.get_one(Photo, photo_id).place = "second state"
    write_journal(catalog, store)
    with catalog.write() as session:
        session.execute(update(Installation).values(journal_sequence=0))
    assert catalog_lag(catalog, store) is None
    with catalog.write() as session:
        session.execute(back(photo_id))
    assert catalog_lag(catalog, store) is not None


MALFORMED: dict[str, Any] = {
    "no JSON": b'{"table": ',
    "no object": b"[1, 2]",
    "no text": b"\xff\xfe",
    "deep": b"[" * 100_000,
    "id": {"id": 5},
    "revision": {"revision": "seven"},
    "large revision": {"revision": 2**70},
    "row": {"row": [1]},
    "missing column": {"row": {"sha256": "0" * 64}},
    "text as a number": {"latitude": "north"},
    "number as a text": {"filename": 7},
    "number as a time": {"uploaded_at": 5},
    "time without a zone": {"uploaded_at": "2026-05-01T12:00:00"},
    "too large": {"width": 2**40},
    "null": {"object_key": None},
    "half a character": {"filename": "\ud800"},
    "NUL": {"filename": "a\0b"},
}


@pytest.mark.databases("sqlite")  # lines are checked before a database sees them
@pytest.mark.parametrize("store", ["folder"], indirect=True)
@pytest.mark.parametrize("malformed", MALFORMED.values(), ids=MALFORMED.keys())
def test_a_malformed_line_is_named_and_its_segment_is_left_out_of_a_rebuild(
    catalog: Catalog, store: ObjectStore, malformed: bytes | dict[str, Any]
) -> None:
    _, photo_id = filled(catalog)
    write_journal(catalog, store)
    (segment,) = list_segments(store)
    head, *lines = gzip.decompress(store.get(segment.key)).splitlines()
    number = next(n for n, line in enumerate(lines) if str(photo_id) in json.loads(line)["id"])
    if isinstance(malformed, dict):
        line = json.loads(lines[number])
        of_line = malformed.keys() & {"id", "revision", "row"}
        (line if of_line else line["row"]).update(malformed)
        malformed = json.dumps(line).encode()
    lines[number] = malformed
    store.put(segment.key, gzip.compress(b"\n".join([head, *lines])))
    with pytest.raises(Unavailable) as caught:
        read_segment(store, segment.key)
    assert caught.value.code == "journal_damaged"
    assert f"{segment.key} can't be read (line {number + 2}: " in caught.value.detail
    with LatestStates() as states:
        states.read(store, lambda *_: None)
        (damaged,) = states.damaged
    assert damaged.startswith(f"{segment.key} (line {number + 2}: ")


@pytest.mark.parametrize("store", ["folder"], indirect=True)
def test_a_damaged_segment_says_which_and_stays_when_others_are_merged(
    catalog: Catalog, store: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    filled(catalog)
    write_journal(catalog, store)
    (segment,) = list_segments(store)
    data = store.get(segment.key)
    for damaged in (data[:-9], b"", data[:40] + b"xx" + data[42:], b"no gzip"):
        store.put(segment.key, damaged)
        with pytest.raises(Unavailable) as caught:
            read_segment(store, segment.key)
        assert caught.value.code == "journal_damaged"
        assert segment.key in caught.value.detail
    for module in (outbox, segments):
        monkeypatch.setattr(module, "MIN_SEGMENTS_TO_MERGE", 3)
    for _ in range(2):
        with catalog.write() as session:
            add_map(session, str(new_id()))
        write_journal(catalog, store)
    assert [(s.first, s.last) for s in list_segments(store)] == [(1, 1), (2, 3)]
