"""Which network: everything that decides a place model but its weights. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from shared.errors import Unprocessable

STAGES = {
    "resnet18": 4,
    "resnet34": 4,
    "resnet50": 4,
    "resnet101": 4,
    "resnext50_32x4d": 4,
    "efficientnet_b0": 8,
    "efficientnet_lite0": 8,
    "swin_t": 4,
    "dinov2_vits14": 12,
    "dinov2_vitb14": 12,
    "dinov2_vitl14": 24,
    "dinov2_vitg14": 40,
}
"""Backbones, with the number of their stages after the stem: layer1 to layer4 of a ResNet, the
blocks of a transformer. The 8th of an EfficientNet is the convolution before its classifier."""

ALIASES = {
    "resnext50": "resnext50_32x4d",
    "tf_efficientnet_lite0": "efficientnet_lite0",
    "swin": "swin_t",
    "swin_tiny": "swin_t",
    **{f"dinov2_{size}": f"dinov2_vit{size}14" for size in "sblg"},
}

VPR_AGGREGATORS = {
    "cosplace": "CosPlace",
    "avg": "AVG",
    "gem": "GeM",
    "convap": "ConvAP",
    "mixvpr": "MixVPR",
    "netvlad": "NetVLAD",
    "salad": "SALAD",
    "boq": "BoQ",
}
"""By the part of a name, in small letters, that means them."""

NO_FREEZING = -1
MIN_STAGE_TO_CROP = 2  # a stem without any stage sees a few pixels
MAX_SIDE_PIXELS = 4096

SidePixels = Annotated[int, Field(ge=16, le=MAX_SIDE_PIXELS)]


class VprModelConfig(BaseModel):
    """A place model in words; `model_dump()` is of plain types.

    Names are brought to their canonical form: backbones by any name of STAGES or ALIASES, in
    capitals or not, `-` for `_`; aggregators by any name that contains a key of AGGREGATORS.

    Raises Unprocessable: `unknown_backbone`, `unknown_aggregator` (both list the known ones),
    `bad_model_config`. What has another type is pydantic's ValidationError; `read` makes that
    `bad_model_config`, too.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    backbone_arch: str = "resnet18"
    pretrained: bool = True
    """Begin with the published ImageNet (DINOv2: LVD-142M) weights."""
    layers_to_freeze: int = 2
    """-1 trains everything; 0 freezes the stem; n the stem and the first n stages. Frozen layers
    keep their weights and the statistics of their BatchNorms, in training as well."""
    layers_to_crop: tuple[int, ...] = ()
    """Numbers of stages, from 1: the lowest of them and all after it are left out."""
    agg_arch: str = "AVG"
    agg_config: dict[str, Any] = {}
    """Arguments of the aggregator; what is left out has the published default, and sizes of the
    map are found by the first pass."""
    image_size: tuple[SidePixels, SidePixels] = (320, 320)
    """Height and width in pixels."""

    @classmethod
    def parse(cls, values: Mapping[str, Any]) -> VprModelConfig:
        """From a mapping of anything; Unprocessable as above."""
        try:
            return cls.model_validate(dict(values))
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise _bad(f"{where}: {first['msg']}") from error

    @property
    def stages(self) -> int:
        """How many stages are left after cropping."""
        return min((STAGES[self.backbone_arch] + 1, *self.layers_to_crop)) - 1

    @field_validator("backbone_arch")
    @classmethod
    def _canonical_backbone(cls, name: str) -> str:
        plain = name.strip().lower().replace("-", "_")
        plain = ALIASES.get(plain, plain)
        if plain not in STAGES:
            raise Unprocessable(
                "unknown_backbone",
                f"There is no backbone {name!r}. Known: {', '.join(STAGES)} (backbone_arch).",
            )
        return plain

    @field_validator("agg_arch")
    @classmethod
    def _canonical_aggregator(cls, name: str) -> str:
        for part, canonical in VPR_AGGREGATORS.items():
            if part in name.lower():
                return canonical
        raise Unprocessable(
            "unknown_aggregator",
            f"There is no aggregator {name!r}. Known: {', '.join(VPR_AGGREGATORS.values())} "
            "(agg_arch).",
        )

    @model_validator(mode="after")
    def _layers_exist(self) -> VprModelConfig:
        count = STAGES[self.backbone_arch]
        if not NO_FREEZING <= self.layers_to_freeze <= count:
            raise _bad(
                f"layers_to_freeze={self.layers_to_freeze}: {self.backbone_arch} has {count} "
                f"stages, so it is a number from {NO_FREEZING} (train everything) to {count}."
            )
        outside = [n for n in self.layers_to_crop if not MIN_STAGE_TO_CROP <= n <= count]
        if outside:
            raise _bad(
                f"layers_to_crop={list(self.layers_to_crop)}: {self.backbone_arch} has {count} "
                f"stages; those from {MIN_STAGE_TO_CROP} to {count} can be cropped."
            )
        return self


def _bad(detail: str) -> Unprocessable:
    return Unprocessable("bad_model_config", detail)
