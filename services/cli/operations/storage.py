"""`placewise verify`: every chunk against its hash and the catalog.

`placewise storage ...`: the bucket, the owner of the object store, orphans and the trash.

What belongs to the steward is imported where it is used: not every image has it.
"""

from __future__ import annotations

import contextlib
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from services.cli.environment import read_settings
from services.cli.operations.backup import open_storage, print_taken_in, progress_reporter
from services.cli.output import JsonOption, console, err_console, print_json, report_errors
from shared.backup.folder import BackupProgress
from shared.catalog.installation import adopt_store, get_or_create_installation
from shared.catalog.schema import check_schema, migrate
from shared.catalog.session import NO_TIMEOUTS, Catalog
from shared.catalog.tables import open_catalog
from shared.config.embedded_home import find_running_server, lock_home
from shared.config.settings import Settings
from shared.errors import Conflict
from shared.integrity.verify import FaultKind, IntegrityReport, repair_descriptors, verify_store
from shared.jobs import InProcessWakeups
from shared.journal.outbox import Lag, catalog_lag
from shared.storage import ObjectStore
from shared.storage.open_store import open_store
from shared.storage.ownership import read_owner
from shared.storage.trash import (
    Hold,
    HoldReason,
    measure_trash,
    read_hold,
    restore_trash,
    write_hold,
)

if TYPE_CHECKING:
    from services.steward.tasks.orphans import StoreCount
    from shared.rebuild.recover import RecoveryReport


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
        from services.steward.tasks.orphans import find_orphans

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
) -> RecoveryReport:
    if lag.since is None:
        raise Conflict("rebuild_unfinished", lag.detail)
    from shared.rebuild.recover import recover_catalog  # it reads photos, which not every image can

    served = settings.database_url is not None or find_running_server(settings.placewise_home)
    age_seconds = UPLOAD_SECONDS if served else 0.0
    return recover_catalog(
        catalog, store, settings, unnamed_age_seconds=age_seconds, progress=progress
    )


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


app = typer.Typer(help="Where objects lie.", no_args_is_help=True)

ConfirmOption = Annotated[
    bool, typer.Option("--confirm", help="Do it; without this option nothing is changed.")
]


@app.command("create-bucket")
def create_bucket_command(as_json: JsonOption = False) -> None:
    """Make the bucket S3_BUCKET at S3_ENDPOINT, once; one that is there already is fine.

    S3_ACCESS_KEY has to be allowed to make buckets, which Placewise itself need not be.
    """
    with report_errors(as_json):
        from shared.storage.s3 import Bucket, create_bucket  # the minio client takes its time

        bucket = Bucket.from_settings(read_settings())
        made = create_bucket(bucket)
    if as_json:
        print_json({"bucket": bucket.name, "endpoint": bucket.endpoint, "made": made})
        return
    state = "is made" if made else "was there already"
    console.print(f"The bucket {bucket.name} at {bucket.endpoint} {state}.", soft_wrap=True)


@app.command("adopt")
def adopt(confirm: ConfirmOption = False, as_json: JsonOption = False) -> None:
    """Make the catalog of the settings the owner of the object store.

    For a store that belongs to a catalog that is gone for good. Stop every service that uses the
    store first: the catalog that owned it refuses to start afterwards. Objects that this catalog
    does not know are kept until `placewise storage collect --confirm`.
    """
    with report_errors(as_json), contextlib.ExitStack() as held:
        from services.steward.tasks.orphans import count_store

        settings = read_settings()
        if settings.database_url is None:
            held.enter_context(lock_home(settings.placewise_home))
        catalog = open_catalog(settings, "storage", NO_TIMEOUTS)
        held.callback(catalog.close)
        store = open_store(settings, exclusive=False)
        store.check()
        if confirm and catalog.is_sqlite:
            migrate(catalog)
        is_new = catalog.is_sqlite and not Path(catalog.url.database or "").exists()
        if not is_new:
            check_schema(catalog)
            _check_not_owned(catalog, read_owner(store))
        count = count_store(None if is_new else catalog, store)
        unknown = count.orphans.total()
        if confirm:
            if unknown:  # before the store is ours, or the steward of this catalog could collect
                unknown_bytes = count.orphan_bytes.total()
                write_hold(store, Hold(HoldReason.ADOPTED, unknown, unknown_bytes, count.objects))
            adopt_store(catalog, store)
    if as_json:
        print_json({"adopted": confirm, **_as_dict(count)})
        return
    console.print(f"{count.objects} objects; unknown to this catalog: {unknown}")
    _print_orphans(count)
    if confirm:
        console.print("The store belongs to this catalog now.")
    else:
        console.print(
            "Nothing was changed. --confirm makes this catalog the owner; any other catalog then "
            "refuses to start with this store. Unknown objects are kept: they are not searchable, "
            "and nothing deletes them before `placewise storage collect --confirm`.",
            soft_wrap=True,
        )


@app.command("collect")
def collect(confirm: ConfirmOption = False, as_json: JsonOption = False) -> None:
    """List the objects that no row of the catalog knows, by prefix; with --confirm, move them to
    the trash, also where the steward holds that back.

    Only those older than ORPHAN_AGE_SECONDS. Runs while the service runs.
    """
    with report_errors(as_json):
        from services.steward.tasks.orphans import StoreCount, collect_orphans, find_orphans

        settings = read_settings()
        with open_storage(settings, "storage") as (catalog, store):
            count, moved, hold = StoreCount(), 0, read_hold(store)
            for _ in find_orphans(catalog, store, settings.orphan_age_seconds, count):
                pass
            if confirm:
                moved = collect_orphans(catalog, store, settings.orphan_age_seconds, confirmed=True)
    if as_json:
        held = None if hold is None else hold.reason
        print_json({"moved": moved, "held": held, **_as_dict(count)})
        return
    console.print(f"{count.objects} objects; known to no row: {count.orphans.total()}")
    _print_orphans(count)
    if confirm:
        console.print(
            f"{moved} objects were moved to the trash, and are deleted after "
            f"{settings.trash_days:g} days (TRASH_DAYS)."
        )
        return
    if hold is not None:
        console.print(f"Collection is held: {escape(hold.describe())}", soft_wrap=True)
    console.print("Nothing was changed. --confirm moves them to the trash.")


@app.command("restore-trash")
def restore(
    prefix: Annotated[
        str, typer.Option("--prefix", help="Only objects whose key begins so: originals/.")
    ] = "",
    as_json: JsonOption = False,
) -> None:
    """Move the objects of the trash back to their keys, while the service runs.

    The catalog does not know them by that: they become orphans again, and are kept for another
    ORPHAN_AGE_SECONDS. `placewise verify --repair` takes originals in, `placewise rebuild-catalog`
    makes a catalog of everything.
    """
    with report_errors(as_json):
        settings = read_settings()
        restored, kept = 0, 0
        with open_storage(settings, "storage") as (_, store):
            for _, is_back in restore_trash(store, prefix):
                restored += is_back
                kept += not is_back
    if as_json:
        print_json({"restored": restored, "kept_in_trash": kept})
        return
    console.print(f"{restored} objects are back under their keys")
    if kept:
        console.print(f"{kept} stay in the trash: another object has their key by now")


def _check_not_owned(catalog: Catalog, owner: str | None) -> None:
    with catalog.write() as session:
        installation_id = get_or_create_installation(session).id
    if owner == str(installation_id):
        raise Conflict("already_owner", "The store belongs to this catalog already.")


def _as_dict(count: StoreCount) -> dict[str, Any]:
    unknown = {
        prefix: {"objects": number, "bytes": count.orphan_bytes[prefix]}
        for prefix, number in sorted(count.orphans.items())
    }
    return {"objects": count.objects, "unknown": unknown}


def _print_orphans(count: StoreCount) -> None:
    for prefix, number in sorted(count.orphans.items()):
        console.print(f"  {prefix:14} {number:8}  {count.orphan_bytes[prefix] / 1e6:10.1f} MB")
