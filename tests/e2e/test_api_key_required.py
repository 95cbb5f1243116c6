"""Beyond loopback every call needs a key; on loopback none does."""

from __future__ import annotations

import json
import re
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest

from services.http_server import lan_url
from shared.config.embedded_home import server_address_file
from tests.support.photos import photo_bytes
from tests.support.problems import problem
from tests.support.server import ServerProcess, environment, run_command

API = "/api/v1"
SETTINGS = {"host": "0.0.0.0"}
CHOSEN = "a-key-of-ones-own-0123456789"


def shown_key(server: ServerProcess) -> str:
    """The key as the last start has printed it."""
    found = re.findall(r"export PLACEWISE_KEY=(pw_\S+)", server.log())
    assert found, server.log()
    key: str = found[-1]
    return key


@pytest.fixture(scope="module")
def key(server: ServerProcess) -> str:
    return shown_key(server)


@pytest.fixture
def stranger(server: ServerProcess) -> Iterator[httpx2.Client]:
    """Somebody who reaches the server and has no key."""
    with httpx2.Client(base_url=server.client.base_url, timeout=30) as client:
        yield client


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


# --- calls -----------------------------------------------------------------------------------


def test_the_start_and_the_page_name_the_address_for_a_phone(
    server: ServerProcess, stranger: httpx2.Client
) -> None:
    url = lan_url("0.0.0.0", stranger.base_url.port or 80)
    assert url is not None, "this machine has no network"
    assert f"phone:    {url} " in server.log()
    assert stranger.get("/console/settings.json").json()["lan_url"] == url


def test_probes_and_descriptions_are_open(stranger: httpx2.Client) -> None:
    for path in ("/", "/livez", "/readyz", "/docs", "/redoc", "/openapi.json", "/console/app.js"):
        assert stranger.get(path).status_code == 200, path
    # No way out of the page's folder, and no other folder that begins alike.
    for path in ("/console/../api/v1/maps", "/console/%2e%2e/api/v1/maps", "/console"):
        assert stranger.get(path).status_code in (401, 404), path


def test_every_call_says_which_scope_it_needs(stranger: httpx2.Client) -> None:
    described = stranger.get("/openapi.json").json()
    assert described["components"]["securitySchemes"]["key"]["scheme"] == "bearer"
    calls = 0
    for path, methods in described["paths"].items():
        for call in methods.values():
            if not path.startswith(API) and path != "/metrics":
                assert "security" not in call, path
                continue
            ((scope,),) = (needed["key"] for needed in call["security"])
            assert scope in ("read", "write", "admin"), path
            assert {"401", "403", "429"} <= call["responses"].keys(), path
            calls += 1
    assert calls > 40


@pytest.mark.parametrize("path", ["/nowhere", f"{API}/nowhere", "/docs/x", f"/docs%2F..{API}/jobs"])
def test_calls_without_a_key_are_401_on_unknown_paths_too(
    stranger: httpx2.Client, path: str
) -> None:
    problem(stranger.get(path), 401, "key_missing")


def test_the_printed_key_authorises_every_call(
    server: ServerProcess, stranger: httpx2.Client, key: str
) -> None:
    photo = {"file": ("mine.jpg", photo_bytes(1))}
    stored = stranger.post(f"{API}/upload", files=photo, headers=bearer(key))
    assert stored.status_code == 202
    job = stored.json()["status_url"]
    ended = stranger.get(job, params={"wait": 30}, headers=bearer(key)).json()
    assert ended["state"] == "succeeded", "long polls, too"
    problem(stranger.get(job), 401, "key_missing")
    image = f"{API}/uploads/{stored.json()['file_id']}/image"
    assert stranger.get(image, headers=bearer(key)).content == photo_bytes(1)
    problem(stranger.get(image), 401, "key_missing")
    problem(stranger.get(image, params={"key": key}), 401, "key_missing")


def test_an_upload_without_a_key_is_refused_before_its_body(server: ServerProcess) -> None:
    url = server.client.base_url
    head = (
        f"POST {API}/upload HTTP/1.1\r\nHost: {url.host}\r\nContent-Length: 5000000\r\n"
        "Content-Type: multipart/form-data; boundary=x\r\n\r\n"
    )
    with socket.create_connection((url.host, url.port or 80), timeout=10) as connection:
        connection.sendall(head.encode())  # and not one byte of the body
        assert connection.recv(4096).startswith(b"HTTP/1.1 401 ")


# --- commands --------------------------------------------------------------------------------


def test_commands_of_the_same_user_need_no_key(server: ServerProcess, tmp_path: Path) -> None:
    env = environment(server.home)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "one.jpg").write_bytes(photo_bytes(2))
    for command in (
        ("index", tmp_path / "photos", "--json"),
        ("query", tmp_path / "photos" / "one.jpg", "--json"),
        ("vocabulary", "list", "--json"),
        ("doctor", "--json"),
    ):
        ended = run_command(*command, env=env, cwd=tmp_path)
        assert ended.returncode == 0, ended.stdout + ended.stderr
    assert stat.S_IMODE(server_address_file(server.home).stat().st_mode) == 0o600


def test_commands_with_a_servers_address_need_its_key(
    server: ServerProcess, key: str, tmp_path: Path
) -> None:
    photo = tmp_path / "one.jpg"
    photo.write_bytes(photo_bytes(2))
    env = environment(tmp_path / "elsewhere", placewise_server=server.client.base_url)
    command = ("query", photo, "--json")
    refused = run_command(*command, env=env, cwd=tmp_path)
    assert refused.returncode == 1
    assert json.loads(refused.stdout)["code"] == "key_missing"
    assert "PLACEWISE_KEY" in json.loads(refused.stdout)["detail"]
    given = {**env, "PLACEWISE_KEY": key}
    assert run_command(*command, env=given, cwd=tmp_path).returncode == 0
    assert run_command(*command, "--key", key, env=env, cwd=tmp_path).returncode == 0
    wrong = run_command(*command, "--key", "pw_wrong", env=given, cwd=tmp_path)
    assert json.loads(wrong.stdout)["code"] == "key_unknown"


# --- starts ----------------------------------------------------------------------------------


def test_a_restart_keeps_the_key_and_another_one_replaces_it(tmp_path: Path) -> None:
    with ServerProcess(tmp_path / "home", host="0.0.0.0", debug=True) as server:
        first = shown_key(server)

        def opens(key: str) -> bool:
            answer = server.client.get(f"{API}/jobs", headers=bearer(key))
            return answer.status_code == 200

        assert opens(first)
        local = json.loads(server_address_file(server.home).read_text())["key"]
        assert opens(local)
        assert server.stop() == 0
        server.log_path.unlink()

        server.start()
        assert first not in server.log()
        assert "keys create" in server.log()
        assert opens(first)
        assert not opens(local), "good until that server ended"

        env = environment(server.home)
        made = run_command("keys", "create", "another", "--scope", "admin", env=env, cwd=tmp_path)
        assert made.returncode == 0, made.stderr
        second = made.stdout.strip()
        assert opens(second), "while the server runs"
        revoked = run_command("keys", "revoke", first[:11], env=env, cwd=tmp_path)
        assert revoked.returncode == 0, revoked.stderr
        assert not opens(first)
        assert opens(second)
        written = [path.read_bytes() for path in server.home.rglob("*") if path.is_file()]
        assert not any(key.encode() in data for key in (first, second) for data in written)


def test_a_key_made_before_the_first_start_is_the_admins(tmp_path: Path) -> None:
    env = environment(tmp_path / "home")
    made = run_command("keys", "create", "me", "--scope", "admin", env=env, cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    with ServerProcess(tmp_path / "home", host="0.0.0.0") as server:
        assert "PLACEWISE_KEY=" not in server.log(), "no other one was needed"
        headers = bearer(made.stdout.strip())
        assert server.client.get(f"{API}/keys", headers=headers).json()[0]["name"] == "me"


def test_a_chosen_key_is_the_key_also_on_loopback(tmp_path: Path) -> None:
    with ServerProcess(tmp_path / "home", admin_key=CHOSEN) as server:
        url = f"{str(server.client.base_url).rstrip('/')}{API}/jobs"
        problem(httpx2.get(url), 401, "key_missing")
        assert httpx2.get(url, headers=bearer(CHOSEN)).status_code == 200
        assert CHOSEN not in server.log()
        shown = run_command("config", env=environment(server.home, admin_key=CHOSEN), cwd=tmp_path)
        assert CHOSEN not in shown.stdout + shown.stderr


def test_loopback_needs_no_key(tmp_path: Path) -> None:
    with ServerProcess(tmp_path / "home", host="::1") as server:
        assert "authorization" not in server.client.headers
        assert server.client.get(f"{API}/jobs").status_code == 200
        assert "PLACEWISE_KEY" not in server.log()
        assert server.client.get(f"{API}/keys").json() == []
