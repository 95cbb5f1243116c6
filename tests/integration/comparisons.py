"""What the tests of comparisons ask of the HTTP API."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from sqlalchemy import func, select

from services.steward.tasks.model_changes import advance_model_changes
from shared.catalog.maps import Search
from shared.catalog.photos import Photo
from shared.jobs import InProcessWakeups, Job
from tests.integration.in_process_api import Service

ROUNDS = 60
CLOSELY: dict[str, Any] = {"rerank": 3, "explain": "true"}


def begun(service: Service, path: str, **params: Any) -> dict[str, Any]:
    """The 202 of a comparison."""
    started: dict[str, Any] = service.json("POST", path, 202, params={**CLOSELY, **params})
    return started


def result(service: Service, started: dict[str, Any], **params: Any) -> dict[str, Any]:
    """The answer that the job's 202 has promised."""
    path = started["result_url"].removeprefix("/api/v1")
    answer: dict[str, Any] = service.json("GET", path, params=params)
    return answer


def compared(
    service: Service, photo_id: str, map_name: str = "default", **params: Any
) -> dict[str, Any]:
    """The answer to a stored photo, looked at closely."""
    started = begun(service, f"/similarity/{photo_id}", map=map_name, **params)
    service.drain()
    return result(service, started, map=map_name)


def plain(service: Service, photo_id: str, **params: Any) -> dict[str, Any]:
    answer: dict[str, Any] = service.json("POST", f"/similarity/{photo_id}", params=params)
    return answer


def ids(answer: dict[str, Any]) -> list[str]:
    return [found["image_id"] for found in answer["similar_images"]]


def column(answer: dict[str, Any], name: str) -> list[Any]:
    return [found[name] for found in answer["similar_images"]]


def jobs(service: Service, kind: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = service.json("GET", "/jobs", params={"kind": kind})["jobs"]
    return found


def searches(service: Service) -> int:
    with service.catalog.read() as session:
        return session.scalar(select(func.count()).select_from(Search)) or 0


def lose_bytes(service: Service, photo_id: str) -> None:
    with service.catalog.read() as session:
        service.store.delete(session.get_one(Photo, UUID(photo_id)).object_key)


def release(service: Service, started: dict[str, Any]) -> None:
    """Let the job that was held back be done."""
    with service.catalog.write() as session:
        session.get_one(Job, UUID(started["job_id"])).waiting_for = None
    service.drain()


def fit(service: Service, map_name: str, **params: int) -> None:
    """A vocabulary for the map, from its start to its end."""
    started = service.json("POST", "/vocabularies", 202, params={"map": map_name}, json=params)
    for _ in range(ROUNDS):
        service.drain()
        advance_model_changes(service.catalog, InProcessWakeups())
        job = service.json("GET", f"/jobs/{started['job_id']}", params={"map": map_name})
        if job["state"] == "succeeded":
            return
        assert job["state"] in ("queued", "running"), job
    raise AssertionError(f"the fit did not end: {job}")
