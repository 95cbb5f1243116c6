"""Backups of a Placewise that has work under way, restored into empty ones."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import select

from services.cli.recovery.backup import BackupFolder, BackupManifest, create_backup
from services.cli.recovery.restore import RestoreReport, open_backup, restore_backup
from services.extractor.worker import ExtractorWorker
from shared.catalog.api_keys import authenticate_api_key, create_api_key
from shared.catalog.chunks import Chunk
from shared.catalog.database.session import Catalog
from shared.catalog.generations import active_generation
from shared.catalog.installation import check_not_behind, get_or_create_installation
from shared.catalog.jobs import Job, JobKind, JobState
from shared.catalog.maps import get_map
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.errors import Conflict, Misconfigured
from shared.integrity.verify import verify_store
from shared.jobs.model_changes import start_model_change
from shared.journal.outbox import write_journal
from shared.journal.segments import SNAPSHOT_TABLES, TABLES, line_of, table_of
from shared.security.api_keys import Scope, hash_api_key
from shared.storage import FolderStore
from shared.storage.keys import JOURNAL, thumbnail_key
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_reconstruction, take
from tests.support.photos import photo_bytes
from tests.support.servers import PostgresServer

pytestmark = pytest.mark.databases("postgresql")


@pytest.fixture
def other_catalog(
    catalog: Catalog, tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[Catalog]:
    """An empty one on the other kind of database."""
    if catalog.is_sqlite:
        server: PostgresServer = request.getfixturevalue("postgres")
        opened = Catalog(server.new_database(request.getfixturevalue("migrated_postgres")))
    else:
        copy = shutil.copy(request.getfixturevalue("migrated_sqlite"), tmp_path / "other.sqlite")
        opened = Catalog(f"sqlite:///{copy}")
    yield opened
    opened.close()


@pytest.fixture
def other_store(tmp_path: Path) -> FolderStore:
    return FolderStore(tmp_path / "other-objects")


class ObservedStore:
    """Calls `before(method, argument)` before each call that reads the store."""

    def __init__(self, store: Any, before: Callable[[str, str], object]) -> None:
        self._store, self._before = store, before

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._store, name)

        def call(argument: str, *more: Any) -> Any:
            self._before(name, argument)
            return method(argument, *more)

        return call


BackUp = Callable[..., BackupManifest]


@pytest.fixture
def back_up(service: Service, tmp_path: Path) -> BackUp:
    with service.catalog.write() as session:
        installation_id = get_or_create_installation(session).id

    def run(before: Callable[[str, str], object] = lambda method, argument: None) -> BackupManifest:
        store: Any = ObservedStore(service.store, before)
        return create_backup(service.catalog, store, installation_id, tmp_path / "backup")

    return run


@pytest.fixture
def restore(
    back_up: BackUp,
    tmp_path: Path,
    other_catalog: Catalog,
    other_store: FolderStore,
    settings: Settings,
) -> Callable[[], RestoreReport]:
    folder = BackupFolder(tmp_path / "backup")
    return lambda: restore_backup(folder, other_catalog, other_store, settings)


def answers(service: Service, file_ids: list[str]) -> list[Any]:
    found = [service.json("POST", f"/similarity/{file_id}") for file_id in file_ids]
    return [one["similar_images"] for one in found]


def rows_of(catalog: Catalog, name: str) -> list[Any]:
    """The rows of a table without the catalog's own bookkeeping."""
    table = table_of(name)
    with catalog.read() as session:
        rows = session.execute(select(table).order_by(*table.primary_key.columns)).mappings()
        return [line_of(name, row).row for row in rows]


def original_of(service: Service, file_id: str) -> str:
    with service.catalog.read() as session:
        return session.get_one(Photo, UUID(file_id)).object_key


@pytest.mark.databases("sqlite", "postgresql")
def test_a_backup_goes_from_either_database_into_the_other_and_answers_the_same(
    service: Service,
    back_up: BackUp,
    restore: Callable[[], RestoreReport],
    other_catalog: Catalog,
    other_store: FolderStore,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
) -> None:
    known = service.indexed(1, 2, 3, 4, latitude=45.1, longitude=7.6, tags="a,b", place="here")
    write_journal(service.catalog, service.store)
    track = service.json("POST", "/tracks", 201, json={})["track_id"]
    frame = {"data": {"captured_at": "2026-05-01T12:00Z"}, "files": {"file": photo_bytes(1)}}
    service.json("POST", f"/tracks/{track}/frames", 202, **frame)
    service.drain()
    assert service.json("GET", f"/tracks/{track}")["pending"] == 0
    answers(service, known)  # the search history
    webhook = {"url": "https://8.8.8.8/hook", "events": ["job.failed"]}
    service.json("POST", "/webhooks", 201, json=webhook)
    gone = service.json("POST", "/webhooks", 201, json=webhook)["id"]
    service.json("DELETE", f"/webhooks/{gone}")
    files = [("file", ("batch.jpg", photo_bytes(8), "image/jpeg"))]
    batch = service.json("POST", "/upload/batch", 202, files=files)["job_id"]
    # Work of all kinds under way: queued, failed, held by a worker, a query.
    queued, failed = (service.upload(photo_bytes(number))["job_id"] for number in (5, 6))
    with service.catalog.write() as session:
        default = get_map(session, "default").id
        fit = start_model_change(session, default, JobKind.FIT, {"clusters": 2}).id
        session.get_one(Job, UUID(failed)).state = JobState.FAILED
        _, key = create_api_key(session, "theirs", {Scope.READ})
        active = active_generation(session, default)
        assert active is not None
        add_reconstruction(session, service.store, active)
    (held,) = (str(job.id) for job in take(service.catalog, 1))
    query = service.ask(photo_bytes(7))
    manifest = back_up()
    assert (manifest.missing, manifest.damaged) == ([], [])

    assert restore().recovered.queued_photos == 0, "their jobs are restored"
    for name in [*TABLES, *SNAPSHOT_TABLES]:
        live = [row for row in rows_of(service.catalog, name) if row.get("deleted_at") is None]
        assert name == "jobs" or rows_of(other_catalog, name) == live, name
    other = Service(other_catalog, other_store, settings, make_worker)
    assert answers(other, known) == answers(service, known)
    features = [each.json("GET", "/maps/default")["local_features"] for each in (service, other)]
    assert features[0] == features[1]
    assert features[1]["photos"] == 4
    states = {
        row["id"]: (row["state"], row["lease_token"]) for row in rows_of(other_catalog, "jobs")
    }
    expected = dict.fromkeys([queued, batch, str(fit), held], ("queued", None))
    assert states == expected | {failed: ("failed", None)} | {batch: states[batch]}
    assert query not in states
    with other_catalog.read() as session:
        assert authenticate_api_key(session, hash_api_key(key)).name == "theirs"
    assert other.json("GET", "/webhooks") == service.json("GET", "/webhooks")
    assert verify_store(other_catalog, other_store, originals=True).faults == []
    check_not_behind(other_catalog, other_store)
    other.upload(photo_bytes(9))
    assert write_journal(other_catalog, other_store) > 0


@pytest.mark.parametrize("is_marked", [True, False])
def test_restored_catalog_has_the_id_of_its_store_or_else_of_the_backup(
    back_up: BackUp,
    restore: Callable[[], RestoreReport],
    other_catalog: Catalog,
    other_store: FolderStore,
    is_marked: bool,
) -> None:
    manifest = back_up()
    with other_catalog.write() as session:
        own = str(get_or_create_installation(session).id)
    if is_marked:  # as after a first start
        other_store.write_note(".placewise", own.encode())
    restore()
    with other_catalog.read() as session:
        restored_id = str(get_or_create_installation(session).id)
    assert restored_id == (own if is_marked else manifest.installation_id)
    assert other_store.read_note(".placewise") == restored_id.encode()


def test_a_backup_taken_again_copies_only_what_is_new_and_forgets_what_is_gone(
    service: Service, back_up: BackUp, tmp_path: Path
) -> None:
    first, _ = service.indexed(1, 2)
    back_up()
    read: list[str] = []

    def on_call(method: str, key: str) -> None:
        if method == "open":
            read.append(key)

    back_up(on_call)
    assert read == []
    gone = original_of(service, first)
    service.json("DELETE", f"/uploads/{first}", params={"permanently": True})
    service.store.delete(gone)  # as the steward does
    service.upload(photo_bytes(3))
    manifest = back_up(on_call)
    assert [key.split("/")[0] for key in read] == ["originals"]
    folder = BackupFolder(tmp_path / "backup")
    _, index = open_backup(folder)
    assert manifest.objects == len(index)
    assert gone not in index
    assert {info.key for info in folder.objects.list("")} == index.keys()
    assert len(list((tmp_path / "backup").glob("objects-*.jsonl"))) == 1


def test_what_comes_or_goes_while_a_backup_is_taken_is_in_it_or_not_restored_from_it(
    service: Service,
    back_up: BackUp,
    restore: Callable[[], RestoreReport],
) -> None:
    first, _ = service.indexed(1, 2)
    listings: list[str] = []

    def meanwhile(method: str, argument: str) -> None:
        if method == "open" and not gone:  # while objects are copied
            gone.append(first)
            service.upload(photo_bytes(6))
        if method == "list":
            listings.append(argument)
            if argument == JOURNAL:  # all objects are copied
                service.indexed(3)
                gone.append(service.upload(photo_bytes(4))["file_id"])
                write_journal(service.catalog, service.store)
            elif len(listings) > 2:  # the catalog is read
                service.upload(photo_bytes(5))
                write_journal(service.catalog, service.store)
                for file_id in gone:
                    service.json("DELETE", f"/uploads/{file_id}", params={"permanently": True})
                    service.store.delete(original_of(service, file_id))

    gone: list[str] = []
    manifest = back_up(meanwhile)
    assert listings == ["", JOURNAL, ""]
    assert (manifest.missing, manifest.damaged, manifest.photos) == ([], [], 3)
    report = restore().recovered
    assert (report.photos, report.lost_originals, report.queued_photos) == (3, 0, 0)


def test_what_the_store_has_lost_or_changed_is_named_and_the_rest_backed_up(
    service: Service, back_up: BackUp
) -> None:
    file_id = service.indexed(1)[0]
    original = original_of(service, file_id)
    with service.catalog.read() as session:
        chunk = session.scalars(select(Chunk.object_key)).one()
    service.store.delete(original)
    service.store.put(chunk, service.store.get(chunk)[:-1] + b"x")
    manifest = back_up()
    assert manifest.missing == [original]
    assert manifest.damaged == [chunk]


def test_an_interrupted_backup_leaves_the_one_before_and_goes_on(
    service: Service,
    back_up: BackUp,
    restore: Callable[[], RestoreReport],
    tmp_path: Path,
) -> None:
    service.indexed(1)
    before = back_up()
    service.indexed(2)
    write_journal(service.catalog, service.store)

    def interrupt(method: str, argument: str) -> None:
        if (method, argument) == ("list", JOURNAL):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        back_up(interrupt)
    with (tmp_path / "backup/copied.jsonl").open("a") as lines:
        lines.write('\n{"key": "cut o')
    folder = BackupFolder(tmp_path / "backup")
    manifest, index = open_backup(folder)
    assert (manifest, len(index)) == (before, before.objects)
    shutil.copytree(tmp_path / "backup", tmp_path / "left")
    back_up()
    assert restore().recovered.photos == 2
    left, objects = open_backup(BackupFolder(tmp_path / "left"))
    assert (left.photos, len(objects)) == (1, before.objects)


def test_a_backup_killed_while_it_deletes_old_objects_can_be_restored_and_deletes_them_later(
    service: Service,
    back_up: BackUp,
    restore: Callable[[], RestoreReport],
    other_store: FolderStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gone, _ = service.indexed(1, 2)
    back_up()
    service.json("DELETE", f"/uploads/{gone}", params={"permanently": True})
    original = original_of(service, gone)
    service.store.delete(original)
    service.store.delete(thumbnail_key(UUID(gone)))
    delete = FolderStore.delete

    def killed_after_the_first(store: FolderStore, key: str) -> None:
        delete(store, key)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(FolderStore, "delete", killed_after_the_first)
        with pytest.raises(KeyboardInterrupt):
            back_up()
    restore()
    assert service.store.head(original) is other_store.head(original) is None
    back_up()
    folder = BackupFolder(tmp_path / "backup")
    assert {info.key for info in folder.objects.list("")} == open_backup(folder)[1].keys()


def test_an_interrupted_restore_goes_on_with_what_it_lacks(
    service: Service,
    back_up: BackUp,
    restore: Callable[[], RestoreReport],
    other_catalog: Catalog,
    other_store: FolderStore,
    tmp_path: Path,
) -> None:
    service.indexed(1, 2)
    manifest = back_up()
    folder = BackupFolder(tmp_path / "backup")
    key, hidden = next(iter(open_backup(folder)[1])), tmp_path / "hidden"
    folder.objects.path(key).rename(hidden)
    with pytest.raises(Misconfigured, match=f"missing or damaged: {key}") as caught:
        restore()
    assert caught.value.code == "backup_damaged"
    with pytest.raises(Misconfigured) as caught:
        check_not_behind(other_catalog, other_store)
    assert caught.value.code == "rebuild_unfinished", "no service starts with it"
    hidden.rename(folder.objects.path(key))
    done = restore()
    assert (done.copied_objects, done.objects) == (1, manifest.objects)
    check_not_behind(other_catalog, other_store)


def test_only_an_empty_placewise_is_restored_into(
    service: Service,
    back_up: BackUp,
    restore: Callable[[], RestoreReport],
    other_store: FolderStore,
    tmp_path: Path,
) -> None:
    service.indexed(1)
    back_up()
    folder = BackupFolder(tmp_path / "backup")
    with pytest.raises(Conflict, match=r"PLACEWISE_HOME.*this one has") as caught:
        restore_backup(folder, service.catalog, service.store, service.settings)
    assert caught.value.code == "target_not_empty"
    other_store.put("vocabularies/another", b"centres")
    with pytest.raises(Conflict, match="vocabularies/another"):
        restore()
    other_store.delete("vocabularies/another")
    other_store.write_note(".placewise", str(UUID(int=7)).encode())
    with pytest.raises(Misconfigured, match="belongs to another catalog"):
        restore()


def test_a_folder_that_is_no_backup_or_anothers_is_left_alone(
    service: Service, back_up: BackUp, tmp_path: Path
) -> None:
    def check_refused(code: str, act: Callable[[], object]) -> None:
        with pytest.raises(Misconfigured) as caught:
            act()
        assert caught.value.code == code

    def write(name: str) -> None:
        create_backup(service.catalog, service.store, UUID(int=1), tmp_path / name)

    check_refused("no_backup", lambda: open_backup(BackupFolder(tmp_path / "nowhere")))
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters/to-mother.txt").write_text("Dear")
    check_refused("not_a_backup", lambda: write("letters"))
    back_up()
    check_refused("other_installation", lambda: write("backup"))
    file = tmp_path / "backup/backup.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "format": 99}))
    check_refused("backup_of_another_release", lambda: open_backup(BackupFolder(file.parent)))
