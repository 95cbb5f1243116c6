"""`placewise export descriptors|pairs|geojson`: what a map knows, for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.connect import connect
from services.cli.export_descriptors import export_descriptors
from services.cli.export_geojson import write_geojson
from services.cli.export_pairs import PairNames, write_pairs
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    answers,
    explained,
    print_json,
    progress_bar,
)
from services.cli.whole_file import check_out, whole_or_nothing
from shared.client import Json

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
    with explained(as_json):
        with connect(server, map_name, key) as client, progress_bar() as progress:
            written = export_descriptors(client, out, generation, progress)
        _say(written, as_json, f"{written['rows']} rows of {written['dimension']} dimensions")


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
    with explained(as_json):
        check_out(out, ".txt", "a list of pairs")
        with (
            connect(server, map_name, key) as client,
            progress_bar() as progress,
            whole_or_nothing(out) as file,
        ):
            written = write_pairs(client, file, top_k, names, progress)
        _say(
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
    with explained(as_json):
        check_out(out, ".geojson", "GeoJSON")
        with (
            connect(server, map_name, key) as client,
            progress_bar() as progress,
            whole_or_nothing(out) as file,
        ):
            written = write_geojson(client, file, estimates, progress)
        _say(
            {"file": str(out), **written},
            as_json,
            f"{written['photos']} photos, {written['estimates']} estimates",
        )


def _say(written: Json, as_json: bool, what: str) -> None:
    if as_json:
        print_json(written)
    else:
        answers.print(f"{written['file']}: {what}.", soft_wrap=True, markup=False)
