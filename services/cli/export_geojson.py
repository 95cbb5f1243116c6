"""A map's photos as a GeoJSON FeatureCollection (RFC 7946): longitude first, WGS 84."""

from __future__ import annotations

import json
from typing import Any, BinaryIO

from rich.progress import Progress

from shared.client import Client, Json
from shared.errors import Conflict

PHOTO_PROPERTIES = (
    "original_filename",
    "upload_time",
    "captured_at",
    "heading",
    "place",
    "tags",
    "metadata",
    "role",
    "image_url",
)


def export_geojson(client: Client, file: BinaryIO, estimates: bool, progress: Progress) -> Json:
    """One feature for each photo, without a geometry where it has no coordinates. With
    `estimates`, each labelled query is asked with, and its estimate is a feature of its own.

    Returns counts: `photos`, `estimates`, `passed_over` of queries that are not described.
    """
    writing = progress.add_task("photos", total=client.stats()["total_images"])
    photos = 0
    queries: list[Json] = []
    out = _FeatureWriter(file)
    for photo in client.each("/search", "images"):
        kept = {name: photo[name] for name in PHOTO_PROPERTIES}
        out.add(photo["image_id"], photo, {"kind": "photo", **kept})
        photos += 1
        if estimates and photo["role"] == "query":
            queries.append(photo)
        progress.advance(writing)
    passed_over = 0
    asking = progress.add_task("asking", total=len(queries), visible=estimates)
    for photo in queries:
        try:
            estimate = client.similar_to(photo["image_id"])["estimate"]
        except Conflict as error:
            if error.code != "not_searchable":
                raise
            passed_over += 1
        else:
            about = {"kind": "estimate", "query": photo["image_id"], **estimate}
            out.add(f"{photo['image_id']}#estimate", estimate, about)
        progress.advance(asking)
    out.end()
    return {
        "photos": photos,
        "estimates": len(queries) - passed_over,
        "passed_over": passed_over,
    }


class _FeatureWriter:
    """Features, one a line, written as they come."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._between = b"\n"
        file.write(b'{"type": "FeatureCollection", "features": [')

    def add(self, feature_id: str, where: Json, properties: Json) -> None:
        geometry: dict[str, Any] | None = None
        if where["latitude"] is not None:
            geometry = {"type": "Point", "coordinates": [where["longitude"], where["latitude"]]}
        feature = {
            "type": "Feature",
            "id": feature_id,
            "geometry": geometry,
            "properties": properties,
        }
        self._file.write(self._between + json.dumps(feature, ensure_ascii=False).encode())
        self._between = b",\n"

    def end(self) -> None:
        self._file.write(b"\n]}\n")
