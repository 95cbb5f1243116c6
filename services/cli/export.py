"""`placewise export descriptors|pairs|geojson`: what a map knows, for other programs.

A generation's descriptors into a folder.

Retrieval pairs as hloc reads them: two names a line, the best match of a photo first.

A map's photos as a GeoJSON FeatureCollection (RFC 7946): longitude first, WGS 84.
"""

from __future__ import annotations

import json
import shutil
import tarfile
import tempfile
from collections import Counter
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, BinaryIO
from uuid import UUID

import numpy as np
import typer
from rich.progress import Progress

from services.cli.client import connect
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    atomic_write,
    check_output_path,
    console,
    print_json,
    printable_path,
    progress_bar,
    report_errors,
)
from shared.client import Client, Json
from shared.errors import Conflict, InvalidRequest, Misconfigured

EXPORTED_FILES = ("photos.csv", "names.txt", "descriptors.npy")


def export_descriptors(
    client: Client, out: Path, generation_id: str | None, progress: Progress
) -> Json:
    """Write FILES into the folder; each is whole or not there.

    Raises InvalidRequest (`bad_id`), Conflict (`nothing_described`), NotFound, Misconfigured
    (`out_unwritable`).
    """
    chosen = (
        _validate_generation_id(generation_id) if generation_id else _active_generation_id(client)
    )
    receiving = progress.add_task("receiving (bytes)", total=None)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out) as received:
            client.export_descriptors(
                chosen, received, lambda size: progress.update(receiving, completed=size)
            )
            received.seek(0)
            with tarfile.open(fileobj=received, mode="r:") as tar:
                for name in EXPORTED_FILES:
                    member = tar.extractfile(name)
                    assert member is not None, "the server sends files"
                    with member, atomic_write(out / name) as file:
                        shutil.copyfileobj(member, file)
    except OSError as error:
        raise Misconfigured(
            "out_unwritable", f"{printable_path(out)} can't be written: {error.strerror}."
        ) from error
    rows = np.load(out / "descriptors.npy", mmap_mode="r")
    return {
        "file": printable_path(out / "descriptors.npy"),
        "generation_id": chosen,
        "rows": rows.shape[0],
        "dimension": rows.shape[1],
    }


def _active_generation_id(client: Client) -> str:
    for one in client.generations():
        if one["state"] == "active":
            return str(one["generation_id"])
    raise Conflict(
        "nothing_described", "The map has no described photo yet. Upload some: placewise index."
    )


def _validate_generation_id(generation_id: str) -> str:
    """What is no id would be another path."""
    try:
        return str(UUID(generation_id))
    except ValueError:
        raise InvalidRequest("bad_id", f"{generation_id!r} is no generation's id.") from None


class PairNames(StrEnum):
    FILENAME = "filename"
    ID = "id"


def export_pairs(
    client: Client, file: BinaryIO, top_k: int, names: PairNames, progress: Progress
) -> Json:
    """Ask with each labelled query, or with every photo where there is none.

    Returns counts: `asked`, `pairs`, and `passed_over` of photos that are not described. Raises
    Conflict (`no_photos`), InvalidRequest (`ambiguous_names`: two photos of one name, or a name
    with a space, which hloc's format has no way to write).
    """
    photos = list(client.each("/search", "images"))
    if names == PairNames.FILENAME:
        _check_unique_names(photos)
    asked = [one for one in photos if one["role"] == "query"] or photos
    if not asked:
        raise Conflict("no_photos", "The map has no photos yet. Upload some: placewise index.")
    asking = progress.add_task("asking", total=len(asked))
    pairs = passed_over = 0
    for photo in asked:
        try:
            found = client.similar_to(photo["image_id"], top_k=top_k)["similar_images"]
        except Conflict as error:
            if error.code != "not_searchable":
                raise
            passed_over += 1
            found = []
        for match in found:
            file.write(f"{_photo_name(photo, names)} {_photo_name(match, names)}\n".encode())
            pairs += 1
        progress.advance(asking)
    return {"asked": len(asked), "pairs": pairs, "passed_over": passed_over}


def _photo_name(photo: Json, names: PairNames) -> str:
    return str(photo["original_filename" if names == PairNames.FILENAME else "image_id"])


def _check_unique_names(photos: list[Json]) -> None:
    times = Counter(photo["original_filename"] for photo in photos)
    bad = [name for name, count in times.items() if count > 1 or name.split() != [name]]
    if bad:
        raise InvalidRequest(
            "ambiguous_names",
            f"{len(bad)} names stand for several photos, or have a space: {bad[0]!r}. Call photos "
            "by their ids: --names id.",
        )


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


app = typer.Typer(help="Write a map's descriptors, pairs for hloc, or its photos as GeoJSON.")


@app.command("descriptors")
def descriptors(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", file_okay=False, help="Made if need be.")
    ],
    generation: Annotated[
        str | None, typer.Option(metavar="ID", help="Left out: the generation that answers.")
    ] = None,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write descriptors.npy (photos x dimension, float32), and photos.csv and names.txt in the
    order of its rows. np.load(..., mmap_mode="r") reads it without loading it."""
    with report_errors(as_json):
        with connect(server, map_name, key) as client, progress_bar() as progress:
            written = export_descriptors(client, out, generation, progress)
        _print_result(
            written, as_json, f"{written['rows']} rows of {written['dimension']} dimensions"
        )


@app.command("pairs")
def pairs(
    out: Annotated[Path, typer.Option("--out", metavar="FILE.txt")],
    top_k: Annotated[
        int, typer.Option("--top-k", min=1, max=100, help="Matches of each photo.")
    ] = 20,
    names: Annotated[
        PairNames, typer.Option(help="What photos are called: by their file's name or their id.")
    ] = PairNames.FILENAME,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write each photo's most similar ones as hloc reads them: `NAME NAME` in each line.

    Asked are the map's labelled queries; where it has none, all of its photos.
    """
    with report_errors(as_json):
        check_output_path(out, ".txt", "a list of pairs")
        with (
            connect(server, map_name, key) as client,
            progress_bar() as progress,
            atomic_write(out) as file,
        ):
            written = export_pairs(client, file, top_k, names, progress)
        _print_result(
            {"file": str(out), **written},
            as_json,
            f"{written['pairs']} pairs of {written['asked']} photos, "
            f"{written['passed_over']} not described",
        )


@app.command("geojson")
def geojson(
    out: Annotated[Path, typer.Option("--out", metavar="FILE.geojson")],
    estimates: Annotated[
        bool,
        typer.Option(help="Ask with each labelled query, and add where the map places it."),
    ] = False,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write every photo with what is known of it as a GeoJSON feature (RFC 7946)."""
    with report_errors(as_json):
        check_output_path(out, ".geojson", "GeoJSON")
        with (
            connect(server, map_name, key) as client,
            progress_bar() as progress,
            atomic_write(out) as file,
        ):
            written = export_geojson(client, file, estimates, progress)
        _print_result(
            {"file": str(out), **written},
            as_json,
            f"{written['photos']} photos, {written['estimates']} estimates",
        )


def _print_result(result: Json, as_json: bool, summary: str) -> None:
    if as_json:
        print_json(result)
    else:
        console.print(f"{result['file']}: {summary}.", soft_wrap=True, markup=False)
