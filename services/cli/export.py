"""`placewise export`: write a map's data for other programs."""

from __future__ import annotations

import contextlib
import json
import shutil
import tarfile
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, BinaryIO
from uuid import UUID

import numpy as np
import typer
from rich.progress import Progress

from placewise.answers import Photo
from placewise.client import Client
from services.cli.client import MapOptions, active_generation
from services.cli.ingest.photo_archive import unpack_tar
from services.cli.option_groups import CommandGroup
from services.cli.output import (
    Json,
    atomic_write,
    check_output_path,
    print_result,
    printable_path,
    progress_bar,
    refuse_unwritable,
)
from shared.errors import Conflict, InvalidRequest

EXPORTED_FILES = ("photos.csv", "names.txt", "descriptors.npy")
PHOTO_PROPERTIES = {
    "original_filename",
    "relative_path",
    "upload_time",
    "captured_at",
    "altitude",
    "heading",
    "place",
    "tags",
    "metadata",
    "role",
    "image_url",
}

app = CommandGroup(
    help="Export a map's descriptors, its reconstruction, pairs for hloc, or photos as GeoJSON."
)

FolderOption = Annotated[
    Path,
    typer.Option(
        metavar="DIR", file_okay=False, help="Output folder; created if it does not exist."
    ),
]


class PairNames(StrEnum):
    FILENAME = "filename"
    PATH = "path"
    ID = "id"


@app.command("descriptors")
def descriptors(
    common: MapOptions,
    out: FolderOption,
    generation: Annotated[
        UUID | None,
        typer.Option(metavar="ID", help="Generation to export. Default: the active one."),
    ] = None,
) -> None:
    """Export descriptors as NumPy and CSV files.

    Writes descriptors.npy (photos x dimension, float32), and photos.csv and names.txt in the order
    of its rows. Use np.load(..., mmap_mode="r") to read descriptors.npy without loading it.
    """
    with common.connect() as client, progress_bar() as progress:
        generation = generation or _active_generation_id(client)
        receive = partial(client.export_descriptors, generation)
        with _received_tar(out, receive, progress) as tar:
            for name in EXPORTED_FILES:
                member = tar.extractfile(name)
                assert member is not None, "the archive contains regular files"
                with member, atomic_write(out / name) as file:
                    shutil.copyfileobj(member, file)
    rows, dimension = np.load(out / "descriptors.npy", mmap_mode="r").shape
    path = printable_path(out / "descriptors.npy")
    print_result(
        {"file": path, "generation_id": str(generation), "rows": rows, "dimension": dimension},
        common.as_json,
        f"{path}: {rows} rows of {dimension} dimensions.",
    )


@contextlib.contextmanager
def _received_tar(
    out: Path, receive: Callable[[BinaryIO, Callable[[int], object]], None], progress: Progress
) -> Iterator[tarfile.TarFile]:
    """Receive an archive into a temporary file in the folder `out`, which is created, and open it.

    Raises:
        Misconfigured: `out_unwritable`.
    """
    receiving = progress.add_task("receiving (bytes)", total=None)
    with refuse_unwritable(out):
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out) as received:
            receive(received, lambda size: progress.update(receiving, completed=size))
            received.seek(0)
            with tarfile.open(fileobj=received, mode="r:") as tar:
                yield tar


def _active_generation_id(client: Client) -> UUID:
    generation = active_generation(client)
    if generation is None:
        raise Conflict(
            "nothing_described",
            "The map has no photos with descriptors yet. Upload photos: placewise index.",
        )
    return generation.generation_id


@app.command("colmap")
def colmap(common: MapOptions, out: FolderOption) -> None:
    """Export the map's reconstruction as a COLMAP model of each component: DIR/0, DIR/1, ...

    Images have the path or file name of their photo, and the photo's ID where that is not unique.
    """
    with common.connect() as client, progress_bar() as progress:
        made = client.reconstruction()
        receive = partial(client.export_colmap, made.reconstruction_id)
        with _received_tar(out, receive, progress) as tar:
            unpack_tar(tar, out)
    photos = sum(component.photos for component in made.components)
    folder = printable_path(out)
    print_result(
        {"folder": folder, "components": len(made.components), "photos": photos},
        common.as_json,
        f"{folder}: {photos} photos in {len(made.components)} COLMAP models.",
    )


@app.command("pairs")
def pairs(
    common: MapOptions,
    out: Annotated[Path, typer.Option(metavar="FILE.txt", help="Output file.")],
    top_k: Annotated[
        int, typer.Option(min=1, max=100, help="Maximum number of matches per query.")
    ] = 20,
    names: Annotated[
        PairNames, typer.Option(help="Identify photos by file name, path in their folder, or ID.")
    ] = PairNames.FILENAME,
) -> None:
    """Export retrieval pairs in hloc's format: `QUERY MATCH` on each line, best match first.

    The queries are the map's labelled queries, or all of its photos if it has none.
    """
    check_output_path(out, ".txt", "a list of pairs")
    count = skipped = 0
    with common.connect() as client, progress_bar() as progress, atomic_write(out) as file:
        photos = list(client.photos())
        if names != PairNames.ID:
            _check_unique_names(photos, names)
        queries = [photo for photo in photos if photo.role == "query"] or photos
        if not queries:
            raise Conflict(
                "no_photos", "The map has no photos yet. Upload photos: placewise index."
            )
        for photo in progress.track(queries, description="querying"):
            try:
                matches = client.similar(photo, top_k=top_k, history=False).similar_images
            except Conflict as error:
                if error.code != "not_searchable":
                    raise
                skipped += 1
                continue
            count += len(matches)
            for match in matches:
                file.write(f"{_photo_name(photo, names)} {_photo_name(match, names)}\n".encode())
    print_result(
        {"file": str(out), "queries": len(queries), "pairs": count, "skipped": skipped},
        common.as_json,
        f"{out}: {count} pairs for {len(queries)} queries, {skipped} of them without a descriptor.",
    )


def _photo_name(photo: Photo, names: PairNames) -> str:
    if names == PairNames.ID:
        return str(photo.image_id)
    path = photo.relative_path if names == PairNames.PATH else None
    return path or photo.original_filename


def _check_unique_names(photos: list[Photo], names: PairNames) -> None:
    """Raise InvalidRequest (`ambiguous_names`) for names that hloc's format can't represent."""
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


@app.command("geojson")
def geojson(
    common: MapOptions,
    out: Annotated[Path, typer.Option(metavar="FILE.geojson", help="Output file.")],
) -> None:
    """Export every photo with its metadata as a GeoJSON feature (RFC 7946).

    Coordinates are WGS 84, longitude first. A photo without coordinates has a null geometry.
    """
    check_output_path(out, ".geojson", "a GeoJSON export")
    photos = 0
    with common.connect() as client, progress_bar() as progress, atomic_write(out) as file:
        stats = client.stats()
        total = stats.total_images + stats.labelled_queries
        file.write(b'{"type": "FeatureCollection", "features": [')
        for photo in progress.track(client.photos(), total=total, description="photos"):
            feature = json.dumps(_to_feature(photo), ensure_ascii=False)
            file.write((b",\n" if photos else b"\n") + feature.encode())
            photos += 1
        file.write(b"\n]}\n")
    print_result({"file": str(out), "photos": photos}, common.as_json, f"{out}: {photos} photos.")


def _to_feature(photo: Photo) -> Json:
    point = {"type": "Point", "coordinates": [photo.longitude, photo.latitude]}
    return {
        "type": "Feature",
        "id": str(photo.image_id),
        "geometry": None if photo.latitude is None else point,
        "properties": photo.model_dump(mode="json", include=PHOTO_PROPERTIES),
    }
