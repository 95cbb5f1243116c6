"""`placewise immich`: index the photos of an Immich server, and propose places for the others."""

from __future__ import annotations

import contextlib
import os
from typing import Annotated

import typer

from services.cli.client import MapOptions
from services.cli.environment import read_settings
from services.cli.immich.api import ImmichApi
from services.cli.immich.library import ImmichLibrary
from services.cli.immich.sync import sync_map
from services.cli.locate.proposals import LocateOptions, locate_library, report_undo
from services.cli.output import (
    Json,
    first_names,
    print_failures,
    print_note,
    printable_text,
    progress_bar,
)
from shared.errors import Misconfigured

KEY_VARIABLE = "IMMICH_API_KEY"


def immich(
    options: LocateOptions,
    common: MapOptions,
    url: Annotated[
        str,
        typer.Option(envvar="IMMICH_URL", help="Address of Immich, such as http://immich:2283."),
    ],
    write: Annotated[
        bool,
        typer.Option(
            "--write",
            help="Write the accepted proposals into Immich. Without it, Immich is not changed.",
        ),
    ] = False,
    undo_changes: Annotated[
        bool, typer.Option("--undo", help="Take back what --write has written into Immich.")
    ] = False,
) -> None:
    """Index the photos of Immich that have coordinates, and propose places for the others.

    The environment variable IMMICH_API_KEY is the API key of an Immich user. The map follows what
    was added, changed, moved or deleted in Immich since the last run. Proposals are made as
    `placewise locate` makes them. Coordinates that a photo has are never changed.
    """
    immich_key = os.environ.get(KEY_VARIABLE)
    if not immich_key:
        raise Misconfigured(
            "immich_key_missing",
            f"Set the environment variable {KEY_VARIABLE} to an API key of Immich (Account "
            "settings, API keys).",
        )
    with contextlib.ExitStack() as stack:
        api = stack.enter_context(contextlib.closing(ImmichApi(url, immich_key)))
        journals = read_settings().placewise_home / "immich"
        library = ImmichLibrary(api, journals, options.time_zone, options.clock_offset)
        if undo_changes:
            undone = library.undo()
            message = f"{len(undone.restored)} photos have the coordinates of before again."
            if undone.removed:
                message += (
                    f" {len(undone.removed)} photos had none. Immich's API can't take coordinates "
                    "away, so they have 0, 0 now, which Placewise takes for no place: "
                    f"{printable_text(first_names(undone.removed))}"
                )
            report_undo(undone, message, common.as_json)
            return
        client = stack.enter_context(common.connect())
        print_note(
            f"Indexing Immich {api.version()} at {api.url} into {common.describe_target(client)}"
        )
        photos = library.list_photos()
        with progress_bar() as progress:
            indexed = sync_map(client, library, photos, progress)
        if not common.as_json:
            _print_indexed(indexed)
        complete = locate_library(
            library,
            options,
            common,
            lambda: contextlib.nullcontext(client),
            photos,
            write=write,
            indexed=indexed,
        )
    if indexed["failed"] or not complete:
        raise typer.Exit(1)


def _print_indexed(indexed: Json) -> None:
    print_note(
        f"{indexed['with_coordinates']} photos have coordinates: {indexed['indexed']} indexed now, "
        f"{indexed['changed']} changed, {indexed['removed']} removed from the map, which has "
        f"{indexed['searchable']} searchable photos."
    )
    print_failures(indexed, "failed")
