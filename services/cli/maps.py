"""`placewise maps list|create|switch|delete`."""

from __future__ import annotations

import sys
from typing import Annotated

import typer
from rich.table import Table

from services.cli.client import connect, wait_for_job
from services.cli.extractor_options import PreprocessingOption, extractor_name
from services.cli.output import (
    JsonOption,
    KeyOption,
    ServerOption,
    console,
    print_json,
    progress_bar,
    report_errors,
)
from shared.client import Json
from shared.errors import Conflict

app = typer.Typer(help="Named databases of photos, each with its own extractor and vocabulary.")

MapName = Annotated[str, typer.Argument(metavar="NAME")]


@app.command("list")
def list_maps(
    server: ServerOption = None, key: KeyOption = None, as_json: JsonOption = False
) -> None:
    """Show every map."""
    with report_errors(as_json):
        with connect(server, None, key) as client:
            found = client.maps()
        if as_json:
            print_json(found)
            return
        counts = ("photos", "searchable", "queries")
        table = Table("map", *counts, "extractor", "vocabulary", "dimension")
        for map_ in found:
            table.add_row(
                map_["name"],
                str(map_["photos"]),
                str(map_["searchable"]),
                str(map_["labelled_queries"]),
                map_["extractor"],
                map_["vocabulary"] or "",
                _format_dimension(map_),
            )
        console.print(table)


def _format_dimension(map_: Json) -> str:
    if map_["dimension"] is None:
        return ""
    whole = "" if map_["pca_from"] is None else f" (PCA of {map_['pca_from']})"
    return f"{map_['dimension']}{whole}"


@app.command("create")
def create(
    name: MapName,
    extractor: Annotated[
        str | None, typer.Option(help="How its photos are described; left out: as configured.")
    ] = None,
    preprocessing: PreprocessingOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make an empty map."""
    with report_errors(as_json):
        if preprocessing is not None:
            extractor = extractor_name(extractor, None, preprocessing=preprocessing)
        with connect(server, None, key) as client:
            made = client.create_map(name, extractor)
        if as_json:
            print_json(made)
            return
        console.print(f"The map {name} is there, for photos described by {made['extractor']}.")


@app.command("switch")
def switch(
    name: MapName,
    extractor: Annotated[
        str, typer.Option("--extractor", help="By name: gsv:NAME of a model that was added, say.")
    ],
    vocabulary: Annotated[
        str | None,
        typer.Option(
            metavar="ID", help="One that the map has; left out: the one that comes with it, if any."
        ),
    ] = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Describe a map's photos with another extractor; search goes on, and switches at the end."""
    with report_errors(as_json):
        with connect(server, name, key) as client, progress_bar() as progress:
            started = client.start_generation(extractor=extractor, vocabulary_id=vocabulary)
            job = wait_for_job(client, started["job_id"], progress, "switching")
        if as_json:
            print_json(job)
            return
        result = job["result"]
        console.print(
            f"The map {name} is described by {extractor}: {result['photos']} photos, "
            f"{result['dimension']} dimensions, {result['failed']} failed.",
            soft_wrap=True,
            markup=False,
        )


@app.command("delete")
def delete(
    name: MapName,
    yes: Annotated[bool, typer.Option("--yes", help="Don't ask.")] = False,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Delete a map with all its photos."""
    with report_errors(as_json):
        with connect(server, None, key) as client:
            photos = next((m["photos"] for m in client.maps() if m["name"] == name), None)
            if photos and not yes and not sys.stdin.isatty():
                raise Conflict(
                    "not_confirmed",
                    f"The map {name} has {photos} photos. To delete them: --yes.",
                )
            if photos and not yes:
                typer.confirm(f"Delete the map {name} with its {photos} photos?", abort=True)
            deleted = client.delete_map(name)
        if as_json:
            print_json(deleted)
            return
        console.print(deleted["message"])
