"""Rows to search in, and what brute force in float64 finds."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from uuid import UUID

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.search import executor
from services.search.chunk_loader import LoadedChunk
from services.search.executor import SCORE_DECIMALS
from services.search.photo_columns import PhotoColumns
from services.search.query_batcher import QueryBatcher
from services.search.snapshot import Snapshot
from shared.catalog.photos import PhotoFilterValues, PhotoRole
from shared.codes.sign_codes import encode_signs
from shared.ids import new_id
from shared.search_api.protocol import SearchResponse
from shared.storage.chunks import StoredRows

DIMENSION = 7168

Rows = NDArray[np.float32]

LAST_DECIMAL = 1.5 * 10**-SCORE_DECIMALS
"""Of a score, which may differ by one there: the order of a sum depends on the processor"""


def photo(number: int) -> UUID:
    return UUID(int=number + 1)


def snapshot_of(
    rows: StoredRows,
    pieces: int = 3,
    *,
    coded: bool = True,
    numbers: Sequence[int] | None = None,
    dead: Collection[int] = (),
) -> Snapshot:
    """The rows in so many chunks, with sign codes or without; `numbers` are those of their photos.

    Rows of `dead` numbers have no photo.
    """
    numbers = range(len(rows)) if numbers is None else numbers
    bounds = np.linspace(0, len(rows), pieces + 1).astype(int)
    chunks = []
    for a, b in pairwise(bounds.tolist()):
        live = [(row, facts_of(photo(n))) for row, n in enumerate(numbers[a:b]) if n not in dead]
        codes = encode_signs(rows[a:b]) if coded else None
        columns = PhotoColumns.of(b - a, live)
        chunks.append(LoadedChunk(new_id(), f"chunks/{a}.npy", rows[a:b], columns, codes=codes))
    return Snapshot(new_id(), new_id(), 1, tuple(chunks))


def brute_force(
    rows: StoredRows,
    query: Rows,
    k: int,
    selected: NDArray[np.bool_] | None = None,
    numbers: Sequence[int] | None = None,
) -> list[tuple[UUID, float]]:
    numbers = range(len(rows)) if numbers is None else numbers
    exact = query.astype(np.float64)
    exact /= np.linalg.norm(exact)
    scores = np.round([row.astype(np.float64) @ exact for row in rows], SCORE_DECIMALS)
    scored = [
        (-float(np.clip(score, -1.0, 1.0)), photo(number))
        for row, (number, score) in enumerate(zip(numbers, scores.tolist(), strict=True))
        if selected is None or selected[row]
    ]
    return [(photo_id, -score) for score, photo_id in sorted(scored)[:k]]


def assert_best(found: list[tuple[UUID, float]], exact: dict[UUID, float], k: int) -> None:
    """Assert that these are the k best, ordered by score and then by id.

    A score may differ by one in its last decimal.
    """
    assert len(found) == min(k, len(exact))
    assert found == sorted(found, key=lambda hit: (-hit[1], hit[0]))
    assert all(abs(score - exact[photo_id]) < LAST_DECIMAL for photo_id, score in found)
    if not found:
        return
    last_id, lowest = found[-1]
    for photo_id in exact.keys() - {photo_id for photo_id, _ in found}:
        assert exact[photo_id] < lowest + LAST_DECIMAL
        assert exact[photo_id] != exact[last_id] or photo_id > last_id


def answer(snapshot: Snapshot, query: Rows, selected: NDArray[np.bool_], k: int) -> SearchResponse:
    """Of a query that comes alone."""
    return executor.execute_query(snapshot, query, selected, k, QueryBatcher())


def hits_of(found: SearchResponse) -> list[tuple[UUID, float]]:
    return [(hit.photo_id, hit.score) for hit in found.hits]


def places(seed: int, count: int, dimension: int = DIMENSION) -> Rows:
    """Rows in neighbourhoods: some places were photographed many times."""
    rng = np.random.default_rng(seed)
    centres = rng.standard_normal((max(1, count // 5), dimension))
    near = centres[rng.integers(len(centres), size=count)]
    rows = near + rng.uniform(0.1, 3.0, size=(count, 1)) * rng.standard_normal((count, dimension))
    found: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A map of rows, with duplicates and zeros among them, and a query."""

    rows: StoredRows
    pieces: int
    query: Rows
    selected: NDArray[np.bool_]
    k: int

    @property
    def exact(self) -> dict[UUID, float]:
        """The scores of all rows that may be found."""
        return dict(brute_force(self.rows, self.query, len(self.rows), self.selected))


@st.composite
def cases(draw: st.DrawFn, dimension: int) -> Case:
    count = draw(st.integers(1, 300))
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    rows = places(int(rng.integers(2**31)), count, dimension)
    for _ in range(draw(st.integers(0, 30))):
        a, b = rng.integers(0, count, 2)
        rows[a] = rows[b]
    rows[rng.integers(0, count, draw(st.integers(0, 3)))] = 0
    query = rng.standard_normal(dimension).astype(np.float32)
    if draw(st.booleans()):  # of a place on the map
        query = query * np.float32(0.005) + rows[rng.integers(count)]
    stored: StoredRows = rows.astype(draw(st.sampled_from([np.float32, np.float16])))
    return Case(
        rows=stored,
        pieces=draw(st.integers(1, 4)),
        query=query,
        selected=rng.random(count) < draw(st.sampled_from([1.0, 0.5, 0.02])),
        k=draw(st.sampled_from([1, 2, 10, 100, 400])),
    )


def facts_of(
    photo_id: UUID,
    *,
    latitude: float | None = None,
    longitude: float | None = None,
    captured_at: datetime | None = None,
    place: str | None = None,
    tags: tuple[str, ...] = (),
) -> PhotoFilterValues:
    """A live photo; fields that are not given are unknown."""
    return PhotoFilterValues(
        photo_id, PhotoRole.DATABASE, None, latitude, longitude, captured_at, place, list(tags)
    )
