"""Garbage collection. Objects go before the rows that remember them, orphans go to the trash first.

An object is deleted first and its row after it: a crash in between repeats the deletion, which
harms nothing, while the other order would leave bytes that no one knows of.
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

from sqlalchemy import and_, delete, exists, or_, select, update
from sqlalchemy.orm import Session

from services.steward.tasks.journal import deletion_is_journaled, journal_deletions
from shared.catalog.base import db_now, db_now_plus, is_journaled
from shared.catalog.batch_items import BatchItem
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import (
    MODEL_CHANGE_JOBS,
    QUERY_JOBS,
    UNFINISHED_STATES,
    Job,
    JobKind,
    JobState,
)
from shared.catalog.maps import increment_map_version, lock_map
from shared.catalog.models import Model
from shared.catalog.photos import Photo, PresignedUpload
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.config.settings import Settings
from shared.errors import Conflict
from shared.journal.outbox import accept_segments, catalog_lag
from shared.storage import ObjectStore, OwnedStore
from shared.storage.chunks import codes_key, delete_chunk, manifest_key
from shared.storage.keys import (
    ARCHIVES,
    CHECKPOINTS,
    FEATURES,
    INCOMING,
    MODELS,
    ORIGINALS,
    QUERIES,
    THUMBNAILS,
    VOCABULARIES,
    WHITENINGS,
    WORK,
    incoming_key,
    is_original_key,
    local_features_key,
    local_features_prefix,
    query_object_keys,
    thumbnail_key,
)
from shared.storage.protocol import ObjectInfo
from shared.storage.trash import (
    Hold,
    HoldReason,
    TrashSize,
    end_hold,
    expire_trash,
    move_to_trash,
    read_hold,
    write_hold,
)

log = logging.getLogger(__name__)

ROWS_PER_TRANSACTION = 500  # rows looked at in one transaction
REMEMBERED = 10_000  # orphans that need no second walk over the store
ALWAYS_COLLECTED = 100  # orphans: in a small store, a few are a large share
COMPLETED_UPLOAD_SECONDS = 86_400.0  # for which a completed direct upload is remembered


def collect_superseded_chunks(catalog: Catalog, store: ObjectStore, grace_seconds: float) -> None:
    """Chunks that were merged into others; the grace lets running queries finish with them."""
    with catalog.read() as session:
        chunks = session.scalars(
            select(Chunk)
            .where(Chunk.superseded_at < db_now_plus(-grace_seconds))
            .limit(ROWS_PER_TRANSACTION)
        ).all()
    for chunk in chunks:
        delete_chunk(store, chunk.object_key)
    if chunks:
        with catalog.write() as session:
            session.execute(delete(Chunk).where(Chunk.id.in_([chunk.id for chunk in chunks])))


def collect_ended_generations(catalog: Catalog, store: ObjectStore, grace_seconds: float) -> None:
    """Generations that no longer answer: their rows, chunks, local features and unfinished photos'
    jobs.

    The generation's own row stays as history until its map goes.
    """
    with catalog.read() as session:
        ended = session.scalars(
            select(Chunk)
            .join(Generation, Generation.id == Chunk.generation_id)
            .where(
                Generation.state.in_((GenerationState.RETIRED, GenerationState.ABANDONED)),
                Generation.ended_at < db_now_plus(-grace_seconds),
            )
            .limit(ROWS_PER_TRANSACTION)
        ).all()
        given_up = session.scalars(
            select(Job.id)
            .join(Generation, Generation.id == Job.generation_id)
            .where(
                Job.kind == JobKind.REINDEX,
                Generation.state == GenerationState.ABANDONED,
                Generation.ended_at < db_now_plus(-grace_seconds),
            )
            .limit(ROWS_PER_TRANSACTION)
        ).all()
    if given_up:
        with catalog.write() as session:
            session.execute(delete(Job).where(Job.id.in_(given_up)))
    for generation_id in {chunk.generation_id for chunk in ended}:
        for info in list(store.list(local_features_prefix(generation_id))):
            store.delete(info.key)
    for chunk in ended:
        delete_chunk(store, chunk.object_key)
    if ended:
        chunk_ids = [chunk.id for chunk in ended]
        with catalog.write() as session:
            session.execute(delete(Descriptor).where(Descriptor.chunk_id.in_(chunk_ids)))
            session.execute(delete(Chunk).where(Chunk.id.in_(chunk_ids)))


def collect_whitenings(catalog: Catalog, store: ObjectStore, grace_seconds: float) -> None:
    """Whitenings whose generations have all ended: no model change takes one up again."""
    in_use = exists().where(
        Generation.whitening_id == StoredWhitening.id,
        or_(Generation.ended_at.is_(None), Generation.ended_at >= db_now_plus(-grace_seconds)),
    )
    with catalog.read() as session:
        ended = session.scalars(
            select(StoredWhitening).where(~in_use).limit(ROWS_PER_TRANSACTION)
        ).all()
    for whitening in ended:
        store.delete(whitening.object_key)
    if ended:
        ids = [whitening.id for whitening in ended]
        with catalog.write() as session:
            session.execute(
                update(Generation)
                .where(Generation.whitening_id.in_(ids))
                .values(whitening_id=None)
                .execution_options(synchronize_session=False)
            )
            session.execute(delete(StoredWhitening).where(StoredWhitening.id.in_(ids)))


def collect_deleted_photos(catalog: Catalog, store: ObjectStore, grace_seconds: float) -> None:
    """The bytes and local features of deleted photos, once the journal tells of the deletion; their
    rows after the grace, when every search worker has seen the deletion and merging has dropped
    their descriptors."""
    journal_deletions(catalog, store, Photo)
    with catalog.read() as session:
        photos = session.scalars(
            select(Photo)
            .where(
                Photo.deleted_at.is_not(None), Photo.object_key != "", deletion_is_journaled(Photo)
            )
            .limit(ROWS_PER_TRANSACTION)
        ).all()
        described_in = _generations_with_rows(session, {photo.map_id for photo in photos})
    for photo in photos:
        store.delete(photo.object_key)
        store.delete(thumbnail_key(photo.id))
        for generation_id in described_in[photo.map_id]:
            store.delete(local_features_key(generation_id, photo.id))
    photo_ids = [photo.id for photo in photos]
    with catalog.write() as session:
        if photo_ids:
            session.execute(
                update(Photo)
                .where(Photo.id.in_(photo_ids))
                # The revision is named, or this would count as a change for the journal.
                .values(object_key="", revision=Photo.revision)
            )
        _delete_photo_rows(session, grace_seconds)


def _generations_with_rows(session: Session, map_ids: set[UUID]) -> dict[UUID, list[UUID]]:
    """Of each map the generations that have chunks: of the others nothing is kept."""
    found: dict[UUID, list[UUID]] = {map_id: [] for map_id in map_ids}
    generations = session.execute(
        select(Generation.map_id, Generation.id).where(
            Generation.map_id.in_(map_ids), exists().where(Chunk.generation_id == Generation.id)
        )
    )
    for map_id, generation_id in generations:
        found[map_id].append(generation_id)
    return found


def _delete_photo_rows(session: Session, grace_seconds: float) -> None:
    gone = session.execute(
        select(Photo.id, Photo.map_id)
        .where(
            Photo.deleted_at < db_now_plus(-grace_seconds),
            Photo.object_key == "",
            is_journaled(Photo),
        )
        .limit(ROWS_PER_TRANSACTION)
    ).all()
    photo_ids = [photo_id for photo_id, _ in gone]
    if not photo_ids:
        return
    for map_id in sorted({map_id for _, map_id in gone}):
        lock_map(session, map_id)
        increment_map_version(
            session, map_id
        )  # workers that are far behind load their chunks again
    session.execute(delete(Descriptor).where(Descriptor.photo_id.in_(photo_ids)))
    session.execute(delete(Job).where(Job.photo_id.in_(photo_ids)))
    session.execute(delete(Photo).where(Photo.id.in_(photo_ids)))


def collect_queries(catalog: Catalog, store: ObjectStore, ttl_seconds: float) -> None:
    """Query photos that are not stored, with their descriptors, comparisons and jobs, after
    QUERY_TTL."""
    with catalog.read() as session:
        job_ids = session.scalars(
            select(Job.id)
            .where(Job.kind.in_(QUERY_JOBS), Job.created_at < db_now_plus(-ttl_seconds))
            .limit(ROWS_PER_TRANSACTION)
        ).all()
    for job_id in job_ids:
        for key in query_object_keys(job_id):
            store.delete(key)
    if job_ids:
        with catalog.write() as session:
            session.execute(delete(Job).where(Job.id.in_(job_ids)))


def collect_direct_uploads(catalog: Catalog, store: ObjectStore) -> None:
    """Direct uploads that were not completed in time, with what was sent for them; completed ones
    after a day more, in which completing them again gives the same answer."""
    gone = or_(
        and_(PresignedUpload.answer.is_(None), PresignedUpload.expires_at < db_now()),
        PresignedUpload.expires_at < db_now_plus(-COMPLETED_UPLOAD_SECONDS),
    )
    with catalog.read() as session:
        upload_ids = session.scalars(
            select(PresignedUpload.id).where(gone).limit(ROWS_PER_TRANSACTION)
        ).all()
    for upload_id in upload_ids:
        store.delete(incoming_key(upload_id))
    if upload_ids:
        with catalog.write() as session:
            session.execute(
                # Looked at again: it may have been completed at the last moment.
                delete(PresignedUpload).where(PresignedUpload.id.in_(upload_ids), gone)
            )


def collect_model_change_files(catalog: Catalog, store: ObjectStore) -> None:
    """What model changes kept between their slices, once they have ended or need it no more."""
    keys = [info.key for info in store.list(WORK)]
    if not keys:
        return
    with catalog.read() as session:
        unfinished = session.scalars(
            select(Job.id).where(
                Job.kind.in_(MODEL_CHANGE_JOBS),
                Job.state.in_(UNFINISHED_STATES),
                Job.generation_id.is_(None),
            )
        )
        needed = {str(job_id) for job_id in unfinished}
    for key in keys:
        if key.split("/")[1] not in needed:
            store.delete(key)


def collect_job_files(catalog: Catalog, store: ObjectStore, prefix: str, kind: JobKind) -> None:
    """Files that came for jobs of this kind, once these have ended. One that no job knows may just
    be coming in.
    """
    keys = [info.key for info in store.list(prefix)]
    if not keys:
        return
    with catalog.read() as session:
        ended = session.scalars(
            select(Job.params).where(Job.kind == kind, Job.state.not_in(UNFINISHED_STATES))
        )
        done = {params.get("object_key") for params in ended}
    for key in keys:
        if key in done:
            store.delete(key)


class CollectionHeld(Conflict):
    """Orphans are not collected before someone decides."""

    def __init__(self, hold: Hold) -> None:
        super().__init__("collection_held", hold.describe())
        self.hold = hold


@dataclass(slots=True)
class StoreCount:
    """What a walk over the store has counted."""

    objects: int = 0
    orphans: Counter[str] = field(default_factory=Counter)
    """By prefix."""
    orphan_bytes: Counter[str] = field(default_factory=Counter)
    """By prefix."""


def collect_orphans(
    catalog: Catalog,
    store: OwnedStore,
    age_seconds: float,
    *,
    max_share: float = 1.0,
    confirmed: bool = False,
) -> int:
    """Move objects older than `age_seconds` that no row knows to the trash; how many.

    Raises CollectionHeld before anything is moved, unless `confirmed`: where the catalog is behind
    its store, where it adopted the store without knowing them, and where they are more than
    `max_share` of all objects and more than ALWAYS_COLLECTED. The store then has a note of it. A
    `confirmed` run also ends the lag of a catalog that is behind: what only later catalogs knew
    lies in the trash then, and the journal goes on.
    """
    count, first = StoreCount(), list[ObjectInfo]()
    for info in find_orphans(catalog, store, age_seconds, count):
        if len(first) < REMEMBERED:
            first.append(info)
    found, before = count.orphans.total(), read_hold(store)
    if found and not confirmed:
        reason = None
        if before is not None and before.reason == HoldReason.ADOPTED:
            reason = HoldReason.ADOPTED
        elif catalog_lag(catalog, store) is not None:
            reason = HoldReason.CATALOG_BEHIND
        elif found > max(ALWAYS_COLLECTED, max_share * count.objects):
            reason = HoldReason.SHARE
        if reason is not None:
            hold = Hold(reason, found, count.orphan_bytes.total(), count.objects)
            if hold != before:
                write_hold(store, hold)
            raise CollectionHeld(hold)
    moved = _move_orphans(catalog, store, first)
    if found > len(first):
        moved += _move_orphans(catalog, store, find_orphans(catalog, store, age_seconds))
    if confirmed:
        accept_segments(catalog, store)
    if before is not None and (confirmed or before.reason != HoldReason.ADOPTED):
        end_hold(store)
    if moved:
        log.info("%d orphaned objects were moved to the trash", moved)
    return moved


def count_store(catalog: Catalog | None, store: ObjectStore) -> StoreCount:
    """All objects, and those of any age that no row knows; without a catalog: none is known."""
    count = StoreCount()
    if catalog is not None:
        for _ in find_orphans(catalog, store, 0.0, count):
            pass
        return count
    for prefix in REFERENCED_BY_PREFIX:
        for info in _counted(store.list(prefix), count):
            if prefix != ORIGINALS or is_original_key(info.key):
                count.orphans[prefix] += 1
                count.orphan_bytes[prefix] += info.size_bytes
    return count


def find_orphans(
    catalog: Catalog, store: ObjectStore, age_seconds: float, count: StoreCount | None = None
) -> Iterator[ObjectInfo]:
    """Objects older than `age_seconds` that no row knows: crashes between object and commit.

    `count`, if given, is brought up to date meanwhile.
    """
    count = StoreCount() if count is None else count
    before = _now(catalog) - timedelta(seconds=age_seconds)
    for prefix in REFERENCED_BY_PREFIX:
        for some in _batches(_counted(store.list(prefix), count)):
            for info in _unknown(catalog, prefix, [i for i in some if i.modified_at < before]):
                count.orphans[prefix] += 1
                count.orphan_bytes[prefix] += info.size_bytes
                yield info


def _counted(found: Iterable[ObjectInfo], count: StoreCount) -> Iterator[ObjectInfo]:
    for info in found:
        count.objects += 1
        yield info


def _batches(found: Iterable[ObjectInfo]) -> Iterator[list[ObjectInfo]]:
    iterator = iter(found)
    while some := list(islice(iterator, ROWS_PER_TRANSACTION)):
        yield some


def _unknown(catalog: Catalog, prefix: str, some: list[ObjectInfo]) -> list[ObjectInfo]:
    """Those that no row knows; all of them lie under the prefix."""
    if not some:
        return []
    with catalog.read() as session:
        known = set(REFERENCED_BY_PREFIX[prefix](session, [info.key for info in some]))
    return [info for info in some if info.key not in known]


def _move_orphans(catalog: Catalog, store: OwnedStore, found: Iterable[ObjectInfo]) -> int:
    """Move them to today's trash, but those that a row knows by now; how many."""
    today, moved = _now(catalog).date(), 0
    for prefix, same_prefix in groupby(found, lambda info: info.key.partition("/")[0] + "/"):
        for some in _batches(same_prefix):
            for info in _unknown(catalog, prefix, some):
                moved += move_to_trash(store, info.key, today)
    return moved


def empty_expired_trash(
    catalog: Catalog, store: ObjectStore, trash_days: float
) -> tuple[int, TrashSize]:
    """Delete what was moved to the trash more than `trash_days` ago; how many objects, and what is
    left."""
    return expire_trash(store, _now(catalog) - timedelta(days=trash_days))


def _now(catalog: Catalog) -> datetime:
    with catalog.read() as session:
        return session.execute(select(db_now())).scalar_one()


def collect_garbage(catalog: Catalog, store: ObjectStore, settings: Settings) -> None:
    """Everything above but the orphans, which need a walk over the whole store."""
    collect_superseded_chunks(catalog, store, settings.superseded_grace_seconds)
    collect_ended_generations(catalog, store, settings.retired_grace_seconds)
    collect_whitenings(catalog, store, settings.retired_grace_seconds)
    collect_deleted_photos(catalog, store, settings.retired_grace_seconds)
    collect_queries(catalog, store, settings.query_ttl_seconds)
    collect_model_change_files(catalog, store)
    collect_direct_uploads(catalog, store)
    collect_job_files(catalog, store, ARCHIVES, JobKind.BATCH)
    collect_job_files(catalog, store, CHECKPOINTS, JobKind.ADD_MODEL)


def _referenced_originals(session: Session, keys: list[str]) -> Iterable[str]:
    """Those of photos and of waiting items of batches; and whatever Placewise has not put there:
    that is not ours to remove."""
    stored = session.scalars(select(Photo.object_key).where(Photo.object_key.in_(keys)))
    waiting = session.scalars(
        select(BatchItem.object_key).where(
            BatchItem.object_key.in_(keys), BatchItem.state == JobState.QUEUED
        )
    )
    return [*stored, *filter(None, waiting), *(key for key in keys if not is_original_key(key))]


def _referenced_by_unfinished_jobs(kind: JobKind) -> Callable[[Session, list[str]], Iterable[str]]:
    """Files that came for jobs of this kind which have not ended."""

    def known(session: Session, keys: list[str]) -> Iterable[str]:
        waiting = session.scalars(
            select(Job.params).where(Job.kind == kind, Job.state.in_(UNFINISHED_STATES))
        )
        return [params["object_key"] for params in waiting if "object_key" in params]

    return known


def _referenced_incoming(session: Session, keys: list[str]) -> Iterable[str]:
    """Those of uploads that are not completed; of others, a URL that was still good sent more."""
    upload_ids = _parse_uuids(key.removeprefix(INCOMING) for key in keys)
    waiting = session.scalars(
        select(PresignedUpload.id).where(
            PresignedUpload.id.in_(upload_ids), PresignedUpload.answer.is_(None)
        )
    )
    return [incoming_key(upload_id) for upload_id in waiting]


def _referenced_thumbnails(session: Session, keys: list[str]) -> Iterable[str]:
    photo_ids = _parse_uuids(key.removeprefix(THUMBNAILS).removesuffix(".jpg") for key in keys)
    live = session.scalars(
        select(Photo.id).where(Photo.id.in_(photo_ids), Photo.deleted_at.is_(None))
    )
    return [thumbnail_key(photo_id) for photo_id in live]


def _referenced_chunks(session: Session, keys: list[str]) -> Iterable[str]:
    arrays = {key.rpartition(".")[0] + ".npy" for key in keys}
    known = session.scalars(select(Chunk.object_key).where(Chunk.object_key.in_(arrays)))
    return [name for key in known for name in (key, manifest_key(key), codes_key(key))]


def _referenced_vocabularies(session: Session, keys: list[str]) -> Iterable[str]:
    stored = session.scalars(select(Vocabulary.object_key).where(Vocabulary.object_key.in_(keys)))
    waiting = session.scalars(
        select(Job.params).where(Job.kind == JobKind.IMPORT, Job.state.in_(UNFINISHED_STATES))
    )
    return [*stored, *(params["object_key"] for params in waiting)]


def _referenced_whitenings(session: Session, keys: list[str]) -> Iterable[str]:
    return session.scalars(
        select(StoredWhitening.object_key).where(StoredWhitening.object_key.in_(keys))
    )


def _referenced_models(session: Session, keys: list[str]) -> Iterable[str]:
    return filter(None, session.scalars(select(Model.object_key).where(Model.object_key.in_(keys))))


def _referenced_queries(session: Session, keys: list[str]) -> Iterable[str]:
    job_ids = _parse_uuids(key.removeprefix(QUERIES).partition(".")[0] for key in keys)
    known = session.scalars(select(Job.id).where(Job.id.in_(job_ids)))
    return [key for job_id in known for key in query_object_keys(job_id)]


def _referenced_local_features(session: Session, keys: list[str]) -> Iterable[str]:
    """Those of live photos in generations that still have their descriptors."""
    named = {key: key.removeprefix(FEATURES).removesuffix(".npy").split("/") for key in keys}
    generation_ids = _parse_uuids(names[0] for names in named.values())
    photo_ids = _parse_uuids(names[-1] for names in named.values())
    known = session.execute(
        select(Descriptor.generation_id, Descriptor.photo_id)
        .join(Photo, Photo.id == Descriptor.photo_id)
        .where(
            Descriptor.generation_id.in_(generation_ids),
            Descriptor.photo_id.in_(photo_ids),
            Photo.deleted_at.is_(None),
        )
    )
    return [local_features_key(generation_id, photo_id) for generation_id, photo_id in known]


def _parse_uuids(names: Iterable[str]) -> set[UUID]:
    """Those of the names that are ids: what else lies in the store belongs to no row."""
    found = set()
    for name in names:
        with contextlib.suppress(ValueError):
            found.add(UUID(name))
    return found


REFERENCED_BY_PREFIX: dict[str, Callable[[Session, list[str]], Iterable[str]]] = {
    INCOMING: _referenced_incoming,
    ARCHIVES: _referenced_by_unfinished_jobs(JobKind.BATCH),
    CHECKPOINTS: _referenced_by_unfinished_jobs(JobKind.ADD_MODEL),
    MODELS: _referenced_models,
    ORIGINALS: _referenced_originals,
    THUMBNAILS: _referenced_thumbnails,
    "chunks/": _referenced_chunks,
    VOCABULARIES: _referenced_vocabularies,
    WHITENINGS: _referenced_whitenings,
    QUERIES: _referenced_queries,
    FEATURES: _referenced_local_features,
}
