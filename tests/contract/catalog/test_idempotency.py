"""Idempotency keys in the catalog: claims, stored responses, expiry."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from uuid import UUID

import pytest
from sqlalchemy import func, select, update

from services.steward.tasks import maintenance
from services.steward.tasks.maintenance import delete_expired_idempotency_keys
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.idempotency import (
    IdempotencyRecord,
    RequestIdentity,
    StoredResponse,
    claim_idempotency_key,
    release_idempotency_key,
    store_response,
)
from shared.errors import Conflict, Unprocessable

CALL = RequestIdentity("someone", "key-1", "POST /api/v1/maps", "f" * 64)
ANSWER = StoredResponse(201, {"Location": "/there"}, '{"name":"citè","b":1,"a":null}')


def claim(
    catalog: Catalog, made: RequestIdentity = CALL, lease_seconds: float = 60
) -> UUID | StoredResponse:
    with catalog.write() as session:
        return claim_idempotency_key(session, made, lease_seconds=lease_seconds, life_seconds=3600)


def token(catalog: Catalog, made: RequestIdentity = CALL, lease_seconds: float = 60) -> UUID:
    claimed = claim(catalog, made, lease_seconds)
    assert isinstance(claimed, UUID)
    return claimed


def keep(catalog: Catalog, held: UUID, answer: StoredResponse = ANSWER) -> None:
    with catalog.write() as session:
        store_response(session, held, answer)


def rows(catalog: Catalog) -> int:
    with catalog.read() as session:
        return session.scalar(select(func.count()).select_from(IdempotencyRecord)) or 0


def expire(catalog: Catalog) -> None:
    with catalog.write() as session:
        session.execute(update(IdempotencyRecord).values(expires_at=db_now_plus(-1)))


def test_a_stored_response_is_replayed_unchanged_to_its_scope_and_key(catalog: Catalog) -> None:
    keep(catalog, token(catalog))
    token(catalog, replace(CALL, scope="someone else"))
    token(catalog, replace(CALL, key="key-2"))
    assert claim(catalog) == ANSWER
    assert claim(catalog) == ANSWER


def test_a_call_in_progress_is_not_started_again(catalog: Catalog) -> None:
    token(catalog)
    with pytest.raises(Conflict) as caught:
        claim(catalog)
    assert caught.value.code == "idempotency_key_in_use"
    assert caught.value.extra["retry_after_seconds"] >= 1


@pytest.mark.parametrize("other", [{"call": "POST /api/v1/upload"}, {"fingerprint": "0" * 64}])
@pytest.mark.parametrize("answered", [True, False])
def test_another_call_under_the_key_is_refused(
    catalog: Catalog, other: dict[str, str], answered: bool
) -> None:
    held = token(catalog)
    if answered:
        keep(catalog, held)
    with pytest.raises(Unprocessable) as caught:
        claim(catalog, replace(CALL, **other))
    assert caught.value.code == "idempotency_key_reused"
    if answered:
        assert claim(catalog) == ANSWER


def test_an_expired_lease_is_taken_over_and_its_holder_can_not_commit(catalog: Catalog) -> None:
    dead = token(catalog, lease_seconds=-1)
    living = token(catalog)
    with pytest.raises(Conflict):
        keep(catalog, dead)
    with catalog.write() as session:
        release_idempotency_key(session, dead)
    keep(catalog, living)
    assert claim(catalog) == ANSWER


def test_an_expired_lease_that_was_not_taken_over_can_commit(
    catalog: Catalog,
) -> None:
    held = token(catalog, lease_seconds=-1)
    keep(catalog, held)
    assert claim(catalog) == ANSWER
    later = StoredResponse(200, {}, '{"state":"done"}')
    keep(catalog, held, later)
    assert claim(catalog) == later
    with catalog.write() as session:
        release_idempotency_key(session, held)
    assert claim(catalog) == later, "what was answered is not given back"


def test_a_released_key_is_free_at_once(catalog: Catalog) -> None:
    held = token(catalog)
    with catalog.write() as session:
        release_idempotency_key(session, held)
    assert rows(catalog) == 0
    token(catalog, replace(CALL, fingerprint="0" * 64))


def test_an_expired_key_is_free_for_any_call(catalog: Catalog) -> None:
    keep(catalog, token(catalog))
    expire(catalog)
    other = replace(CALL, call="POST /api/v1/upload", fingerprint="0" * 64)
    keep(catalog, token(catalog, other), StoredResponse(202, {}, "{}"))
    assert claim(catalog, other) == StoredResponse(202, {}, "{}")
    assert rows(catalog) == 1


def test_one_of_concurrent_claims_gets_the_key(catalog: Catalog) -> None:
    together = threading.Barrier(8)

    def one(_: int) -> bool:
        together.wait(timeout=30)
        try:
            return isinstance(claim(catalog), UUID)
        except Conflict:
            return False

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(one, range(8))) == 1


def test_expired_keys_are_forgotten_and_others_stay(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(maintenance, "RETENTION_ROWS_PER_TRANSACTION", 2)
    for number in range(3):
        keep(catalog, token(catalog, replace(CALL, key=f"old-{number}")))
    expire(catalog)
    keep(catalog, token(catalog))
    left = []
    for _ in range(3):
        delete_expired_idempotency_keys(catalog)
        left.append(rows(catalog))
    assert left == [2, 1, 1]
    assert claim(catalog) == ANSWER
