"""Vocabularies: VLAD's cluster centres, where they were learnt, and where they lie.

PCA whitenings that a map's generations are made with, and where they lie.
"""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Any
from uuid import UUID

from sqlalchemy import Float, ForeignKey, Integer, String, Text, Uuid, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, Journaled, JsonValue, UtcDateTime, db_now
from shared.catalog.generations import Generation, active_generation
from shared.errors import Conflict, NotFound
from shared.extractor_config.configs import ANYLOC_PREPROCESSING_NAMES
from shared.ids import new_id


class VocabularyOrigin(StrEnum):
    SHIPPED = "shipped"  # came with the extractor: learnt on photographs of elsewhere
    FITTED = "fitted"  # learnt on the map's own photos
    IMPORTED = "imported"  # brought by the user


class Vocabulary(Journaled, Base):
    """(clusters, dimension) float32 centres under `object_key`, as a `.npy` file.

    `provenance` is what `shared.descriptors.vocabulary_file` says of them.
    """

    __tablename__ = "vocabularies"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
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
        """What an answer says of it: `own` when learnt on this map's photos, else `foreign`."""
        return "own" if self.origin == VocabularyOrigin.FITTED else "foreign"


def vocabulary_standing(session: Session, generation: Generation) -> str:
    """The standing of the generation's vocabulary; `none` for an extractor without one."""
    if generation.vocabulary_id is None:
        return "none"
    return session.get_one(Vocabulary, generation.vocabulary_id).standing


def word_weights_unavailable_reason(session: Session, generation: Generation) -> str | None:
    """Why its words can't be weighed, as a clause; None where they can.

    A weight belongs to one block of the descriptor, as long as a local feature. PCA mixes the
    blocks, which its shorter descriptors show.
    """
    if generation.vocabulary_id is None:
        return "its extractor uses no vocabulary"
    preprocessing = generation.spec["preprocessing"]["name"]
    if preprocessing in ANYLOC_PREPROCESSING_NAMES:
        return f"with {preprocessing} it is to rank as its authors' code does"
    vocabulary = session.get_one(Vocabulary, generation.vocabulary_id)
    if "pca" in generation.spec or (
        vocabulary.clusters * vocabulary.dimension != generation.dimension
    ):
        return "its descriptors are projected, and no longer made of words"
    return None


def add_vocabulary(
    session: Session,
    map_id: UUID,
    origin: VocabularyOrigin,
    *,
    shape: tuple[int, int],
    object_key: str,
    sha256: str,
    provenance: dict[str, Any],
) -> Vocabulary:
    """Make centres that lie under `object_key` known; `shape` is (clusters, dimension)."""
    vocabulary = Vocabulary(
        id=new_id(),
        map_id=map_id,
        origin=origin,
        clusters=shape[0],
        dimension=shape[1],
        object_key=object_key,
        sha256=sha256,
        provenance=provenance,
    )
    session.add(vocabulary)
    session.flush()
    return vocabulary


def get_vocabulary(session: Session, map_id: UUID, vocabulary_id: UUID) -> Vocabulary:
    """A vocabulary of the map; 404 when there is none."""
    found = session.scalar(
        select(Vocabulary).where(Vocabulary.id == vocabulary_id, Vocabulary.map_id == map_id)
    )
    if found is None:
        raise NotFound(
            "vocabulary_not_found",
            f"There is no vocabulary {vocabulary_id} in this map.",
            vocabulary_id=str(vocabulary_id),
        )
    return found


def list_vocabularies(session: Session, map_id: UUID) -> list[Vocabulary]:
    """The map's vocabularies, newest first."""
    return list(
        session.scalars(
            select(Vocabulary).where(Vocabulary.map_id == map_id).order_by(Vocabulary.id.desc())
        )
    )


class StoredWhitening(Journaled, Base):
    """From `dimension` numbers to `kept`: a file of `shared.descriptors.pca_whitening` under
    `object_key`.

    It goes when none of its generations answers or is built any more, some time after.
    """

    __tablename__ = "whitenings"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    map_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("maps.id"), index=True)
    dimension: Mapped[int] = mapped_column(Integer)
    kept: Mapped[int] = mapped_column(Integer)
    # Those that it was fitted on, and the share of their variance that is left, 0 to 1.
    rows: Mapped[int] = mapped_column(Integer)
    explained: Mapped[float] = mapped_column(Float)
    object_key: Mapped[str] = mapped_column(Text)
    sha256: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    def summary(self) -> dict[str, Any]:
        """What an answer says of it."""
        return {
            "from_dimension": self.dimension,
            "dimension": self.kept,
            "rows": self.rows,
            "explained": self.explained,
        }


def get_pca_source_generation(session: Session, map_id: UUID) -> Generation:
    """The active generation, whose rows a PCA can be fitted on.

    Conflict: `nothing_described` in a map without one; `already_reduced` where PCA has shortened
    its descriptors: what it has left out can't be had back from them.
    """
    active = active_generation(session, map_id)
    if active is None:
        raise Conflict(
            "nothing_described",
            "PCA is fitted on the map's descriptors, and it has none yet. Upload photos first.",
        )
    if active.pca_from is not None:
        raise Conflict(
            "already_reduced",
            f"PCA has brought the map's descriptors to {active.dimension} dimensions already. Go "
            "back to whole ones first: `placewise pca undo`, or POST /api/v1/generations with the "
            "vocabulary alone.",
            dimension=active.dimension,
        )
    return active


def add_whitening(session: Session, map_id: UUID, **columns: Any) -> StoredWhitening:
    """Make a whitening that lies under `object_key` known."""
    whitening = StoredWhitening(id=new_id(), map_id=map_id, **columns)
    session.add(whitening)
    session.flush()
    return whitening
