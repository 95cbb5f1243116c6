"""What is secret stands in no log, whatever is done and however much is logged."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from placewise.client import Client
from shared.config.embedded_home import server_address_file
from shared.errors import PlacewiseError
from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess
from tests.support.servers import S3Server

ADMIN = "the-key-in-the-environment-01"
API = "/api/v1"


@pytest.fixture(scope="module")
def server(s3: S3Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """With everything logged, and secrets of every kind."""
    home = tmp_path_factory.mktemp("server") / "home"
    settings = {
        **s3.variables(s3.new_bucket().name),
        "admin_key": ADMIN,
        "debug": True,
        "webhook_private_addresses": True,
    }
    with ServerProcess(home, **settings) as started:
        yield started


def test_no_secret_is_logged(server: ServerProcess, s3: S3Server) -> None:
    url, call = str(server.client.base_url), server.client
    secrets = {"ADMIN_KEY": ADMIN, "S3_SECRET_KEY": s3.secret_key}
    secrets["local key"] = json.loads(server_address_file(server.home).read_text())["key"]
    request = {"name": "someone", "scopes": ["read", "write"]}
    made = call.post(f"{API}/keys", json=request).json()
    secrets["key"] = made["key"]
    hook = {"url": "http://127.0.0.1:9/nobody", "events": ["job.succeeded", "job.failed"]}
    secrets["webhook"] = call.post(f"{API}/webhooks", json=hook).json()["secret"]

    # Used rightly, too little, wrongly, in the wrong place, and no more.
    with Client(url, key=made["key"]) as places, pytest.raises(PlacewiseError):
        places.keys()
    bearer = {"Authorization": f"Bearer {made['key']}"}
    file = {"file": ("street.jpg", photo_bytes(1))}
    uploaded = call.post(f"{API}/upload", files=file, headers=bearer).json()
    server.finished(uploaded["job_id"])
    assert call.get(f"{API}/uploads/{uploaded['file_id']}/image", headers=bearer).is_success
    secrets["mistyped key"] = made["key"][:-1] + "_"
    wrong = {"Authorization": f"Bearer {secrets['mistyped key']}"}
    assert call.get(f"{API}/jobs", headers=wrong).status_code == 401
    basic = {"Authorization": f"Basic {made['key']}"}
    assert call.get(f"{API}/jobs", headers=basic).status_code == 401

    assert call.delete(f"{API}/keys/{made['id']}").is_success
    assert call.get(f"{API}/jobs", headers=bearer).status_code == 401
    assert server.stop() == 0

    log = server.log_path.read_text(errors="replace")
    assert f"GET {API}/jobs" in log, "calls are logged, or else this could not tell"
    assert all(len(secret) > 15 for secret in secrets.values()), "or else they may stand by chance"
    assert [name for name, secret in secrets.items() if secret in log] == []
    stored = b"".join(path.read_bytes() for path in server.home.rglob("*") if path.is_file())
    hashed = {name: secret for name, secret in secrets.items() if name != "webhook"}
    assert [name for name, secret in hashed.items() if secret.encode() in stored] == []
