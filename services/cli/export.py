"""`placewise export descriptors|pairs|geojson`: what a map knows, for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.connect import connect
from services.cli.export_descriptors import export_descriptors
from services.cli.export_geojson import export_geojson
from services.cli.export_pairs import PairNames, export_pairs
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    console,
    print_json,
    progress_bar,
    report_errors,
)
from services.cli.whole_file import atomic_write, check_output_path
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
