"""`placewise doctor`: part by part, what works and what to do about what does not.

The doctor's look at what describes photos: the device, its memory, the extractor's weights.
"""

from __future__ import annotations

import errno
import math
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import typer
from rich.markup import escape
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from services.cli.environment import read_settings
from services.cli.operations.deployment_checks import (
    check_gateway,
    check_object_store,
    check_postgres,
    check_processes,
    check_redis,
    check_search,
    check_steward,
)
from services.cli.operations.store_checks import collection_check, permissions_check
from services.cli.output import JsonOption, KeyOption, ServerOption, console, print_json
from shared.catalog.database_errors import to_unavailable
from shared.catalog.file_checks import check_pages
from shared.catalog.photos import Photo
from shared.catalog.schema import check_schema
from shared.catalog.tables import open_catalog
from shared.client import Client
from shared.config.embedded_home import find_running_server
from shared.config.settings import Settings, memory_limit_bytes
from shared.errors import Misconfigured, PlacewiseError
from shared.extractor_config.configs import ExtractorConfig
from shared.journal.outbox import catalog_lag

BYTES_PER_PARAMETER = 4  # float32
# Twice what was measured in the forward pass of ViT-g, the widest, at 224 x 224 pixels: the next
# batch is being decoded meanwhile. Of larger photos, fewer go through in one pass.
BYTES_PER_BATCH_PHOTO = 40_000_000
PROCESS_OVERHEAD_BYTES = 1_000_000_000  # PyTorch, or CUDA's context, before any weights


def check_device(settings: Settings) -> str:
    """Where photos are described, and in which precision."""
    import torch

    from shared.descriptors.extractor import choose_device
    from shared.descriptors.inference import choose_precision

    device = choose_device(settings.device)
    new = (
        "new generations in "
        f"{choose_precision(settings.precision, _default_recipe(settings), device)}"
    )
    if device.type == "cuda":
        return f"CUDA: {torch.cuda.get_device_name(device)}, PyTorch {torch.__version__}, {new}"
    return f"CPU, PyTorch {torch.__version__} (CUDA available: {torch.cuda.is_available()}), {new}"


def check_memory(settings: Settings) -> str:
    """Whether the extractor of new maps fits into the memory of its device: an estimate."""
    import torch

    from shared.descriptors.extractor import choose_device
    from shared.descriptors.inference import DEFAULT_PHOTO_PIXELS
    from shared.imaging.preprocessing import get_preprocessing

    recipe = _default_recipe(settings)
    if recipe.parameters is None or recipe.preprocessing is None:
        return f"{recipe.name} tells its size only when it is loaded"
    device = choose_device(settings.device)
    if device.type == "cuda":
        there, whose = torch.cuda.get_device_properties(device).total_memory, "the GPU"
    else:
        there, whose = memory_limit_bytes(), "this machine"
    weights = recipe.parameters * BYTES_PER_PARAMETER
    # One photo always goes through whole, however large its preprocessing leaves it.
    one = math.ceil(get_preprocessing(recipe.preprocessing).max_pixels / DEFAULT_PHOTO_PIXELS)
    batch = max(settings.batch_photos, one) * BYTES_PER_BATCH_PHOTO
    needed = PROCESS_OVERHEAD_BYTES + weights + batch
    estimate = (
        f"{recipe.name} takes about {needed / 1e9:.1f} GB (weights {weights / 1e9:.1f}, a batch of "
        f"{settings.batch_photos} photos {batch / 1e9:.1f}), {whose} has {there / 1e9:.1f} GB"
    )
    if needed <= there:
        return estimate
    ways = []
    if (
        settings.batch_photos > one
        and PROCESS_OVERHEAD_BYTES + weights + one * BYTES_PER_BATCH_PHOTO <= there
    ):
        ways.append(f"a smaller BATCH_PHOTOS than {settings.batch_photos}")
    if recipe.depth is not None:
        ways.append("a smaller DINO_MODEL (dinov2_vits14 takes 0.1 GB of weights)")
    if one > 1:
        ways.append("EXTRACTOR with the preprocessing square224")
    if device.type == "cuda":
        ways.append("DEVICE=cpu")
    raise Misconfigured("memory_short", f"{estimate}. Set {', or '.join(ways) or 'more memory'}.")


def check_extractor(settings: Settings) -> str:
    """Whether the extractor of new maps has its weights.

    DINOv2's, up to 4.5 GB, are looked at without being loaded; the others are loaded.
    """
    recipe = _default_recipe(settings)
    if recipe.depth is not None:
        return _check_dinov2(recipe, settings.dino_weights)
    if recipe.hub is not None:
        from shared.descriptors.backbones.torchhub import find_local_code

        find_local_code(recipe.hub)
    from services.cli.descriptors.local_extractor import load_extractor

    extractor = load_extractor(recipe, settings)
    shipped = extractor.shipped_vocabulary()
    return f"{recipe.name}: weights {extractor.backbone.fingerprint[:12]} load, " + (
        f"{shipped[0].clusters} shipped centres" if shipped else "no shipped vocabulary"
    )


def _check_dinov2(recipe: ExtractorConfig, weights: Path | None) -> str:
    from shared.descriptors.backbones.dinov2 import check_dinov2_weights
    from shared.descriptors.backbones.dinov2_weights import find_local_weights, open_weights

    assert recipe.layer is not None
    assert recipe.facet is not None
    size = recipe.backbone.removeprefix("dinov2-")
    path = find_local_weights(size, weights)
    check_dinov2_weights(size, recipe.layer, recipe.facet, open_weights(path, size))
    return (
        f"{recipe.name}: the weights {path} ({path.stat().st_size / 1e9:.1f} GB) fit, no shipped "
        f"vocabulary: photos wait until one is fitted on them or imported"
    )


def _default_recipe(settings: Settings) -> ExtractorConfig:
    return settings.recipe(settings.new_map_extractor)


MIN_FREE_DISK_BYTES = 1_000_000_000


@dataclass(frozen=True, slots=True)
class CheckResult:
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
        _print_results([CheckResult("settings", False, error.detail)], as_json)
        raise typer.Exit(1) from None
    checks: list[tuple[str, Callable[[Settings], str]]] = [("python", _check_python)]
    checks.append(("settings", _check_settings))
    if settings.s3_endpoint is None or settings.database_url is None:
        checks.append(("folder", _check_home))  # else a service may have none that it can write to
        checks.append(("permissions", permissions_check))
    if settings.s3_endpoint is None:
        checks.append(("uploads", _check_upload_dir))
    else:
        checks.append(("objects", check_object_store))
    checks.append(("collection", collection_check))
    checks.append(("journal", _journal))
    if settings.database_url is None:
        checks += [("server", _check_server), ("vocabulary", _check_vocabulary)]
    else:
        checks += [
            ("postgresql", check_postgres),
            ("redis", check_redis),
            ("search", check_search),
            ("gateways", partial(check_processes, role="gateway")),
            ("extractors", partial(check_processes, role="extractor")),
            ("stewards", check_steward),
        ]
    if server is not None:
        checks.append(("gateway", lambda _: check_gateway(server, key)))
    checks += [("device", check_device), ("memory", check_memory), ("extractor", check_extractor)]
    findings = [_run_check(part, check, settings) for part, check in checks]
    _print_results(findings, as_json)
    if not all(finding.ok for finding in findings):
        raise typer.Exit(1)


def _print_results(results: list[CheckResult], as_json: bool) -> None:
    if as_json:
        print_json([asdict(finding) for finding in results])
        return
    for finding in results:
        mark = "[green]ok[/green]  " if finding.ok else "[red]look[/red]"
        # What was found is no markup: a path may hold brackets.
        console.print(f"{mark} {finding.part}: {escape(finding.detail)}", soft_wrap=True)


def _run_check(part: str, check: Callable[[Settings], str], settings: Settings) -> CheckResult:
    try:
        return CheckResult(part, True, check(settings))
    except PlacewiseError as error:
        return CheckResult(part, False, error.detail)
    except ModuleNotFoundError as error:
        # Each image has its service's packages only.
        return CheckResult(part, True, f"not looked at: {error.name} is not installed here")
    except OSError as error:
        return CheckResult(
            part, False, f"{error.filename or ''}: {error.strerror}. Check permissions."
        )


def _check_python(_settings: Settings) -> str:
    return f"Python {sys.version.split()[0]}"


def _check_settings(settings: Settings) -> str:
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


def _check_home(settings: Settings) -> str:
    home = settings.placewise_home
    there = next(folder for folder in (home, *home.parents) if folder.exists())
    if not os.access(there, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, "this user may not write there", str(there))
    free = shutil.disk_usage(there).free
    if free < MIN_FREE_DISK_BYTES:
        raise OSError(errno.ENOSPC, f"only {free / 1e9:.1f} GB are free", str(there))
    state = "is writable" if there == home else "is not there yet and can be made"
    return f"{home} {state}, {free / 1e9:.0f} GB free"


def _check_upload_dir(settings: Settings) -> str:
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
    from shared.storage.open_store import open_store  # the minio client takes its time

    catalog = open_catalog(settings, "doctor")
    try:
        check_schema(catalog)
        lag = catalog_lag(catalog, open_store(settings, exclusive=False))
    except SQLAlchemyError as error:
        raise to_unavailable(error) or Misconfigured(
            "catalog_unreadable",
            f"The catalog can't be read ({type(error).__name__}). Check its permissions, or "
            "restore it from a backup.",
        ) from error
    finally:
        catalog.close()
    if lag is not None:
        raise Misconfigured("catalog_behind", lag.detail)
    return "the catalog is as new as the object store"


def _check_vocabulary(settings: Settings) -> str:
    running = find_running_server(settings.placewise_home)
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


def _check_server(settings: Settings) -> str:
    running = find_running_server(settings.placewise_home)
    if running is not None:
        check_gateway(running.url, running.key)
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
