"""Vocabularies (VLAD cluster centres) and PCA whitenings of maps, stored as objects."""

from __future__ import annotations

from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import Float, ForeignKey, Integer, String, Text, Uuid
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import (
    Entity,
    Journaled,
    JsonValue,
    UtcDateTime,
    db_now,
    get_in_map,
)
from shared.catalog.generations import Generation, active_generation
from shared.catalog.maps import Map
from shared.enums import VocabularyOrigin as VocabularyOrigin
from shared.errors import Conflict, Misconfigured
from shared.extractor_config.configs import MIN_PHOTOS_TO_FIT, get_extractor_config


class Vocabulary(Journaled, Entity):
    """A vocabulary: (clusters, dimension) float32 centres in a `.npy` file under `object_key`.

    `provenance` is that of `shared.descriptors.vocabulary_file`.
    """

    __tablename__ = "vocabularies"

    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"), index=True)
    origin: Mapped[VocabularyOrigin] = mapped_column(String(20))
    clusters: Mapped[int] = mapped_column(Integer)
    dimension: Mapped[int] = mapped_column(Integer)
    object_key: Mapped[str] = mapped_column(Text)
    sha256: Mapped[str] = mapped_column(String(64))
    provenance: Mapped[dict[str, Any]] = mapped_column(JsonValue, default=dict)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    @property
    def standing(self) -> str:
        """`own` if fitted on this map's photos, else `foreign`; part of API responses.

        `provisional` if the map had fewer than MIN_PHOTOS_TO_FIT photos when it was fitted.
        """
        if self.origin != VocabularyOrigin.FITTED:
            return "foreign"
        return "provisional" if self.provenance.get("provisional") else "own"


def vocabulary_standing(session: Session, generation: Generation) -> str:
    """Return the standing of the generation's vocabulary; `none` for an extractor without one.

    `pending` if the generation pools because its map's extractor has no vocabulary yet.
    """
    if generation.vocabulary_id is None:
        name = session.get_one(Map, generation.map_id).extractor
        if generation.extractor == name:
            return "none"
        needed = get_extractor_config(name, allow_test_extractors=True).needs_vocabulary
        return "pending" if needed else "none"
    return session.get_one(Vocabulary, generation.vocabulary_id).standing


def next_fit_photos(session: Session, map_: Map) -> int | None:
    """Return the number of photos at which the steward fits the map's next vocabulary.

    That is MIN_PHOTOS_TO_FIT, and after a fit, also a failed or cancelled one, twice the photos
    that the map had then. None if the steward fits none: it is switched off, the extractor uses no
    vocabulary, or the descriptors are reduced by a PCA that was fitted with the present one.
    """
    try:
        config = get_extractor_config(map_.extractor, allow_test_extractors=True)
    except Misconfigured:  # of another release: nothing can be described here
        return None
    active = active_generation(session, map_.id)
    is_reduced = active is not None and active.pca_from is not None
    if not map_.auto_fit or not config.needs_vocabulary or is_reduced:
        return None
    return max(MIN_PHOTOS_TO_FIT, 2 * (map_.fitted_photos or 0))


def get_vocabulary(session: Session, map_id: UUID, vocabulary_id: UUID) -> Vocabulary:
    """Return a vocabulary of the map; NotFound (`vocabulary_not_found`)."""
    return get_in_map(session, Vocabulary, map_id, vocabulary_id)


class StoredWhitening(Journaled, Entity):
    """A PCA whitening from `dimension` to `components`, stored under `object_key`.

    The file is one of `shared.descriptors.pca_whitening`. It is deleted after a grace period when
    none of its generations is active or being built any more.
    """

    __tablename__ = "whitenings"

    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"), index=True)
    dimension: Mapped[int] = mapped_column(Integer)
    components: Mapped[int] = mapped_column("kept", Integer)
    # The number of rows that it was fitted on, and the explained share of their variance, 0 to 1.
    rows: Mapped[int] = mapped_column(Integer)
    explained: Mapped[float] = mapped_column(Float)
    object_key: Mapped[str] = mapped_column(Text)
    sha256: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    def summary(self) -> dict[str, Any]:
        """Return its description in API responses."""
        return {
            "from_dimension": self.dimension,
            "dimension": self.components,
            "rows": self.rows,
            "explained": self.explained,
        }


def get_pca_source_generation(session: Session, map_id: UUID) -> Generation:
    """Return the active generation, whose descriptors a PCA is fitted on.

    Raises:
        Conflict: `nothing_described`: the map has no active generation. `already_reduced`: its
            descriptors are already reduced by PCA, and what that discarded can't be restored.
    """
    active = active_generation(session, map_id)
    if active is None:
        raise Conflict(
            "nothing_described",
            "PCA is fitted on the map's descriptors, but it has none yet. Upload photos first.",
        )
    if active.pca_from is not None:
        raise Conflict(
            "already_reduced",
            f"The map's descriptors are already reduced to {active.dimension} dimensions by PCA. "
            "Go back to full descriptors first: `placewise maps switch NAME --pca 0`, or POST "
            "/api/v1/generations with only the vocabulary.",
            dimension=active.dimension,
        )
    return active
