"""Keys over HTTP: made, shown once, listed, limited to their scopes, expired, revoked."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import select, update
from starlette.datastructures import Headers

from services.gateway.authentication import ApiKeyAuthenticator
from shared.catalog.api_keys import ApiKey
from shared.catalog.photos import Photo
from shared.security.api_keys import hash_api_key
from shared.storage import FolderStore
from tests.integration.api_with_keys import ADMIN, Door
from tests.support.photos import photo_bytes
from tests.support.problems import problem


def test_a_key_is_shown_once_and_kept_as_a_hash(door: Door) -> None:
    made = door.key("read", "write")
    key = made.pop("key")
    assert key.startswith(made["prefix"])
    assert door(ADMIN, "GET", "/keys").json() == [made]
    with door.catalog.read() as session:
        row = session.scalars(select(ApiKey)).one()
    assert row.sha256 == hash_api_key(key)
    assert key not in str(vars(row))


def test_each_scope_opens_its_calls_and_no_others(door: Door) -> None:
    reads, writes = door.key("read")["key"], door.key("write")["key"]
    rules = door.key("admin")["key"]
    assert door(reads, "GET", "/jobs").status_code == 200
    problem(door.put(reads), 403, "scope_missing")
    problem(door(reads, "GET", "/keys"), 403, "scope_missing")
    assert door.put(writes).status_code == 202
    assert problem(door(writes, "GET", "/jobs"), 403, "scope_missing")["needed"] == ["read"]
    problem(door(writes, "POST", "/keys", json={}), 403, "scope_missing")
    for call in (door(rules, "GET", "/jobs"), door(rules, "GET", "/keys"), door.put(rules)):
        assert call.is_success


def test_originals_and_thumbnails_are_for_those_who_may_read(door: Door) -> None:
    file_id = door.put(ADMIN).json()["file_id"]
    reads, writes = door.key("read")["key"], door.key("write")["key"]
    image = f"/uploads/{file_id}/image"
    assert door(reads, "GET", image).content == photo_bytes(1)
    problem(door(reads, "GET", f"/uploads/{file_id}/thumbnail"), 404, "thumbnail_not_found")
    for path in (image, f"/uploads/{file_id}/thumbnail"):
        problem(door(writes, "GET", path), 403, "scope_missing")


def test_a_refused_upload_stores_nothing(door: Door, store: FolderStore) -> None:
    problem(door.put(door.key("read")["key"]), 403, "scope_missing")
    assert list(store.list("")) == []


def test_a_revoked_key_opens_nothing_from_then_on(door: Door) -> None:
    made = door.key("read")
    assert door(made["key"], "GET", "/jobs").status_code == 200
    revoked = door(ADMIN, "DELETE", f"/keys/{made['id']}").json()
    assert revoked["revoked_at"] is not None
    problem(door(made["key"], "GET", "/jobs"), 401, "key_revoked")
    again = door(ADMIN, "DELETE", f"/keys/{made['id']}").json()
    assert again["revoked_at"] == revoked["revoked_at"]
    assert [key["id"] for key in door(ADMIN, "GET", "/keys").json()] == [made["id"]]
    problem(door(ADMIN, "DELETE", f"/keys/{made['id'][:-4]}0000"), 404, "key_not_found")


def test_an_expired_key_opens_nothing(door: Door) -> None:
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
    # Another gateway, which has not seen the key yet, leaves a fresh note as it is.
    keys = ApiKeyAuthenticator(door.catalog)
    caller = asyncio.run(keys.authenticate(Headers({"authorization": f"Bearer {made['key']}"})))
    asyncio.run(keys.record_use(caller))
    assert used() == first


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
        {"name": "", "scopes": ["read"]},
        {"name": "x", "scopes": []},
        {"name": "x", "scopes": ["root"]},
        {"name": "x", "scopes": ["read"], "days": 0},
        {"name": "x", "scopes": ["read"], "max_photos": 0},
        {"name": "x\0", "scopes": ["read"]},
        {"name": "x", "scopes": ["read"], "key": "chosen"},
    ],
)
def test_a_key_that_can_not_be_made_is_refused(door: Door, params: dict[str, Any]) -> None:
    problem(door(ADMIN, "POST", "/keys", json=params), 422, "invalid_field")
    assert door(ADMIN, "GET", "/keys").json() == []
