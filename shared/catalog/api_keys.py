"""API keys: authentication, scopes and limits. Only the hashes of keys are stored.

The row of a revoked or expired key stays, so that lists and logs can still name it.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy import BigInteger, Integer, String, Text, or_, select, update
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import (
    Entity,
    Journaled,
    JsonValue,
    UtcDateTime,
    count_rows,
    db_now,
    db_now_plus,
    insert_row,
)
from shared.catalog.maps import MAP_NAME_PATTERN
from shared.catalog.photos import Photo
from shared.catalog.tracks import Track, TrackFrame
from shared.errors import NotFound, Unauthorized, invalid_field_error
from shared.security.api_keys import Scope, api_key_prefix, generate_api_key, hash_api_key


class ApiKey(Journaled, Entity):
    """An API key. A limit that is null defaults to the one of the settings."""

    __tablename__ = "api_keys"

    name: Mapped[str] = mapped_column(Text)
    prefix: Mapped[str] = mapped_column(String(20))
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    scopes: Mapped[list[str]] = mapped_column(JsonValue)
    maps: Mapped[list[str] | None] = mapped_column(JsonValue)  # names; None: all maps
    requests_per_minute: Mapped[int | None] = mapped_column(Integer)
    max_photos: Mapped[int | None] = mapped_column(BigInteger)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    expires_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    last_used_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    revoked_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


@dataclass(frozen=True, slots=True)
class KeyLimits:
    """Rate limit and quotas of a key; None defaults to the limit of the settings."""

    requests_per_minute: int | None = None
    max_photos: int | None = None


def create_api_key(
    session: Session,
    name: str,
    scopes: Collection[Scope],
    *,
    life_seconds: float | None = None,
    limits: KeyLimits = KeyLimits(),
    maps: Collection[str] | None = None,
) -> tuple[ApiKey, str]:
    """Create a key.

    Args:
        life_seconds: Time until it expires; None: never.
        limits: Its rate limit and quotas.
        maps: Names of the only maps that it may use; None: all maps.

    Returns:
        Its row, and the key itself, which is not stored and only shown once.

    Raises:
        Unprocessable: `invalid_field` for the scope `admin` with `maps`: admins manage all keys;
            and for what can't be the name of a map, such as `*`.
    """
    if maps is not None and Scope.ADMIN in scopes:
        raise invalid_field_error("maps", "can't be combined with the scope admin")
    for each in maps or ():
        if not re.fullmatch(MAP_NAME_PATTERN, each):
            raise invalid_field_error(
                "maps", f"{each!r} can't be the name of a map; a key for all maps has no maps"
            )
    key = generate_api_key()
    row = ApiKey(
        name=name,
        prefix=api_key_prefix(key),
        sha256=hash_api_key(key),
        scopes=sorted(scopes),
        maps=None if maps is None else sorted(set(maps)),
        expires_at=None if life_seconds is None else db_now_plus(life_seconds),
        requests_per_minute=limits.requests_per_minute,
        max_photos=limits.max_photos,
    )
    session.refresh(insert_row(session, row))
    return row, key


def authenticate_api_key(session: Session, sha256: str) -> ApiKey:
    """Return the valid key with this hash.

    Raises:
        Unauthorized: `key_unknown`, `key_revoked` or `key_expired`.
    """
    result = session.execute(
        select(ApiKey, (ApiKey.expires_at <= db_now()).label("expired")).where(
            ApiKey.sha256 == sha256
        )
    ).one_or_none()
    if result is None:
        raise Unauthorized("key_unknown", "The API key is unknown to this server.")
    key: ApiKey = result[0]
    if key.revoked_at is not None:
        raise Unauthorized("key_revoked", f"The key {key.prefix}... ({key.name}) was revoked.")
    if result.expired:
        raise Unauthorized(
            "key_expired",
            f"The key {key.prefix}... ({key.name}) expired at {key.expires_at}. An admin can "
            "create another one: placewise keys create.",
        )
    return key


def revoke_api_key(session: Session, key_id: UUID) -> ApiKey:
    """Revoke the key: it is rejected from this commit on. NotFound (`key_not_found`)."""
    key = session.get(ApiKey, key_id, with_for_update=True)
    if key is None:
        raise NotFound("key_not_found", f"There is no key {key_id}. GET /api/v1/keys lists all.")
    if key.revoked_at is None:
        key.revoked_at = db_now()
        session.flush()
        session.refresh(key)
    return key


def has_admin_key(session: Session) -> bool:
    """Return whether a valid key with the admin scope exists."""
    usable = select(ApiKey.scopes).where(
        ApiKey.revoked_at.is_(None), or_(ApiKey.expires_at.is_(None), ApiKey.expires_at > db_now())
    )
    return any(Scope.ADMIN in scopes for scopes in session.scalars(usable))


def record_key_use(session: Session, key_id: UUID) -> None:
    """Set `last_used_at` to now."""
    session.execute(
        update(ApiKey)
        .where(ApiKey.id == key_id)
        # `revision` is set explicitly: otherwise the journal would record each use.
        .values(last_used_at=db_now(), revision=ApiKey.revision)
        .execution_options(synchronize_session=False)
    )


def count_photos_of_key(session: Session, key_id: UUID, limit: int) -> int:
    """Count what the key has stored, each kind up to `limit`: live photos, tracks and frames."""
    stored = (
        select(Photo.id).where(Photo.key_id == key_id, Photo.deleted_at.is_(None)),
        select(Track.id).where(Track.key_id == key_id),
        select(TrackFrame.id).where(TrackFrame.key_id == key_id),
    )
    return sum(count_rows(session, rows, limit) for rows in stored)
