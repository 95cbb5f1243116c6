"""`placewise export`: write a map's data for other programs.

`descriptors` writes a generation's descriptors as NumPy and CSV files, `pairs` writes retrieval
pairs in hloc's format (two names per line, best match first), and `geojson` writes the photos as an
RFC 7946 FeatureCollection (WGS 84, longitude first).
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

from placewise.answers import Estimate, Photo
from placewise.client import Client
from services.cli.client import active_generation, connect
from services.cli.output import (
    Json,
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    atomic_write,
    check_output_path,
    print_result,
    printable_path,
    progress_bar,
    refuse_unwritable,
)
from shared.errors import Conflict, InvalidRequest

EXPORTED_FILES = ("photos.csv", "names.txt", "descriptors.npy")


def export_descriptors(
    client: Client, out: Path, generation_id: str | None, progress: Progress
) -> Json:
    """Download a generation's descriptors and write EXPORTED_FILES, each of them atomically.

    Args:
        client: Client of the map.
        out: Output folder; created if it does not exist.
        generation_id: The generation; None for the active one.
        progress: Shows the number of bytes received.

    Returns:
        `file`, `generation_id`, `rows` and `dimension`.

    Raises:
        InvalidRequest: `bad_id`.
        Conflict: `nothing_described` if the map has no active generation.
        NotFound: The map has no such generation.
        Misconfigured: `out_unwritable`.
    """
    generation = (
        _active_generation_id(client)
        if generation_id is None
        else _parse_generation_id(generation_id)
    )
    receiving = progress.add_task("receiving (bytes)", total=None)
    with refuse_unwritable(out):
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out) as received:
            client.export_descriptors(
                generation, received, lambda size: progress.update(receiving, completed=size)
            )
            received.seek(0)
            with tarfile.open(fileobj=received, mode="r:") as tar:
                for name in EXPORTED_FILES:
                    member = tar.extractfile(name)
                    assert member is not None, "the archive contains regular files"
                    with member, atomic_write(out / name) as file:
                        shutil.copyfileobj(member, file)
    rows = np.load(out / "descriptors.npy", mmap_mode="r")
    return {
        "file": printable_path(out / "descriptors.npy"),
        "generation_id": str(generation),
        "rows": rows.shape[0],
        "dimension": rows.shape[1],
    }


def _active_generation_id(client: Client) -> UUID:
    generation = active_generation(client)
    if generation is None:
        raise Conflict(
            "nothing_described",
            "The map has no photos with descriptors yet. Upload photos: placewise index.",
        )
    return generation.generation_id


def _parse_generation_id(generation_id: str) -> UUID:
    try:
        return UUID(generation_id)
    except ValueError:
        raise InvalidRequest(
            "bad_id", f"Invalid generation ID {generation_id!r}: a UUID is required."
        ) from None


class PairNames(StrEnum):
    FILENAME = "filename"
    PATH = "path"
    ID = "id"


def export_pairs(
    client: Client, file: BinaryIO, top_k: int, names: PairNames, progress: Progress
) -> Json:
    """Search with each labelled query, or with every photo of a map without any, and write pairs.

    Returns:
        Counts: `asked` (queries), `pairs`, and `passed_over` (queries without a descriptor).

    Raises:
        Conflict: `no_photos` if the map is empty.
        InvalidRequest: `ambiguous_names` if two photos share a name, or if a name contains white
            space, which hloc's format can't represent.
    """
    photos = list(client.photos())
    if names != PairNames.ID:
        _check_unique_names(photos, names)
    queries = [photo for photo in photos if photo.role == "query"] or photos
    if not queries:
        raise Conflict("no_photos", "The map has no photos yet. Upload photos: placewise index.")
    bar = progress.add_task("querying", total=len(queries))
    pairs = skipped = 0
    for photo in queries:
        try:
            matches = client.similar(photo, top_k=top_k, history=False).similar_images
        except Conflict as error:
            if error.code != "not_searchable":
                raise
            skipped += 1
            matches = []
        for match in matches:
            file.write(f"{_photo_name(photo, names)} {_photo_name(match, names)}\n".encode())
            pairs += 1
        progress.advance(bar)
    return {"asked": len(queries), "pairs": pairs, "passed_over": skipped}


def _photo_name(photo: Photo, names: PairNames) -> str:
    if names == PairNames.ID:
        return str(photo.image_id)
    path = photo.relative_path if names == PairNames.PATH else None
    return path or photo.original_filename


def _check_unique_names(photos: list[Photo], names: PairNames) -> None:
    counts = Counter(_photo_name(photo, names) for photo in photos)
    bad = [name for name, count in counts.items() if count > 1 or name.split() != [name]]
    if bad:
        # A path contains the name, and with it the white space.
        by_path = names == PairNames.FILENAME and all(name.split() == [name] for name in bad)
        raise InvalidRequest(
            "ambiguous_names",
            f"{len(bad)} names are shared by several photos or contain white space, which the "
            f"format can't represent, for example {bad[0]!r}. Identify photos by "
            + ("their path or ID: --names path or --names id." if by_path else "ID: --names id."),
        )


PHOTO_PROPERTIES = {
    "original_filename",
    "relative_path",
    "upload_time",
    "captured_at",
    "heading",
    "place",
    "tags",
    "metadata",
    "role",
    "image_url",
}


def export_geojson(client: Client, file: BinaryIO, estimates: bool, progress: Progress) -> Json:
    """Write one feature per photo; a photo without coordinates has a null geometry.

    Args:
        client: Client of the map.
        file: Output file.
        estimates: Also search with each labelled query and write its estimate as a feature.
        progress: Shows the photos written and the queries searched.

    Returns:
        Counts: `photos`, `estimates`, and `passed_over` (queries without a descriptor).
    """
    stats = client.stats()
    writing = progress.add_task("photos", total=stats.total_images + stats.labelled_queries)
    photos = 0
    queries: list[Photo] = []
    out = _FeatureWriter(file)
    for photo in client.photos():
        properties = photo.model_dump(mode="json", include=PHOTO_PROPERTIES)
        out.add(str(photo.image_id), photo, {"kind": "photo", **properties})
        photos += 1
        if estimates and photo.role == "query":
            queries.append(photo)
        progress.advance(writing)
    skipped = 0
    bar = progress.add_task("querying", total=len(queries), visible=estimates)
    for photo in queries:
        try:
            estimate = client.similar(photo, history=False).estimate
        except Conflict as error:
            if error.code != "not_searchable":
                raise
            skipped += 1
        else:
            query = str(photo.image_id)
            properties = {"kind": "estimate", "query": query, **estimate.as_json()}
            out.add(f"{query}#estimate", estimate, properties)
        progress.advance(bar)
    out.end()
    return {
        "photos": photos,
        "estimates": len(queries) - skipped,
        "passed_over": skipped,
    }


class _FeatureWriter:
    """Streams GeoJSON features to a file, one per line."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._separator = b"\n"
        file.write(b'{"type": "FeatureCollection", "features": [')

    def add(self, feature_id: str, position: Photo | Estimate, properties: Json) -> None:
        geometry: dict[str, Any] | None = None
        if position.latitude is not None:
            geometry = {
                "type": "Point",
                "coordinates": [position.longitude, position.latitude],
            }
        feature = {
            "type": "Feature",
            "id": feature_id,
            "geometry": geometry,
            "properties": properties,
        }
        self._file.write(self._separator + json.dumps(feature, ensure_ascii=False).encode())
        self._separator = b",\n"

    def end(self) -> None:
        self._file.write(b"\n]}\n")


app = typer.Typer(
    help="Export a map's descriptors, retrieval pairs for hloc, or photos as GeoJSON."
)


@app.command("descriptors")
def descriptors(
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="DIR",
            file_okay=False,
            help="Output folder; created if it does not exist.",
        ),
    ],
    generation: Annotated[
        str | None,
        typer.Option(metavar="ID", help="Generation to export. Default: the active one."),
    ] = None,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Export descriptors as NumPy and CSV files.

    Writes descriptors.npy (photos x dimension, float32), and photos.csv and names.txt in the order
    of its rows. Use np.load(..., mmap_mode="r") to read descriptors.npy without loading it.
    """
    with connect(server, map_name, key) as client, progress_bar() as progress:
        written = export_descriptors(client, out, generation, progress)
    print_result(
        written,
        as_json,
        f"{written['file']}: {written['rows']} rows of {written['dimension']} dimensions.",
    )


@app.command("pairs")
def pairs(
    out: Annotated[Path, typer.Option("--out", metavar="FILE.txt", help="Output file.")],
    top_k: Annotated[
        int, typer.Option("--top-k", min=1, max=100, help="Maximum number of matches per query.")
    ] = 20,
    names: Annotated[
        PairNames, typer.Option(help="Identify photos by file name, path in their folder, or ID.")
    ] = PairNames.FILENAME,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Export retrieval pairs in hloc's format: `QUERY MATCH` on each line.

    The queries are the map's labelled queries, or all of its photos if it has none.
    """
    check_output_path(out, ".txt", "a list of pairs")
    with (
        connect(server, map_name, key) as client,
        progress_bar() as progress,
        atomic_write(out) as file,
    ):
        written = export_pairs(client, file, top_k, names, progress)
    print_result(
        {"file": str(out), **written},
        as_json,
        f"{out}: {written['pairs']} pairs for {written['asked']} queries, "
        f"{written['passed_over']} of them without a descriptor.",
    )


@app.command("geojson")
def geojson(
    out: Annotated[Path, typer.Option("--out", metavar="FILE.geojson", help="Output file.")],
    estimates: Annotated[
        bool,
        typer.Option(help="Also search with each labelled query and export its estimated place."),
    ] = False,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Export every photo with its metadata as a GeoJSON feature (RFC 7946)."""
    check_output_path(out, ".geojson", "a GeoJSON export")
    with (
        connect(server, map_name, key) as client,
        progress_bar() as progress,
        atomic_write(out) as file,
    ):
        written = export_geojson(client, file, estimates, progress)
    print_result(
        {"file": str(out), **written},
        as_json,
        f"{out}: {written['photos']} photos, {written['estimates']} estimates.",
    )
