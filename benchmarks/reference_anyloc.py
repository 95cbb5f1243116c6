"""AnyLoc as its authors publish it, written from the description in their paper and code: what
`bench extract` compares with.

One photo after the other, float32, the whole network although a hook takes the features in its
middle, and VLAD in a loop over the clusters with every residual in memory. On a CPU attention is
written out, as in Meta's code there; on a GPU it is fused, as with xFormers. Photos are decoded and
brought to size as ours, so that both make the same descriptor.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch.nn.functional import normalize

from benchmarks.networks import BenchmarkedExtractor
from shared.recipes import FACETS
from shared.vision.backbones.dinov2 import SHAPES, Dinov2
from shared.vision.precision import autocast
from shared.vision.preprocessing import get_preprocessing


class ReferenceAnyLoc:
    def __init__(self, measured: BenchmarkedExtractor, centres: NDArray[np.float32]) -> None:
        """(K, width) centres. The recipe is one of the `anyloc-` ones, with hard VLAD."""
        recipe, device = measured.recipe, measured.device
        assert recipe.layer is not None
        assert recipe.preprocessing is not None
        size = recipe.backbone.removeprefix("dinov2-")
        self._device = device
        self._preprocessing = get_preprocessing(recipe.preprocessing)
        self._centres = torch.from_numpy(centres).to(device)
        whole = SHAPES[size].depth - 1
        self._network = Dinov2(size, whole, "token", device, measured.dino_weights)
        self._third = None if recipe.facet == "token" else FACETS.index(recipe.facet or "value")
        blocks: Any = self._network._vit.blocks
        for block in blocks:
            block.attn.fused_attn = device.type == "cuda"
        hooked = blocks[recipe.layer]
        (hooked if self._third is None else hooked.attn.qkv).register_forward_hook(self._keep)
        self._kept = torch.empty(0)

    def describe(self, photos: Sequence[bytes]) -> NDArray[np.float32]:
        """JPEGs -> (n, K * width), rows of length 1."""
        return np.stack([self._describe(photo) for photo in photos])

    @torch.inference_mode()
    def _describe(self, photo: bytes) -> NDArray[np.float32]:
        with Image.open(io.BytesIO(photo)) as image:
            pixels = self._preprocessing.apply(image.convert("RGB"))
        with autocast("float32", self._device):
            self._network.features(torch.from_numpy(np.array(pixels))[None])
            found = self._kept[0, 1:]
            if self._third is not None:
                found = found.chunk(3, dim=-1)[self._third]
            row: NDArray[np.float32] = vlad_in_loops(normalize(found, dim=-1), self._centres)
        return row

    def _keep(self, _module: Any, _arguments: Any, output: torch.Tensor) -> None:
        self._kept = output


def vlad_in_loops(features: torch.Tensor, centres: torch.Tensor) -> NDArray[np.float32]:
    """(patches, width) unit features, (K, width) -> (K * width) of length 1."""
    labels = (features @ normalize(centres, dim=-1).T).argmax(dim=-1).cpu()
    residuals = features[:, None] - centres[None]  # (patches, K, width)
    blocks = torch.zeros_like(centres)
    for cluster in set(labels.tolist()):
        blocks[cluster] = normalize(residuals[labels == cluster, cluster].sum(dim=0), dim=0)
    row: NDArray[np.float32] = normalize(blocks.flatten(), dim=0).cpu().numpy()
    return row
