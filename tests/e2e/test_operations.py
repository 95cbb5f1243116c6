"""Running it: backups, probes, figures, starts that are refused, and ends."""

from __future__ import annotations

import signal
import socket
from pathlib import Path
from typing import Any

from shared.config.embedded_home import server_address_file
from tests.support.metrics import read
from tests.support.photos import photo_bytes
from tests.support.problems import got, problem
from tests.support.server import CommandLine, ServerProcess, environment, run_command

API = "/api/v1"


# --- backups, which begin with the only photo of the server ------------------------------------


def run(server_or_home: Path, *arguments: str | Path, code: int = 0) -> Any:
    return CommandLine(server_or_home.parent, server_or_home)(*arguments, "--json").json(code)


def test_a_running_server_is_backed_up_and_another_one_answers_as_it_did(
    server: ServerProcess, tmp_path: Path
) -> None:
    for number in range(1, 4):
        server.indexed(
            photo_bytes(number), f"{number}.jpg", latitude=45 + number / 100, longitude=7
        )
    out = tmp_path / "backup"
    about = run(server.home, "storage", "backup", out)
    assert about["photos"] == 4
    assert about["missing"] == about["damaged"] == []
    query = photo_bytes(2)
    before = server.ask(query, top_k=3).json()["similar_images"]

    refused = run(server.home, "storage", "restore", out, code=1)
    assert refused["code"] == "home_in_use"
    refused = run(server.home, "storage", "backup", out / "backup.json", code=1)
    assert refused["code"] == "out_unwritable"
    home = tmp_path / "other"
    restored = run(home, "storage", "restore", out)
    assert restored["objects"] == about["objects"]
    again = run(home, "storage", "restore", out, code=1)
    assert again["code"] == "target_not_empty"
    with ServerProcess(home) as other:
        assert other.ask(query, top_k=3).json()["similar_images"] == before
        assert run(home, "storage", "verify", "--originals")["faults"] == []


def test_one_scrape_of_the_embedded_server_has_metrics_of_all_its_parts(
    server: ServerProcess,
) -> None:
    server.indexed(photo_bytes(20))
    assert server.ask(photo_bytes(21)).is_success
    text = read(server.client.get("/metrics").text)
    assert text["placewise_extractor_jobs_total"][(("kind", "index"), ("outcome", "succeeded"))] > 0
    assert text["placewise_search_searches_total"][(("outcome", "answered"),)] > 0
    assert text["placewise_search_rows"][()] > 0
    assert text["placewise_steward_tasks_total"][(("outcome", "done"), ("task", "reclaim_leases"))]
    assert text["placewise_gateway_catalog_up"][()] == 1


def test_what_is_not_there_can_neither_be_backed_up_nor_verified(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for code, *command in (("nothing_stored", "verify"), ("no_backup", "restore", out)):
        assert run(tmp_path / "home", "storage", *command, code=1)["code"] == code
    assert run(tmp_path / "home", "storage", "backup", out, code=1)["code"] == "nothing_stored"
    assert not out.exists()


# --- what the server tells of itself ---------------------------------------------------------


def test_the_first_page_says_what_this_is_and_where_to_look(server: ServerProcess) -> None:
    body = got(server.client.get("/"))
    assert (body["service"], body["status"]) == ("Placewise", "running")
    for link in ("docs", "redoc", "health"):
        assert server.client.get(body[link]).status_code == 200, link
    assert got(server.client.get(body["health"]))["version"] == body["version"]


def test_probes_and_health_say_that_every_part_works(server: ServerProcess) -> None:
    assert got(server.client.get("/livez")) == {"status": "alive"}
    assert got(server.client.get("/readyz")) == {"status": "ready"}
    body = got(server.client.get(f"{API}/health"))
    assert body["status"] == "healthy"
    assert body["uptime_seconds"] > 0
    assert set(body["parts"]) == {
        *("catalog", "object_store", "search", "extractors", "queue", "uploads"),
    }
    assert {part["status"] for part in body["parts"].values()} == {"healthy"}


def test_statistics_follow_uploads_and_deletions(server: ServerProcess) -> None:
    before = got(server.client.get(f"{API}/database/stats"))
    made = server.indexed(photo_bytes(5000))
    after = got(server.client.get(f"{API}/database/stats"))
    for figure in ("total_images", "searchable_images", "recent_uploads_24h"):
        assert after[figure] == before[figure] + 1
    assert after["total_storage_bytes"] > before["total_storage_bytes"] + len(photo_bytes(5000))
    assert after["jobs"]["succeeded"] == before["jobs"]["succeeded"] + 1
    assert after["map_version"] > before["map_version"]
    assert after["feature_dimension"] == 16
    assert after["total_chunks"] >= 1
    assert (after["map"], after["extractor"]) == ("default", "test-tiny-avg")
    assert server.client.delete(f"{API}/uploads/{made}").status_code == 200
    assert got(server.client.get(f"{API}/database/stats"))["total_images"] == before["total_images"]


# --- errors of every call --------------------------------------------------------------------


def test_unknown_paths_and_methods_are_problems_too(server: ServerProcess) -> None:
    problem(server.client.get("/nowhere"), 404, "path_not_found")
    problem(server.client.get(f"{API}/nowhere"), 404, "path_not_found")
    answer = server.client.put(f"{API}/upload")
    problem(answer, 405, "method_not_allowed")
    assert answer.headers["allow"] == "POST"
    problem(server.client.delete("/livez"), 405, "method_not_allowed")


# --- starts that are refused -----------------------------------------------------------------


def refused_start(home: Path, **settings: Any) -> str:
    """What `placewise serve` says when it can't start; a person reads it, so no traceback."""
    ended = run_command("serve", env=environment(home, **settings), cwd=home.parent)
    assert ended.returncode == 1, ended.stderr
    assert "Traceback" not in ended.stderr
    return ended.stderr


def test_a_home_is_served_by_one_process(server: ServerProcess, tmp_path: Path) -> None:
    reported = refused_start(server.home)
    assert reported.startswith("home_in_use: ")
    assert str(server.client.base_url).rstrip("/") in reported
    assert str(server.home) in reported
    assert got(server.client.get("/readyz")), "the first one goes on"
    assert server_address_file(server.home).exists(), "and can still be found"


def test_an_address_in_use_is_refused(server: ServerProcess, tmp_path: Path) -> None:
    port = server.client.base_url.port
    reported = refused_start(tmp_path / "another", port=port)
    assert reported.startswith("address_in_use: ")
    assert f"127.0.0.1:{port}" in reported


# --- its end, and the next start -------------------------------------------------------------


def test_a_restarted_server_resumes_its_jobs(tmp_path: Path) -> None:
    with ServerProcess(tmp_path / "home", batch_photos=1) as server:
        first = server.indexed(photo_bytes(1))
        with server.no_decoding():
            uploads = [server.upload(photo_bytes(n)).json() for n in range(2, 7)]
            server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(timeout=30) == 0, server.log()
        assert not server_address_file(server.home).exists()

        server.start()
        for upload in uploads:
            assert server.finished(upload["job_id"])["state"] == "succeeded"
        found = got(server.similar(first, top_k=100))
        assert {photo["image_id"] for photo in found["similar_images"]} == {
            upload["file_id"] for upload in uploads
        }

        # Ctrl-C ends it as well, also while a client holds a connection open.
        url = server.client.base_url
        with socket.create_connection((url.host, url.port or 80)):
            server.process.send_signal(signal.SIGINT)
            assert server.process.wait(timeout=30) == 0, server.log()
        assert "Traceback" not in server.log()
