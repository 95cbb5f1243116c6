"""Idempotency keys: the request made with a key, and its stored response.

```
            claim: lease + token                  store_response, with a valid token
  (no row) ───────────────────────────> IN FLIGHT ─────────────────────────────────────> ANSWERED
     ^                                   │  │  ^                                            │
     │  release: it had no effect        │  │  │ claim: the lease has expired, because      │
     ├───────────────────────────────────┘  └──┘ its process died; a new token              │
     └──────────────────────────────────────────────────────────────── expires_at ──────────┘
```
The response is stored in the transaction of the request's effects, and only with a valid token: of
two processes that claim a key one after the other, at most one commits.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy import Index, Integer, String, Text, UniqueConstraint, Uuid, delete, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import (
    Base,
    JsonValue,
    UtcDateTime,
    affected_rows,
    db_now,
    db_now_plus,
)
from shared.errors import Conflict, Unprocessable
from shared.ids import new_id

IN_USE_RETRY_SECONDS = 1


class IdempotencyRecord(Base):
    """A request with a key. `scope` is the caller: two callers may use the same key."""

    __tablename__ = "idempotency_keys"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    scope: Mapped[str] = mapped_column(String(200))
    key: Mapped[str] = mapped_column(String(255))
    call: Mapped[str] = mapped_column(Text)  # method and path
    fingerprint: Mapped[str] = mapped_column(String(64))
    token: Mapped[UUID] = mapped_column(Uuid, index=True)
    lease_until: Mapped[datetime] = mapped_column(UtcDateTime)
    status: Mapped[int | None] = mapped_column(Integer)  # of the response; null while in flight
    headers: Mapped[dict[str, str] | None] = mapped_column(JsonValue)
    body: Mapped[str | None] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    expires_at: Mapped[datetime] = mapped_column(UtcDateTime)

    __table_args__ = (
        UniqueConstraint("scope", "key"),
        Index("ix_idempotency_keys_expires_at", "expires_at"),
    )


@dataclass(frozen=True, slots=True)
class RequestIdentity:
    """Identifies a request: distinguishes a repetition from another request with the same key."""

    scope: str
    key: str
    call: str
    fingerprint: str
    """SHA-256 of the whole request, in hexadecimal."""


@dataclass(frozen=True, slots=True)
class StoredResponse:
    """The response of a request, to be repeated."""

    status: int
    headers: dict[str, str]
    body: str
    """JSON, as it was sent."""


def claim_idempotency_key(
    session: Session, request: RequestIdentity, *, lease_seconds: float, life_seconds: float
) -> UUID | StoredResponse:
    """Claim the key for a request.

    Args:
        lease_seconds: Time after which another process may take the request over.
        life_seconds: Time for which the key and its response are stored.

    Returns:
        A token with which the request may be executed, or its stored response.

    Raises:
        Unprocessable: `idempotency_key_reused`: another request was made with the key.
        Conflict: `idempotency_key_in_use`: the same request is being executed.
    """
    while True:
        token = _insert(session, request, lease_seconds, life_seconds)
        if token is not None:
            return token
        result = session.execute(
            select(
                IdempotencyRecord,
                (IdempotencyRecord.expires_at <= db_now()).label("expired"),
                (IdempotencyRecord.lease_until > db_now()).label("is_leased"),
            )
            .where(IdempotencyRecord.scope == request.scope, IdempotencyRecord.key == request.key)
            .with_for_update()
            .execution_options(populate_existing=True)
        ).one_or_none()
        if result is None:
            continue  # released since the insert failed
        row, expired, is_leased = result
        if not expired:
            if (row.call, row.fingerprint) != (request.call, request.fingerprint):
                raise Unprocessable(
                    "idempotency_key_reused",
                    "This Idempotency-Key was used for another request. Use a new key for each "
                    "request, and the same key only to repeat one.",
                )
            if row.status is not None:
                return StoredResponse(row.status, row.headers or {}, row.body or "")
            if is_leased:
                raise _key_in_use_error()
        row.call, row.fingerprint = request.call, request.fingerprint
        row.token = new_id()
        row.lease_until = db_now_plus(lease_seconds)
        row.expires_at = db_now_plus(life_seconds)
        row.status = row.headers = row.body = None
        session.flush()
        return row.token


def store_response(session: Session, token: UUID, response: StoredResponse) -> None:
    """Store the response of the request.

    Raises:
        Conflict: `idempotency_key_in_use`: the lease expired and another process executes the
            request. The caller's transaction must be rolled back.
    """
    updated = session.execute(
        update(IdempotencyRecord)
        .where(IdempotencyRecord.token == token)
        .values(status=response.status, headers=response.headers, body=response.body)
        .execution_options(synchronize_session=False)
    )
    if not affected_rows(updated):
        raise _key_in_use_error()


def release_idempotency_key(session: Session, token: UUID) -> None:
    """Release the key of a request that had no effect, so that it may be repeated at once."""
    session.execute(
        delete(IdempotencyRecord).where(
            IdempotencyRecord.token == token, IdempotencyRecord.status.is_(None)
        )
    )


def _key_in_use_error() -> Conflict:
    return Conflict(
        "idempotency_key_in_use",
        "A request with this Idempotency-Key is still being processed. Repeat it a little later.",
        retry_after_seconds=IN_USE_RETRY_SECONDS,
    )


def _insert(
    session: Session, request: RequestIdentity, lease_seconds: float, life_seconds: float
) -> UUID | None:
    """Insert a row and return its token; None if the key already has a row."""
    token = new_id()
    try:
        with session.begin_nested():
            session.add(
                IdempotencyRecord(
                    scope=request.scope,
                    key=request.key,
                    call=request.call,
                    fingerprint=request.fingerprint,
                    token=token,
                    lease_until=db_now_plus(lease_seconds),
                    expires_at=db_now_plus(life_seconds),
                )
            )
            session.flush()
    except IntegrityError:
        return None
    return token
