"""What the rows of a map's photos teach of its words, read a lesson at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.steward.ask import TRIES, damaged
from shared.catalog.chunks import rows_of
from shared.catalog.session import Catalog
from shared.chunks import Rows, are_whole, read_rows
from shared.errors import NotFound
from shared.objects import ObjectStore
from shared.word_weights.learn import Taught, nothing_taught
from shared.word_weights.pairs import Lesson

LESSON_BYTES = 64_000_000  # of rows in memory: 160 photos at 98,304 dimensions
LEAST_ROWS = 8  # however long they are: the far pairs come from the same photos


def rows_at_once(dimension: int) -> int:
    """How many photos a lesson may have."""
    return max(LEAST_ROWS, LESSON_BYTES // (dimension * np.dtype(np.float32).itemsize))


def teach(
    catalog: Catalog,
    store: ObjectStore,
    generation_id: UUID,
    photo_ids: Sequence[UUID],
    lessons: Sequence[Lesson],
    words: int,
    before_each: Callable[[], None],
) -> Taught:
    """What the lessons about `photo_ids` come to; pairs of photos deleted since are left out.

    Holds the rows of one lesson at a time. Conflict (`map_damaged`) for rows that can't be read.
    """
    taught = nothing_taught(words)
    for lesson in lessons:
        before_each()
        rows, there = _read(catalog, store, generation_id, [photo_ids[i] for i in lesson.photos])
        near, far = (pairs[there[pairs].all(axis=1)] for pairs in (lesson.near, lesson.far))
        taught += Taught.of(rows, near, far, words)
    return taught


def _read(
    catalog: Catalog, store: ObjectStore, generation_id: UUID, photo_ids: Sequence[UUID]
) -> tuple[Rows, NDArray[np.bool_]]:
    """(n, dimension) rows in the photos' order, and which of them there are."""
    place_of = {photo_id: place for place, photo_id in enumerate(photo_ids)}
    for attempt in range(1, TRIES + 1):
        with catalog.read() as session:
            located = rows_of(session, generation_id, photo_ids)
        found: Rows | None = None
        there = np.zeros(len(photo_ids), dtype=bool)
        try:
            for object_key, rows in located.items():
                read = _read_checked(store, object_key, [row for row, _ in rows])
                if found is None:
                    found = np.zeros((len(photo_ids), read.shape[1]), dtype=np.float32)
                places = [place_of[photo_id] for _, photo_id in rows]
                found[places], there[places] = read, True
        except NotFound as error:  # the chunk was merged into another between the two reads
            if attempt == TRIES:
                raise damaged(sorted(located)) from error
            continue
        return found if found is not None else np.zeros((len(photo_ids), 0), np.float32), there
    raise AssertionError("the last try returns or raises")


def _read_checked(store: ObjectStore, object_key: str, rows: Sequence[int]) -> Rows:
    try:
        read = read_rows(store, object_key, rows)
    except (IndexError, ValueError) as error:
        raise damaged([object_key]) from error
    if not are_whole(read).all():
        raise damaged([object_key])
    return read
