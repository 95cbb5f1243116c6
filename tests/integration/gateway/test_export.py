"""What leaves a map for other programs: descriptors of one moment, with what they belong to."""

from __future__ import annotations

import csv
import io
import tarfile
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.catalog.chunks import list_live_chunks, list_live_rows
from shared.catalog.generations import Generation
from shared.ids import new_id
from shared.storage.chunks import read_chunk
from tests.integration.in_process_api import Service
from tests.support.problems import problem


def exported(service: Service) -> tuple[NDArray[np.float32], list[dict[str, str]], list[str]]:
    """Rows, the lines of photos.csv, and names.txt."""
    [generation] = service.json("GET", "/generations")
    answer = service("GET", f"/generations/{generation['generation_id']}/descriptors")
    assert answer.status_code == 200, answer.text
    assert answer.content.endswith(bytes(2 * tarfile.BLOCKSIZE))
    with tarfile.open(fileobj=io.BytesIO(answer.content), mode="r:") as tar:
        assert tar.getnames() == ["photos.csv", "names.txt", "descriptors.npy"]
        files = {name: tar.extractfile(name) for name in tar.getnames()}
        contents = {name: file.read() for name, file in files.items() if file is not None}
    rows = np.load(io.BytesIO(contents["descriptors.npy"]), allow_pickle=False)
    table = list(csv.DictReader(io.StringIO(contents["photos.csv"].decode(), newline="")))
    return rows, table, contents["names.txt"].decode().splitlines()


def test_each_row_is_the_descriptor_of_its_line(service: Service) -> None:
    service.indexed(
        1, 2, latitude=45.5, longitude=7.25, place="hall, north", relative_path="Day 2/1.jpg"
    )
    [gone] = service.indexed(3)
    service.indexed(4)
    service.indexed(5, latitude=-45.5, longitude=-7.25, place="=1+1", relative_path="@a/1.jpg")
    service.json("DELETE", f"/uploads/{gone}")
    rows, table, names = exported(service)
    stored: dict[UUID, NDArray[np.float32]] = {}
    with service.catalog.read() as session:
        [generation] = session.query(Generation).all()
        for chunk in list_live_chunks(session, generation.id):
            found = read_chunk(service.store, chunk.object_key, chunk.sha256)
            stored |= {photo: found[row] for row, photo in list_live_rows(session, chunk.id)}
    del stored[UUID(gone)]  # kept while it is in the trash
    assert rows.dtype == np.float32
    assert len(rows) == len(table) == len(names) == len(stored) == 4
    for number, (row, line) in enumerate(zip(rows, table, strict=True)):
        assert int(line["row"]) == number
        assert np.array_equal(row, stored[UUID(line["image_id"])])
    hall = ("hall, north", "45.5", "Day 2/1.jpg")
    assert [(line["place"], line["latitude"], line["relative_path"]) for line in table] == [
        *(hall, hall, ("", "", "")),
        ("'=1+1", "-45.5", "'@a/1.jpg"),  # text is no formula for a spreadsheet
    ]
    assert gone not in {line["image_id"] for line in table}


def test_descriptors_of_a_generation_that_is_not_there_are_not_found(service: Service) -> None:
    service.indexed(1)
    answer = service("GET", f"/generations/{new_id()}/descriptors")
    problem(answer, 404, "generation_not_found")
