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

from services.extractor.worker import ExtractorWorker
from shared.backup import create
from shared.backup import folder as folder_module
from shared.backup.create import create_backup
from shared.backup.folder import BackupFolder, backup_tables, open_backup
from shared.backup.restore import RestoreResult, restore_backup
from shared.catalog.chunks import Chunk
from shared.catalog.database.session import Catalog
from shared.catalog.installation import get_or_create_installation
from shared.catalog.jobs import Job, JobKind, JobState
from shared.catalog.maps import get_map
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.errors import Conflict, Misconfigured
from shared.integrity.verify import verify_store
from shared.jobs.model_changes import start_model_change
from shared.storage import FolderStore
from shared.storage.keys import thumbnail_key
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import read_job, take
from tests.support.photos import photo_bytes
from tests.support.servers import PostgresServer


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


@pytest.fixture
def backed_up(service: Service, tmp_path: Path) -> Callable[[], Any]:
    with service.catalog.write() as session:
        installation_id = get_or_create_installation(session).id

    def back_up() -> Any:
        return create_backup(service.catalog, service.store, installation_id, tmp_path / "backup")

    return back_up


def restored(path: Path, catalog: Catalog, store: FolderStore) -> RestoreResult:
    folder, about = open_backup(path)
    return restore_backup(folder, about, catalog, lambda: store)


def answers(service: Service, file_ids: list[str]) -> list[Any]:
    found = [service.json("POST", f"/similarity/{file_id}") for file_id in file_ids]
    return [one["similar_images"] for one in found]


def test_a_backup_goes_from_either_database_into_the_other_and_answers_the_same(
    service: Service,
    backed_up: Callable[[], Any],
    other_catalog: Catalog,
    other_store: FolderStore,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
    tmp_path: Path,
) -> None:
    known = service.indexed(1, 2, 3, 4, latitude=45.1, longitude=7.6, tags="a,b", place="here")
    track = service.json("POST", "/tracks", 201, json={})["track_id"]
    frame = {"data": {"captured_at": "2026-05-01T12:00Z"}, "files": {"file": photo_bytes(1)}}
    service.json("POST", f"/tracks/{track}/frames", 202, **frame)
    service.drain()
    assert service.json("GET", f"/tracks/{track}")["pending"] == 0
    # Work of all kinds under way: queued, held by a worker, a query.
    queued = [service.upload(photo_bytes(number))["job_id"] for number in (5, 6)]
    query = service.ask(photo_bytes(7))
    with service.catalog.write() as session:
        default = get_map(session, "default").id
        fit = start_model_change(session, default, JobKind.FIT, {"clusters": 2}).id
    held = {str(job.id) for job in take(service.catalog, 1)}
    about = backed_up()
    assert (about.missing, about.damaged) == ([], [])

    done = restored(tmp_path / "backup", other_catalog, other_store)
    assert done.cancelled_jobs == 1
    with service.catalog.read() as here, other_catalog.read() as there:
        for table in backup_tables():
            if table.name in ("installation", "jobs"):
                continue
            order = list(table.primary_key.columns)
            ours = [tuple(row) for row in here.execute(select(table).order_by(*order))]
            theirs = [tuple(row) for row in there.execute(select(table).order_by(*order))]
            assert ours == theirs, table.name
    other = Service(other_catalog, other_store, settings, make_worker)
    assert answers(other, known) == answers(service, known)
    assert read_job(other_catalog, UUID(query)).state == JobState.CANCELLED
    assert read_job(other_catalog, fit).state == JobState.QUEUED, "it starts again"
    for job_id in [*queued, *held]:
        job = read_job(other_catalog, UUID(job_id))
        assert job.lease_token is None
    report = verify_store(other_catalog, other_store, originals=True)
    assert report.faults == []
    assert report.checked["chunk"] >= 1


@pytest.mark.parametrize("is_marked", [True, False])
def test_restored_catalog_has_the_id_of_its_store_or_else_of_the_backup(
    service: Service,
    backed_up: Callable[[], Any],
    other_catalog: Catalog,
    other_store: FolderStore,
    tmp_path: Path,
    is_marked: bool,
) -> None:
    about = backed_up()
    with other_catalog.write() as session:
        own = str(get_or_create_installation(session).id)
    folder, _ = open_backup(tmp_path / "backup")
    owner = own if is_marked else None  # as after a first start, which marks the store
    restore_backup(folder, about, other_catalog, lambda: other_store, store_owner=owner)
    with other_catalog.write() as session:
        restored_id = str(get_or_create_installation(session).id)
    assert restored_id == (own if is_marked else about.installation_id)


def test_progress_has_few_stages(
    service: Service, other_catalog: Catalog, other_store: FolderStore, tmp_path: Path
) -> None:
    service.indexed(1, 2)
    with service.catalog.write() as session:
        installation_id = get_or_create_installation(session).id
    reports: dict[str, list[tuple[int, int]]] = {}

    def report(stage: str, done: int, total: int) -> None:
        reports.setdefault(stage, []).append((done, total))

    path = tmp_path / "backup"
    create_backup(service.catalog, service.store, installation_id, path, report)
    folder, about = open_backup(path)
    restore_backup(folder, about, other_catalog, lambda: other_store, report)
    assert reports.keys() <= {"objects", "new objects", "rows"}
    for stage in reports.values():
        assert stage[-1][0] == stage[-1][1] > 0


def test_a_backup_taken_again_copies_only_what_is_new_and_forgets_what_is_gone(
    service: Service, backed_up: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, _ = service.indexed(1, 2)
    backed_up()
    taken: list[str] = []

    def noted(store: FolderStore, folder: BackupFolder, info: Any) -> int:
        taken.append(info.key)
        return folder_module.back_up_object(store, folder, info)

    monkeypatch.setattr("shared.backup.create.back_up_object", noted)
    assert backed_up().objects
    assert taken == []
    with service.catalog.read() as session:
        gone = session.get_one(Photo, UUID(first)).object_key
    assert service("DELETE", f"/uploads/{first}").is_success
    service.store.delete(gone)  # as the steward does
    service.upload(photo_bytes(3))
    about = backed_up()
    assert [key.split("/")[0] for key in taken] == ["originals"]
    folder, _ = open_backup(tmp_path / "backup")
    assert gone not in folder.index
    assert not folder.objects.path(gone).exists()
    assert about.objects == len(folder.index)
    assert len(list((tmp_path / "backup").glob("catalog-*"))) == 1


def test_what_comes_or_goes_while_a_backup_is_taken_is_in_it_or_not_named_by_it(
    service: Service, backed_up: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    service.indexed(1, 2)
    rounds: list[int] = []

    def meanwhile(*arguments: Any) -> Any:
        counts = folder_module.dump_rows(*arguments)
        rounds.append(1)
        return counts

    def before(*arguments: Any) -> Any:
        """Objects are copied: a photo comes, and another goes with its bytes."""
        seen = copy_all(*arguments)
        service.indexed(3)
        return seen

    def after(*arguments: Any) -> Any:
        """The catalog is read: what it names and is not copied yet goes away."""
        if len(rounds) == 1:
            with service.catalog.read() as session:
                newest = session.scalars(select(Photo).order_by(Photo.id.desc()).limit(1)).one()
            assert service("DELETE", f"/uploads/{newest.id}").is_success
            service.store.delete(newest.object_key)
        return copy_rest(*arguments)

    copy_all, copy_rest = create._copy_all, create._copy_missing
    monkeypatch.setattr("shared.backup.create.dump_rows", meanwhile)
    monkeypatch.setattr(create, "_copy_all", before)
    monkeypatch.setattr(create, "_copy_missing", after)
    about = backed_up()
    assert len(rounds) == 2
    assert (about.missing, about.damaged) == ([], [])


def test_what_the_store_has_lost_or_changed_is_named_and_the_rest_backed_up(
    service: Service, backed_up: Callable[[], Any]
) -> None:
    file_id = service.indexed(1)[0]
    with service.catalog.read() as session:
        original = session.get_one(Photo, UUID(file_id)).object_key
        chunk = session.scalars(select(Chunk.object_key)).one()
    service.store.delete(original)
    service.store.put(chunk, service.store.get(chunk)[:-1] + b"x")
    about = backed_up()
    assert about.missing == [original]
    assert about.damaged == [chunk]


def test_an_interrupted_backup_leaves_the_one_before_and_goes_on(
    service: Service,
    backed_up: Callable[[], Any],
    other_catalog: Catalog,
    other_store: FolderStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    service.indexed(1)
    before = backed_up()
    service.indexed(2)
    with monkeypatch.context() as patched:
        patched.setattr(create, "_copy_missing", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            backed_up()
    with (tmp_path / "backup/objects.jsonl").open("a") as lines:
        lines.write('\n{"key": "cut o')
    assert open_backup(tmp_path / "backup")[1] == before
    backed_up()
    restored(tmp_path / "backup", other_catalog, other_store)
    with other_catalog.read() as session:
        assert len(session.scalars(select(Photo)).all()) == 2


def test_a_backup_killed_while_it_deletes_old_objects_can_be_restored_and_deletes_them_later(
    service: Service,
    backed_up: Callable[[], Any],
    other_catalog: Catalog,
    other_store: FolderStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gone, _ = service.indexed(1, 2)
    backed_up()
    service.json("DELETE", f"/uploads/{gone}")
    with service.catalog.read() as session:
        original = session.get_one(Photo, UUID(gone)).object_key
    service.store.delete(original)
    service.store.delete(thumbnail_key(UUID(gone)))
    delete = FolderStore.delete

    def killed_after_the_first(store: FolderStore, key: str) -> None:
        delete(store, key)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(FolderStore, "delete", killed_after_the_first)
        with pytest.raises(KeyboardInterrupt):
            backed_up()
    restored(tmp_path / "backup", other_catalog, other_store)
    assert service.store.head(original) is other_store.head(original) is None
    backed_up()
    folder, _ = open_backup(tmp_path / "backup")
    assert {info.key for info in folder.objects.list("")} == folder.index.keys()


def test_an_interrupted_restore_goes_on_with_what_it_lacks(
    service: Service,
    backed_up: Callable[[], Any],
    other_catalog: Catalog,
    other_store: FolderStore,
    tmp_path: Path,
) -> None:
    service.indexed(1, 2)
    about = backed_up()
    folder, _ = open_backup(tmp_path / "backup")
    key, hidden = next(iter(folder.index)), tmp_path / "hidden"
    folder.objects.path(key).rename(hidden)
    with pytest.raises(Misconfigured, match="missing or damaged") as caught:
        restored(tmp_path / "backup", other_catalog, other_store)
    assert caught.value.code == "backup_damaged"
    with other_catalog.read() as session:
        assert session.scalars(select(Job)).all() == []
    hidden.rename(folder.objects.path(key))
    done = restored(tmp_path / "backup", other_catalog, other_store)
    assert (done.copied_objects, done.objects) == (1, about.objects)


def test_only_an_empty_placewise_is_restored_into(
    service: Service,
    backed_up: Callable[[], Any],
    other_catalog: Catalog,
    other_store: FolderStore,
    tmp_path: Path,
) -> None:
    service.indexed(1)
    backed_up()
    with pytest.raises(Conflict) as caught:
        restored(tmp_path / "backup", service.catalog, service.store)  # type: ignore[arg-type]
    assert caught.value.code == "target_not_empty"
    other_store.put("vocabularies/another", b"centres")
    with pytest.raises(Conflict, match="vocabularies/another"):
        restored(tmp_path / "backup", other_catalog, other_store)


def test_a_folder_that_is_no_backup_or_anothers_is_left_alone(
    service: Service, backed_up: Callable[[], Any], tmp_path: Path
) -> None:
    with pytest.raises(Misconfigured) as caught:
        open_backup(tmp_path / "nowhere")
    assert caught.value.code == "no_backup"
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters/to-mother.txt").write_text("Dear")
    with pytest.raises(Misconfigured) as caught:
        create_backup(service.catalog, service.store, UUID(int=1), tmp_path / "letters")
    assert caught.value.code == "not_a_backup"
    backed_up()
    with pytest.raises(Misconfigured) as caught:
        create_backup(service.catalog, service.store, UUID(int=1), tmp_path / "backup")
    assert caught.value.code == "other_installation"
    file = tmp_path / "backup/backup.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "format": 99}))
    with pytest.raises(Misconfigured) as caught:
        open_backup(tmp_path / "backup")
    assert caught.value.code == "backup_of_another_release"
