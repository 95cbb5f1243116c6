"""What the rows of a map's photos teach of its words, read a lesson at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.steward.ask import MAX_READ_ATTEMPTS, map_damaged_error
from shared.catalog.chunks import find_descriptor_rows
from shared.catalog.session import Catalog
from shared.chunks import Rows, read_rows, rows_are_valid
from shared.errors import NotFound
from shared.objects import ObjectStore
from shared.word_weights.learn import PairStatistics, empty_pair_statistics
from shared.word_weights.pairs import PairBatch

ROW_BATCH_BYTES = 64_000_000  # of rows in memory: 160 photos at 98,304 dimensions
MIN_BATCH_ROWS = 8  # however long they are: the far pairs come from the same photos


def photos_per_lesson(dimension: int) -> int:
    """How many photos a lesson may have."""
    return max(MIN_BATCH_ROWS, ROW_BATCH_BYTES // (dimension * np.dtype(np.float32).itemsize))


def accumulate_pair_statistics(
    catalog: Catalog,
    store: ObjectStore,
    generation_id: UUID,
    photo_ids: Sequence[UUID],
    lessons: Sequence[PairBatch],
    words: int,
    on_lesson: Callable[[], None],
) -> PairStatistics:
    """What the lessons about `photo_ids` come to; pairs of photos deleted since are left out.

    Holds the rows of one lesson at a time. Conflict (`map_damaged`) for rows that can't be read.
    """
    taught = empty_pair_statistics(words)
    for lesson in lessons:
        on_lesson()
        rows, there = _read_photo_rows(
            catalog, store, generation_id, [photo_ids[i] for i in lesson.photos]
        )
        near, far = (pairs[there[pairs].all(axis=1)] for pairs in (lesson.near, lesson.far))
        taught += PairStatistics.from_rows(rows, near, far, words)
    return taught


def _read_photo_rows(
    catalog: Catalog, store: ObjectStore, generation_id: UUID, photo_ids: Sequence[UUID]
) -> tuple[Rows, NDArray[np.bool_]]:
    """(n, dimension) rows in the photos' order, and which of them there are."""
    place_of = {photo_id: place for place, photo_id in enumerate(photo_ids)}
    for attempt in range(1, MAX_READ_ATTEMPTS + 1):
        with catalog.read() as session:
            located = find_descriptor_rows(session, generation_id, photo_ids)
        found: Rows | None = None
        there = np.zeros(len(photo_ids), dtype=bool)
        try:
            for object_key, rows in located.items():
                read = _read_rows_checked(store, object_key, [row for row, _ in rows])
                if found is None:
                    found = np.zeros((len(photo_ids), read.shape[1]), dtype=np.float32)
                places = [place_of[photo_id] for _, photo_id in rows]
                found[places], there[places] = read, True
        except NotFound as error:  # the chunk was merged into another between the two reads
            if attempt == MAX_READ_ATTEMPTS:
                raise map_damaged_error(sorted(located)) from error
            continue
        return found if found is not None else np.zeros((len(photo_ids), 0), np.float32), there
    raise AssertionError("the last try returns or raises")


def _read_rows_checked(store: ObjectStore, object_key: str, rows: Sequence[int]) -> Rows:
    try:
        read = read_rows(store, object_key, rows)
    except (IndexError, ValueError) as error:
        raise map_damaged_error([object_key]) from error
    if not rows_are_valid(read).all():
        raise map_damaged_error([object_key])
    return read
