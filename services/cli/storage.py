"""`placewise storage ...`: the bucket, the owner of the object store, orphans and the trash.

What belongs to the steward is imported where it is used: not every image has it.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from services.cli.configuration import read_settings
from services.cli.output import JsonOption, console, print_json, report_errors
from services.cli.stored import open_storage
from shared.catalog.connections import NO_TIMEOUTS
from shared.catalog.installation import adopt_store, get_or_create_installation
from shared.catalog.open_catalog import open_catalog
from shared.catalog.schema import check_schema, migrate
from shared.catalog.session import Catalog
from shared.errors import Conflict
from shared.home import lock_home
from shared.objects.collection_hold import Hold, HoldReason, read_hold, write_hold
from shared.objects.open_store import open_store
from shared.objects.store_owner import read_owner
from shared.objects.trash import restore_trash

if TYPE_CHECKING:
    from services.steward.collect import StoreCount

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
        from shared.objects.s3 import Bucket, create_bucket  # the minio client takes its time

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
        from services.steward.collect import count_store

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
        from services.steward.collect import StoreCount, collect_orphans, find_orphans

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
