"""Damage of every kind is found, and what can be repaired is."""

from __future__ import annotations

import json
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import delete, select

from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.base import Base
from shared.catalog.generations import Generation
from shared.catalog.maps import Map, mark_map_deleted
from shared.catalog.photos import Photo
from shared.integrity.verify import IntegrityReport, repair_descriptors, verify_store
from shared.jobs import InProcessWakeups
from shared.storage.chunks import features_key, manifest_key
from tests.integration.harness import Harness
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_reconstruction


def looked(service: Service, *, originals: bool = False) -> IntegrityReport:
    return verify_store(service.catalog, service.store, originals=originals)


def faults(report: IntegrityReport) -> set[tuple[str, str]]:
    return {(str(fault.wrong), fault.what) for fault in report.faults}


def chunk_keys(service: Service) -> list[str]:
    with service.catalog.read() as session:
        statement = select(Chunk.object_key).where(Chunk.superseded_at.is_(None)).order_by(Chunk.id)
        return list(session.scalars(statement))


def mend(service: Service, report: IntegrityReport) -> int:
    return repair_descriptors(service.catalog, InProcessWakeups(), report)


def test_an_intact_store_has_no_faults_and_deleted_photos_need_no_objects(
    service: Service,
) -> None:
    first, *_ = service.indexed(1, 2, 3)
    report = looked(service, originals=True)
    assert report.faults == []
    assert report.checked == {"chunk": 1, "manifest": 1, "feature file": 1, "original": 3}
    assert report.read_bytes > 0
    with service.catalog.read() as session:
        key = session.get_one(Photo, UUID(first)).object_key
    service.json("DELETE", f"/uploads/{first}", params={"permanently": True})
    service.store.delete(key)
    assert looked(service, originals=True).faults == []


@pytest.mark.parametrize("damage", ["changed", "missing", "manifest missing", "manifest another"])
def test_photos_of_a_damaged_chunk_are_described_again(service: Service, damage: str) -> None:
    file_ids = service.indexed(1, 2, 3)
    before = service.json("POST", f"/similarity/{file_ids[0]}")["similar_images"]
    (key,) = chunk_keys(service)
    manifest = manifest_key(key)
    if damage == "changed":
        service.store.put(key, service.store.get(key)[:-1] + b"x")
        expected = ("damaged", "chunk")
    elif damage == "missing":
        service.store.delete(key)
        expected = ("missing", "chunk")
    elif damage == "manifest missing":
        service.store.delete(manifest)
        expected = ("missing", "manifest")
    else:
        body = json.loads(service.store.get(manifest))
        service.store.put(manifest, json.dumps({**body, "sha256": "0" * 64}).encode())
        expected = ("different", "manifest")
    report = looked(service)
    assert faults(report) == {expected}
    assert mend(service, report) == 3
    assert mend(service, report) == 0, "once is enough"
    service.drain()
    assert looked(service).faults == []
    assert key not in chunk_keys(service)
    after = service.json("POST", f"/similarity/{file_ids[0]}")["similar_images"]
    for one, other in zip(before, after, strict=True):
        assert one["image_id"] == other["image_id"]
        assert one["similarity_score"] == pytest.approx(other["similarity_score"], abs=1e-5)


@pytest.mark.parametrize("damage", ["changed", "missing"])
def test_damaged_local_features_are_given_up_and_photos_are_found_all_the_same(
    service: Service, damage: str
) -> None:
    first, *_ = service.indexed(1, 2, 3)
    before = service.json("POST", f"/similarity/{first}")["similar_images"]
    (chunk,) = chunk_keys(service)
    key = features_key(chunk)
    if damage == "changed":
        service.store.put(key, service.store.get(key)[:-1] + b"x")
    else:
        service.store.delete(key)
    report = looked(service)
    assert faults(report) == {("damaged" if damage == "changed" else "missing", "feature file")}
    assert mend(service, report) == 0, "no photo is described again"
    assert looked(service).faults == []
    assert chunk_keys(service) == [chunk]
    assert service.json("POST", f"/similarity/{first}")["similar_images"] == before
    features = service.json("GET", "/maps/default")["local_features"]
    assert (features["photos"], features["missing"], features["bytes"]) == (0, 3, 0)


def test_rows_that_belong_to_other_photos_are_found(service: Service) -> None:
    first, _ = service.indexed(1, 2)
    with service.catalog.write() as session:
        session.scalars(select(Descriptor).where(Descriptor.photo_id == UUID(first))).one().row = 5
    report = looked(service)
    assert faults(report) == {("different", "chunk")}
    assert "1 photos have another row" in report.faults[0].detail


@pytest.mark.databases("sqlite", "postgresql")
def test_photos_without_a_descriptor_are_found_and_described_again(service: Service) -> None:
    first, _ = service.indexed(1, 2)
    with service.catalog.write() as session:
        session.execute(delete(Descriptor).where(Descriptor.photo_id == UUID(first)))
    report = looked(service)
    assert [(str(f.wrong), f.name) for f in report.faults] == [("not_described", first)]
    assert mend(service, report) == 1
    service.drain()
    assert looked(service).faults == []


def test_a_changed_original_is_found_by_its_hash_and_a_missing_one_without(
    service: Service,
) -> None:
    first, second = service.indexed(1, 2)
    with service.catalog.read() as session:
        changed = session.get_one(Photo, UUID(first)).object_key
        lost = session.get_one(Photo, UUID(second)).object_key
    data = service.store.get(changed)
    service.store.put(changed, bytes([data[0] ^ 1]) + data[1:])
    service.store.delete(lost)
    assert faults(looked(service)) == {("missing", "original")}
    report = looked(service, originals=True)
    assert faults(report) == {("missing", "original"), ("damaged", "original")}
    assert mend(service, report) == 0


def test_a_changed_vocabulary_is_found(vlads: Harness) -> None:
    vlads.upload(*range(10))
    vlads.fit()
    (key,) = vlads.keys("vocabularies/")
    vlads.store.put(key, vlads.store.get(key)[:-4] + b"\0\0\0\0")
    stages: set[str] = set()
    found = verify_store(
        vlads.catalog,
        vlads.store,
        originals=False,
        progress=lambda what, done, total: stages.add(what),
    )
    assert faults(found) == {("damaged", "vocabulary")}
    assert "vocabularies" in stages


def test_a_vocabulary_that_is_deleted_while_it_is_verified_is_no_fault(
    vlads: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    vlads.upload(*range(10))
    vlads.fit()
    (key,) = vlads.keys("vocabularies/")
    head = vlads.store.head

    def delete_the_map_after(looked_up: str) -> Any:
        found = head(looked_up)
        if looked_up == key:
            with vlads.catalog.write() as session:
                mark_map_deleted(session, session.get_one(Map, vlads.map_id))
            vlads.store.delete(key)
        return found

    monkeypatch.setattr(vlads.store, "head", delete_the_map_after)
    assert verify_store(vlads.catalog, vlads.store, originals=False).faults == []


@pytest.mark.parametrize("damage", ["changed", "missing"])
def test_damaged_reconstructions_are_found(service: Service, damage: str) -> None:
    service.indexed(1)
    with service.catalog.write() as session:
        generation = session.scalars(select(Generation)).one()
        made = add_reconstruction(session, service.store, generation)
        (component,) = made.list_components()
    assert looked(service).faults == []
    if damage == "changed":
        service.store.put(component.object_key, b"other bytes")
    else:
        service.store.delete(component.object_key)
    expected = "damaged" if damage == "changed" else "missing"
    assert faults(looked(service)) == {(expected, "reconstruction")}


def test_every_table_that_names_objects_is_looked_at() -> None:
    """A new one has to be added to `list_referenced_objects`, or backups would miss its objects
    unseen."""
    naming = {table.name for table in Base.metadata.sorted_tables if "object_key" in table.columns}
    assert naming == {"batch_items", "chunks", "models", "photos", "vocabularies", "whitenings"}
