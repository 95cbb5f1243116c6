"""The doctor's look at what describes photos: the device, its memory, the extractor's weights."""

from __future__ import annotations

import math
from pathlib import Path

from shared.errors import Misconfigured
from shared.machine import memory_limit_bytes
from shared.recipes import ExtractorConfig
from shared.settings import Settings

BYTES_PER_PARAMETER = 4  # float32
# Twice what was measured in the forward pass of ViT-g, the widest, at 224 x 224 pixels: the next
# batch is being decoded meanwhile. Of larger photos, fewer go through in one pass.
BYTES_PER_BATCH_PHOTO = 40_000_000
PROCESS_OVERHEAD_BYTES = 1_000_000_000  # PyTorch, or CUDA's context, before any weights


def check_device(settings: Settings) -> str:
    """Where photos are described, and in which precision."""
    import torch

    from shared.vision.extractors import choose_device
    from shared.vision.precision import choose_precision

    device = choose_device(settings.device)
    new = f"new generations in {choose_precision(settings.precision, _default_recipe(settings), device)}"
    if device.type == "cuda":
        return f"CUDA: {torch.cuda.get_device_name(device)}, PyTorch {torch.__version__}, {new}"
    return f"CPU, PyTorch {torch.__version__} (CUDA available: {torch.cuda.is_available()}), {new}"


def check_memory(settings: Settings) -> str:
    """Whether the extractor of new maps fits into the memory of its device: an estimate."""
    import torch

    from shared.vision.extractors import choose_device
    from shared.vision.passes import DEFAULT_PHOTO_PIXELS
    from shared.vision.preprocessing import get_preprocessing

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
    one = math.ceil(get_preprocessing(recipe.preprocessing).most_pixels / DEFAULT_PHOTO_PIXELS)
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
        from shared.vision.torchhub_code import find_local_code

        find_local_code(recipe.hub)
    from services.cli.load_extractor import load_extractor

    extractor = load_extractor(recipe, settings)
    shipped = extractor.shipped_vocabulary()
    return f"{recipe.name}: weights {extractor.backbone.fingerprint[:12]} load, " + (
        f"{shipped[0].clusters} shipped centres" if shipped else "no shipped vocabulary"
    )


def _check_dinov2(recipe: ExtractorConfig, weights: Path | None) -> str:
    from shared.vision.backbones.dinov2 import check_dinov2_weights
    from shared.vision.backbones.dinov2_weights import find_local_weights, open_weights

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
