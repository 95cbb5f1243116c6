"""`placewise doctor`: part by part, what works and what to do about what does not."""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec

import typer
from rich.markup import escape
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from services.cli.configuration import read_settings
from services.cli.extractor_checks import device_check, extractor_check, memory_check
from services.cli.output import JsonOption, KeyOption, ServerOption, answers, print_json
from services.cli.server_checks import objects_check, postgres_check, redis_check
from services.cli.service_checks import (
    gateway_check,
    processes_check,
    search_check,
    steward_check,
)
from services.cli.store_checks import collection_check, permissions_check
from shared.catalog.away import as_unavailable
from shared.catalog.open_catalog import open_catalog
from shared.catalog.photos import Photo
from shared.catalog.schema import check_schema
from shared.catalog.unusable import check_pages
from shared.client import Client
from shared.errors import Misconfigured, PlacewiseError
from shared.home import running_server
from shared.journal.lag import catalog_lag
from shared.settings import Settings

LOW_DISK_BYTES = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Finding:
    part: str
    ok: bool
    detail: str


def doctor(server: ServerOption = None, key: KeyOption = None, as_json: JsonOption = False) -> None:
    """Check this installation part by part; exit code 1 when something needs attention.

    With DATABASE_URL: of separate services, who lives and what each part says of itself. Run it
    with the settings of a service, where that one runs; --server names the gateway.
    """
    try:
        settings = read_settings()
    except Misconfigured as error:
        _report([Finding("settings", False, error.detail)], as_json)
        raise typer.Exit(1) from None
    checks: list[tuple[str, Callable[[Settings], str]]] = [("python", _python)]
    checks.append(("settings", _settings))
    if settings.s3_endpoint is None or settings.database_url is None:
        checks.append(("folder", _folder))  # else a service may have none that it can write to
        checks.append(("permissions", permissions_check))
    if settings.s3_endpoint is None:
        checks.append(("uploads", _uploads))
    else:
        checks.append(("objects", objects_check))
    checks.append(("collection", collection_check))
    checks.append(("journal", _journal))
    if settings.database_url is None:
        checks += [("server", _server), ("vocabulary", _vocabulary)]
    else:
        checks += [
            ("postgresql", postgres_check),
            ("redis", redis_check),
            ("search", search_check),
            ("gateways", partial(processes_check, role="gateway")),
            ("extractors", partial(processes_check, role="extractor")),
            ("stewards", steward_check),
        ]
    if server is not None:
        checks.append(("gateway", lambda _: gateway_check(server, key)))
    checks += [("device", device_check), ("memory", memory_check), ("extractor", extractor_check)]
    findings = [_look(part, check, settings) for part, check in checks]
    _report(findings, as_json)
    if not all(finding.ok for finding in findings):
        raise typer.Exit(1)


def _report(findings: list[Finding], as_json: bool) -> None:
    if as_json:
        print_json([asdict(finding) for finding in findings])
        return
    for finding in findings:
        mark = "[green]ok[/green]  " if finding.ok else "[red]look[/red]"
        # What was found is no markup: a path may hold brackets.
        answers.print(f"{mark} {finding.part}: {escape(finding.detail)}", soft_wrap=True)


def _look(part: str, check: Callable[[Settings], str], settings: Settings) -> Finding:
    try:
        return Finding(part, True, check(settings))
    except PlacewiseError as error:
        return Finding(part, False, error.detail)
    except ModuleNotFoundError as error:
        # Each image has its service's packages only.
        return Finding(part, True, f"not looked at: {error.name} is not installed here")
    except OSError as error:
        return Finding(part, False, f"{error.filename or ''}: {error.strerror}. Check permissions.")


def _python(_settings: Settings) -> str:
    return f"Python {sys.version.split()[0]}"


def _settings(settings: Settings) -> str:
    """They were read, or nothing else would be looked at."""
    if settings.otel_exporter_otlp_endpoint is not None and not _is_installed("opentelemetry.sdk"):
        raise Misconfigured(
            "otel_missing",
            "OTEL_EXPORTER_OTLP_ENDPOINT is set, and the extra otel is not installed: uv pip "
            "install '.[otel]', or unset it.",
        )
    return f"{len(settings.model_fields_set)} are set (placewise config prints all)"


def _is_installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:  # not even what it is a part of
        return False


def _folder(settings: Settings) -> str:
    home = settings.placewise_home
    there = next(folder for folder in (home, *home.parents) if folder.exists())
    if not os.access(there, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, "this user may not write there", str(there))
    free = shutil.disk_usage(there).free
    if free < LOW_DISK_BYTES:
        raise OSError(errno.ENOSPC, f"only {free / 1e9:.1f} GB are free", str(there))
    state = "is writable" if there == home else "is not there yet and can be made"
    return f"{home} {state}, {free / 1e9:.0f} GB free"


def _uploads(settings: Settings) -> str:
    folder = settings.upload_dir
    if folder is None:
        return "originals lie under PLACEWISE_HOME"
    there = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not os.access(there, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, "UPLOAD_DIR: this user may not write there", str(there))
    return f"UPLOAD_DIR {folder} is writable"


def _journal(settings: Settings) -> str:
    """Does the catalog know all that the object store's journal tells of?"""
    if settings.database_url is None and not (settings.placewise_home / "catalog.sqlite").exists():
        return "nothing is stored yet"
    from shared.objects.open_store import open_store  # the minio client takes its time

    catalog = open_catalog(settings, "doctor")
    try:
        check_schema(catalog)
        lag = catalog_lag(catalog, open_store(settings, alone=False))
    except SQLAlchemyError as error:
        raise as_unavailable(error) or Misconfigured(
            "catalog_unreadable",
            f"The catalog can't be read ({type(error).__name__}). Check its permissions, or "
            "restore it from a backup.",
        ) from error
    finally:
        catalog.close()
    if lag is not None:
        raise Misconfigured("catalog_behind", lag.detail)
    return "the catalog is as new as the object store"


def _vocabulary(settings: Settings) -> str:
    running = running_server(settings.placewise_home)
    if running is None:
        return "asked of a running server only"
    with Client(running.url, key=running.key) as client:
        maps = client.maps()
    waiting = [m for m in maps if m["photos"] and m["generation_id"] is None]
    if waiting:
        named = ", ".join(f"{m['name']} ({m['photos']} photos)" for m in waiting)
        raise Misconfigured(
            "vocabulary_missing",
            f"Photos wait to be described: {named}. Fit a vocabulary (placewise vocabulary fit "
            "--map NAME) or import one (placewise vocabulary import FILE --map NAME), unless they "
            "were uploaded a moment ago.",
        )
    foreign = [m["name"] for m in maps if m["vocabulary"] == "foreign"]
    if foreign:
        return f"foreign in {', '.join(foreign)}: `placewise vocabulary fit` makes it their own"
    return "no map has a foreign one"


def _server(settings: Settings) -> str:
    running = running_server(settings.placewise_home)
    if running is not None:
        gateway_check(running.url, running.key)
        with Client(running.url, key=running.key) as client:
            maps = client.maps()
        searchable, photos = sum(m["searchable"] for m in maps), sum(m["photos"] for m in maps)
        named = ", ".join(m["name"] for m in maps)
        return f"running on {running.url}: {searchable} of {photos} photos searchable ({named})"
    if not (settings.placewise_home / "catalog.sqlite").exists():
        return "not running, and nothing is stored yet (start it: make run)"
    catalog = open_catalog(settings, "doctor")
    try:
        check_pages(catalog, max_bytes=None)
        with catalog.read() as session:
            photos = session.scalar(
                select(func.count()).select_from(Photo).where(Photo.deleted_at.is_(None))
            )
    except SQLAlchemyError as error:
        raise Misconfigured(
            "catalog_unreadable",
            f"The catalog in {settings.placewise_home} can't be read ({type(error).__name__}). "
            "Check its permissions, or restore it from a backup.",
        ) from error
    finally:
        catalog.close()
    return f"not running; {photos} photos are stored (start it: make run)"
