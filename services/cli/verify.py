"""`placewise verify`: every chunk against its hash and the catalog."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from services.cli.backup import progress_reporter
from services.cli.configuration import read_settings
from services.cli.output import JsonOption, console, err_console, print_json, report_errors
from services.cli.rebuild import print_taken_in
from services.cli.stored import open_storage
from shared.backup.rows import BackupProgress
from shared.catalog.session import Catalog
from shared.errors import Conflict
from shared.home import find_running_server
from shared.integrity.check import verify_store
from shared.integrity.repair import repair_descriptors
from shared.integrity.report import FaultKind, IntegrityReport
from shared.jobs import InProcessWakeups
from shared.journal.lag import Lag, catalog_lag
from shared.objects import ObjectStore
from shared.objects.trash import measure_trash
from shared.settings import Settings

if TYPE_CHECKING:
    from shared.rebuild.take_in import TakenIn

MAX_FAULTS_SHOWN = 20
UPLOAD_SECONDS = 3600.0  # an original of this age belongs to no upload that is under way
REMEDIES = {
    "chunk": "placewise verify --repair describes their photos again",
    "manifest": "placewise verify --repair describes the photos of their chunks again",
    "photo": "placewise verify --repair describes them again",
    "original": "restore the object from a backup, or delete the photo and upload it again",
    "vocabulary": "restore the object from a backup, or fit a new vocabulary",
    "whitening": "restore the object from a backup, or start a model change",
    "archive": "its batch fails: send it again",
    "file": "its batch fails: send it again",
}


def verify(
    originals: Annotated[
        bool, typer.Option("--originals", help="Read every photo against its hash, too.")
    ] = False,
    mend: Annotated[
        bool, typer.Option("--repair", help="Queue the photos of damaged chunks again.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Read every chunk against its hash and the catalog, while the service runs; exit code 1 when
    something is wrong, also when it was repaired. Where the catalog is older than the object store,
    --repair takes in what is missing."""
    with report_errors(as_json), progress_reporter() as progress:
        # Imported only here: it is the steward's.
        from services.steward.collect import find_orphans

        settings = read_settings()
        with open_storage(settings, "verify") as (catalog, store):
            lag, taken = catalog_lag(catalog, store), None
            if lag is not None and mend:
                taken = _take_in(catalog, store, settings, lag, progress)
            report = verify_store(catalog, store, originals=originals, progress=progress)
            for info in find_orphans(catalog, store, age_seconds=0.0):
                report.orphans += 1
                report.orphan_bytes += info.size_bytes
                progress("objects that no row knows", report.orphans, report.orphans)
            trash = measure_trash(store)
            report.trash_objects, report.trash_bytes = trash.objects, trash.size_bytes
            # Workers look every second, and the steward sends hints.
            queued = repair_descriptors(catalog, InProcessWakeups(), report) if mend else None
    if as_json:
        found = {
            "lag": lag.detail if lag else None,
            "taken_in": asdict(taken) if taken else None,
        }
        print_json(_report_as_json(report, queued) | found)
    else:
        if taken is not None:
            print_taken_in(taken)
        elif lag is not None:
            err_console.print(f"[red]behind[/red] {escape(lag.detail)}", soft_wrap=True)
        _print_report(report, queued)
    if report.faults or lag is not None:
        raise typer.Exit(1)


def _take_in(
    catalog: Catalog, store: ObjectStore, settings: Settings, lag: Lag, progress: BackupProgress
) -> TakenIn:
    if lag.since is None:
        raise Conflict("rebuild_unfinished", lag.detail)
    from shared.rebuild.take_in import take_in  # it reads photos, which not every image can

    served = settings.database_url is not None or find_running_server(settings.placewise_home)
    age_seconds = UPLOAD_SECONDS if served else 0.0
    return take_in(catalog, store, settings, unnamed_age_seconds=age_seconds, progress=progress)


def _report_as_json(report: IntegrityReport, queued: int | None) -> dict[str, Any]:
    faults = [
        {name: str(value) for name, value in asdict(fault).items() if value is not None}
        for fault in report.faults
    ]
    return {
        "checked": dict(report.checked),
        "read_bytes": report.read_bytes,
        "faults": faults,
        "orphans": report.orphans,
        "orphan_bytes": report.orphan_bytes,
        "trash_objects": report.trash_objects,
        "trash_bytes": report.trash_bytes,
        "queued_photos": queued,
    }


def _print_report(report: IntegrityReport, queued: int | None) -> None:
    looked = ", ".join(f"{count} {what}s" for what, count in sorted(report.checked.items()))
    console.print(
        f"{looked or 'nothing'} looked at, {report.read_bytes / 1e6:.1f} MB read: "
        f"{len(report.faults)} faults",
        soft_wrap=True,
    )
    if report.orphans:
        console.print(
            f"{report.orphans} objects ({report.orphan_bytes / 1e6:.1f} MB) are known to no row: "
            "just coming in, or left by a crash; the steward moves old ones to the trash",
            soft_wrap=True,
        )
    if report.trash_objects:
        console.print(
            f"{report.trash_objects} objects ({report.trash_bytes / 1e6:.1f} MB) are in the trash; "
            "`placewise storage restore-trash` puts them back",
            soft_wrap=True,
        )
    for fault in report.faults[:MAX_FAULTS_SHOWN]:
        console.print(
            f"[red]{fault.wrong}[/red] {fault.what} {escape(fault.name)}: {escape(fault.detail)}",
            soft_wrap=True,
        )
    if len(report.faults) > MAX_FAULTS_SHOWN:
        console.print(f"and {len(report.faults) - MAX_FAULTS_SHOWN} more: --json names them all")
    mended = {"chunk", "manifest", "photo"} if queued is not None else set()
    for what in dict.fromkeys(fault.what for fault in report.faults):
        if what not in mended:
            err_console.print(f"{what}s: {REMEDIES[what]}", soft_wrap=True)
    if queued is not None:
        console.print(f"{queued} photos are queued again")
    if any(f.wrong == FaultKind.MISSING and f.what == "original" for f in report.faults):
        err_console.print("Lost originals can't be described again.")
