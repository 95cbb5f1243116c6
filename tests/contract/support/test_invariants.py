"""The counts after faults see each kind of damage."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from sqlalchemy import delete, update
from sqlalchemy.orm import Session

from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.session import Catalog
from shared.catalog.photos import Photo
from shared.jobs import JobState
from shared.storage import FolderStore
from shared.storage.chunks import manifest_key
from tests.support.catalog_rows import add_chunk, add_generation, add_job, add_map, add_photo
from tests.support.invariants import find_violations

Damage = Callable[[Session, FolderStore, Photo, Chunk], object]
DAMAGES: dict[str, Damage] = {
    "is not in the catalog": lambda session, *_: session.execute(
        update(Photo).values(sha256="0" * 64)
    ),
    "is not in the object store": lambda _s, store, photo, _c: store.delete(photo.object_key),
    "has no descriptor": lambda session, *_: session.execute(delete(Descriptor)),
    "is stored 2 times": lambda session, _s, photo, _c: add_photo(
        session, add_map(session, "another").id, sha256=photo.sha256
    ),
    "is queued": lambda session, _s, photo, _c: add_job(session, photo.map_id),
    "is failed": lambda session, _s, photo, _c: add_job(
        session, photo.map_id, state=JobState.FAILED, error={"code": "worker_crashed"}
    ),
    "does not match its hash": lambda session, *_: session.execute(
        update(Chunk).values(sha256="0" * 64)
    ),
    "chunk": lambda _s, store, _p, chunk: store.delete(manifest_key(chunk.object_key)),
}


@pytest.mark.databases("sqlite")
@pytest.mark.parametrize("seen", [None, *DAMAGES])
def test_damage_is_seen_and_nothing_else(
    catalog: Catalog, store: FolderStore, seen: str | None
) -> None:
    with catalog.write() as session:
        map_id = add_map(session).id
        photo = add_photo(session, map_id)
        generation_id = add_generation(session, map_id).id
    store.put(photo.object_key, b"its bytes")
    add_chunk(catalog, store, generation_id, [photo.id])
    if seen is not None:
        with catalog.write() as session:
            DAMAGES[seen](session, store, photo, session.query(Chunk).one())
    violations = find_violations(catalog, store, {photo.sha256: photo.id})
    if seen is None:
        assert not violations
    else:
        [violation] = violations
        assert seen in violation
