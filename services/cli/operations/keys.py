"""`placewise keys`: create, list and revoke API keys.

With `--server`, the commands call the HTTP API. Without it, they access the catalog directly
(DATABASE_URL or PLACEWISE_HOME) and require no key, since write access to the catalog already
implies full control. This is how the first admin key is created.
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

app = typer.Typer(help="Manage API keys: their scopes, limits and expiry.")

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
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Name of the key: its owner or purpose.")
    ],
    scope: Annotated[list[Scope], typer.Option("--scope", help="Scope to grant. Can be repeated.")],
    days: Annotated[
        float | None,
        typer.Option(min=0.001, max=36_500, help="Lifetime in days. Default: no expiry."),
    ] = None,
    requests_per_minute: Annotated[
        int | None, typer.Option(min=1, max=10**9, help="Rate limit.")
    ] = None,
    upload_bytes_per_day: Annotated[
        int | None, typer.Option(min=1, max=2**53, help="Upload quota.")
    ] = None,
    max_photos: Annotated[
        int | None, typer.Option(min=1, max=2**53, help="Maximum number of stored photos.")
    ] = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Create a key and print it. It can't be shown again.

    Limits that are not given default to the server's settings.
    """
    limits = KeyLimits(requests_per_minute, upload_bytes_per_day, max_photos)
    with report_errors(as_json):
        if server:
            with Client(server, key=key) as client:
                created = client.create_key(
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
                row, new_key = create_api_key(
                    session, name, set(scope), life_seconds=life_seconds, limits=limits
                )
                created = {**_key_as_json(row), "key": new_key}
        if as_json:
            print_json(created)
            return
        # The key alone goes to stdout, so that it can be redirected to a file.
        typer.echo(created["key"])
        typer.echo("This key is shown only once. Use it as PLACEWISE_KEY.", err=True)


@app.command("list")
def list_(server: ServerOption = None, key: KeyOption = None, as_json: JsonOption = False) -> None:
    """List all keys, including revoked and expired ones, without their secrets."""
    with report_errors(as_json):
        if server:
            with Client(server, key=key) as client:
                keys = client.keys()
        else:
            with _open_catalog() as catalog, catalog.read() as session:
                keys = [_key_as_json(row) for row in list_api_keys(session)]
        if as_json:
            print_json(keys)
            return
        table = Table("key", "name", "scopes", "created", "last used", "state")
        for item in keys:
            table.add_row(
                f"{item['prefix']}...",
                item["name"],
                ", ".join(item["scopes"]),
                item["created_at"][:10],
                (item["last_used_at"] or "never")[:16],
                _key_status(item),
            )
        console.print(table)


@app.command("revoke")
def revoke(
    which: Annotated[str, typer.Argument(metavar="KEY", help="The key's ID or displayed prefix.")],
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Revoke a key with immediate effect."""
    with report_errors(as_json):
        if server:
            with Client(server, key=key) as client:
                revoked = client.revoke_key(_resolve_key_id(which, client.keys()))
        else:
            with _open_catalog() as catalog, catalog.write() as session:
                keys = [_key_as_json(row) for row in list_api_keys(session)]
                revoked = _key_as_json(revoke_api_key(session, UUID(_resolve_key_id(which, keys))))
        if as_json:
            print_json(revoked)
            return
        console.print(f"Revoked key {revoked['prefix']}... ({revoked['name']}).")


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
    """Resolve an ID or prefix to an ID; NotFound (`key_not_found`), Conflict (`key_ambiguous`)."""
    prefix = id_or_prefix.removesuffix("...")
    found = [item["id"] for item in keys if prefix in (item["id"], item["prefix"])]
    if not found:
        raise NotFound(
            "key_not_found", f"Key {id_or_prefix!r} does not exist. List keys: placewise keys list."
        )
    if len(found) > 1:
        raise Conflict("key_ambiguous", f"Several keys begin with {prefix}. Use the ID instead.")
    return str(found[0])


def _key_as_json(row: ApiKey) -> Json:
    """The key in the API's JSON format."""
    fields = {name: getattr(row, name) for name in KEY_FIELDS}
    times = {name: value and value.isoformat() for name, value in fields.items() if "_at" in name}
    return {**fields, "id": str(row.id), **times}


def _key_status(key: Json) -> str:
    if key["revoked_at"]:
        return f"revoked {key['revoked_at'][:10]}"
    return f"until {key['expires_at'][:10]}" if key["expires_at"] else "active"
