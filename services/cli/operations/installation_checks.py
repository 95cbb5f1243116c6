"""The checks of `placewise doctor`.

Each check is a function of the settings that returns a summary, or raises a PlacewiseError whose
`detail` says what is wrong and what to do. This module contains the checks of the embedded
installation, of stored files and of the extractor (device, memory, weights); `deployment_checks`
contains those of separate services.
"""

from __future__ import annotations

import errno
import math
import os
import shutil
import sys
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn
from uuid import UUID

from sqlalchemy import func, select

from placewise.answers import Map
from placewise.client import Client
from services.cli.descriptors.local_weights import find_dinov2_weights, suggest_extractor
from services.cli.operations.deployment_checks import (
    check_gateway,
    check_object_store,
    check_postgres,
    check_processes,
    check_redis,
    check_search,
    check_steward,
    open_for_check,
    read_health,
)
from shared.catalog.database.schema import check_pages, check_schema
from shared.catalog.installation import Installation
from shared.catalog.maps import count_failed_photos
from shared.catalog.photos import Photo
from shared.catalog.tables import open_catalog
from shared.config.command_line import command_line
from shared.config.embedded_home import find_running_server
from shared.config.private_files import is_open_to_others
from shared.config.settings import Settings, memory_limit_bytes
from shared.errors import Misconfigured
from shared.extractor_config.configs import MIN_PHOTOS_TO_FIT, ExtractorConfig
from shared.journal.outbox import catalog_lag
from shared.storage import FolderStore, OwnedStore
from shared.storage.open_store import open_store
from shared.storage.ownership import read_owner, store_taken_error
from shared.storage.trash import read_hold

BYTES_PER_PARAMETER = 4  # float32
# Twice the memory measured in the forward pass of ViT-g, the widest backbone, at 224 x 224 pixels:
# the next batch is decoded meanwhile. Larger photos go through in smaller batches.
BYTES_PER_BATCH_PHOTO = 40_000_000
PROCESS_OVERHEAD_BYTES = 1_000_000_000  # PyTorch or the CUDA context, without weights

CHECK_FILE = "Check its permissions, or restore it from a backup."

Check = Callable[[Settings], str]


def list_checks(settings: Settings, server: str | None, key: str | None) -> list[tuple[str, Check]]:
    """Return the checks of this installation, each with the name of the part that it checks.

    A gateway at the URL `server` is checked as well, with the API key `key`.
    """
    checks: list[tuple[str, Check]] = [
        ("python", lambda _: f"Python {sys.version.split()[0]}"),
        ("settings", _check_settings),
    ]
    if settings.s3_endpoint is None or settings.database_url is None:
        checks.append(("folder", _check_home))  # other services need no writable folder
        checks.append(("permissions", check_permissions))
    if settings.s3_endpoint is None:
        checks.append(("uploads", _check_upload_dir))
    else:
        checks.append(("objects", check_object_store))
    checks += [
        ("collection", _check_collection),
        ("journal", _check_journal),
        ("photos", _check_photos),
    ]
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
    return checks


def check_device(settings: Settings) -> str:
    """Report the device and the precision that new generations use."""
    import torch

    from shared.descriptors.extractor import choose_device
    from shared.descriptors.inference import choose_precision

    device = choose_device(settings.device)
    precision_note = (
        "precision of new generations: "
        f"{choose_precision(settings.precision, _default_extractor_config(settings), device)}"
    )
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
        return f"CUDA: {name}, PyTorch {torch.__version__}, {precision_note}"
    has_cuda = torch.cuda.is_available()
    return f"CPU, PyTorch {torch.__version__} (CUDA available: {has_cuda}), {precision_note}"


def check_memory(settings: Settings) -> str:
    """Estimate whether the default extractor fits into the memory of its device.

    Raises:
        Misconfigured: `memory_short`.
    """
    import torch

    from shared.descriptors.extractor import choose_device
    from shared.descriptors.inference import DEFAULT_PHOTO_PIXELS
    from shared.imaging.preprocessing import get_preprocessing

    config = _default_extractor_config(settings)
    if config.parameters is None or config.preprocessing is None:
        return f"the size of {config.name} is unknown until it is loaded"
    device = choose_device(settings.device)
    if device.type == "cuda":
        available, owner = torch.cuda.get_device_properties(device).total_memory, "the GPU"
    else:
        available, owner = memory_limit_bytes(), "this machine"
    weights = config.parameters * BYTES_PER_PARAMETER
    # A single photo is never split, however many pixels its preprocessing produces.
    min_batch = math.ceil(get_preprocessing(config.preprocessing).max_pixels / DEFAULT_PHOTO_PIXELS)
    batch = max(settings.batch_photos, min_batch) * BYTES_PER_BATCH_PHOTO
    needed = PROCESS_OVERHEAD_BYTES + weights + batch
    estimate = (
        f"{config.name} requires about {needed / 1e9:.1f} GB (weights {weights / 1e9:.1f}, "
        f"a batch of {settings.batch_photos} photos {batch / 1e9:.1f}), "
        f"{owner} has {available / 1e9:.1f} GB"
    )
    if needed <= available:
        return estimate
    remedies = []
    if (
        settings.batch_photos > min_batch
        and PROCESS_OVERHEAD_BYTES + weights + min_batch * BYTES_PER_BATCH_PHOTO <= available
    ):
        remedies.append(f"BATCH_PHOTOS below {settings.batch_photos}")
    if config.depth is not None:
        remedies.append("a smaller DINO_MODEL (dinov2_vits14 takes 0.1 GB of weights)")
    if min_batch > 1:
        remedies.append("EXTRACTOR with the preprocessing square224")
    if device.type == "cuda":
        remedies.append("DEVICE=cpu")
    raise Misconfigured(
        "memory_short", f"{estimate}. Set {', or '.join(remedies) or 'more memory'}."
    )


def check_extractor(settings: Settings) -> str:
    """Check that the weights of the default extractor are available.

    DINOv2 weights (up to 4.5 GB) are inspected without loading them; others are loaded.

    Raises:
        Misconfigured: The weights are missing or don't fit the extractor.
    """
    summary = _check_weights(_default_extractor_config(settings), settings)
    suggestion = suggest_extractor(settings)
    return f"{summary}; {suggestion}" if suggestion else summary


def _check_weights(config: ExtractorConfig, settings: Settings) -> str:
    if config.depth is not None:
        return _check_dinov2(config, settings.dino_weights)
    if config.hub is not None:
        from shared.descriptors.backbones.torchhub import find_local_code

        find_local_code(config.hub)
    from services.cli.descriptors.local_extractor import load_extractor

    extractor = load_extractor(config, settings)
    shipped = extractor.shipped_vocabulary()
    return f"{config.name}: weights {extractor.backbone.fingerprint[:12]} loaded, " + (
        f"shipped vocabulary of {shipped[0].clusters} centres"
        if shipped
        else "no shipped vocabulary"
    )


def _check_dinov2(config: ExtractorConfig, weights: Path | None) -> str:
    path = find_dinov2_weights(config, weights)
    return (
        f"{config.name}: weights {path} ({path.stat().st_size / 1e9:.1f} GB) match; no shipped "
        "vocabulary: photos are described once one is fitted or imported"
    )


def _default_extractor_config(settings: Settings) -> ExtractorConfig:
    return settings.extractor_config(settings.new_map_extractor)


MIN_FREE_DISK_BYTES = 1_000_000_000


def _check_settings(settings: Settings) -> str:
    """Report the settings; they are valid, or no check would run."""
    if settings.otel_exporter_otlp_endpoint is not None and not _is_installed("opentelemetry.sdk"):
        raise Misconfigured(
            "otel_missing",
            "OTEL_EXPORTER_OTLP_ENDPOINT is set, but the extra otel is not installed. Install it "
            "(uv pip install '.[otel]') or unset the variable.",
        )
    return f"{len(settings.model_fields_set)} settings are set (placewise config lists all)"


def _is_installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:  # the parent package is missing
        return False


def _check_home(settings: Settings) -> str:
    home = settings.placewise_home
    existing = next(folder for folder in (home, *home.parents) if folder.exists())
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, "no write permission for this user", str(existing))
    free = shutil.disk_usage(existing).free
    if free < MIN_FREE_DISK_BYTES:
        raise OSError(errno.ENOSPC, f"only {free / 1e9:.1f} GB are free", str(existing))
    state = "is writable" if existing == home else "does not exist yet and can be created"
    return f"{home} {state}, {free / 1e9:.0f} GB free"


def _check_upload_dir(settings: Settings) -> str:
    folder = settings.upload_dir
    if folder is None:
        return "originals are stored in PLACEWISE_HOME"
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, "UPLOAD_DIR: no write permission for this user", str(existing))
    return f"UPLOAD_DIR {folder} is writable"


def _check_journal(settings: Settings) -> str:
    """Check that the catalog contains every change recorded in the object store's journal."""
    if settings.database_url is None and not (settings.placewise_home / "catalog.sqlite").exists():
        return "nothing is stored yet"
    with open_for_check(settings, CHECK_FILE) as catalog:
        check_schema(catalog)
        lag = catalog_lag(catalog, open_store(settings, exclusive=False))
    if lag is not None:
        raise Misconfigured("catalog_behind", lag.detail)
    return "the catalog is up to date with the object store"


def _check_photos(settings: Settings) -> str:
    """Check that no stored photo is left out of searches because its description failed."""
    if settings.database_url is None and not (settings.placewise_home / "catalog.sqlite").exists():
        return "nothing is stored yet"
    with open_for_check(settings, CHECK_FILE) as catalog:
        check_schema(catalog)
        with catalog.read() as session:
            failed = count_failed_photos(session)
    if not failed:
        return "no photo is left out of searches because its description failed"
    named = ", ".join(f"{number} in the map {name}" for name, number in failed.items())
    raise Misconfigured(
        "photos_failed",
        f"Stored photos can't be searched for, because their description failed: {named}. List "
        "them with GET /api/v1/search?failed=true&map=NAME; the page shows the reason with each. "
        "Delete or replace photos that can't be decoded; the next model change describes all "
        "others again.",
    )


def _check_vocabulary(settings: Settings) -> str:
    running = find_running_server(settings.placewise_home)
    if running is None:
        return "checked only while a server runs"
    extractors = read_health(running.url, running.key)["parts"].get("extractors", {})
    with Client(running.url, key=running.key) as client:
        maps = client.maps()
    unloadable = {
        name: code
        for each in extractors.get("processes", ())
        for name, code in each["errors"].items()
    }
    for each in maps:
        if each.photos and each.generation_id is None and each.extractor in unloadable:
            _raise_unloadable(each, unloadable[each.extractor], settings)
    waiting = extractors.get("waiting_for_vocabulary")
    if waiting:
        names = ", ".join(f"{m.name} ({m.photos} photos)" for m in maps if m.name in waiting)
        raise Misconfigured(
            "vocabulary_missing",
            f"Photos are waiting for a vocabulary: {names}. Fit one (placewise vocabulary fit "
            "--map NAME) or import one (placewise vocabulary import FILE --map NAME).",
        )
    pending = [m.name for m in maps if m.vocabulary == "pending"]
    if pending:
        return (
            f"no vocabulary yet in {', '.join(pending)}: their descriptors are GeM-pooled until "
            "one is fitted (placewise vocabulary fit --map NAME), which starts by itself at "
            f"{MIN_PHOTOS_TO_FIT} photos"
        )
    provisional = [m.name for m in maps if m.vocabulary == "provisional"]
    if provisional:
        return (
            f"vocabulary fitted on too few photos in {', '.join(provisional)}: another one is "
            f"fitted by itself at {MIN_PHOTOS_TO_FIT} photos"
        )
    foreign = [m.name for m in maps if m.vocabulary == "foreign"]
    if foreign:
        return (
            f"foreign vocabulary in {', '.join(foreign)}: one is fitted by itself at "
            f"{MIN_PHOTOS_TO_FIT} photos unless a map's auto_fit is off, or with `placewise "
            "vocabulary fit`"
        )
    return "no map uses a foreign vocabulary"


def _raise_unloadable(map_: Map, code: str, settings: Settings) -> NoReturn:
    """Say why the extractor of a map can't be loaded; it needs no vocabulary before."""
    try:
        _check_weights(settings.extractor_config(map_.extractor), settings)
        reason = "The server's log has the details."
    except Misconfigured as error:
        reason = error.detail
    raise Misconfigured(
        code,
        f"{map_.name} ({map_.photos} photos) can't be described: its extractor {map_.extractor} "
        f"can't be loaded ({code}). {reason}",
    )


def _check_server(settings: Settings) -> str:
    running = find_running_server(settings.placewise_home)
    if running is not None:
        check_gateway(running.url, running.key)
        with Client(running.url, key=running.key) as client:
            maps = client.maps()
        searchable, stored = sum(m.searchable for m in maps), sum(m.photos for m in maps)
        names = ", ".join(m.name for m in maps)
        return f"running on {running.url}: {searchable} of {stored} photos searchable ({names})"
    start = command_line("serve", home=settings.placewise_home)
    if not (settings.placewise_home / "catalog.sqlite").exists():
        return f"not running, nothing is stored yet. Start it: {start}"
    with open_for_check(settings, CHECK_FILE) as catalog:
        check_pages(catalog, max_bytes=None)
        with catalog.read() as session:
            photos = session.scalar(select(func.count()).where(Photo.deleted_at.is_(None)))
    return f"not running; {photos} photos are stored. Start it: {start}"


def _check_collection(settings: Settings) -> str:
    """Check that this catalog owns the store and that orphans are collected.

    Raises:
        Misconfigured: Another catalog owns the store, or `collection_held`.
    """
    folder = settings.placewise_home / "objects"
    store: OwnedStore
    if settings.s3_endpoint is not None:
        store = open_store(settings, exclusive=False)
    elif folder.exists():
        store = FolderStore(folder, exclusive=False)  # UPLOAD_DIR has no owner record
    else:
        return "nothing is stored yet"
    owner = read_owner(store)
    if owner is None:
        return "the object store has no owner yet; the next start assigns it"
    if str(_installation_id(settings)) != owner:
        raise store_taken_error(store, "belongs to another catalog than this one")
    hold = read_hold(store)
    if hold is not None:
        raise Misconfigured("collection_held", hold.describe())
    return "the object store belongs to this catalog, and orphans are collected"


def check_permissions(settings: Settings) -> str:
    """Check that other users of this machine can't read stored files.

    Raises:
        Misconfigured: `readable_by_others`.
    """
    roots = [settings.placewise_home, settings.upload_dir, _sqlite_file(settings)]
    existing = [root for root in roots if root is not None and root.exists()]
    # Contents of a private folder are not accessible, whatever their own permissions.
    accessible = [
        root
        for root in existing
        if is_open_to_others(root)
        and not any(_is_private_parent(parent, root) for parent in existing)
    ]
    if accessible:
        paths = " ".join(f"'{root}'" for root in accessible)
        raise Misconfigured(
            "readable_by_others",
            f"Other users of this machine have access to {paths}, which contain photos, key hashes "
            f"and the catalog. Revoke it: chmod -R go-rwx {paths}",
        )
    return "only this user can read stored files" if existing else "nothing is stored yet"


def _is_private_parent(parent: Path, path: Path) -> bool:
    return path != parent and path.is_relative_to(parent) and not is_open_to_others(parent)


def _sqlite_file(settings: Settings) -> Path | None:
    catalog = open_catalog(settings, "doctor")  # opens no connection
    catalog.close()
    return Path(catalog.url.database) if catalog.is_sqlite and catalog.url.database else None


def _installation_id(settings: Settings) -> UUID | None:
    """None for a catalog that does not exist."""
    file = _sqlite_file(settings)
    if file is not None and not file.exists():
        return None
    with open_for_check(settings, CHECK_FILE) as catalog, catalog.read() as session:
        return session.scalar(select(Installation.id))
