"""A torch.hub entry as a backbone: a network that makes one global descriptor of a photo.

MegaLoc, BoQ, CosPlace, EigenPlaces and others publish such entries: (B, 3, H, W) normalised pixels
-> (B, D). Of a tuple the first member counts: BoQ adds its attention maps.
"""

from __future__ import annotations

import hashlib
from typing import Any

import torch
from torch.nn.functional import normalize

from shared.recipes import MAX_WIDTH
from shared.torchhub_names import TorchHubEntry
from shared.vision.backbones.base import normalise_features, normalise_pixels
from shared.vision.download import OnProgress
from shared.vision.torchhub_code import (
    code_fingerprint,
    find_licence,
    find_or_download_code,
    ignore_progress,
    load_module,
    torchhub_unfit_error,
)

PROBE_SEED = 20_242
MIN_REPEAT_COSINE = 0.999  # of a photo described alone and beside others; kernels differ a little


class TorchHubBackbone:
    facet: str | None = None

    def __init__(
        self, hub: TorchHubEntry, device: torch.device, *, on_progress: OnProgress = ignore_progress
    ) -> None:
        """Load the entry, which executes its code, and let it describe two pictures of noise.

        Misconfigured: `weights_missing`, `torchhub_unfit`, `download_corrupt`.
        """
        self._hub = hub
        folder = find_or_download_code(hub, on_progress)
        # Before anything is executed: the code may change what lies beside it.
        self.code_fingerprint = code_fingerprint(folder)
        self.name = hub.module
        self.layer = hub.entry
        self.licence = find_licence(folder)
        self.device = device
        module = load_module(hub, folder, on_progress)
        self._module = module.eval().requires_grad_(False).to(device)
        self.fingerprint, size_bytes = module_fingerprint(self._module)
        self.card: dict[str, Any] = {
            "source": hub.source,
            "entry": hub.entry,
            "arguments": dict(hub.arguments),
            "size_bytes": size_bytes,
        }
        self.width = self._probe()

    @torch.inference_mode()
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        return normalise_features(self._forward(pixels)).unsqueeze(1)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return 1, 1

    def _forward(self, pixels: torch.Tensor) -> Any:
        batch = normalise_pixels(pixels.to(self.device), self._hub.mean, self._hub.std)
        out = self._module(batch)
        return out[0] if isinstance(out, tuple | list) and out else out

    @torch.inference_mode()
    def _probe(self) -> int:
        """The length of a descriptor, found by describing; `torchhub_unfit` for what is none."""
        hub = self._hub
        noise = torch.Generator().manual_seed(PROBE_SEED)
        shape = (2, hub.height, hub.width, 3)
        photos = torch.randint(0, 256, shape, dtype=torch.uint8, generator=noise)
        try:
            both, alone = self._forward(photos), self._forward(photos[:1])
        except Exception as error:  # whatever the network of others does
            said = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise torchhub_unfit_error(
                hub,
                f"with 2 photos of {hub.height} x {hub.width} pixels it ends with "
                f"{type(error).__name__}: {said}",
            ) from error
        if not isinstance(both, torch.Tensor) or not both.is_floating_point():
            raise torchhub_unfit_error(
                hub, f"it makes a {_value_kind(both)}, not a tensor of floats"
            )
        if both.ndim != 2 or len(both) != 2 or alone.shape != (1, both.shape[1]):
            raise torchhub_unfit_error(
                hub,
                f"of 2 photos it makes numbers of the shape {tuple(both.shape)}, of one "
                f"{tuple(alone.shape)}; one descriptor for each is expected: (2, D) and (1, D)",
            )
        if both.shape[1] > MAX_WIDTH:
            raise torchhub_unfit_error(hub, f"{both.shape[1]} dimensions are more than {MAX_WIDTH}")
        if not torch.isfinite(both).all() or not torch.isfinite(alone).all():
            raise torchhub_unfit_error(hub, "its descriptors hold NaN or infinite numbers")
        if bool((both.norm(dim=-1) == 0).any()):
            raise torchhub_unfit_error(hub, "its descriptors are zero")
        cosine = float(normalize(both[:1].float(), dim=-1) @ normalize(alone[0].float(), dim=-1))
        if cosine < MIN_REPEAT_COSINE:
            raise torchhub_unfit_error(
                hub,
                "it describes a photo otherwise when another one is beside it (cosine "
                f"{cosine:.3f}), and which ones are described together is chance here",
            )
        return int(both.shape[1])


def module_fingerprint(module: torch.nn.Module) -> tuple[str, int]:
    """sha256 of the module's tensors, name-sorted with type and shape, and their size in bytes."""
    digest, size_bytes = hashlib.sha256(), 0
    state: dict[str, Any] = module.state_dict()
    for name in sorted(state):
        tensor = state[name]
        if not isinstance(tensor, torch.Tensor):
            continue  # what a module keeps beside its weights
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        flat = tensor.detach().cpu().contiguous().reshape(-1)
        digest.update(flat.view(torch.uint8).numpy().data)
        size_bytes += tensor.nbytes
    return digest.hexdigest(), size_bytes


def _value_kind(value: object) -> str:
    return f"tensor of {value.dtype}" if isinstance(value, torch.Tensor) else type(value).__name__
