"""DINOv2 (Oquab et al. 2023) as a map: the patch tokens after the last norm, and the class token.

A stage is a block: `layers_to_freeze` of the depth less n trains the last n. The network is that of
`shared.vision.backbones.dinov2`, with gradients.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import nn

from shared.vision.backbones.dinov2 import (
    PATCH,
    SHAPES,
    VitShape,
    build_empty_vit,
    load_vit_weights,
    resample_positions,
)
from shared.vision.backbones.dinov2_weights import find_or_download_weights, open_weights
from shared.vision.place_models.backbones.staged import FeatureMaps, StagedBackbone


class Dinov2Backbone(StagedBackbone):
    patch: ClassVar[int] = PATCH

    def forward(self, photos: torch.Tensor) -> FeatureMaps:
        rows, columns = photos.shape[-2] // PATCH, photos.shape[-1] // PATCH
        tokens = self._run(photos)
        maps = tokens[:, 1:].transpose(1, 2).reshape(len(tokens), -1, rows, columns)
        return FeatureMaps(maps, tokens[:, 0])


class VitTokens(nn.Module):
    """(B, 3, H, W) -> (B, 1 + patches, width): the class token, and patches row by row."""

    def __init__(self, vit: Any) -> None:
        super().__init__()
        self.projection: nn.Module = vit.patch_embed.proj
        self.cls_token: nn.Parameter = vit.cls_token
        self.positions: nn.Parameter = vit.pos_embed

    def forward(self, photos: torch.Tensor) -> torch.Tensor:
        maps: torch.Tensor = self.projection(photos)
        rows, columns = maps.shape[-2:]
        of_patches = resample_positions(self.positions[:, 1:], rows, columns)
        patches = maps.flatten(2).transpose(1, 2) + of_patches
        first = self.cls_token + self.positions[:, :1]
        return torch.cat([first.expand(len(photos), -1, -1), patches], dim=1)


def build_dinov2(
    name: str, pretrained: bool, weights: Path | None, *, shape: VitShape | None = None
) -> StagedBackbone:
    """`weights`: a file in Meta's or timm's naming, None for timm's on the hub. `shape` is that of
    `name` unless a test has a smaller one."""
    size = name.removeprefix("dinov2_")
    shape = shape or SHAPES[size]
    if pretrained:
        vit = build_empty_vit(shape, shape.depth - 1, "token", with_norm=True)
        load_vit_weights(
            vit,
            open_weights(find_or_download_weights(size, weights), size),
            shape,
            size,
            torch.device("cpu"),
        )
    else:
        vit = build_empty_vit(
            shape, shape.depth - 1, "token", with_norm=True, device=torch.get_default_device()
        )
    vit.requires_grad_(True)
    return Dinov2Backbone(VitTokens(vit), list(vit.blocks), vit.norm)
