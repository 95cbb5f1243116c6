"""The VPR model: photos to global descriptors by a backbone and an aggregator."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_type_hints

import torch
from pydantic import ConfigDict, ValidationError, create_model
from torch import nn

from shared.descriptors.aggregators import AGGREGATORS
from shared.descriptors.aggregators.base import Aggregator, FeatureMapShape
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
        """Compute descriptors; raises Unprocessable (`image_size_unsupported`)."""
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
        Misconfigured: `weights_missing`, `weights_unusable`.
        Unprocessable: `bad_agg_config`, `image_size_unsupported`.
    """
    backbone = build_backbone(config, weights)
    _check_patches(backbone, *config.image_size, config)
    with torch.inference_mode():
        maps, _ = backbone(torch.zeros(1, 3, *config.image_size))
    shape = FeatureMapShape(*maps.shape[1:])
    aggregator, arguments = _build_aggregator(config, shape)
    _check_map(aggregator, config, maps, config.image_size)
    complete = config.model_copy(update={"agg_config": arguments})
    return VprModel(complete, backbone, aggregator).eval()


def _build_aggregator(
    config: VprModelConfig, shape: FeatureMapShape
) -> tuple[Aggregator, dict[str, Any]]:
    """Build the aggregator for maps of `shape`; return it with all of its arguments."""
    aggregator_class = AGGREGATORS[config.agg_arch]
    inferred = {name: getattr(shape, field) for name, field in aggregator_class.inferred.items()}
    for name, size in inferred.items():
        given = config.agg_config.get(name, size)
        if given != size:
            raise _bad_config_error(
                config,
                f"{name}={given}, but {config.backbone_arch} with layers_to_crop="
                f"{list(config.layers_to_crop)} has {shape.channels} channels of {shape.height} "
                f"x {shape.width} at image_size {list(config.image_size)}. Remove {name}.",
            )
    arguments = _validate_arguments(config, aggregator_class, {**config.agg_config, **inferred})
    aggregator = aggregator_class(**arguments)
    return aggregator, arguments


def _validate_arguments(
    config: VprModelConfig, aggregator_class: type[Aggregator], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Validate arguments against the signature of `aggregator_class` and add its defaults."""
    hints = get_type_hints(aggregator_class.__init__, include_extras=True)
    fields: dict[str, Any] = {
        name: (
            hints.get(name, Any),
            ... if parameter.default is parameter.empty else parameter.default,
        )
        for name, parameter in inspect.signature(aggregator_class).parameters.items()
    }
    arguments = create_model(
        "Arguments", __config__=ConfigDict(extra="forbid", strict=True), **fields
    )
    try:
        return arguments.model_validate(dict(given)).model_dump()
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise _bad_config_error(
                config, f"it has no argument {name}; it has {', '.join(fields)}"
            ) from error
        raise _bad_config_error(config, f"{name}={given.get(name)!r}: {first['msg']}") from error


def _bad_config_error(config: VprModelConfig, reason: str) -> Unprocessable:
    return Unprocessable("bad_agg_config", f"agg_config of {config.agg_arch}: {reason}")


def _check_patches(
    backbone: StagedBackbone, height: int, width: int, config: VprModelConfig
) -> None:
    side = backbone.patch
    if height % side or width % side:
        nearest = [max(1, round(length / side)) * side for length in (height, width)]
        raise Unprocessable(
            "image_size_unsupported",
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
            "image_size_unsupported",
            f"{config.agg_arch} can't take photos of {photo[0]} x {photo[1]} pixels: {reason}. "
            f"{advice}",
        )
