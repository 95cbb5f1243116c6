"""`GET /health` reports whether photos can be described, and uploads report what they wait for."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from sqlalchemy import update

from shared.catalog.database.base import db_now_plus
from shared.catalog.processes import RegisteredProcess, process_heartbeat
from shared.jobs import Job
from shared.storage.trash import end_hold, write_hold
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_map, set_columns
from tests.support.photos import photo_bytes
from tests.support.waiting import wait_until

ANYLOC = "anyloc-vits14:clusters=2,layer=0"


def extractors(service: Service, status: int) -> Any:
    return service.json("GET", "/health", status)["parts"]["extractors"]


def register(
    service: Service, seconds_ago: float = 0, *, role: str = "extractor", **state: Any
) -> None:
    with service.catalog.write() as session:
        session.add(
            RegisteredProcess(
                role=role,
                name="one",
                release="1",
                state=state or None,
                seen_at=db_now_plus(-seconds_ago),
            )
        )


def test_health_is_degraded_when_every_separate_steward_was_killed(service: Service) -> None:
    assert "stewards" not in service.json("GET", "/health")["parts"], "none has ever registered"
    register(service, seconds_ago=60, role="steward")
    health = service.json("GET", "/health", 503)
    assert health["status"] == health["parts"]["stewards"]["status"] == "degraded"
    register(service, role="steward")
    part = service.json("GET", "/health")["parts"]["stewards"]
    assert part == {"status": "healthy", "detail": "1 running"}


def test_health_says_why_orphans_are_not_collected(service: Service) -> None:
    write_hold(service.store, "too many orphans")
    part = service.json("GET", "/health", 503)["parts"]["object_store"]
    assert part == {"status": "degraded", "detail": "too many orphans"}
    end_hold(service.store)
    assert service.json("GET", "/health")["parts"]["object_store"]["status"] == "healthy"


def test_extractors_that_are_scaled_to_zero_are_healthy_until_a_job_is_overdue(
    service: Service,
) -> None:
    assert extractors(service, 200)["processes"] == []
    job_id = UUID(service.upload(photo_bytes(1))["job_id"])
    assert extractors(service, 200)["status"] == "healthy"
    set_columns(service.catalog, job_id, created_at=db_now_plus(-60))
    part = extractors(service, 503)
    assert part["status"] == "degraded"
    assert "no extractor is running" in part["detail"]


def test_health_is_degraded_when_every_extractor_was_killed(service: Service) -> None:
    register(service, seconds_ago=60, device="cpu", models=["test-tiny-avg"], errors={})
    assert extractors(service, 503)["processes"] == []
    assert service.json("GET", "/database/stats")["device"] is None
    register(service, device="cuda", models=["test-tiny-avg"], errors={})
    part = extractors(service, 200)
    assert [process["device"] for process in part["processes"]] == ["cuda"]
    assert service.json("GET", "/database/stats")["device"] == "cuda"


def test_a_new_extractor_replaces_the_killed_ones_in_the_registry(service: Service) -> None:
    register(service, seconds_ago=60)
    with process_heartbeat(service.catalog, "extractor"):
        pass
    assert extractors(service, 200)["status"] == "healthy"


def test_health_ignores_load_errors_of_extractors_that_no_map_uses(service: Service) -> None:
    register(service, device="cpu", models=[], errors={ANYLOC: "weights_missing"})
    assert extractors(service, 200)["status"] == "healthy"
    with service.catalog.write() as session:
        add_map(session, "other", ANYLOC)
    part = extractors(service, 503)
    assert part["processes"][0]["errors"] == {ANYLOC: "weights_missing"}
    assert part["detail"].startswith(f"{ANYLOC} can't be loaded (weights_missing)")


def test_photos_whose_description_failed_are_counted_and_listed(service: Service) -> None:
    register(service, device="cpu", models=["test-tiny-avg"], errors={})
    good = service.indexed(1)
    broken = service.upload(photo_bytes(2)[:-60])["file_id"]
    assert extractors(service, 200)["failed_photos"] == {}, "it is not described yet"
    service.drain()
    part = extractors(service, 200)
    assert part["failed_photos"] == {"default": 1}
    assert (
        part["detail"]
        == "1 running; stored photos that can't be searched for: 1 in the map default"
    )
    listed = service.json("GET", "/search", params={"failed": "true"})["images"]
    assert [photo["image_id"] for photo in listed] == [broken]
    map_ = service.json("GET", "/maps/default")
    assert (map_["photos"], map_["searchable"], map_["failed_photos"]) == (2, len(good), 1)
    assert service.json("GET", "/database/stats")["failed_images"] == 1
    service.json("DELETE", f"/uploads/{broken}")
    assert extractors(service, 200)["failed_photos"] == {}


def test_health_says_that_redis_takes_no_messages(service: Service) -> None:
    part = service.json("GET", "/health")["parts"]["queue"]
    assert (part["status"], part["oldest_waiting_seconds"]) == ("healthy", 0)
    service.wakeups.problem = "Timeout reading from socket"
    part = service.json("GET", "/health", 503)["parts"]["queue"]
    assert part["status"] == "degraded"
    assert "Timeout reading from socket" in part["detail"]


def test_extractors_are_degraded_while_a_job_waits_much_longer_than_usual(
    service: Service,
) -> None:
    register(service, device="cpu", models=["test-tiny-avg"], errors={})
    (photo,) = service.indexed(1)
    job_id = UUID(service.upload(photo_bytes(2))["job_id"])
    set_columns(service.catalog, job_id, created_at=db_now_plus(-3600))
    assert extractors(service, 200)["status"] == "healthy", "a job has just finished"
    with service.catalog.write() as session:
        session.execute(
            update(Job).where(Job.photo_id == UUID(photo)).values(finished_at=db_now_plus(-120))
        )
    # The queue is measured every second, or less often.
    wait_until(lambda: not service("GET", "/health").is_success, 60)
    part = extractors(service, 503)
    assert part["status"] == "degraded"
    assert "waited for 36" in part["detail"]
    assert "usual" in part["detail"]
