"""Idempotency keys: the response of a request, under the key that was sent with it.

It is stored in the transaction of the request's effects. Of two processes that execute a request at
the same time, one commits, because `scope` and `key` are unique.
"""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import Index, Integer, Select, String, Text, UniqueConstraint, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import Entity, JsonValue, UtcDateTime, db_now, get_or_insert
from shared.errors import Unprocessable


class StoredResponse(Entity):
    """The response of a request. `scope` is the caller: two callers may use the same key.

    `fingerprint` is the SHA-256 of the request, in hexadecimal; `body` is JSON, as it was sent.
    """

    __tablename__ = "idempotency_keys"

    scope: Mapped[str] = mapped_column(String(200))
    key: Mapped[str] = mapped_column(String(255))
    fingerprint: Mapped[str] = mapped_column(String(64))
    status: Mapped[int] = mapped_column(Integer)
    headers: Mapped[dict[str, str]] = mapped_column(JsonValue)
    body: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    expires_at: Mapped[datetime] = mapped_column(UtcDateTime)

    __table_args__ = (
        UniqueConstraint("scope", "key"),
        Index("ix_idempotency_keys_expires_at", "expires_at"),
    )


def find_response(
    session: Session, scope: str, key: str, fingerprint: str
) -> StoredResponse | None:
    """Return the response of a request, if it was executed.

    Raises:
        Unprocessable: `idempotency_key_reused`: another request was made with the key.
    """
    stored = session.scalar(_select_response(scope, key))
    return None if stored is None else _check_same_request(stored, fingerprint)


def store_response(session: Session, new: StoredResponse) -> StoredResponse:
    """Store a response and return it; if another process was faster, return that one's.

    The caller's transaction must be rolled back then. Raises as `find_response` does.
    """
    stored = get_or_insert(session, _select_response(new.scope, new.key), new)
    return _check_same_request(stored, new.fingerprint)


def _select_response(scope: str, key: str) -> Select[StoredResponse]:
    return select(StoredResponse).where(StoredResponse.scope == scope, StoredResponse.key == key)


def _check_same_request(stored: StoredResponse, fingerprint: str) -> StoredResponse:
    if stored.fingerprint != fingerprint:
        raise Unprocessable(
            "idempotency_key_reused",
            "This Idempotency-Key was used for another request. Use a new key for each request, "
            "and the same key only to repeat one.",
        )
    return stored
