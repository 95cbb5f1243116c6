"""What search knows of a photo, for tests of the search worker's parts."""

from __future__ import annotations

from datetime import datetime
from uuid import UUID

from shared.catalog.photos import PhotoFilterValues, PhotoRole


def facts_of(
    photo_id: UUID,
    *,
    role: PhotoRole = PhotoRole.DATABASE,
    latitude: float | None = None,
    longitude: float | None = None,
    captured_at: datetime | None = None,
    place: str | None = None,
    tags: tuple[str, ...] = (),
) -> PhotoFilterValues:
    """A live photo of which only what is said is known."""
    return PhotoFilterValues(
        photo_id, role, None, latitude, longitude, captured_at, place, list(tags)
    )
