"""The VPR model: photos to global descriptors by a backbone and an aggregator."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

from shared.descriptors.vpr_models.aggregators import Aggregator, FeatureMapShape, build_aggregator
from shared.descriptors.vpr_models.backbones import StagedBackbone, build_backbone
from shared.descriptors.vpr_models.config import VprModelConfig
from shared.errors import Unprocessable


class VprModel(nn.Module):
    """Computes (B, D) float32 unit descriptors of (B, 3, H, W) float32 photos.

    Photos are normalised by ImageNet's mean and standard deviation. An all-zero map gives a zero
    row; non-finite values propagate.
    """

    def __init__(
        self, config: VprModelConfig, backbone: StagedBackbone, aggregator: Aggregator
    ) -> None:
        super().__init__()
        self.config = config
        self.backbone = backbone
        self.aggregator = aggregator

    @property
    def dimension(self) -> int:
        """D, the number of dimensions of a descriptor."""
        return self.aggregator.dimension

    def forward(self, photos: torch.Tensor) -> torch.Tensor:
        """Compute descriptors; raises Unprocessable (`image_size_unfit`) for unsupported sizes."""
        height, width = photos.shape[-2:]
        _check_patches(self.backbone, height, width, self.config)
        maps, token = self.backbone(photos)
        _check_map(self.aggregator, self.config, maps, (height, width))
        rows: torch.Tensor = (
            self.aggregator(maps, token) if self.aggregator.takes_token else self.aggregator(maps)
        )
        return rows


def build_vpr_model(config: VprModelConfig, *, weights: Path | None = None) -> VprModel:
    """Build a model on the CPU, in evaluation mode.

    The model's own `config` holds all arguments of the aggregator, including the defaults and those
    inferred from the backbone's map.

    Args:
        config: The architecture. Without `config.pretrained` every tensor is random, by torch's
            seed.
        weights: A file of pretrained weights for the backbone; None for those of the hub's cache.
            Unused without `config.pretrained`.

    Raises:
        Misconfigured: `weights_missing`, `weights_unfit`.
        Unprocessable: `bad_agg_config`, `image_size_unfit`.
    """
    backbone = build_backbone(config, weights)
    _check_patches(backbone, *config.image_size, config)
    with torch.inference_mode():
        maps, token = backbone(torch.zeros(1, 3, *config.image_size))
    _, channels, height, width = maps.shape
    shape = FeatureMapShape(channels, height, width, has_token=token is not None)
    aggregator, arguments = build_aggregator(config, shape)
    _check_map(aggregator, config, maps, config.image_size)
    complete = config.model_copy(update={"agg_config": arguments})
    return VprModel(complete, backbone, aggregator).eval()


def _check_patches(
    backbone: StagedBackbone, height: int, width: int, config: VprModelConfig
) -> None:
    side = backbone.patch
    if height % side or width % side:
        nearest = [max(1, round(length / side)) * side for length in (height, width)]
        raise Unprocessable(
            "image_size_unfit",
            f"{config.backbone_arch} needs photos whose height and width are multiples of {side} "
            f"pixels, not {height} x {width}. The nearest size is {nearest[0]} x {nearest[1]}.",
        )


def _check_map(
    aggregator: Aggregator, config: VprModelConfig, maps: torch.Tensor, photo: tuple[int, int]
) -> None:
    reason = aggregator.refusal(*maps.shape[-2:])
    if reason is not None:
        built = config.image_size
        advice = (
            "Set a larger image_size, or crop layers (layers_to_crop)."
            if photo == built
            else f"The model was built for {built[0]} x {built[1]}: resize photos to that size, or "
            "train a model at this size."
        )
        raise Unprocessable(
            "image_size_unfit",
            f"{config.agg_arch} can't take photos of {photo[0]} x {photo[1]} pixels: {reason}. "
            f"{advice}",
        )
