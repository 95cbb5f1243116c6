"""What a stranger once broke, and may try again."""

from __future__ import annotations

import json

import psutil
import pytest

from tests.support.memory import memory_bytes
from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess


def nested(levels: int) -> str:
    return '{"a":' * levels + "1" + "}" * levels


@pytest.mark.parametrize("levels", [33, 3000])
def test_deeply_nested_metadata_is_refused_and_spoils_no_answer(
    server: ServerProcess, levels: int
) -> None:
    retained = server.indexed(photo_bytes(1), metadata=nested(32))
    refused = server.upload(photo_bytes(2), metadata=nested(levels))
    assert refused.status_code == 422
    assert "metadata" in refused.json()["detail"]
    patched = server.client.patch(
        f"/api/v1/uploads/{retained}",
        content=f'{{"metadata": {nested(levels)}}}',
        headers={"content-type": "application/json"},
    )
    assert patched.status_code in (400, 422)
    assert patched.json()["code"] in ("malformed_body", "invalid_field")
    assert server.client.get(f"/api/v1/uploads/{retained}").json()["metadata"] == json.loads(
        nested(32)
    )
    assert server.client.get("/api/v1/search").status_code == 200


def test_a_large_json_body_is_refused_and_the_connection_stays_usable(
    server: ServerProcess,
) -> None:
    retained = server.indexed(photo_bytes(1), metadata=nested(32))
    for size, code in ((2_000_000, "body_too_large"), (500_000, "fields_too_large")):
        answer = server.client.patch(
            f"/api/v1/uploads/{retained}", json={"metadata": {"a": "x" * size}}
        )
        assert answer.status_code == 413
        assert answer.json()["code"] == code
    small = server.client.patch(f"/api/v1/uploads/{retained}", json={"place": "hall"})
    assert small.json()["place"] == "hall"


def test_a_photo_may_be_larger_than_a_json_body(server: ServerProcess) -> None:
    large = photo_bytes(7, "BMP") + b"\0" * 3_000_000
    assert server.upload(large, "large.bmp").status_code == 202


def test_probes_may_ask_for_the_head_alone(server: ServerProcess) -> None:
    for path in ("/", "/livez", "/readyz", "/api/v1/health"):
        answer = server.client.head(path)
        assert (answer.status_code, answer.content) == (200, b""), path


@pytest.mark.parametrize("item", ["{}", "[]", "1", '""', '{"":0}'])
def test_a_body_of_millions_of_items_is_refused_in_seconds_and_without_memory(
    server: ServerProcess, item: str
) -> None:
    camera = '{"model":"PINHOLE","width":9,"height":9,"params":[9,9,4,4]}'
    items = ",".join([item] * (12_000_000 // (len(item) + 1)))
    process = psutil.Process(server.process.pid)
    started, before = sum(process.cpu_times()[:2]), memory_bytes("VmHWM", process.pid)
    answer = server.client.post(
        "/api/v1/reconstructions/import",
        content=f'{{"cameras":[{camera}],"photos":[{items}]}}',
        headers={"content-type": "application/json"},
    )
    assert (answer.status_code, answer.json()["code"]) == (413, "too_many_values")
    assert sum(process.cpu_times()[:2]) - started < 5
    assert memory_bytes("VmHWM", process.pid) - before < 300_000_000
