"""Maps whose descriptor rows are stored as float16, from the upload to the answer."""

from __future__ import annotations

from typing import Any
from uuid import UUID

import numpy as np
import pytest

from services.steward.tasks.compaction import merge_small_chunks
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.integrity.verify import verify_store
from shared.storage import FolderStore
from tests.integration.conftest import LentDecoders
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import stored_rows
from tests.support.photos import photo_bytes


def half_map(service: Service) -> list[str]:
    """A map `half` with five searchable photos in three chunks; their ids."""
    service.json("POST", "/maps", 201, json={"name": "half", "rows": "float16"})
    return [
        photo_id
        for numbers in ((1, 2), (3,), (4, 5))
        for photo_id in service.indexed(*numbers, map_name="half")
    ]


def generation(service: Service) -> Any:
    return service.json("GET", "/generations", params={"map": "half"})[0]


def rows_of(service: Service) -> dict[UUID, Any]:
    generation_id = UUID(generation(service)["generation_id"])
    return stored_rows(service.catalog, service.store, generation_id)


def answers(service: Service, file_id: str) -> list[tuple[str, float]]:
    service.search.sync()
    found = service.json("POST", f"/similarity/{file_id}", params={"map": "half"})
    return [(hit["image_id"], hit["similarity_score"]) for hit in found["similar_images"]]


def brute_force(rows: dict[UUID, Any], file_id: str) -> list[tuple[str, float]]:
    query = rows[UUID(file_id)].astype(np.float64)
    query /= np.linalg.norm(query)
    scores = [
        (-min(1.0, float(row.astype(np.float64) @ query)), str(photo_id))
        for photo_id, row in rows.items()
        if str(photo_id) != file_id
    ]
    return [(photo_id, -score) for score, photo_id in sorted(scores)]


def assert_same(found: list[tuple[str, float]], expected: list[tuple[str, float]]) -> None:
    assert [photo_id for photo_id, _ in found] == [photo_id for photo_id, _ in expected]
    np.testing.assert_allclose([s for _, s in found], [s for _, s in expected], atol=1e-6)


def test_uploads_are_searched_by_their_float16_rows_before_and_after_a_merge(
    service: Service, store: FolderStore
) -> None:
    photos = half_map(service)
    assert generation(service)["rows"] == "float16"
    rows = rows_of(service)
    assert {row.dtype for row in rows.values()} == {np.dtype(np.float16)}
    before = [answers(service, photo_id) for photo_id in photos]
    for photo_id, found in zip(photos, before, strict=True):
        assert_same(found, brute_force(rows, photo_id))
    job = service.ask(photo_bytes(3), map_name="half")
    service.drain()
    service.search.sync()
    result = service.json("GET", f"/jobs/{job}/result", params={"map": "half"})
    best = result["similar_images"][0]
    assert best["image_id"] == photos[2], "a photo that is not stored, too"
    assert best["similarity_score"] == pytest.approx(1.0, abs=1e-4)
    assert merge_small_chunks(service.catalog, store, Settings(), compact_chunks=2) == 1
    merged = rows_of(service)
    assert {row.dtype for row in merged.values()} == {np.dtype(np.float16)}
    assert all(np.array_equal(merged[photo_id], row) for photo_id, row in rows.items())
    assert [answers(service, photo_id) for photo_id in photos] == before
    assert verify_store(service.catalog, store, originals=True).faults == []


def test_rows_of_a_map_are_rounded_by_its_next_generation_and_described_again_for_more_precision(
    service: Service, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = {"name": "half", "extractor": "test-tiny-avg", "rows": "float32"}
    service.json("POST", "/maps", 201, json=body)
    photos = service.indexed(1, 2, 3, map_name="half")
    changed = service.json("PATCH", "/maps/half", json={"rows": "float16"})
    assert changed["rows"] == "float16"
    (late,) = service.indexed(4, map_name="half")
    assert generation(service)["rows"] == "float32", "until the next generation"
    full = rows_of(service)
    assert {row.dtype for row in full.values()} == {np.dtype(np.float32)}
    service.json("DELETE", f"/uploads/{late}", params={"map": "half"})
    before = answers(service, photos[0])

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a photo was decoded")

    with monkeypatch.context() as patched:
        patched.setattr(LentDecoders, "decode", refuse)
        reindex(service)
    assert generation(service)["rows"] == "float16"
    rounded = rows_of(service)
    assert {row.dtype for row in rounded.values()} == {np.dtype(np.float16)}
    assert set(rounded) == {UUID(photo_id) for photo_id in photos}
    assert all((row == full[photo_id].astype("float16")).all() for photo_id, row in rounded.items())
    after = answers(service, photos[0])
    assert [photo_id for photo_id, _ in after] == [photo_id for photo_id, _ in before]
    np.testing.assert_allclose([s for _, s in after], [s for _, s in before], atol=1e-3)

    service.json("PATCH", "/maps/half", json={"rows": "float32"})
    reindex(service)
    again = rows_of(service)
    assert all((row == full[photo_id]).all() for photo_id, row in again.items())
    assert {row.dtype for row in again.values()} == {np.dtype(np.float32)}


def reindex(service: Service) -> None:
    """Describe the map `half` into a new generation, and switch to it."""
    service.search.sync()
    before = generation(service)["generation_id"]
    body = {"extractor": "test-tiny-avg"}
    service.done(service("POST", "/generations", params={"map": "half"}, json=body), "half")
    assert generation(service)["state"] == "active"
    assert generation(service)["generation_id"] != before
