"""`placewise models add|added|remove`: models of `placewise train` that describe maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Column, Table

from services.cli.connect import connect
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
from services.cli.wait import wait_for_job

AddedModelName = Annotated[str, typer.Argument(metavar="NAME", help="As `models added` says.")]


def add(
    checkpoint: Annotated[
        Path,
        typer.Argument(metavar="CHECKPOINT", exists=True, dir_okay=False, help="A .ckpt file."),
    ],
    name: Annotated[
        str, typer.Option("--name", metavar="NAME", help="Maps call it gsv:NAME, for good.")
    ],
    licence: Annotated[str | None, typer.Option("--licence", help="Of the weights.")] = None,
    note: Annotated[str | None, typer.Option("--note", help="For people.")] = None,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make a checkpoint of `placewise train` a model that maps can be described with.

    It is sent to the server, whose extractor checks it; what describes photos is kept, and nothing
    else. `--map` only says whose job list shows it.
    """
    with report_errors(as_json):
        with connect(server, map_name, key) as client, progress_bar() as progress:
            client.models()  # a wrong address or key is said before the file is sent
            sending = progress.add_task("sending (bytes)", total=checkpoint.stat().st_size)
            started = client.add_model(
                checkpoint,
                name,
                licence=licence,
                note=note,
                on_sent=lambda sent_bytes: progress.update(sending, completed=sent_bytes),
            )
            job = wait_for_job(client, started["job_id"], progress, "checking")
        if as_json:
            print_json(job)
            return
        list_added = job["result"]
        console.print(
            f"{list_added['extractor']}: {list_added['dimension']} dimensions, "
            f"{list_added['size_bytes'] / 1e6:.1f} MB, fingerprint {list_added['fingerprint'][:12]}"
            f"{'; it was there already' if list_added['already_there'] else ''}.",
            soft_wrap=True,
            markup=False,
        )


def list_added(
    server: ServerOption = None, key: KeyOption = None, as_json: JsonOption = False
) -> None:
    """The models that were added, with the maps that are described with them."""
    with report_errors(as_json):
        with connect(server, None, key) as client:
            found = client.models()
        if as_json:
            print_json(found)
            return
        name = Column("extractor", overflow="fold", min_width=12)
        table = Table(name, "network", "image", "dimension", "size", "licence", "maps", "note")
        for model in found:
            table.add_row(
                escape(model["extractor"]),
                f"{model['config']['backbone_arch']} {model['config']['agg_arch']}",
                "{}x{}".format(*model["image_size"]),
                str(model["dimension"]),
                f"{model['size_bytes'] / 1e6:.1f} MB",
                escape(model["licence"]),
                escape(", ".join(model["maps"])),
                escape(model["note"] or ""),
            )
        console.print(table)


def remove(
    name: AddedModelName,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Remove a model that no map is described with. Its name never means other weights."""
    with report_errors(as_json):
        with connect(server, None, key) as client:
            removed = client.remove_model(name)
        if as_json:
            print_json(removed)
            return
        console.print(removed["message"], soft_wrap=True, markup=False)
