"""Idempotency keys in the catalog: stored responses, and their expiry."""

from __future__ import annotations

import pytest
from sqlalchemy import func, select, update

from services.steward.tasks import maintenance
from services.steward.tasks.maintenance import delete_expired_idempotency_keys
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.idempotency import StoredResponse, find_response, store_response

SCOPE, KEY, CALL, OTHER_CALL = "someone", "key-1", "f" * 64, "0" * 64
BODY = '{"name":"citè","b":1,"a":null}'


def keep(catalog: Catalog, body: str = BODY, *, key: str = KEY, fingerprint: str = CALL) -> str:
    """Store a response under the key; the body that is stored under it then."""
    new = StoredResponse(
        scope=SCOPE,
        key=key,
        fingerprint=fingerprint,
        status=201,
        headers={"Location": "/there"},
        body=body,
        expires_at=db_now_plus(3600),
    )
    with catalog.write() as session:
        return store_response(session, new).body


def find(catalog: Catalog, scope: str = SCOPE, key: str = KEY, fingerprint: str = CALL) -> object:
    with catalog.read() as session:
        found = find_response(session, scope, key, fingerprint)
        return found and (found.status, found.headers, found.body)


def rows(catalog: Catalog) -> int:
    with catalog.read() as session:
        return session.scalar(select(func.count()).select_from(StoredResponse)) or 0


def expire(catalog: Catalog) -> None:
    with catalog.write() as session:
        session.execute(update(StoredResponse).values(expires_at=db_now_plus(-1)))


def test_expired_keys_are_deleted_and_free_for_any_call(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(maintenance, "RETENTION_ROWS_PER_TRANSACTION", 2)
    for number in range(3):
        keep(catalog, key=f"old-{number}")
    expire(catalog)
    keep(catalog)
    left = []
    for _ in range(3):
        delete_expired_idempotency_keys(catalog)
        left.append(rows(catalog))
    assert left == [2, 1, 1]
    keep(catalog, key="old-0", fingerprint=OTHER_CALL)
