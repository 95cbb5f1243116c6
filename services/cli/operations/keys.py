"""`placewise keys`: create, list and revoke API keys of a server."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Annotated
from uuid import UUID

import typer

from placewise.answers import Key
from services.cli.client import ServerOptions
from services.cli.option_groups import CommandGroup
from services.cli.output import Table, print_json, print_result
from shared.errors import Conflict, NotFound
from shared.security.api_keys import Scope

app = CommandGroup(help="Manage API keys: their scopes, limits and expiry.")


@app.command("create")
def create(
    common: ServerOptions,
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Name of the key: its owner or purpose.")
    ],
    scope: Annotated[list[Scope], typer.Option(help="Scope to grant. Can be repeated.")],
    maps: Annotated[
        list[str] | None,
        typer.Option("--map", help="Only map that the key may use. Can be repeated. Default: all."),
    ] = None,
    days: Annotated[
        float | None,
        typer.Option(min=0.001, max=36_500, help="Lifetime in days. Default: no expiry."),
    ] = None,
    requests_per_minute: Annotated[
        int | None, typer.Option(min=1, max=10**9, help="Rate limit.")
    ] = None,
    max_photos: Annotated[
        int | None, typer.Option(min=1, max=2**53, help="Maximum number of stored photos.")
    ] = None,
) -> None:
    """Create a key and print it. It can't be shown again.

    The maps must exist. Limits that are not given default to the server's settings.
    """
    limits = {
        "requests_per_minute": requests_per_minute,
        "max_photos": max_photos,
    }
    with common.connect() as client:
        if maps:
            _check_maps(maps, [each.name for each in client.maps()])
        created = client.create_key(name, list(scope), days=days, maps=maps or None, **limits)
    if common.as_json:
        print_json(created)
        return
    # The key alone goes to stdout, so that it can be redirected to a file.
    typer.echo(created.key)
    typer.echo("This key is shown only once. Use it as PLACEWISE_KEY.", err=True)


@app.command("list")
def list_(common: ServerOptions) -> None:
    """List all keys, including revoked and expired ones, without their secrets."""
    with common.connect() as client:
        listed = client.keys()
    table = Table("key", "name", "scopes", "maps", "created", "last used", "state")
    for item in listed:
        table.add_row(
            f"{item.prefix}...",
            item.name,
            ", ".join(item.scopes),
            "all" if item.maps is None else ", ".join(item.maps),
            f"{item.created_at:%Y-%m-%d}",
            f"{item.last_used_at:%Y-%m-%dT%H:%M}" if item.last_used_at else "never",
            _key_status(item),
        )
    print_result(listed, common.as_json, table)


@app.command("revoke")
def revoke(
    common: ServerOptions,
    which: Annotated[str, typer.Argument(metavar="KEY", help="The key's ID or displayed prefix.")],
) -> None:
    """Revoke a key with immediate effect."""
    with common.connect() as client:
        revoked = client.revoke_key(_resolve_key_id(which, client.keys()))
    print_result(revoked, common.as_json, f"Revoked key {revoked.prefix}... ({revoked.name}).")


def _check_maps(names: Sequence[str], existing: Collection[str]) -> None:
    """Raise NotFound (`map_not_found`) if a map does not exist."""
    missing = [name for name in names if name not in existing]
    if missing:
        raise NotFound(
            "map_not_found",
            f"There is no map named {', '.join(map(repr, missing))}. The maps are "
            f"{', '.join(sorted(existing))}. Create a map: `placewise maps create NAME`. A key "
            "for all maps has no --map.",
            map=missing[0],
        )


def _resolve_key_id(id_or_prefix: str, keys: list[Key]) -> UUID:
    """Resolve an ID or prefix to an ID; NotFound (`key_not_found`), Conflict (`key_ambiguous`)."""
    prefix = id_or_prefix.removesuffix("...")
    found = [item.id for item in keys if prefix in (str(item.id), item.prefix)]
    if not found:
        raise NotFound(
            "key_not_found", f"Key {id_or_prefix!r} does not exist. List keys: placewise keys list."
        )
    if len(found) > 1:
        raise Conflict("key_ambiguous", f"Several keys begin with {prefix}. Use the ID instead.")
    return found[0]


def _key_status(key: Key) -> str:
    if key.revoked_at:
        return f"revoked {key.revoked_at:%Y-%m-%d}"
    return f"until {key.expires_at:%Y-%m-%d}" if key.expires_at else "active"
