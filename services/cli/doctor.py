"""`placewise doctor`: part by part, what works and what to do about what does not."""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass

import typer
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from services.cli.configuration import read_settings
from services.cli.output import JsonOption, answers, explained, print_json
from shared.catalog.photos import Photo
from shared.catalog.session import Catalog
from shared.client import Client
from shared.errors import Misconfigured, PlacewiseError
from shared.home import running_server
from shared.recipes import get_recipe
from shared.settings import Settings

LOW_DISK_BYTES = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Finding:
    part: str
    ok: bool
    detail: str


def doctor(as_json: JsonOption = False) -> None:
    """Check this installation; exit code 1 when something needs attention."""
    with explained(as_json):
        settings = read_settings()
    checks: list[tuple[str, Callable[[Settings], str]]] = [
        ("python", _python),
        ("folder", _folder),
        ("server", _server),
        ("device", _device),
        ("extractor", _extractor),
    ]
    findings = [_look(part, check, settings) for part, check in checks]
    if as_json:
        print_json([asdict(finding) for finding in findings])
    else:
        for finding in findings:
            mark = "[green]ok[/green]  " if finding.ok else "[red]look[/red]"
            answers.print(f"{mark} {finding.part}: {finding.detail}", soft_wrap=True)
    if not all(finding.ok for finding in findings):
        raise typer.Exit(1)


def _look(part: str, check: Callable[[Settings], str], settings: Settings) -> Finding:
    try:
        return Finding(part, True, check(settings))
    except PlacewiseError as error:
        return Finding(part, False, error.detail)
    except OSError as error:
        return Finding(part, False, f"{error.filename or ''}: {error.strerror}. Check permissions.")


def _python(_settings: Settings) -> str:
    return f"Python {sys.version.split()[0]}"


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


def _server(settings: Settings) -> str:
    running = running_server(settings.placewise_home)
    if running is not None:
        with Client(running.url, key=running.key) as client:
            stats = client.stats()
        return (
            f"running on {running.url}: {stats['searchable_images']} of {stats['total_images']} "
            f"photos searchable, vocabulary {stats['vocabulary']}"
        )
    if not (settings.placewise_home / "catalog.sqlite").exists():
        return "not running, and nothing is stored yet (start it: make run)"
    catalog = Catalog(settings.catalog_url())
    try:
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


def _device(settings: Settings) -> str:
    import torch

    from shared.vision.extractors import choose_device

    device = choose_device(settings.device)
    if device.type == "cuda":
        return f"CUDA: {torch.cuda.get_device_name(device)}, PyTorch {torch.__version__}"
    return f"CPU, PyTorch {torch.__version__} (CUDA available: {torch.cuda.is_available()})"


def _extractor(settings: Settings) -> str:
    from shared.vision.extractors import Extractor, choose_device

    recipe = get_recipe(settings.extractor, allow_test_extractors=settings.allow_test_extractors)
    extractor = Extractor(recipe, choose_device(settings.device))
    shipped = extractor.shipped_vocabulary()
    return f"{recipe.name}: weights {extractor.backbone.fingerprint[:12]} load, " + (
        f"{shipped[0].clusters} shipped centres" if shipped else "no shipped vocabulary"
    )
