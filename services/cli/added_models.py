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
    answers,
    explained,
    print_json,
    progress_bar,
)
from services.cli.wait import wait_with_bar

ModelName = Annotated[str, typer.Argument(metavar="NAME", help="As `models added` says.")]


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
    with explained(as_json):
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
            job = wait_with_bar(client, started["job_id"], progress, "checking")
        if as_json:
            print_json(job)
            return
        added = job["result"]
        answers.print(
            f"{added['extractor']}: {added['dimension']} dimensions, "
            f"{added['size_bytes'] / 1e6:.1f} MB, fingerprint {added['fingerprint'][:12]}"
            f"{'; it was there already' if added['already_there'] else ''}.",
            soft_wrap=True,
            markup=False,
        )


def added(server: ServerOption = None, key: KeyOption = None, as_json: JsonOption = False) -> None:
    """The models that were added, with the maps that are described with them."""
    with explained(as_json):
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
        answers.print(table)


def remove(
    name: ModelName,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Remove a model that no map is described with. Its name never means other weights."""
    with explained(as_json):
        with connect(server, None, key) as client:
            removed = client.remove_model(name)
        if as_json:
            print_json(removed)
            return
        answers.print(removed["message"], soft_wrap=True, markup=False)
