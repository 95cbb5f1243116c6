"""The checks of `placewise doctor` that need no server.

Each check is a function of the settings that returns a summary, or raises a PlacewiseError whose
`detail` says what is wrong and what to do. What a running server knows is in its GET /health.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import shutil
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from shared.catalog.database.schema import check_pages
from shared.catalog.tables import open_catalog
from shared.config.private_files import is_open_to_others
from shared.config.settings import Settings, memory_limit_bytes
from shared.errors import Misconfigured

BYTES_PER_PARAMETER = 4  # float32
# Twice the memory measured in the forward pass of ViT-g, the widest backbone, at 224 x 224 pixels:
# the next batch is decoded meanwhile. Larger photos go through in smaller batches.
BYTES_PER_BATCH_PHOTO = 40_000_000
PROCESS_OVERHEAD_BYTES = 1_000_000_000  # PyTorch or the CUDA context, without weights

Check = Callable[[Settings], str]


def list_checks(settings: Settings, *, has_server: bool) -> list[tuple[str, Check]]:
    """Return the checks of this installation, each with the name of the part that it checks.

    The catalog's file is not checked while a server uses it: the check reads all of it.
    """
    checks: list[tuple[str, Check]] = [("versions", _check_versions), ("settings", _check_settings)]
    if settings.s3_endpoint is None or settings.database_url is None:
        checks.append(("folder", _check_home))  # other services need no writable folder
        checks.append(("permissions", check_permissions))
    if settings.upload_dir is not None and settings.s3_endpoint is None:
        checks.append(("UPLOAD_DIR", _check_upload_dir))
    if settings.database_url is None and not has_server:
        checks.append(("catalog file", _check_catalog_file))
    checks += [("device", check_device), ("memory", check_memory), ("extractor", check_extractor)]
    return checks


def check_device(settings: Settings) -> str:
    """Report the device and the precision that new generations use."""
    import torch

    from shared.descriptors.extractor import choose_device
    from shared.descriptors.inference import choose_precision

    device = choose_device(settings.device)
    config = settings.extractor_config(settings.new_map_extractor)
    precision = choose_precision(settings.precision, config, device)
    precision_note = f"precision of new generations: {precision}"
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

    config = settings.extractor_config(settings.new_map_extractor)
    if config.parameters is None or config.preprocessing is None:
        return f"the size of {config.name} is unknown until it is loaded"
    device = choose_device(settings.device)
    settings = settings.for_device(device.type)
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
    from shared.descriptors.backbones import backbone_class

    config = settings.extractor_config(settings.new_map_extractor)
    if not config.for_tests and config.model is None:
        path = backbone_class(config).find_weights(config, settings.dino_weights).path
        if config.depth is not None:
            return (
                f"{config.name}: weights {path} ({path.stat().st_size / 1e9:.1f} GB) match; no "
                "shipped vocabulary: photos are described once one is fitted or imported"
            )
    from services.cli.descriptors.load_extractor import load_extractor

    extractor = load_extractor(config, settings)
    shipped = extractor.shipped_vocabulary()
    vocabulary = f"shipped vocabulary of {shipped[0].clusters} centres" if shipped else None
    return (
        f"{config.name}: weights {extractor.backbone.fingerprint[:12]} loaded, "
        f"{vocabulary or 'no shipped vocabulary'}"
    )


MIN_FREE_DISK_BYTES = 1_000_000_000


def _check_versions(_: Settings) -> str:
    return f"Placewise {version('placewise')}, Python {sys.version.split()[0]}"


def _check_settings(settings: Settings) -> str:
    """Report the settings, which are valid, or no check would run."""
    return f"{len(settings.model_fields_set)} settings are set (placewise config lists all)"


def _check_home(settings: Settings) -> str:
    home = settings.placewise_home
    existing = _writable_parent(home)
    free = shutil.disk_usage(existing).free
    if free < MIN_FREE_DISK_BYTES:
        raise OSError(errno.ENOSPC, f"only {free / 1e9:.1f} GB are free", str(existing))
    state = "is writable" if existing == home else "does not exist yet and can be created"
    return f"{home} {state}, {free / 1e9:.0f} GB free"


def _check_upload_dir(settings: Settings) -> str:
    assert settings.upload_dir is not None, "the check is listed only with a folder"
    _writable_parent(settings.upload_dir)
    return f"{settings.upload_dir} is writable"


def _writable_parent(folder: Path) -> Path:
    """Return the folder, or its nearest parent that exists; raise OSError if it isn't writable."""
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, "no write permission for this user", str(existing))
    return existing


def _check_catalog_file(settings: Settings) -> str:
    """Check every page of the SQLite catalog, of any size."""
    file = _sqlite_file(settings)
    if file is None or not file.exists():
        return "nothing is stored yet"
    with contextlib.closing(open_catalog(settings, "doctor")) as catalog:
        check_pages(catalog, max_bytes=None)
    return f"{file} has no damaged page"


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
