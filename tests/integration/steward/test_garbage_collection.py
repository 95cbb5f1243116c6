"""Garbage collection: superseded chunks, ended generations, deleted photos, queries, job files."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import func, select, update

from services.steward.tasks.garbage_collection import (
    collect_deleted_photos,
    collect_ended_generations,
    collect_queries,
    collect_reconstructions,
    collect_superseded_chunks,
)
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.base import db_now_plus
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.photos import Photo, get_photo
from shared.catalog.reconstructions import Reconstruction
from shared.jobs import Job, JobKind, JobState
from shared.storage import FolderStore
from shared.storage.keys import preview_key, query_key, query_vector_key, thumbnail_key
from tests.integration.steward.chunk_map import HOUR_SECONDS, ChunkMap
from tests.integration.steward.test_compaction import sum_of
from tests.support.catalog_rows import (
    add_chunk,
    add_generation,
    add_job,
    add_reconstruction,
    ask,
    stored_rows,
    upload,
)

pytestmark = pytest.mark.databases("postgresql")


def test_superseded_chunks_go_after_the_grace_and_not_before(chunk_map: ChunkMap) -> None:
    photo_ids = sum_of(chunk_map.chunks(2, 3))
    old = chunk_map.objects("chunks/")
    chunk_map.merge_all()
    collect_superseded_chunks(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)
    assert old < chunk_map.objects("chunks/")
    with chunk_map.catalog.write() as session:
        session.execute(
            update(Chunk)
            .where(Chunk.superseded_at.is_not(None))
            .values(superseded_at=db_now_plus(-HOUR_SECONDS - 1))
        )
    collect_superseded_chunks(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)
    assert not old & chunk_map.objects("chunks/")
    with chunk_map.catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(Chunk)) == 1
    chunk_map.check_rows(photo_ids)


def test_reconstructions_that_were_replaced_or_given_up_go_after_the_grace(
    chunk_map: ChunkMap,
) -> None:
    long_ago = datetime.now(UTC) - timedelta(seconds=HOUR_SECONDS + 60)

    def add(**columns: Any) -> UUID:
        generation = session.get_one(Generation, chunk_map.generation_id)
        return add_reconstruction(session, chunk_map.store, generation, **columns).id

    with chunk_map.catalog.write() as session:
        job = add_job(session, chunk_map.map_id, JobKind.RECONSTRUCT, params={"object_key": None})
        failed, failed_long_ago = (
            add_job(session, job.map_id, JobKind.RECONSTRUCT, state=JobState.FAILED, finished_at=at)
            for at in (datetime.now(UTC), long_ago)
        )
        replaced = add(finished_at=long_ago)
        of_other_features = add(features_model="other@1", finished_at=long_ago)
        last_but_one, last = add(finished_at=long_ago), add()
        running, retried, given_up = (
            add(finished_at=None, job_id=one.id) for one in (job, failed, failed_long_ago)
        )
    collect_reconstructions(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)
    remaining = {of_other_features, last_but_one, last, running, retried}
    with chunk_map.catalog.read() as session:
        assert set(session.scalars(select(Reconstruction.id))) == remaining
    in_store = {UUID(key.split("/")[1]) for key in chunk_map.objects("reconstructions/")}
    assert in_store == remaining
    assert not remaining & {replaced, given_up}


def test_ended_generations_lose_their_chunks_after_the_grace_and_not_before(
    chunk_map: ChunkMap,
) -> None:
    chunk_map.chunks(2, 3)
    with chunk_map.catalog.write() as session:
        session.get_one(Generation, chunk_map.generation_id).state = GenerationState.RETIRED
        session.flush()
        ended = [chunk_map.generation_id]
        ended.append(add_generation(session, chunk_map.map_id, GenerationState.ABANDONED).id)
        active = add_generation(session, chunk_map.map_id).id
    add_chunk(chunk_map.catalog, chunk_map.store, ended[1], chunk_map.photos(1))
    stay = chunk_map.photos(2)
    add_chunk(chunk_map.catalog, chunk_map.store, active, stay)
    for generation_id in ended:
        chunk_map.change(Generation, generation_id, ended_at=db_now_plus(-HOUR_SECONDS + 60))
    collect_ended_generations(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)
    assert len(chunk_map.objects("chunks/")) == 2 * 4
    for generation_id in ended:
        chunk_map.change(Generation, generation_id, ended_at=db_now_plus(-HOUR_SECONDS - 1))
    collect_ended_generations(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)
    assert {key.split("/")[1] for key in chunk_map.objects("chunks/")} == {str(active)}
    assert set(stored_rows(chunk_map.catalog, chunk_map.store, active)) == set(stay)
    with chunk_map.catalog.read() as session:
        assert set(session.scalars(select(Descriptor.generation_id))) == {active}
        assert session.scalar(select(func.count()).select_from(Generation)) == 3  # as history
    collect_ended_generations(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)


def test_a_deleted_photos_bytes_go_at_once_and_its_row_after_the_grace(chunk_map: ChunkMap) -> None:
    data = b"the bytes"
    photo_id, job_id = upload(chunk_map.catalog, chunk_map.store, chunk_map.map_id, data)
    stays, _ = upload(chunk_map.catalog, chunk_map.store, chunk_map.map_id, b"others")
    add_chunk(chunk_map.catalog, chunk_map.store, chunk_map.generation_id, [photo_id, stays])
    for each in (photo_id, stays):
        chunk_map.store.put(thumbnail_key(each), b"small")
        chunk_map.store.put(preview_key(each), b"larger")
    chunk_map.delete(photo_id)
    collect_deleted_photos(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)
    assert chunk_map.objects("thumbnails/") == {thumbnail_key(stays)}
    assert chunk_map.objects("previews/") == {preview_key(stays)}
    with chunk_map.catalog.read() as session:
        assert chunk_map.objects("originals/") == {
            get_photo(session, chunk_map.map_id, stays).object_key
        }
        assert session.get_one(Photo, photo_id).object_key == ""
    again, _ = upload(chunk_map.catalog, chunk_map.store, chunk_map.map_id, data)  # at once, too
    chunk_map.delete(again)

    chunk_map.change(Photo, photo_id, deleted_at=db_now_plus(-HOUR_SECONDS - 1))
    version = chunk_map.version()
    collect_deleted_photos(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)
    with chunk_map.catalog.read() as session:
        assert session.get(Photo, photo_id) is None
        assert session.get(Job, job_id) is None
        assert session.get(Photo, again) is not None  # its grace is not over
    assert chunk_map.version() == version + 1
    chunk_map.check_rows([stays])
    assert len(chunk_map.objects("originals/")) == 1
    last, _ = upload(chunk_map.catalog, chunk_map.store, chunk_map.map_id, data)
    with chunk_map.catalog.read() as session:
        assert get_photo(session, chunk_map.map_id, last).id == last


def test_objects_are_deleted_before_their_rows(
    chunk_map: ChunkMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo_id, _ = upload(chunk_map.catalog, chunk_map.store, chunk_map.map_id, b"the bytes")
    chunk_map.delete(photo_id)
    chunk_map.change(Photo, photo_id, deleted_at=db_now_plus(-2 * HOUR_SECONDS))

    def away(*_: Any) -> None:
        raise OSError("the disk is not there")

    with monkeypatch.context() as patched:
        patched.setattr(FolderStore, "delete", away)
        with pytest.raises(OSError, match="disk"):
            collect_deleted_photos(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)
    with chunk_map.catalog.read() as session:
        assert session.get_one(Photo, photo_id).object_key != ""
    collect_deleted_photos(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)
    assert chunk_map.objects("originals/") == set()


def test_objects_of_queries_are_deleted_after_their_retention(chunk_map: ChunkMap) -> None:
    old, young = (ask(chunk_map.catalog, chunk_map.store, chunk_map.map_id, b"q") for _ in range(2))
    for job_id in (old, young):
        chunk_map.store.put(query_vector_key(job_id), b"v")
    index = add_one_job(chunk_map, JobKind.INDEX)
    for job_id in (old, index):
        chunk_map.change(Job, job_id, created_at=db_now_plus(-HOUR_SECONDS - 1))
    collect_queries(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)
    assert chunk_map.objects("queries/") == {query_key(young), query_vector_key(young)}
    with chunk_map.catalog.read() as session:
        assert set(session.scalars(select(Job.id))) == {young, index}


def add_one_job(chunk_map: ChunkMap, kind: JobKind, **columns: Any) -> UUID:
    with chunk_map.catalog.write() as session:
        return add_job(session, chunk_map.map_id, kind, **columns).id
