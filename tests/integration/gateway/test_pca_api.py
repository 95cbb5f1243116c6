"""PCA and the file of a vocabulary over HTTP."""

from __future__ import annotations

from typing import Any
from uuid import uuid4

import httpx2
import pytest

from shared.catalog.vocabularies import Vocabulary
from shared.descriptors.vocabulary_file import decode_vocabulary
from tests.integration.in_process_api import Service
from tests.support.problems import field_refused, problem

PHOTOS = 8


@pytest.fixture
def vlad(service: Service) -> Service:
    """A map `vlad` of PHOTOS photos with a vocabulary of two centres: 32 dimensions."""
    service.json("POST", "/maps", 201, json={"name": "vlad", "extractor": "test-tiny-vlad"})
    service.indexed(*range(PHOTOS), map_name="vlad")
    service.done(post(service, "/vocabularies", {"clusters": 2}), "vlad")
    return service


def post(service: Service, path: str, body: Any) -> httpx2.Response:
    return service("POST", path, params={"map": "vlad"}, json=body)


def get(service: Service, path: str) -> Any:
    return service.json("GET", path, params={"map": "vlad"})


def active(service: Service) -> Any:
    (found,) = (g for g in get(service, "/generations") if g["state"] == "active")
    return found


def test_an_impossible_pca_is_refused_at_once(vlad: Service) -> None:
    for pca in (33, 0, 1025):
        field_refused(post(vlad, "/generations", {"pca": pca}), "pca")
    first = active(vlad)["vocabulary_id"]
    vlad.done(post(vlad, "/vocabularies", {"clusters": 3}), "vlad")
    other = post(vlad, "/generations", {"pca": 3, "vocabulary_id": first})
    field_refused(other, "vocabulary_id")
    vlad.json("POST", "/maps", 201, json={"name": "empty"})
    empty = vlad("POST", "/generations", params={"map": "empty"}, json={"pca": 3})
    problem(empty, 409, "nothing_described")


def test_the_file_of_a_vocabulary_is_what_another_map_imports(vlad: Service) -> None:
    (listed,) = get(vlad, "/vocabularies")
    path = f"/vocabularies/{listed['vocabulary_id']}/file"
    answer = vlad("GET", path, params={"map": "vlad"})
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/zip"
    assert answer.headers["content-disposition"].endswith(f'{listed["vocabulary_id"]}.npz"')
    file = decode_vocabulary(answer.content)
    assert (file.provenance, file.centres.sha256) == (listed["provenance"], listed["sha256"])
    assert file.encode() == answer.content, "as it was written"

    vlad.json("POST", "/maps", 201, json={"name": "other", "extractor": "test-tiny-vlad"})
    of_other = {"map": "other"}
    files = {"file": ("own.npz", answer.content)}
    vlad.json("POST", "/vocabularies/import", 202, params=of_other, files=files)
    vlad.drain()
    (taken,) = vlad.json("GET", "/vocabularies", params=of_other)
    assert taken["provenance"] == {**listed["provenance"], "imported_from": "own.npz"}

    again = vlad("GET", f"/vocabularies/{taken['vocabulary_id']}/file", params=of_other)
    assert decode_vocabulary(again.content).centres.sha256 == listed["sha256"]


def test_the_file_of_a_vocabulary_of_unknown_origin_is_the_centres_alone(vlad: Service) -> None:
    (listed,) = get(vlad, "/vocabularies")
    with vlad.catalog.write() as session:
        row = session.query(Vocabulary).one()
        row.provenance, key = {"learnt_with": "unknown"}, row.object_key
    path = f"/vocabularies/{listed['vocabulary_id']}/file"
    answer = vlad("GET", path, params={"map": "vlad"})
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.content == vlad.store.get(key)


def test_a_missing_or_corrupt_vocabulary_is_an_error(vlad: Service) -> None:
    missing = vlad("GET", f"/vocabularies/{uuid4()}/file", params={"map": "vlad"})
    problem(missing, 404, "vocabulary_not_found")
    (listed,) = get(vlad, "/vocabularies")
    path = f"/vocabularies/{listed['vocabulary_id']}/file"
    problem(vlad("GET", path), 404, "vocabulary_not_found")  # of another map
    with vlad.catalog.read() as session:
        key = session.query(Vocabulary).one().object_key
    for damaged in (vlad.store.get(key)[:-1] + b"x", b"no array"):
        vlad.store.put(key, damaged)
        problem(vlad("GET", path, params={"map": "vlad"}), 503, "vocabulary_corrupt")
