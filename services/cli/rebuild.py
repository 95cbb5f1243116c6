"""`placewise rebuild-catalog`: a lost catalog from its object store."""

from __future__ import annotations

import contextlib
from dataclasses import asdict
from typing import TYPE_CHECKING

from rich.markup import escape

from services.cli.backup import progress_reporter
from services.cli.configuration import read_settings
from services.cli.output import JsonOption, console, err_console, print_json, report_errors
from shared.catalog.connections import NO_TIMEOUTS
from shared.catalog.installation import open_installation_store
from shared.catalog.open_catalog import open_catalog
from shared.catalog.schema import migrate
from shared.home import lock_home
from shared.objects.open_store import open_store

if TYPE_CHECKING:
    from shared.rebuild.take_in import TakenIn

SHOWN = 10
NEVER_IN_THE_JOURNAL = (
    "API keys, webhooks, jobs, the search history and evaluations' reports are not in the object "
    "store: make keys and webhooks anew."
)


def rebuild_catalog(as_json: JsonOption = False) -> None:
    """Rebuild a lost catalog from the object store: photos with all that was said of them, maps,
    generations, vocabularies. Stop the services first. Interrupted, it goes on when run again."""
    with report_errors(as_json), progress_reporter() as progress, contextlib.ExitStack() as held:
        # Imported only here: it reads photos, which not every image can.
        from shared.rebuild.begin import begin_rebuild
        from shared.rebuild.take_in import take_in

        settings = read_settings()
        alone = settings.database_url is None
        if alone:
            held.enter_context(lock_home(settings.placewise_home))
        catalog = open_catalog(settings, "rebuild-catalog", NO_TIMEOUTS)
        held.callback(catalog.close)
        migrate(catalog)
        begin_rebuild(catalog, open_store(settings, exclusive=alone))
        store = open_installation_store(catalog, settings, exclusive=alone)
        taken = take_in(catalog, store, settings, unnamed_age_seconds=0.0, progress=progress)
    if as_json:
        print_json(asdict(taken))
        return
    print_taken_in(taken)
    err_console.print(NEVER_IN_THE_JOURNAL, soft_wrap=True)


def print_taken_in(taken: TakenIn) -> None:
    """What came back, and what did not."""
    console.print(
        f"{taken.photos + taken.unnamed_photos} photos of {taken.maps} new maps came in, with "
        f"{taken.descriptors} descriptors in {taken.chunks} chunks, {taken.generations} "
        f"generations and {taken.vocabularies} vocabularies; {taken.queued_photos} photos are "
        "queued to be described",
        soft_wrap=True,
    )
    if taken.changed_photos or taken.deleted_photos:
        console.print(
            f"{taken.changed_photos} photos were changed and {taken.deleted_photos} deleted, as "
            "the journal says"
        )
    for old, new in taken.renamed_maps.items():
        err_console.print(
            f"Another map has the name {escape(old)}: the one of the journal is {new}."
        )
    if taken.unnamed_photos:
        err_console.print(
            f"The journal does not name {taken.unnamed_photos} photos: they are in the map "
            "default, with coordinates, heading and time as EXIF has them. Lost are their file "
            "names, place labels, tags, metadata, roles and maps, and what was said instead of "
            "EXIF.",
            soft_wrap=True,
        )
    if taken.unnamed_descriptors:
        err_console.print(
            f"{taken.unnamed_descriptors} descriptors belong to generations that the journal does "
            "not name: they can't be assigned to photos.",
            soft_wrap=True,
        )
    if taken.lost_originals:
        err_console.print(
            f"{taken.lost_originals} photos of the journal have no original in the store and stay "
            "out: they were deleted a moment before the catalog was lost, or their files are gone.",
            soft_wrap=True,
        )
    if taken.doubled_photos:
        err_console.print(f"{taken.doubled_photos} photos are there already, under another id.")
    for what, keys in (
        ("journal segments can't be read; restore them from a backup", taken.damaged_segments),
        ("chunks are damaged; their photos are described again", taken.damaged_chunks),
        ("originals can't be read as photos and stay out", taken.unreadable_originals),
    ):
        if keys:
            named = ", ".join(keys[:SHOWN]) + (" ..." if len(keys) > SHOWN else "")
            err_console.print(f"{len(keys)} {what}: {escape(named)}", soft_wrap=True)
