"""`placewise keys create|list|revoke`: of the server that is named, else straight in the catalog.

In the catalog (DATABASE_URL, or the one of PLACEWISE_HOME) no key is asked for: whoever can write
there can do anything. That is how the first admin key comes to be.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Annotated
from uuid import UUID

import typer
from rich.table import Table

from services.cli.environment import read_settings
from services.cli.output import (
    JsonOption,
    KeyOption,
    ServerOption,
    console,
    print_json,
    report_errors,
)
from shared.catalog.api_keys import ApiKey, KeyLimits, create_api_key, list_api_keys, revoke_api_key
from shared.catalog.schema import wait_for_schema
from shared.catalog.session import Catalog
from shared.catalog.tables import open_catalog
from shared.client import Client, Json
from shared.errors import Conflict, NotFound
from shared.security.api_keys import Scope
from shared.telemetry.logs import configure_logging

app = typer.Typer(help="Keys of the HTTP API: who may call, what, and how much.")

SECONDS_PER_DAY = 86_400.0
KEY_FIELDS = (
    "id",
    "name",
    "prefix",
    "scopes",
    "requests_per_minute",
    "upload_bytes_per_day",
    "max_photos",
    "created_at",
    "expires_at",
    "last_used_at",
    "revoked_at",
)


@app.command("create")
def create(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Whose, or what for.")],
    scope: Annotated[
        list[Scope], typer.Option("--scope", help="What it may do; give several if need be.")
    ],
    days: Annotated[
        float | None, typer.Option(min=0.001, max=36_500, help="Until it expires; left out: never.")
    ] = None,
    requests_per_minute: Annotated[int | None, typer.Option(min=1, max=10**9)] = None,
    upload_bytes_per_day: Annotated[int | None, typer.Option(min=1, max=2**53)] = None,
    max_photos: Annotated[int | None, typer.Option(min=1, max=2**53)] = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make a key and print it, this once. Limits that are left out are those of the settings."""
    limits = KeyLimits(requests_per_minute, upload_bytes_per_day, max_photos)
    with report_errors(as_json):
        if server:
            with Client(server, key=key) as client:
                made = client.create_key(
                    name,
                    list(scope),
                    days=days,
                    requests_per_minute=requests_per_minute,
                    upload_bytes_per_day=upload_bytes_per_day,
                    max_photos=max_photos,
                )
        else:
            life_seconds = None if days is None else days * SECONDS_PER_DAY
            with _open_catalog() as catalog, catalog.write() as session:
                row, new = create_api_key(
                    session, name, set(scope), life_seconds=life_seconds, limits=limits
                )
                made = {**_key_as_json(row), "key": new}
        if as_json:
            print_json(made)
            return
        # Alone on stdout, so that it can be piped into a file that only its user reads.
        typer.echo(made["key"])
        typer.echo("It is shown this once. Use it as PLACEWISE_KEY.", err=True)


@app.command("list")
def list_(server: ServerOption = None, key: KeyOption = None, as_json: JsonOption = False) -> None:
    """Show every key that was ever made, without the keys themselves."""
    with report_errors(as_json):
        if server:
            with Client(server, key=key) as client:
                found = client.keys()
        else:
            with _open_catalog() as catalog, catalog.read() as session:
                found = [_key_as_json(row) for row in list_api_keys(session)]
        if as_json:
            print_json(found)
            return
        table = Table("key", "name", "scopes", "made", "last used", "state")
        for one in found:
            table.add_row(
                f"{one['prefix']}...",
                one["name"],
                ", ".join(one["scopes"]),
                one["created_at"][:10],
                (one["last_used_at"] or "never")[:16],
                _key_status(one),
            )
        console.print(table)


@app.command("revoke")
def revoke(
    which: Annotated[str, typer.Argument(metavar="KEY", help="Its id, or its shown beginning.")],
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Let a key open nothing from now on."""
    with report_errors(as_json):
        if server:
            with Client(server, key=key) as client:
                revoked = client.revoke_key(_resolve_key_id(which, client.keys()))
        else:
            with _open_catalog() as catalog, catalog.write() as session:
                there = [_key_as_json(row) for row in list_api_keys(session)]
                revoked = _key_as_json(revoke_api_key(session, UUID(_resolve_key_id(which, there))))
        if as_json:
            print_json(revoked)
            return
        console.print(f"The key {revoked['prefix']}... ({revoked['name']}) opens nothing any more.")


@contextlib.contextmanager
def _open_catalog() -> Iterator[Catalog]:
    settings = read_settings()
    configure_logging(settings, "keys")
    catalog = open_catalog(settings, "keys")
    try:
        wait_for_schema(catalog, 0)
        yield catalog
    finally:
        catalog.close()


def _resolve_key_id(id_or_prefix: str, keys: list[Json]) -> str:
    """NotFound (`key_not_found`), Conflict (`key_ambiguous`)."""
    wanted = id_or_prefix.removesuffix("...")
    found = [one["id"] for one in keys if wanted in (one["id"], one["prefix"])]
    if not found:
        raise NotFound("key_not_found", f"There is no key {id_or_prefix!r}: placewise keys list.")
    if len(found) > 1:
        raise Conflict("key_ambiguous", f"Several keys begin with {wanted}: give the id instead.")
    return str(found[0])


def _key_as_json(row: ApiKey) -> Json:
    """As the API answers it."""
    shown = {name: getattr(row, name) for name in KEY_FIELDS}
    times = {name: value and value.isoformat() for name, value in shown.items() if "_at" in name}
    return {**shown, "id": str(row.id), **times}


def _key_status(key: Json) -> str:
    if key["revoked_at"]:
        return f"revoked {key['revoked_at'][:10]}"
    return f"until {key['expires_at'][:10]}" if key["expires_at"] else "good"
