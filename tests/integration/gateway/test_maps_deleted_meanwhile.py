"""Work that is under way while its map is deleted: uploads, jobs, searches."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import func, select

from services.extractor.publish import publish
from services.gateway.routes import uploads as uploads_module
from services.gateway.similarity.execute import run_similarity_search
from services.steward.tasks import delete_maps
from services.steward.tasks.delete_maps import purge_deleted_maps
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.session import Catalog
from shared.ingest.validation import validate_photo
from shared.jobs import Job, JobState
from shared.storage import FolderStore
from tests.integration.gateway.deleted_maps import id_of, objects, remove_all, rows
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_job, add_photo, read_job, states
from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import problem
from tests.support.threads import at_once

pytestmark = pytest.mark.databases("postgresql")


class Away(Exception):
    pass


@pytest.fixture
def before_publishing(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], None]:
    """Has something done when a batch is described and not published yet."""

    def meanwhile(do: Callable[[], object]) -> None:
        calls = iter([do])

        def act_and_publish(*arguments: Any) -> Any:
            for act in calls:
                act()
                break
            return publish(*arguments)

        monkeypatch.setattr("services.extractor.describe.publish", act_and_publish)

    return meanwhile


@pytest.mark.parametrize("removed", [False, True])
def test_a_claimed_batch_is_not_published_into_a_map_that_was_deleted(
    service: Service,
    catalog: Catalog,
    store: FolderStore,
    before_publishing: Callable[[Callable[[], object]], None],
    removed: bool,
) -> None:
    """Neither while its rows are there nor once the steward has removed them."""
    (stays,) = service.indexed(9)
    before = rows(catalog), objects(store)
    service.json("POST", "/maps", 201, json={"name": "gone"})
    service.indexed(0, map_name="gone")
    jobs = [service.upload(photo_bytes(number), "gone")["job_id"] for number in (1, 2, 3)]
    jobs.append(service.ask(near_copy(1), "gone"))

    def delete() -> None:
        service.json("DELETE", "/maps/gone")
        if removed:
            remove_all(catalog, store)
            return
        with catalog.read() as session:
            found = [session.get_one(Job, UUID(job_id)) for job_id in jobs]
        assert [job.state for job in found] == [JobState.CANCELLED] * 4
        assert not any(job.lease_token for job in found)

    before_publishing(delete)
    service.drain()
    with catalog.read() as session:
        described = session.scalar(select(func.count()).select_from(Descriptor))
        chunks = session.scalar(select(func.count()).select_from(Chunk))
    assert (described, chunks) == ((1, 1) if removed else (2, 2)), "only what was there before"
    remove_all(catalog, store)
    collect_orphans(catalog, store, 0)  # what the batch wrote in vain
    assert rows(catalog) == before[0]
    assert objects(store) == before[1]
    assert service.json("GET", f"/uploads/{stays}")["searchable"]


def test_jobs_of_a_deleted_map_are_cancelled_in_small_transactions(
    service: Service, catalog: Catalog, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.json("POST", "/maps", 201, json={"name": "gone"})
    jobs = [UUID(service.upload(photo_bytes(n), "gone")["job_id"]) for n in range(5)]
    monkeypatch.setattr("shared.jobs.transitions.CANCELLED_PER_TRANSACTION", 2)
    service.json("DELETE", "/maps/gone")
    assert states(catalog, jobs).count(JobState.CANCELLED) == 2
    remove_all(catalog, store)
    assert rows(catalog)["jobs"] == 0


def test_a_search_whose_map_is_removed_meanwhile_finds_no_map(
    service: Service, catalog: Catalog, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.json("POST", "/maps", 201, json={"name": "gone", "extractor": "test-tiny-avg"})
    photo_id, _ = service.indexed(1, 2, map_name="gone")

    def search_and_remove(*arguments: Any) -> Any:
        result = run_similarity_search(*arguments)
        service.json("DELETE", "/maps/gone")
        remove_all(catalog, store)
        return result

    path = "services.gateway.similarity.execute.run_similarity_search"
    monkeypatch.setattr(path, search_and_remove)
    answer = service("POST", f"/similarity/{photo_id}", params={"map": "gone"})
    problem(answer, 404, "map_not_found")


def test_uploads_while_their_map_is_deleted_are_refused_or_go_with_it(
    service: Service, catalog: Catalog, store: FolderStore
) -> None:
    service.json("POST", "/maps", 201, json={"name": "gone"})
    service.make_worker()
    before = rows(catalog)

    def upload(number: int) -> int:
        answers = [
            service(
                "POST",
                "/upload",
                params={"map": "gone"},
                files={"file": photo_bytes(10 * number + n)},
            )
            for n in range(4)
        ]
        return sum(answer.status_code == 202 for answer in answers) + 100 * sum(
            answer.status_code not in (202, 404) for answer in answers
        )

    def delete() -> int:
        service.json("DELETE", "/maps/gone")
        remove_all(catalog, store)
        return 0

    taken = at_once(delete, *(partial(upload, number) for number in range(4)))
    assert all(0 <= each <= 4 for each in taken)
    remove_all(catalog, store)
    assert objects(store) == set()
    assert rows(catalog) == Counter({**before, "maps": before["maps"] - 1})


def test_a_photo_committed_during_a_removal_is_removed_by_the_next_round(
    service: Service, catalog: Catalog, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its upload began before the deletion and commits after the steward has looked."""
    service.json("POST", "/maps", 201, json={"name": "gone"})
    map_id = id_of(service, "gone")
    service.json("DELETE", "/maps/gone")

    def slip_in(*_: Any) -> None:
        with catalog.write() as session:
            store.put(add_photo(session, map_id).object_key, b"late")

    with monkeypatch.context() as patched:
        patched.setattr(delete_maps, "_purge_vocabulary_objects", slip_in)
        with pytest.raises(Exception, match=r"(?i)foreign key"):
            purge_deleted_maps(catalog, store)
    remove_all(catalog, store)
    assert (rows(catalog)["photos"], rows(catalog)["maps"]) == (0, 1)
    assert objects(store) == set()


def test_a_job_committed_after_the_deletion_is_cancelled_before_the_removal(
    service: Service, catalog: Catalog, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.json("POST", "/maps", 201, json={"name": "gone"})
    map_id = id_of(service, "gone")
    service.json("DELETE", "/maps/gone")
    with catalog.write() as session:
        job = add_job(session, map_id, photo_id=add_photo(session, map_id).id)

    def away(*_: Any, **__: Any) -> bool:
        raise Away

    monkeypatch.setattr(delete_maps, "delete_chunks", away)
    with pytest.raises(Away):
        purge_deleted_maps(catalog, store)
    assert read_job(catalog, job.id).state == JobState.CANCELLED


def test_an_upload_whose_map_went_meanwhile_is_not_found_and_leaves_no_bytes(
    service: Service, catalog: Catalog, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.json("POST", "/maps", 201, json={"name": "gone"})
    real = validate_photo

    def delete_first(*arguments: Any) -> Any:
        service.json("DELETE", "/maps/gone")
        remove_all(catalog, store)
        return real(*arguments)

    monkeypatch.setattr(uploads_module, "validate_photo", delete_first)
    files = {"file": photo_bytes(1)}
    answer = service("POST", "/upload", params={"map": "gone"}, files=files)
    assert "placewise maps create gone" in problem(answer, 404, "map_not_found")["detail"]
    assert objects(store) == set()
