"""Keys: who may call, what they may do, and how much of it. Only hashes of keys are kept.

A revoked or expired key stays as a row, so that lists and logs can still say whose it was.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy import BigInteger, Integer, String, Text, Uuid, func, or_, select, update
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, JsonValue, UtcDateTime, db_now, db_now_plus
from shared.catalog.photos import Photo
from shared.errors import NotFound, Unauthorized
from shared.ids import new_id
from shared.security.api_keys import Scope, api_key_prefix, generate_api_key, hash_api_key

LAST_USED_RESOLUTION_SECONDS = 60.0  # `last_used_at` is no finer


class ApiKey(Base):
    """One key. A limit that is null is the one of the settings."""

    __tablename__ = "api_keys"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(Text)
    prefix: Mapped[str] = mapped_column(String(20))
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    scopes: Mapped[list[str]] = mapped_column(JsonValue)
    requests_per_minute: Mapped[int | None] = mapped_column(Integer)
    upload_bytes_per_day: Mapped[int | None] = mapped_column(BigInteger)
    max_photos: Mapped[int | None] = mapped_column(BigInteger)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    expires_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    last_used_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    revoked_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


@dataclass(frozen=True, slots=True)
class KeyLimits:
    """How much a key may do; None is the limit of the settings."""

    requests_per_minute: int | None = None
    upload_bytes_per_day: int | None = None
    max_photos: int | None = None


def create_api_key(
    session: Session,
    name: str,
    scopes: Collection[Scope],
    *,
    life_seconds: float | None = None,
    limits: KeyLimits = KeyLimits(),
) -> tuple[ApiKey, str]:
    """A new key's row, and the key itself: to be shown now or never."""
    key = generate_api_key()
    row = ApiKey(
        name=name,
        prefix=api_key_prefix(key),
        sha256=hash_api_key(key),
        scopes=sorted(scopes),
        expires_at=None if life_seconds is None else db_now_plus(life_seconds),
        requests_per_minute=limits.requests_per_minute,
        upload_bytes_per_day=limits.upload_bytes_per_day,
        max_photos=limits.max_photos,
    )
    session.add(row)
    session.flush()
    session.refresh(row)
    return row, key


def authenticate_api_key(session: Session, sha256: str) -> ApiKey:
    """The key that may be used now. Unauthorized (`key_unknown`, `key_revoked`, `key_expired`)."""
    found = session.execute(
        select(ApiKey, (ApiKey.expires_at <= db_now()).label("expired")).where(
            ApiKey.sha256 == sha256
        )
    ).one_or_none()
    if found is None:
        raise Unauthorized("key_unknown", "This is not a key of this server.")
    key: ApiKey = found[0]
    if key.revoked_at is not None:
        raise Unauthorized("key_revoked", f"The key {key.prefix}... ({key.name}) was revoked.")
    if found.expired:
        raise Unauthorized(
            "key_expired",
            f"The key {key.prefix}... ({key.name}) expired at {key.expires_at}. An admin makes "
            "another one: placewise keys create.",
        )
    return key


def list_api_keys(session: Session) -> list[ApiKey]:
    """Every key that was ever made, newest first."""
    return list(session.scalars(select(ApiKey).order_by(ApiKey.id.desc())))


def revoke_api_key(session: Session, key_id: UUID) -> ApiKey:
    """From this commit on the key opens nothing. NotFound (`key_not_found`)."""
    found = session.get(ApiKey, key_id, with_for_update=True)
    if found is None:
        raise NotFound("key_not_found", f"There is no key {key_id}. GET /api/v1/keys lists all.")
    if found.revoked_at is None:
        found.revoked_at = db_now()
        session.flush()
        session.refresh(found)
    return found


def has_admin_key(session: Session) -> bool:
    """Is there a key that may make others, and can be used now?"""
    usable = select(ApiKey.scopes).where(
        ApiKey.revoked_at.is_(None),
        or_(ApiKey.expires_at.is_(None), ApiKey.expires_at > db_now()),
    )
    return any(Scope.ADMIN in scopes for scopes in session.scalars(usable))


def record_key_use(session: Session, key_id: UUID) -> None:
    """The key was used now; written only where that was not noted within the last minute."""
    session.execute(
        update(ApiKey)
        .where(
            ApiKey.id == key_id,
            or_(
                ApiKey.last_used_at.is_(None),
                ApiKey.last_used_at < db_now_plus(-LAST_USED_RESOLUTION_SECONDS),
            ),
        )
        .values(last_used_at=db_now())
        .execution_options(synchronize_session=False)
    )


def count_photos_of_key(session: Session, key_id: UUID, limit: int) -> int:
    """Live photos that came in with the key, counted up to `limit`."""
    some = select(Photo.id).where(Photo.key_id == key_id, Photo.deleted_at.is_(None)).limit(limit)
    return session.scalar(select(func.count()).select_from(some.subquery())) or 0
