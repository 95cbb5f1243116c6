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

from services.cli.recovery.journal_rows import LatestStates
from shared.catalog.api_keys import create_api_key, record_key_use, revoke_api_key
from shared.catalog.database.session import Catalog
from shared.catalog.installation import check_not_behind
from shared.catalog.jobs import JobKind, JobState
from shared.catalog.photos import Photo
from shared.catalog.webhooks import EventKind, create_webhook, delete_webhook
from shared.errors import Misconfigured, Unavailable
from shared.ids import new_id
from shared.journal.outbox import write_journal, write_snapshot
from shared.journal.segments import TABLES, Line, last_states, read_lines
from shared.security.api_keys import Scope
from shared.storage import FolderStore, ObjectStore
from shared.storage.s3 import S3Store
from shared.storage.segments import list_segments
from tests.support.catalog_rows import add_job, add_map, add_photo
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
    """The last state of each row that the store's segments hold."""
    segments = [one for one in list_segments(store) if not one.is_snapshot]
    lines = [line for one in segments for line in read_lines(store, one.key)]
    return {line.id: line for line in last_states(lines) if line.id is not None}


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
    assert write_journal(catalog, store) == 2
    row = journaled(store)[photo_id].row
    assert (row["tags"], row["place"], row["latitude"]) == (
        ["night", "rain"],
        "Żółw 🐢",
        45.123456789,
    )
    assert row["deleted_at"] is None
    assert write_journal(catalog, store) == 0, "nothing has changed"

    with catalog.write() as session:  # through the ORM, as a PATCH does
        session.get_one(Photo, photo_id).place = "hall"
    assert write_journal(catalog, store) == 1
    assert journaled(store)[photo_id].row["place"] == "hall"

    delete_photo(catalog, map_id, photo_id)  # by an UPDATE
    write_journal(catalog, store)
    assert journaled(store)[photo_id].row["deleted_at"] is not None
    assert [segment.last for segment in list_segments(store)] == [1, 2, 3]
    check_not_behind(catalog, store)


def test_keys_and_webhooks_are_in_the_journal_and_so_is_their_end(
    catalog: Catalog, store: ObjectStore
) -> None:
    with catalog.write() as session:
        key, _ = create_api_key(session, "theirs", {Scope.READ})
        webhook = create_webhook(session, "https://example.com/hook", [EventKind.JOB_FAILED])
    assert write_journal(catalog, store) == 2
    with catalog.write() as session:
        record_key_use(session, key.id)
    assert write_journal(catalog, store) == 0, "its use is no change"
    with catalog.write() as session:
        revoke_api_key(session, key.id)
        delete_webhook(session, webhook.id)
    assert write_journal(catalog, store) == 2
    rows = {id_: line.row for id_, line in journaled(store).items()}
    assert rows[key.id]["revoked_at"] is not None
    assert rows[webhook.id]["deleted_at"] is not None
    assert rows[webhook.id]["secret"] == ""


class DyingStore:
    """Dies at the end of a write, after what it was to write was written."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store

    def __getattr__(self, name: str) -> Any:
        return getattr(self._store, name)

    def writer(self, key: str) -> Any:
        raise KeyboardInterrupt


def test_a_writer_that_dies_before_or_after_its_segment_is_written_loses_nothing(
    catalog: Catalog, store: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, photo_id = filled(catalog)
    dying: Any = DyingStore(store)
    with pytest.raises(KeyboardInterrupt):
        write_journal(catalog, dying)
    assert list_segments(store) == []
    check_not_behind(catalog, store)

    def die(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(catalog, "run", die)  # the marks are not cleared
        with pytest.raises(KeyboardInterrupt):
            write_journal(catalog, store)
    check_not_behind(catalog, store)
    with catalog.write() as session:
        session.get_one(Photo, photo_id).place = "later"
    assert write_journal(catalog, store) == 2
    assert [segment.last for segment in list_segments(store)] == [2, 3]
    assert journaled(store)[photo_id].row["place"] == "later"
    assert write_journal(catalog, store) == 0


class InterruptedStore:
    """Calls `meanwhile` once, before a segment is written whose lines were read already."""

    def __init__(self, store: ObjectStore, meanwhile: Callable[[], object]) -> None:
        self._store, self._meanwhile = store, [meanwhile]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._store, name)

    def writer(self, key: str) -> Any:
        while self._meanwhile:
            self._meanwhile.pop()()
        return self._store.writer(key)


@pytest.mark.parametrize("by_another_steward", [False, True])
def test_what_changes_while_a_segment_is_written_is_written_by_the_next_one(
    catalog: Catalog, store: ObjectStore, by_another_steward: bool
) -> None:
    _, photo_id = filled(catalog)

    def change() -> None:
        with catalog.write() as session:
            session.get_one(Photo, photo_id).place = "newer"
        if by_another_steward:
            assert write_journal(catalog, store) == 2

    interrupted: Any = InterruptedStore(store, change)
    assert write_journal(catalog, interrupted) == 2
    assert write_journal(catalog, store) == (0 if by_another_steward else 1)
    assert journaled(store)[photo_id].row["place"] == "newer"


def test_segments_are_merged_with_the_latest_states(catalog: Catalog, store: ObjectStore) -> None:
    _, photo_id = filled(catalog)
    write_snapshot(catalog, store, max_age_seconds=0)  # is not merged
    for number in range(9):
        with catalog.write() as session:
            session.get_one(Photo, photo_id).place = f"place {number}"
        write_journal(catalog, store, min_segments_to_merge=4)
        assert len(list_segments(store)) <= 6
    snapshot, merged, *_ = list_segments(store)
    assert snapshot.is_snapshot
    assert (merged.first, merged.last) == (2, 8)
    assert journaled(store)[photo_id].row["place"] == "place 8"
    assert len(journaled(store)) == 2
    check_not_behind(catalog, store)


def test_a_snapshot_has_what_the_journal_lacks_and_replaces_the_one_before(
    catalog: Catalog, store: ObjectStore
) -> None:
    map_id, photo_id = filled(catalog)
    write_journal(catalog, store)
    with catalog.write() as session:
        session.get_one(Photo, photo_id).place = "pending"
        jobs = {
            state: add_job(session, map_id, photo_id=photo_id, state=state).id
            for state in (JobState.QUEUED, JobState.FAILED, JobState.SUCCEEDED)
        }
        add_job(session, map_id, JobKind.DESCRIBE)
        evaluation = add_job(session, map_id, JobKind.EVALUATE, state=JobState.SUCCEEDED).id
    for _ in range(2):
        write_snapshot(catalog, store, max_age_seconds=0)
    segment, snapshot = list_segments(store)
    write_snapshot(catalog, store)
    assert list_segments(store) == [segment, snapshot], "it is young enough"
    assert (segment.is_snapshot, snapshot.is_snapshot) == (False, True)
    lines = list(read_lines(store, snapshot.key))
    assert [line.id for line in lines if line.table in TABLES] == [photo_id]
    expected = {jobs[JobState.QUEUED], jobs[JobState.FAILED], evaluation}
    assert {UUID(line.row["id"]) for line in lines if line.table == "jobs"} == expected


def test_a_catalog_that_is_older_than_its_store_writes_nothing_and_no_process_starts_with_it(
    catalog: Catalog, newer: Catalog, store: ObjectStore
) -> None:
    filled(newer)
    write_journal(newer, store)
    check_not_behind(newer, store)
    filled(catalog)
    for refused in (check_not_behind, write_journal, write_snapshot):
        with pytest.raises(Misconfigured) as caught:
            refused(catalog, store)
        assert caught.value.code == "catalog_behind"
        assert f"{list_segments(store)[0].modified_at:%H:%M:%S} UTC" in caught.value.detail
        assert "storage rebuild" in caught.value.detail
    assert len(list_segments(store)) == 1


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
        list(read_lines(store, segment.key))
    assert caught.value.code == "journal_damaged"
    assert f"{segment.key} can't be read (line {number + 2}: " in caught.value.detail
    with LatestStates() as states:
        states.read(store, lambda *_: None)
        (damaged,) = states.damaged
    assert damaged.startswith(f"{segment.key} (line {number + 2}: ")


@pytest.mark.parametrize("store", ["folder"], indirect=True)
def test_a_damaged_segment_says_which_and_stays_when_others_are_merged(
    catalog: Catalog, store: ObjectStore
) -> None:
    filled(catalog)
    write_journal(catalog, store)
    (segment,) = list_segments(store)
    data = store.get(segment.key)
    for damaged in (data[:-9], b"", data[:40] + b"xx" + data[42:], b"no gzip"):
        store.put(segment.key, damaged)
        with pytest.raises(Unavailable) as caught:
            list(read_lines(store, segment.key))
        assert caught.value.code == "journal_damaged"
        assert segment.key in caught.value.detail
    for _ in range(3):
        with catalog.write() as session:
            add_map(session, str(new_id()))
        write_journal(catalog, store, min_segments_to_merge=3)
    assert [(s.first, s.last) for s in list_segments(store)] == [(1, 1), (2, 3), (4, 4)]
