"""Orphan collection: finds objects that no catalog row refers to and moves them to the trash.

Orphans are left by a crash between writing an object and committing its row. The walk lists every
prefix of the store in batches and looks the keys of a batch up with one query
(`REFERENCED_BY_PREFIX`). Orphans are first counted: where there are suspiciously many, collection
is held until an operator confirms it (`placewise storage collect --confirm`). Objects in the trash
are deleted after TRASH_DAYS.
"""

from __future__ import annotations

import contextlib
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import groupby, islice
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import InstrumentedAttribute, Session

from shared.catalog.batch_items import BatchItem
from shared.catalog.chunks import Chunk
from shared.catalog.database.base import db_now
from shared.catalog.database.session import Catalog
from shared.catalog.installation import check_not_behind
from shared.catalog.jobs import UNFINISHED_STATES, UPLOAD_JOBS, Job, JobKind, JobState
from shared.catalog.models import Model
from shared.catalog.photos import Photo, is_kept
from shared.catalog.reconstructions import Reconstruction
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.errors import Conflict
from shared.storage import ObjectStore, OwnedStore
from shared.storage.chunks import codes_key, features_key, manifest_key
from shared.storage.keys import (
    CHECKPOINTS,
    MODELS,
    ORIGINALS,
    PREVIEWS,
    QUERIES,
    RECONSTRUCTIONS,
    THUMBNAILS,
    TRASH,
    VOCABULARIES,
    WHITENINGS,
    derived_image_keys,
    is_original_key,
    query_object_keys,
)
from shared.storage.protocol import ObjectInfo
from shared.storage.trash import end_hold, move_to_trash, read_hold, write_hold

log = logging.getLogger(__name__)

OBJECTS_PER_LOOKUP = 500  # keys looked up in one query
MAX_ORPHANS_PER_RUN = 100_000  # they are held in memory until all are counted
MAX_ORPHAN_SHARE = 0.1  # of all objects; a larger one is held until it is confirmed
HOLD_MIN_ORPHANS = 100  # so few are never held: in a small store they are a large share


@dataclass(slots=True)
class StoreCount:
    """The objects and orphans counted during a walk over the store."""

    objects: int = 0
    orphans: Counter[str] = field(default_factory=Counter)
    """Prefix -> number of orphans."""
    orphan_bytes: Counter[str] = field(default_factory=Counter)
    """Prefix -> bytes of its orphans."""


class CollectionHeld(Conflict):
    """Orphan collection is held until an operator confirms it."""

    def __init__(self, count: StoreCount) -> None:
        super().__init__(
            "collection_held",
            f"No row of the catalog references {count.orphans.total()} of {count.objects} objects "
            f"({count.orphan_bytes.total() / 1e6:.1f} MB), more than a tenth: nothing was "
            "collected. If this is the wrong catalog, restore the right one, or run `placewise "
            "storage verify --repair`. If the objects are garbage, `placewise storage collect` "
            "lists them, and with --confirm it moves them to the trash.",
        )


def collect_orphans(
    catalog: Catalog,
    store: OwnedStore,
    age_seconds: float,
    *,
    confirmed: bool = False,
) -> int:
    """Move objects that no catalog row refers to to the trash, up to MAX_ORPHANS_PER_RUN.

    Args:
        age_seconds: Younger objects stay, because their rows may not be committed yet.
        confirmed: Move the orphans also where collection would be held.

    Returns:
        The number of objects moved.

    Raises:
        CollectionHeld: Nothing was moved, because the orphans exceed MAX_ORPHAN_SHARE of all
            objects. A note in the store records the hold.
        Misconfigured: As `check_not_behind`; nothing was moved.
    """
    check_not_behind(catalog, store)
    count, found = StoreCount(), list[ObjectInfo]()
    for info in find_orphans(catalog, store, age_seconds, count):
        if len(found) < MAX_ORPHANS_PER_RUN:
            found.append(info)
    previous_hold = read_hold(store)
    limit = max(HOLD_MIN_ORPHANS, MAX_ORPHAN_SHARE * count.objects)
    if count.orphans.total() > limit and not confirmed:
        held = CollectionHeld(count)
        if held.detail != previous_hold:
            write_hold(store, held.detail)
        raise held
    moved, today = 0, _now(catalog).date()
    for prefix, same_prefix in groupby(found, lambda info: info.key.partition("/")[0] + "/"):
        for batch in _batches(same_prefix):
            for info in _select_orphans(catalog, prefix, batch):  # still
                moved += move_to_trash(store, info.key, today)
    if previous_hold is not None:
        end_hold(store)
    if moved:
        log.info("moved %d orphaned objects to the trash", moved)
    return moved


def find_orphans(
    catalog: Catalog, store: ObjectStore, age_seconds: float, count: StoreCount | None = None
) -> Iterator[ObjectInfo]:
    """Yield the objects older than `age_seconds` that no catalog row refers to.

    `count`, if given, is updated during the iteration.
    """
    count = StoreCount() if count is None else count
    cutoff = _now(catalog) - timedelta(seconds=age_seconds)
    for prefix in REFERENCED_BY_PREFIX:
        for batch in _batches(_count_objects(store.list(prefix), count)):
            old = [info for info in batch if info.modified_at < cutoff]
            for info in _select_orphans(catalog, prefix, old):
                count.orphans[prefix] += 1
                count.orphan_bytes[prefix] += info.size_bytes
                yield info


def _count_objects(objects: Iterable[ObjectInfo], count: StoreCount) -> Iterator[ObjectInfo]:
    for info in objects:
        count.objects += 1
        yield info


def _batches(objects: Iterable[ObjectInfo]) -> Iterator[list[ObjectInfo]]:
    iterator = iter(objects)
    while batch := list(islice(iterator, OBJECTS_PER_LOOKUP)):
        yield batch


def _select_orphans(catalog: Catalog, prefix: str, batch: list[ObjectInfo]) -> list[ObjectInfo]:
    """Return the objects of the batch, all under the prefix, that no catalog row refers to."""
    if not batch:
        return []
    with catalog.read() as session:
        referenced = set(REFERENCED_BY_PREFIX[prefix](session, [info.key for info in batch]))
    return [info for info in batch if info.key not in referenced]


def empty_expired_trash(catalog: Catalog, store: ObjectStore, trash_days: float) -> int:
    """Delete objects moved to the trash over `trash_days` ago; return the bytes of the others."""
    cutoff = _now(catalog) - timedelta(days=trash_days)
    remaining_bytes = 0
    for info in store.list(TRASH):
        if info.modified_at < cutoff:
            store.delete(info.key)
        else:
            remaining_bytes += info.size_bytes
    return remaining_bytes


def _now(catalog: Catalog) -> datetime:
    with catalog.read() as session:
        return session.execute(select(db_now())).scalar_one()


def _referenced_originals(session: Session, keys: list[str]) -> Iterable[str]:
    """Keys of photos and of queued batch items, and all keys that Placewise did not make.

    `UPLOAD_DIR` may hold the operator's own files, which must not be removed.
    """
    stored = session.scalars(select(Photo.object_key).where(Photo.object_key.in_(keys)))
    waiting = session.scalars(
        select(BatchItem.object_key).where(
            BatchItem.object_key.in_(keys), BatchItem.state == JobState.QUEUED
        )
    )
    return [*stored, *filter(None, waiting), *(key for key in keys if not is_original_key(key))]


def _referenced_checkpoints(session: Session, keys: list[str]) -> Iterable[str]:
    """Keys of checkpoints and COLMAP models whose jobs are unfinished."""
    unfinished = session.scalars(
        select(Job.params).where(Job.kind.in_(UPLOAD_JOBS), Job.state.in_(UNFINISHED_STATES))
    )
    return [key for params in unfinished if (key := params["object_key"]) is not None]


def _referenced_derived_images(session: Session, keys: list[str]) -> Iterable[str]:
    photo_ids = _parse_uuids(key.rpartition("/")[2].removesuffix(".jpg") for key in keys)
    kept = session.scalars(select(Photo.id).where(Photo.id.in_(photo_ids), is_kept()))
    return [key for photo_id in kept for key in derived_image_keys(photo_id)]


def _referenced_chunks(session: Session, keys: list[str]) -> Iterable[str]:
    arrays = {key.rpartition(".")[0] + ".npy" for key in keys}
    stored = session.scalars(select(Chunk.object_key).where(Chunk.object_key.in_(arrays)))
    beside = (manifest_key, codes_key, features_key)
    return [name for key in stored for name in (key, *(name_of(key) for name_of in beside))]


def _referenced_vocabularies(session: Session, keys: list[str]) -> Iterable[str]:
    stored = session.scalars(select(Vocabulary.object_key).where(Vocabulary.object_key.in_(keys)))
    waiting = session.scalars(
        select(Job.params).where(Job.kind == JobKind.IMPORT, Job.state.in_(UNFINISHED_STATES))
    )
    return [*stored, *(params["object_key"] for params in waiting)]


def _referenced_by_column(
    column: InstrumentedAttribute[str] | InstrumentedAttribute[str | None],
) -> Callable[[Session, list[str]], Iterable[str]]:
    """Make a lookup of the keys that are in a column."""
    return lambda session, keys: session.scalars(select(column).where(column.in_(keys)))


def _referenced_queries(session: Session, keys: list[str]) -> Iterable[str]:
    job_ids = _parse_uuids(key.removeprefix(QUERIES).partition(".")[0] for key in keys)
    stored = session.scalars(select(Job.id).where(Job.id.in_(job_ids)))
    return [key for job_id in stored for key in query_object_keys(job_id)]


def _referenced_reconstructions(session: Session, keys: list[str]) -> Iterable[str]:
    ids_of_keys = {key: _parse_uuids([key.split("/")[1]]) for key in keys}
    ids = set().union(*ids_of_keys.values())
    stored = set(session.scalars(select(Reconstruction.id).where(Reconstruction.id.in_(ids))))
    return [key for key, of_key in ids_of_keys.items() if of_key & stored]


def _parse_uuids(names: Iterable[str]) -> set[UUID]:
    """Return the names that are UUIDs; an object with another name belongs to no row."""
    ids = set()
    for name in names:
        with contextlib.suppress(ValueError):
            ids.add(UUID(name))
    return ids


# Prefix -> which of the keys under it a catalog row refers to; more keys may be returned.
REFERENCED_BY_PREFIX: dict[str, Callable[[Session, list[str]], Iterable[str]]] = {
    CHECKPOINTS: _referenced_checkpoints,
    MODELS: _referenced_by_column(Model.object_key),
    ORIGINALS: _referenced_originals,
    THUMBNAILS: _referenced_derived_images,
    PREVIEWS: _referenced_derived_images,
    "chunks/": _referenced_chunks,
    VOCABULARIES: _referenced_vocabularies,
    WHITENINGS: _referenced_by_column(StoredWhitening.object_key),
    QUERIES: _referenced_queries,
    RECONSTRUCTIONS: _referenced_reconstructions,
}
