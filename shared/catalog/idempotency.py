"""Idempotency keys: which call was made under a key, and what it was answered.

```
            claim_key: lease + token              keep_answer, the token still its own
  (no row) ───────────────────────────> IN FLIGHT ─────────────────────────────────────> ANSWERED
     ^                                   │  │  ^                                            │
     │  release_key: no effect was made  │  │  │ claim_key: the lease has expired,          │
     ├───────────────────────────────────┘  └──┘ its process died; a fresh token            │
     └──────────────────────────────────────────────────────────────── expires_at ──────────┘
```
The answer is kept in the transaction that makes the effect, and only under the token: of two that
hold a key after each other, one at most commits.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy import Index, Integer, String, Text, UniqueConstraint, Uuid, delete, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, JsonValue, UtcDateTime, affected_rows, db_now, db_now_plus
from shared.errors import Conflict, Unprocessable
from shared.ids import new_id

IN_USE_RETRY_SECONDS = 1


class IdempotencyRecord(Base):
    """One call under a key. `scope` is whose key it is: two callers may choose the same one."""

    __tablename__ = "idempotency_keys"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    scope: Mapped[str] = mapped_column(String(200))
    key: Mapped[str] = mapped_column(String(255))
    call: Mapped[str] = mapped_column(Text)  # method and path
    fingerprint: Mapped[str] = mapped_column(String(64))
    token: Mapped[UUID] = mapped_column(Uuid, index=True)
    lease_until: Mapped[datetime] = mapped_column(UtcDateTime)
    status: Mapped[int | None] = mapped_column(Integer)  # of the answer; null while in flight
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
    """What tells a repeated call from another one under the same key."""

    scope: str
    key: str
    call: str
    fingerprint: str
    """SHA-256 of everything that the call says, in hexadecimal."""


@dataclass(frozen=True, slots=True)
class StoredResponse:
    status: int
    headers: dict[str, str]
    body: str
    """JSON, as it was sent."""


def claim_idempotency_key(
    session: Session, request: RequestIdentity, *, lease_seconds: float, life_seconds: float
) -> UUID | StoredResponse:
    """A token under which the call may be done, or the answer that it was given already.

    Raises Unprocessable (`idempotency_key_reused`) when another call was made under the key, and
    Conflict (`idempotency_key_in_use`) while the same call is under way.
    """
    while True:
        token = _insert(session, request, lease_seconds, life_seconds)
        if token is not None:
            return token
        found = session.execute(
            select(
                IdempotencyRecord,
                (IdempotencyRecord.expires_at <= db_now()).label("expired"),
                (IdempotencyRecord.lease_until > db_now()).label("held"),
            )
            .where(IdempotencyRecord.scope == request.scope, IdempotencyRecord.key == request.key)
            .with_for_update()
            .execution_options(populate_existing=True)
        ).one_or_none()
        if found is None:
            continue  # given back since the insert met it
        row, expired, held = found
        if not expired:
            if (row.call, row.fingerprint) != (request.call, request.fingerprint):
                raise Unprocessable(
                    "idempotency_key_reused",
                    "Another call was made with this Idempotency-Key. Take a new key for each "
                    "call, and the same one only to repeat it.",
                )
            if row.status is not None:
                return StoredResponse(row.status, row.headers or {}, row.body or "")
            if held:
                raise key_in_use_error()
        row.call, row.fingerprint = request.call, request.fingerprint
        row.token = new_id()
        row.lease_until = db_now_plus(lease_seconds)
        row.expires_at = db_now_plus(life_seconds)
        row.status = row.headers = row.body = None
        session.flush()
        return row.token


def store_response(session: Session, token: UUID, response: StoredResponse) -> None:
    """The call's answer from now on. Conflict (`idempotency_key_in_use`), which must undo the
    caller's transaction, when the lease has expired and someone else does the call."""
    kept = session.execute(
        update(IdempotencyRecord)
        .where(IdempotencyRecord.token == token)
        .values(status=response.status, headers=response.headers, body=response.body)
        .execution_options(synchronize_session=False)
    )
    if not affected_rows(kept):
        raise key_in_use_error()


def release_idempotency_key(session: Session, token: UUID) -> None:
    """The call has had no effect: it may be made again at once."""
    session.execute(
        delete(IdempotencyRecord).where(
            IdempotencyRecord.token == token, IdempotencyRecord.status.is_(None)
        )
    )


def key_in_use_error() -> Conflict:
    return Conflict(
        "idempotency_key_in_use",
        "The same call is under way with this Idempotency-Key. Repeat it a little later.",
        retry_after_seconds=IN_USE_RETRY_SECONDS,
    )


def _insert(
    session: Session, made: RequestIdentity, lease_seconds: float, life_seconds: float
) -> UUID | None:
    """The new row's token; None when the key has a row."""
    token = new_id()
    try:
        with session.begin_nested():
            session.add(
                IdempotencyRecord(
                    scope=made.scope,
                    key=made.key,
                    call=made.call,
                    fingerprint=made.fingerprint,
                    token=token,
                    lease_until=db_now_plus(lease_seconds),
                    expires_at=db_now_plus(life_seconds),
                )
            )
            session.flush()
    except IntegrityError:
        return None
    return token
