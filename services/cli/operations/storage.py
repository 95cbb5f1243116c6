"""`placewise storage`: the catalog and the object store.

`verify` checks every chunk against its hash and the catalog. Other subcommands create tables and
the bucket, and manage orphaned objects and the trash.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.markup import escape

from services.cli.environment import read_settings
from services.cli.operations.backup import backup, open_storage, rebuild_catalog, restore
from services.cli.output import (
    JsonOption,
    console,
    print_json,
    print_message,
    print_note,
    print_result,
    progress_bar,
    stage_bars,
)
from services.steward.tasks.orphans import StoreCount, collect_orphans, find_orphans
from shared.catalog.database.schema import migrate as migrate_tables
from shared.catalog.installation import get_or_create_installation
from shared.catalog.tables import open_catalog
from shared.integrity.referenced_objects import plural
from shared.integrity.verify import IntegrityReport, repair_descriptors, verify_store
from shared.jobs import InProcessWakeups
from shared.storage.keys import TRASH
from shared.storage.trash import read_hold
from shared.storage.trash import restore_trash as restore_from_trash
from shared.telemetry.logs import configure_logging

MAX_FAULTS_SHOWN = 20
REMEDIES = {
    "chunk": "placewise storage verify --repair queues their photos again",
    "manifest": "placewise storage verify --repair queues the photos of their chunks again",
    "feature file": "placewise storage verify --repair stops matching their photos, and placewise "
    "maps update NAME --matching on computes their local features again",
    "photo": "placewise storage verify --repair queues them again",
    "original": "restore the object from a backup, or delete the photo and upload it again",
    "vocabulary": "restore the object from a backup, or fit a new vocabulary",
    "whitening": "restore the object from a backup, or create a new generation",
    "file": "its batch fails: upload it again",
}

app = typer.Typer(
    help="Verify, back up, restore and rebuild what is stored; manage the bucket, "
    "orphans and trash.",
    no_args_is_help=True,
)


@app.command("verify")
def verify(
    originals: Annotated[
        bool, typer.Option("--originals", help="Also check every original photo against its hash.")
    ] = False,
    repair: Annotated[
        bool,
        typer.Option(
            "--repair",
            help="Queue the photos of damaged chunks for description, and give up damaged local "
            "features.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check every chunk against its hash and the catalog while services run.

    The exit code is 1 if a fault is found, even if it is repaired.
    """
    with progress_bar() as bars, open_storage(read_settings(), "verify") as (catalog, store):
        progress = stage_bars(bars)
        report = verify_store(catalog, store, originals=originals, progress=progress)
        for info in find_orphans(catalog, store, age_seconds=0.0):
            report.orphans += 1
            report.orphan_bytes += info.size_bytes
            progress("orphaned objects", report.orphans, report.orphans)
        trash = [info.size_bytes for info in store.list(TRASH)]
        report.trash_objects, report.trash_bytes = len(trash), sum(trash)
        # No wakeup message is needed: workers poll, and the steward sends messages.
        queued = repair_descriptors(catalog, InProcessWakeups(), report) if repair else None
    if as_json:
        print_json(_report_as_json(report, queued))
    else:
        _print_report(report, queued)
    if report.faults:
        raise typer.Exit(1)


def _report_as_json(report: IntegrityReport, queued: int | None) -> dict[str, Any]:
    faults = [
        {name: str(value) for name, value in asdict(fault).items() if value is not None}
        for fault in report.faults
    ]
    checked = dict(report.checked)
    return {**asdict(report), "checked": checked, "faults": faults, "queued_photos": queued}


def _print_report(report: IntegrityReport, queued: int | None) -> None:
    checked = ", ".join(f"{count} {plural(kind)}" for kind, count in sorted(report.checked.items()))
    print_message(
        f"Checked {checked or 'nothing'} ({report.read_bytes / 1e6:.1f} MB): "
        f"{len(report.faults)} faults"
    )
    if report.orphans:
        print_message(
            f"{report.orphans} objects ({report.orphan_bytes / 1e6:.1f} MB) are not in the "
            "catalog: uploads in progress or left by a crash. The steward moves old ones to the "
            "trash."
        )
    if report.trash_objects:
        print_message(
            f"{report.trash_objects} objects ({report.trash_bytes / 1e6:.1f} MB) are in the trash. "
            "`placewise storage restore-trash` restores them."
        )
    for fault in report.faults[:MAX_FAULTS_SHOWN]:
        console.print(
            f"[red]{fault.wrong}[/red] {fault.what} {escape(fault.name)}: {escape(fault.detail)}",
            soft_wrap=True,
        )
    if len(report.faults) > MAX_FAULTS_SHOWN:
        print_message(
            f"and {len(report.faults) - MAX_FAULTS_SHOWN} more. --json lists all of them."
        )
    repaired = {"chunk", "manifest", "feature file", "photo"} if queued is not None else set()
    for kind in dict.fromkeys(fault.what for fault in report.faults):
        if kind not in repaired:
            print_note(f"{plural(kind)}: {REMEDIES[kind]}")
    if queued is not None:
        print_message(f"Queued {queued} photos for description.")
    if any(f.wrong == "missing" and f.what == "original" for f in report.faults):
        print_note("Photos without their originals can't be described again.")


app.command("backup")(backup)
app.command("restore")(restore)
app.command("rebuild")(rebuild_catalog)


@app.command("migrate")
def migrate() -> None:
    """Create the catalog's tables in an empty database (DATABASE_URL).

    Run it before the services start. It changes nothing where they exist, and refuses the tables of
    another version.
    """
    settings = read_settings()
    configure_logging(settings, "migrate")
    with contextlib.closing(open_catalog(settings, "migrate")) as catalog:
        migrate_tables(catalog)
        with catalog.write() as session:
            installation_id = get_or_create_installation(session).id
    print_note(f"The catalog has its tables (installation {installation_id})")


ConfirmOption = Annotated[
    bool, typer.Option("--confirm", help="Apply the change. Without it, the command only reports.")
]


@app.command("create-bucket")
def create_bucket_command(as_json: JsonOption = False) -> None:
    """Create the bucket S3_BUCKET at S3_ENDPOINT. An existing bucket is left unchanged.

    S3_ACCESS_KEY must be allowed to create buckets. Placewise itself does not need this permission.
    """
    from shared.storage.s3 import Bucket, create_bucket  # importing minio is slow

    bucket = Bucket.from_settings(read_settings())
    created = create_bucket(bucket)
    state = "was created" if created else "already exists"
    print_result(
        {"bucket": bucket.name, "endpoint": bucket.endpoint, "made": created},
        as_json,
        f"Bucket {bucket.name} at {bucket.endpoint} {state}.",
    )


@app.command("collect")
def collect(confirm: ConfirmOption = False, as_json: JsonOption = False) -> None:
    """Count orphaned objects by prefix; with --confirm, move them to the trash.

    Orphans are objects older than ORPHAN_AGE_SECONDS that are not in the catalog. --confirm also
    overrides a hold on garbage collection. Services can keep running.
    """
    settings = read_settings()
    age_seconds = settings.orphan_age_seconds
    with open_storage(settings, "storage") as (catalog, store):
        count, moved, hold = StoreCount(), 0, read_hold(store)
        for _ in find_orphans(catalog, store, age_seconds, count):
            pass
        while confirm and (batch := collect_orphans(catalog, store, age_seconds, confirmed=True)):
            moved += batch
    if as_json:
        print_json({"moved": moved, "held": hold is not None, **_as_dict(count)})
        return
    print_message(f"{count.objects} objects, {count.orphans.total()} of them orphaned")
    for prefix, number in sorted(count.orphans.items()):
        print_message(f"  {prefix:14} {number:8}  {count.orphan_bytes[prefix] / 1e6:10.1f} MB")
    if confirm:
        print_message(
            f"Moved {moved} objects to the trash. They are deleted after "
            f"{settings.trash_days:g} days (TRASH_DAYS)."
        )
        return
    if hold is not None:
        print_message(f"Garbage collection is on hold: {hold}")
    print_message("Nothing was changed. Pass --confirm to move them to the trash.")


@app.command("restore-trash")
def restore_trash(
    prefix: Annotated[
        str,
        typer.Option(help="Only objects whose key starts with this prefix, such as originals/."),
    ] = "",
    as_json: JsonOption = False,
) -> None:
    """Move objects from the trash back to their keys while services run.

    This does not add them to the catalog: they are orphans again and are kept for another
    ORPHAN_AGE_SECONDS. `placewise storage rebuild` creates a catalog from all objects.
    """
    with open_storage(read_settings(), "storage") as (_, store):
        counts = Counter(was_restored for _, was_restored in restore_from_trash(store, prefix))
    restored, skipped = counts[True], counts[False]
    if as_json:
        print_json({"restored": restored, "kept_in_trash": skipped})
        return
    print_message(f"Restored {restored} objects to their keys.")
    if skipped:
        print_message(f"{skipped} objects stay in the trash: their keys are in use again.")


def _as_dict(count: StoreCount) -> dict[str, Any]:
    unknown = {
        prefix: {"objects": number, "bytes": count.orphan_bytes[prefix]}
        for prefix, number in sorted(count.orphans.items())
    }
    return {"objects": count.objects, "unknown": unknown}
