"""A generated city in a map: photos of two seasons, labelled queries of others."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from lab.city.plan import CityOptions, make_plan
from lab.city.write import write_city
from shared.utm_filenames import upload_fields_of_file_name
from tests.support.server import ServerProcess

PLACES = 24
VIEWS = 4
QUERIES = 16
SEASON = re.compile(r"-([a-z]+)-")


def build_city(server: ServerProcess, folder: Path, map_name: str) -> list[Path]:
    """Draw it below `folder`, bring it in and measure it; the photos to ask with."""
    options = CityOptions(
        places=PLACES,
        views=VIEWS,
        queries=QUERIES,
        seed=0,
        catalogue_seed=0,
        out_of_map=0.25,
        width=480,
        height=360,
        train=False,
    )
    write_city(make_plan(options), folder)
    made = server.client.post("/api/v1/maps", json={"name": map_name, "auto_fit": False})
    assert made.status_code == 201, made.text
    queries = sorted((folder / "queries").glob("*.jpg"))
    searched, labelled = queries[::2], queries[1::2]
    _bring_in(server, map_name, sorted((folder / "database").glob("*.jpg")), "database")
    _bring_in(server, map_name, labelled, "query")
    measured = server.client.post("/api/v1/evaluations", params={"map": map_name}, json={})
    assert measured.status_code == 202, measured.text
    finished(server, map_name, measured.json()["job_id"])
    return searched


def _bring_in(server: ServerProcess, map_name: str, photos: list[Path], role: str) -> None:
    lines, files = [], []
    for number, photo in enumerate(photos):
        fields = upload_fields_of_file_name(photo.name, None)
        season = SEASON.search(photo.name)
        assert season, photo.name
        name = f"{season[1]}-street-{number:03}.jpg"
        values = {
            "filename": name,
            "latitude": float(fields["latitude"]),
            "longitude": float(fields["longitude"]),
            "tags": [season[1]],
            "role": role,
        }
        lines.append(json.dumps(values))
        files.append(("file", (name, photo.read_bytes())))
    answer = server.client.post(
        "/api/v1/upload/batch",
        params={"map": map_name},
        files=files,
        data={"manifest": "\n".join(lines)},
    )
    assert answer.status_code == 202, answer.text
    job = finished(server, map_name, answer.json()["job_id"])
    assert job["progress"]["failed"] == 0, job


def finished(server: ServerProcess, map_name: str, job_id: str) -> dict[str, Any]:
    """The job of any map, once it has succeeded."""
    while True:
        job: dict[str, Any] = server.client.get(
            f"/api/v1/jobs/{job_id}", params={"map": map_name, "wait": 30}
        ).json()
        assert job["state"] not in ("failed", "cancelled"), job
        if job["state"] == "succeeded":
            return job
