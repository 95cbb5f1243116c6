"""Whether pretrained weights are on this machine, without importing torch."""

from __future__ import annotations

import os
from pathlib import Path

from shared.errors import Misconfigured

TORCHVISION_NAMES = ("resnet", "resnext", "swin_t", "efficientnet_b")


def find_missing_weights(arch: str, pretrained: bool, weights: Path | None) -> list[Misconfigured]:
    """Return what is missing if torchvision's weights of a backbone are not on this machine.

    That alone keeps nothing from starting where they can be downloaded.
    """
    name = arch.lower().replace("-", "_")
    cache = os.environ.get("TORCH_HOME", f"{os.environ.get('XDG_CACHE_HOME', '~/.cache')}/torch")
    folder = Path(cache, "hub", "checkpoints").expanduser()  # `torch.hub.get_dir`
    if weights is not None:
        found, reason = weights.is_file(), f"{weights} (--weights) is not a file."
    else:
        found = not name.startswith(TORCHVISION_NAMES) or any(folder.glob(f"{name}-*.pth"))
        reason = (
            f"{folder} has no pretrained weights of {name}. With internet access they are "
            "downloaded; otherwise copy them there, pass --weights FILE, or train with "
            "--pretrained False."
        )
    return [] if found or not pretrained else [Misconfigured("weights_missing", reason)]
