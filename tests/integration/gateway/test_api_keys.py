"""Keys over HTTP: made, shown once, listed, limited to their scopes, expired, revoked."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import select, update

from services.gateway.app import form_paths
from shared.catalog.api_keys import ApiKey
from shared.catalog.photos import Photo
from shared.ids import new_id
from shared.security.api_keys import hash_api_key
from shared.storage import FolderStore
from tests.integration.api_with_keys import ADMIN, Door
from tests.support.photos import photo_bytes
from tests.support.problems import problem
from tools.make_api_page import openapi_description


def test_a_key_is_shown_once_and_kept_as_a_hash(door: Door) -> None:
    made = door.key("read", "write")
    key = made.pop("key")
    assert key.startswith(made["prefix"])
    assert door(ADMIN, "GET", "/keys").json() == [made]
    with door.catalog.read() as session:
        row = session.scalars(select(ApiKey)).one()
    assert row.sha256 == hash_api_key(key)
    assert key not in str(vars(row))


def test_each_scope_allows_its_calls_alone(door: Door, store: FolderStore) -> None:
    reads, writes = door.key("read")["key"], door.key("write")["key"]
    rules = door.key("admin")["key"]
    assert door(reads, "GET", "/jobs").status_code == 200
    problem(door.put(reads), 403, "scope_missing")
    assert list(store.list("")) == [], "a refused upload stores nothing"
    problem(door(reads, "GET", "/keys"), 403, "scope_missing")
    stored = door.put(writes)
    assert stored.status_code == 202
    photo = f"/uploads/{stored.json()['file_id']}"
    assert door(reads, "GET", f"{photo}/image").content == photo_bytes(1)
    problem(door(reads, "GET", f"{photo}/thumbnail"), 404, "thumbnail_not_found")
    for part in ("image", "thumbnail"):
        problem(door(writes, "GET", f"{photo}/{part}"), 403, "scope_missing")
    assert problem(door(writes, "GET", "/jobs"), 403, "scope_missing")["needed"] == ["read"]
    problem(door(writes, "POST", "/keys", json={}), 403, "scope_missing")
    for call in (door(rules, "GET", "/jobs"), door(rules, "GET", "/keys"), door.put(rules)):
        assert call.is_success


def test_a_revoked_key_is_refused(door: Door) -> None:
    made = door.key("read")
    assert door(made["key"], "GET", "/jobs").status_code == 200
    revoked = door(ADMIN, "DELETE", f"/keys/{made['id']}").json()
    assert revoked["revoked_at"] is not None
    problem(door(made["key"], "GET", "/jobs"), 401, "key_revoked")
    again = door(ADMIN, "DELETE", f"/keys/{made['id']}").json()
    assert again["revoked_at"] == revoked["revoked_at"]
    assert [key["id"] for key in door(ADMIN, "GET", "/keys").json()] == [made["id"]]
    problem(door(ADMIN, "DELETE", f"/keys/{made['id'][:-4]}0000"), 404, "key_not_found")


def test_an_expired_key_is_refused(door: Door) -> None:
    made = door.key("read", days=1)
    left = datetime.fromisoformat(made["expires_at"]) - datetime.fromisoformat(made["created_at"])
    assert abs(left - timedelta(days=1)) < timedelta(minutes=1)
    assert door(made["key"], "GET", "/jobs").status_code == 200
    with door.catalog.write() as session:
        session.execute(update(ApiKey).values(expires_at=datetime(2020, 1, 1, tzinfo=UTC)))
    problem(door(made["key"], "GET", "/jobs"), 401, "key_expired")


def test_the_last_use_is_noted_once_a_minute(door: Door) -> None:
    made = door.key("read")

    def used() -> Any:
        return door(ADMIN, "GET", "/keys").json()[0]["last_used_at"]

    assert used() is None
    door(made["key"], "GET", "/jobs")
    first = used()
    assert first is not None
    door(made["key"], "GET", "/jobs")
    assert used() == first
    with door.catalog.write() as session:
        session.execute(update(ApiKey).values(last_used_at=datetime(2020, 1, 1, tzinfo=UTC)))
    door(made["key"], "GET", "/jobs")
    assert datetime.fromisoformat(used()) >= datetime.fromisoformat(first)


def test_a_photo_says_which_key_it_came_in_with(door: Door) -> None:
    made = door.key("write")
    door.put(made["key"], 1)
    door.put(ADMIN, 2)
    with door.catalog.read() as session:
        found = session.scalars(select(Photo.key_id).order_by(Photo.id)).all()
    assert [key_id and str(key_id) for key_id in found] == [made["id"], None]


@pytest.mark.parametrize(
    "params",
    [
        {},
        {"name": "x", "scopes": []},
        {"name": "x", "scopes": ["read"], "days": 0},
        {"name": "x\0", "scopes": ["read"]},
        {"name": "x", "scopes": ["read"], "maps": ["a\0"]},
        {"name": "x", "scopes": ["read"], "maps": ["*"]},
        {"name": "x", "scopes": ["read"], "key": "chosen"},
    ],
)
def test_a_key_that_can_not_be_made_is_refused(door: Door, params: dict[str, Any]) -> None:
    problem(door(ADMIN, "POST", "/keys", json=params), 422, "invalid_field")
    assert door(ADMIN, "GET", "/keys").json() == []


# --- keys for some maps ----------------------------------------------------------------------

ALL_MAPS_CALLS = {
    "GET /api/v1/health",
    "GET /api/v1/models",
    "GET /api/v1/models/{name}",
    "GET /metrics",
    "POST /api/v1/maps",
}
"""Calls about no map or all maps; a key for some maps has no admin scope."""


def calls() -> list[tuple[str, str]]:
    """Method and path template of each call that needs a key."""
    found = [
        (method.upper(), path)
        for path, methods in openapi_description()["paths"].items()
        for method in methods
        if path.startswith(("/api/", "/metrics"))
    ]
    assert len(found) > 40
    return found


def refusal(door: Door, key: str, method: str, path: str, maps: list[str]) -> str | None:
    """The code of a 403, for a call that selects these maps; `name` in paths is the map b."""
    filled = re.sub(r"\{(\w+)\}", lambda m: "b" if m[1] == "name" else str(new_id()), path)
    answer = door.call(key, method, filled, params={"map": maps})
    return answer.json()["code"] if answer.status_code == 403 else None


@pytest.fixture
def limited(door: Door) -> str:
    """A key for the map a, beside which there is a map b."""
    for name in ("a", "b"):
        assert door(ADMIN, "POST", "/maps", json={"name": name}).status_code == 201
    key: str = door.key("read", "write", maps=["a"])["key"]
    return key


def test_no_call_takes_two_maps_of_which_a_key_has_one(door: Door, limited: str) -> None:
    for method, path in calls():
        for maps in (["a", "b"], ["b", "a"]):
            filled = re.sub(r"\{\w+\}", str(new_id()), path)
            answer = door.call(limited, method, filled, params={"map": maps})
            assert answer.status_code in (403, 422), (method, path)


@pytest.mark.parametrize("maps", [["b"], []], ids=str)
def test_every_call_refuses_a_key_of_another_map(door: Door, limited: str, maps: list[str]) -> None:
    open_calls = [
        f"{method} {path}"
        for method, path in calls()
        if refusal(door, limited, method, path, maps) not in ("map_not_allowed", "scope_missing")
    ]
    assert open_calls == ["GET /api/v1/maps"], "which lists the maps of the key"
    assert [m["name"] for m in door(limited, "GET", "/maps", params={"map": maps}).json()] == ["a"]


def test_a_key_of_a_map_is_allowed_the_calls_of_its_map_alone(door: Door, limited: str) -> None:
    closed = {
        f"{method} {path}"
        for method, path in calls()
        if "/maps/" not in path and refusal(door, limited, method, path, ["a"]) == "map_not_allowed"
    }
    assert closed == ALL_MAPS_CALLS
    assert door(limited, "GET", "/maps/a").status_code == 200
    assert door(limited, "GET", "/maps/b", params={"map": "a"}).status_code == 403
    photo = {"files": {"file": ("photo.jpg", photo_bytes(1))}, "params": {"map": "a"}}
    assert door(limited, "POST", "/upload", **photo).status_code == 202


def test_the_calls_that_receive_a_form_are_those_without_a_limit_on_its_body(door: Door) -> None:
    paths = openapi_description()["paths"]
    forms = [
        path
        for path, methods in paths.items()
        for call in methods.values()
        if "multipart/form-data" in call.get("requestBody", {}).get("content", {})
    ]
    assert len(forms) >= 6
    for path in paths:
        filled = re.sub(r"\{\w+\}", str(new_id()), path)
        assert (form_paths().fullmatch(filled) is not None) == (path in forms), path


def test_a_key_for_some_maps_is_listed_with_them_and_can_not_be_an_admin(door: Door) -> None:
    assert door.key("read", maps=["b", "a", "b"])["maps"] == ["a", "b"]
    assert door.key("read")["maps"] is None
    params = {"name": "x", "scopes": ["admin"], "maps": ["a"]}
    body = problem(door(ADMIN, "POST", "/keys", json=params), 422, "invalid_field")
    assert "admin" in body["detail"]
    params = {"name": "x", "scopes": ["read"], "maps": []}
    problem(door(ADMIN, "POST", "/keys", json=params), 422, "invalid_field")
