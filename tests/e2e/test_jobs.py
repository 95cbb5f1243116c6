"""Jobs: listed, waited for, watched, cancelled and tried again."""

from __future__ import annotations

import itertools
import time
from typing import Any
from uuid import uuid4

import httpx2

from tests.support.photos import photo_bytes
from tests.support.problems import problem
from tests.support.server import CommandLine, ServerProcess

# One photo per batch, so that of several photos only the first ones are under way.
SETTINGS = {"batch_photos": 1}
JOBS = "/api/v1/jobs"
fresh = itertools.count(2000)


def get(server: ServerProcess, path: str, **params: Any) -> dict[str, Any]:
    answer = server.client.get(path, params=params)
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def listed(server: ServerProcess, **params: Any) -> list[dict[str, Any]]:
    jobs: list[dict[str, Any]] = get(server, JOBS, limit=1000, **params)["jobs"]
    return jobs


def failed_job(server: ServerProcess) -> str:
    job_id: str = server.upload(photo_bytes(next(fresh))[:-60]).json()["job_id"]
    assert server.finished(job_id)["state"] == "failed"
    return job_id


def post(server: ServerProcess, job_id: str, verb: str) -> httpx2.Response:
    return server.client.post(f"{JOBS}/{job_id}/{verb}")


def test_a_job_has_its_times_progress_and_result(server: ServerProcess) -> None:
    uploaded = server.upload(photo_bytes(next(fresh))).json()
    job = server.finished(uploaded["job_id"])
    assert job["job_id"] == uploaded["job_id"]
    assert job["file_id"] == uploaded["file_id"]
    assert job["status_url"] == uploaded["status_url"]
    assert (job["kind"], job["state"]) == ("index", "succeeded")
    assert job["progress"] == {"done": 1, "total": 1, "failed": 0}
    assert job["error"] is None
    assert job["waiting_for"] is None
    assert job["created_at"] <= job["started_at"] <= job["finished_at"]


def test_the_command_names_failed_photos_with_the_reason_and_retries_them(
    server: ServerProcess,
) -> None:
    placewise = CommandLine(server.home.parent, server.home)
    broken = server.upload(photo_bytes(next(fresh))[:-60], "cut-off.jpg").json()["job_id"]
    assert server.finished(broken)["state"] == "failed"
    failed = placewise("jobs", "--failed", "--json").json()
    assert {job["state"] for job in failed} == {"failed"}
    assert (failed[0]["filename"], failed[0]["map"]) == ("cut-off.jpg", "default")
    assert failed[0]["error"]["code"] == "undecodable_photo"
    table = placewise("jobs").stdout.splitlines()
    (row,) = [line for line in table if "cut-off.jpg" in line]
    assert row.startswith("failed\tcut-off.jpg\tindex\t")
    assert failed[0]["error"]["detail"] in row

    (retried,) = placewise("jobs", "--retry", "--limit", "1", "--json").json()
    assert (retried["job_id"], retried["state"]) == (broken, "queued")
    assert server.finished(broken)["state"] == "failed", "it is as broken as before"


def test_jobs_are_listed_newest_first_by_state_and_kind_page_by_page(server: ServerProcess) -> None:
    indexed = server.upload(photo_bytes(next(fresh))).json()["job_id"]
    server.finished(indexed)
    broken = failed_job(server)
    body = server.client.post(
        "/api/v1/similarity", files={"file": ("q.jpg", photo_bytes(next(fresh)))}
    ).json()["job_id"]
    server.finished(body)

    everything = [job["job_id"] for job in listed(server)]
    assert everything[:3] == [body, broken, indexed]
    failed = listed(server, state="failed")
    assert broken in [job["job_id"] for job in failed]
    assert {job["state"] for job in failed} == {"failed"}
    queries = listed(server, kind="describe")
    assert body in [job["job_id"] for job in queries]
    assert {job["kind"] for job in queries} == {"describe"}
    both = listed(server, state=["failed", "succeeded"], kind="index")
    assert {broken, indexed} <= {job["job_id"] for job in both}
    assert body not in {job["job_id"] for job in both}

    whole = [job["job_id"] for job in listed(server, kind="index")]
    read: list[str] = []
    cursor: dict[str, str] = {}
    while len(read) < len(whole):
        page = get(server, JOBS, kind="index", limit=2, **cursor)
        assert 0 < len(page["jobs"]) <= 2
        read += [job["job_id"] for job in page["jobs"]]
        cursor = {"cursor": page["next_cursor"]}
    assert (read, page["next_cursor"]) == (whole, None)


def test_unknown_jobs_are_not_found(server: ServerProcess) -> None:
    for job_id in (str(uuid4()), "no-id-at-all"):
        problem(server.client.get(f"{JOBS}/{job_id}"), 404, "job_not_found")
        problem(post(server, job_id, "cancel"), 404, "job_not_found")
        problem(post(server, job_id, "retry"), 404, "job_not_found")


def test_a_job_is_watched_until_its_final_state(server: ServerProcess) -> None:
    with server.no_decoding():
        uploaded = server.upload(photo_bytes(next(fresh))).json()
        began = time.monotonic()
        job = get(server, uploaded["status_url"], wait=1)
        assert time.monotonic() - began >= 1, "a job that goes on is waited for"
        assert job["state"] in ("queued", "running")
    began = time.monotonic()
    job = get(server, uploaded["status_url"], wait=60)
    assert time.monotonic() - began < 30, "its end is answered at once"
    assert (job["job_id"], job["state"]) == (uploaded["job_id"], "succeeded")


def test_a_cancelled_job_runs_only_after_a_retry(server: ServerProcess) -> None:
    with server.no_decoding():
        for _ in range(3):  # one is described, one prepared, one more for good measure
            server.upload(photo_bytes(next(fresh)))
        uploaded = server.upload(photo_bytes(next(fresh))).json()
        assert get(server, uploaded["status_url"])["state"] == "queued"
        answer = post(server, uploaded["job_id"], "cancel")
        assert answer.status_code == 200
        assert answer.json()["state"] == "cancelled"
        assert answer.json()["finished_at"]
        last = server.upload(photo_bytes(next(fresh))).json()["job_id"]
    # One that was queued behind it is done: it would have been, too.
    assert server.finished(last)["state"] == "succeeded"
    assert get(server, uploaded["status_url"])["state"] == "cancelled"
    refused = problem(server.similar(uploaded["file_id"]), 409, "not_searchable")
    assert refused["state"] == "cancelled"
    body = problem(post(server, uploaded["job_id"], "cancel"), 409, "job_finished")
    assert (body["job_id"], body["state"]) == (uploaded["job_id"], "cancelled")

    again = post(server, uploaded["job_id"], "retry")
    assert again.status_code == 200
    assert (again.json()["state"], again.json()["finished_at"]) == ("queued", None)
    assert server.finished(uploaded["job_id"])["state"] == "succeeded"
    body = problem(post(server, uploaded["job_id"], "retry"), 409, "job_not_retryable")
    assert body["job_id"] == uploaded["job_id"]
    assert server.similar(uploaded["file_id"]).status_code == 200


def test_a_cancelled_query_has_no_result(server: ServerProcess) -> None:
    with server.no_decoding():
        started = server.client.post(
            "/api/v1/similarity", files={"file": ("q.jpg", photo_bytes(next(fresh)))}
        ).json()
        assert post(server, started["job_id"], "cancel").status_code == 200
        problem(server.client.get(started["result_url"]), 409, "job_cancelled")
