"""VprModelConfig: the architecture of a VPR model, validated."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from shared.descriptors.aggregators import AGGREGATORS
from shared.errors import Unprocessable

STAGES = {
    "resnet18": 4,
    "resnet34": 4,
    "resnet50": 4,
    "resnet101": 4,
    "resnet152": 4,
    "resnext50_32x4d": 4,
    "vgg16": 4,
    **{f"efficientnet_b{size}": 8 for size in range(8)},
    "efficientnet_lite0": 8,
    "swin_t": 4,
    "dinov2_vits14": 12,
    "dinov2_vitb14": 12,
    "dinov2_vitl14": 24,
    "dinov2_vitg14": 40,
}
"""Backbones and their number of stages after the stem: layer1 to layer4 of a ResNet, poolings of
VGG-16 with what follows them, the blocks of a transformer. The 8th stage of an EfficientNet is the
convolution before its classifier."""

VGG16_POOLINGS = (4, 9, 16, 23)
"""Numbers of the layers in torchvision's VGG-16 with which a stage begins"""

NORMED_BACKBONES = ("dinov2", "swin")

ALIASES = {
    "resnext50": "resnext50_32x4d",
    "tf_efficientnet_lite0": "efficientnet_lite0",
    "swin": "swin_t",
    "swin_tiny": "swin_t",
    **{f"dinov2_{size}": f"dinov2_vit{size}14" for size in "sblg"},
}

NO_FREEZING = -1
MIN_STAGE_TO_CROP = 2  # a stem alone has a receptive field of a few pixels
MAX_SIDE_PIXELS = 4096


def is_own_module(name: str) -> bool:
    """Whether a name is `package.module:Name`, code of the user instead of a network's name."""
    return ":" in name


SidePixels = Annotated[int, Field(ge=16, le=MAX_SIDE_PIXELS)]


class VprModelConfig(BaseModel):
    """The architecture of a VPR model; `model_dump()` returns plain types.

    Names are canonicalised: backbones by any name in STAGES or ALIASES, case-insensitive, with `-`
    for `_`; aggregators by the longest key of AGGREGATORS that the name contains.

    Raises:
        Unprocessable: `unknown_backbone`, `unknown_aggregator` (both list the valid names),
            `bad_model_config`.
        pydantic.ValidationError: A value of another type; `parse` converts it to
            `bad_model_config`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    backbone_arch: str = "resnet18"
    pretrained: bool = True
    """Initialise with the published ImageNet (DINOv2: LVD-142M) weights."""
    layers_to_freeze: int = 2
    """-1 trains everything; 0 freezes the stem; n freezes the stem and the first n stages. Frozen
    layers keep their weights and their BatchNorm statistics during training."""
    layers_to_crop: tuple[int, ...] = ()
    """Stage numbers, from 1: the lowest of them and all later stages are removed."""
    backbone_norm: Annotated[bool, Field(exclude_if=bool)] = True
    """Whether the final LayerNorm of DINOv2 and Swin is applied to the map. Left out of the stored
    configuration if true, so that fingerprints of models without this field remain."""
    agg_arch: str = "AVG"
    agg_config: dict[str, Any] = {}
    """Arguments of the aggregator. Missing ones have the published defaults; the sizes of the map
    are inferred by a first pass."""
    image_size: tuple[SidePixels, SidePixels] = (320, 320)
    """Height and width in pixels."""
    interpolation: Annotated[
        Literal["bilinear", "bicubic"], Field(exclude_if=lambda value: value == "bilinear")
    ] = "bilinear"
    """Resizing of photos to that size. Left out of the stored configuration if bilinear, as for
    `backbone_norm`."""

    @classmethod
    def parse(cls, values: Mapping[str, Any]) -> VprModelConfig:
        """Validate a mapping; raises Unprocessable as the class does."""
        try:
            return cls.model_validate(dict(values))
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(str(part) for part in first["loc"])
            raise _bad_config_error(f"{field}: {first['msg']}") from error

    @property
    def stages(self) -> int:
        """Number of stages after cropping."""
        return min((STAGES[self.backbone_arch] + 1, *self.layers_to_crop)) - 1

    @field_validator("backbone_arch")
    @classmethod
    def _canonical_backbone(cls, name: str) -> str:
        if is_own_module(name):
            return _registered(name, STAGES, "backbone_arch")
        canonical = name.strip().lower().replace("-", "_")
        canonical = ALIASES.get(canonical, canonical)
        if canonical not in STAGES:
            raise Unprocessable(
                "unknown_backbone",
                f"Unknown backbone {name!r} (backbone_arch). Valid names: {', '.join(STAGES)}.",
            )
        return canonical

    @field_validator("agg_arch")
    @classmethod
    def _canonical_aggregator(cls, name: str) -> str:
        if is_own_module(name):
            return _registered(name, AGGREGATORS, "agg_arch")
        for canonical in sorted(AGGREGATORS, key=len, reverse=True):
            if canonical.lower() in name.lower():
                return canonical
        raise Unprocessable(
            "unknown_aggregator",
            f"Unknown aggregator {name!r} (agg_arch). Valid names: {', '.join(AGGREGATORS)}.",
        )

    @model_validator(mode="after")
    def _check_layers(self) -> VprModelConfig:
        count = STAGES[self.backbone_arch]
        if not NO_FREEZING <= self.layers_to_freeze <= count:
            raise _bad_config_error(
                f"layers_to_freeze={self.layers_to_freeze}: {self.backbone_arch} has {count} "
                f"stages; set a number from {NO_FREEZING} (train everything) to {count}."
            )
        if not self.backbone_norm and not self.backbone_arch.startswith(NORMED_BACKBONES):
            raise _bad_config_error(
                f"backbone_norm=False: {self.backbone_arch} has no final norm; remove it."
            )
        outside = [n for n in self.layers_to_crop if not MIN_STAGE_TO_CROP <= n <= count]
        if outside:
            raise _bad_config_error(
                f"layers_to_crop={list(self.layers_to_crop)}: {self.backbone_arch} has {count} "
                f"stages; stages from {MIN_STAGE_TO_CROP} to {count} can be cropped."
            )
        return self


def _registered(name: str, known: Container[str], field: str) -> str:
    if name not in known:
        raise Unprocessable(
            "own_module_unknown",
            f"The network uses {name} ({field}), code of the user who trained it. Only `placewise "
            "train` imports such code, when its arguments name it. Elsewhere the network works as "
            "a torch.hub entry (docs/how-to/weights-and-other-engines.md).",
        )
    return name


def _bad_config_error(detail: str) -> Unprocessable:
    return Unprocessable("bad_model_config", detail)
