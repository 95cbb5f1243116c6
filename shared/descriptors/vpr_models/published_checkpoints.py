"""Reads checkpoints of other training code under the names of `VprModel`.

    code                           names of its tensors
    gsv_xs, gsv-cities, MixVPR     backbone.model.layer1
    CosPlace, EigenPlaces          backbone.4, aggregation.3; VGG-16: backbone.28,
                                   EfficientNet: backbone.8.0 or backbone.0.8.0
    BoQ                            backbone.net.4 or backbone.dino.blocks.0
    SALAD, MegaLoc                 backbone.model.blocks.0, aggregator.agg
    OpenVPRLab                     backbone.frozen_layers.1 or backbone.dino.blocks.0

gsv_xs and OpenVPRLab write checkpoints of PyTorch Lightning with `hyper_parameters`; the others
publish the tensors alone.

Code that trains on several GPUs, compiles or wraps the network puts `module.`, `_orig_mod.` or the
name of an attribute before these names.

Files of tensors do not describe their network. It is inferred from the tensors' names and shapes;
the size of photos is that of the published results, and Conv-AP has 2 x 2 cells. BoQ and
OpenVPRLab resize photos with bicubic interpolation, the others with bilinear.
"""

from __future__ import annotations

import bisect
import math
import re
from collections.abc import Mapping
from typing import Any

import torch

from shared.descriptors.backbones.dinov2 import SHAPES
from shared.descriptors.vpr_models.config import NO_FREEZING, STAGES, VGG16_POOLINGS, VprModelConfig

GSV_IMAGE_SIZE = (320, 320)  # pixels, of all published runs
GSV_MODEL_ARGUMENTS = (
    "backbone_arch",
    "pretrained",
    "layers_to_freeze",
    "layers_to_crop",
    "agg_arch",
    "agg_config",
)

Tensors = dict[str, torch.Tensor]
Replacements = tuple[tuple[str, str], ...]

_BACKBONE_STAGES = (
    (r"backbone\.model\.layer([1-4])\.", 1),
    (r"backbone\.(?:net\.)?([4-7])\.", 4),
    (r"backbone\.layers\.([1-4])\.", 1),
)
"""Patterns of a ResNet's stages, and the number of the first one"""
_RENAMED: Replacements = (
    (r"backbone\.model\.conv1\.", "backbone.stem.0."),
    (r"backbone\.model\.bn1\.", "backbone.stem.1."),
    (r"backbone\.(?:net\.|layers\.0\.)?([01])\.", r"backbone.stem.\1."),
    (r"backbone\.(?:model|dino)\.patch_embed\.proj\.", "backbone.stem.projection."),
    (r"backbone\.(?:model|dino)\.cls_token$", "backbone.stem.cls_token"),
    (r"backbone\.(?:model|dino)\.pos_embed$", "backbone.stem.positions"),
    (r"backbone\.(?:model|dino)\.blocks\.", "backbone.stages."),
    (r"backbone\.model\.norm\.", "backbone.norm."),
    (r"aggregator\.agg\.", "aggregator."),
    (r"aggregation\.1\.p$", "aggregator.gem.p"),
    (r"aggregation\.3\.", "aggregator.fc."),
)
_UNUSED = re.compile(r"backbone\.(?:(?:model|dino)\.mask_token|dino\.norm\..*)$")
_AGGREGATORS: dict[str, tuple[str, Replacements]] = {
    "SALAD": (
        "dust_bin",
        (
            (r"token_features\.", "token."),
            (r"cluster_features\.", "features."),
            (r"score\.", "scores."),
            (r"dust_bin$", "dustbin"),
            (r"linear\.", "projection."),
        ),
    ),
    "BoQ": (
        "proj_c.weight",
        (
            (r"proj_c\.", "project."),
            (r"norm_input\.", "norm."),
            (r"boqs\.(\d+)\.self_attn\.", r"blocks.\1.among_queries."),
            (r"boqs\.(\d+)\.norm_q\.", r"blocks.\1.norm_queries."),
            (r"boqs\.(\d+)\.cross_attn\.", r"blocks.\1.to_positions."),
            (r"boqs\.", "blocks."),
            (r"fc\.", "rows."),
        ),
    ),
    "MixVPR": (
        "row_proj.weight",
        (
            (r"channel_proj\.", "channels."),
            (r"row_proj\.", "rows."),
            (r"mix\.(\d+)\.mix\.0\.", r"mixers.\1.norm."),
            (r"mix\.(\d+)\.mix\.1\.", r"mixers.\1.widen."),
            (r"mix\.(\d+)\.mix\.3\.", r"mixers.\1.narrow."),
        ),
    ),
    "ConvAP": ("channel_pool.weight", ((r"channel_pool\.", "channels."),)),
    "CosPlace": ("gem.p", ((r"gem\.p$", "pool.p"), (r"fc\.", "linear."))),
    "GeM": ("p", ((r"p$", "pool.p"),)),
    "AVG": ("", ()),
}
"""The tensor by which each aggregator is recognised, and its tensors' names here"""

_RESNETS = {
    "resnet18": ((64, 64, 3, 3), (2, 2, 2, 2)),
    "resnet34": ((64, 64, 3, 3), (3, 4, 6, 3)),
    "resnet50": ((64, 64, 1, 1), (3, 4, 6, 3)),
    "resnet101": ((64, 64, 1, 1), (3, 4, 23, 3)),
    "resnet152": ((64, 64, 1, 1), (3, 8, 36, 3)),
    "resnext50_32x4d": ((128, 64, 1, 1), (3, 4, 6, 3)),
}
"""Shape of the first convolution of the first stage, and the number of blocks of each stage"""
_EFFICIENTNETS = {
    1280: "efficientnet_b0",
    1408: "efficientnet_b2",
    1536: "efficientnet_b3",
    1792: "efficientnet_b4",
    2048: "efficientnet_b5",
    2304: "efficientnet_b6",
    2560: "efficientnet_b7",
}
"""By the channels of their last convolution; B1 has those of B0, and more blocks"""


def read_published_checkpoint(
    parameters: Mapping[str, Any], tensors: Mapping[str, Any]
) -> tuple[VprModelConfig, Tensors]:
    """Return the configuration of a published checkpoint and its tensors, by our names.

    Tensors that do not belong to the network, such as those of a loss, are left out.

    Args:
        parameters: The file's `hyper_parameters`; empty for a file of tensors.
        tensors: The file's tensors, by its own names.

    Raises:
        ValueError: The network is unknown; the message is a reason.
        Unprocessable: As `VprModelConfig.parse`.
    """
    try:
        tensors = _without_wrappers(tensors)
        aggregator, renamed = _rename(tensors)
        if {"backbone_arch", "agg_arch"} <= parameters.keys():
            return _read_gsv_config(parameters), renamed
        return _infer_config(aggregator, parameters, tensors, renamed), renamed
    except (KeyError, IndexError, AttributeError, TypeError, StopIteration) as error:
        first = ", ".join(f"{name!s:.60}" for name in list(tensors)[:3])
        raise ValueError(
            f"its tensors are not those of a known network (the first are {first})"
        ) from error


def _without_wrappers(tensors: Mapping[str, Any]) -> dict[str, Any]:
    """Remove what DataParallel, torch.compile and wrapping modules put before the names."""
    names = {name: re.sub(r"(?<![^.])(?:module|_orig_mod)\.", "", name) for name in tensors}
    inner = [re.match(r"(.*?)backbone\.", name) for name in names.values()]
    before = min((match[1] for match in inner if match), key=len, default="")
    return {names[name].removeprefix(before): tensor for name, tensor in tensors.items()}


def _rename(tensors: Mapping[str, Any]) -> tuple[str, Tensors]:
    """Return the aggregator's name and the network's tensors by our names."""
    # OpenVPRLab splits a ResNet's layers in two lists, which both begin with 0.
    frozen = {name.split(".")[2] for name in tensors if name.startswith("backbone.frozen_layers.")}
    ours: Tensors = {}
    for name, tensor in tensors.items():
        if _UNUSED.match(name):
            continue
        name = name.replace("backbone.frozen_layers.", "backbone.layers.")
        name = re.sub(
            r"^backbone\.unfrozen_layers\.(\d+)",
            lambda match: f"backbone.layers.{int(match[1]) + len(frozen)}",
            name,
        )
        name = _rename_layer(name, tensors)
        for pattern, first in _BACKBONE_STAGES:
            if stage := re.match(pattern, name):
                name = f"backbone.stages.{int(stage[1]) - first}.{name[stage.end() :]}"
        ours[_replace(name, _RENAMED)] = tensor
    prefix = "aggregator."
    aggregator, (_, replacements) = next(
        (arch, known)
        for arch, known in _AGGREGATORS.items()
        if not known[0] or prefix + known[0] in ours
    )
    return aggregator, {
        prefix + _replace(name.removeprefix(prefix), replacements)
        if name.startswith(prefix)
        else name: tensor
        for name, tensor in ours.items()
        if name.startswith((prefix, "backbone."))
    }


def _rename_layer(name: str, tensors: Mapping[str, Any]) -> str:
    """Return our name of a tensor of VGG-16 or an EfficientNet, whose layers are one sequence."""
    if "backbone.28.weight" in tensors:  # the last convolution of VGG-16
        before, is_vgg = "backbone.", True
    else:
        before, is_vgg = ("backbone.", "backbone.0.")["backbone.0.8.0.weight" in tensors], False
        if f"{before}8.0.weight" not in tensors:
            return name
    number, _, rest = name.removeprefix(before).partition(".")
    if not name.startswith(before) or not number.isdigit():
        return name
    stage = bisect.bisect(VGG16_POOLINGS, int(number)) if is_vgg else int(number)
    part = f"stages.{stage - 1}" if stage else "stem"
    return f"backbone.{part}.{number + '.' if is_vgg else ''}{rest}"


def _replace(name: str, replacements: Replacements) -> str:
    """Replace the beginning of a name by the first pattern that matches."""
    for pattern, replacement in replacements:
        renamed, hits = re.subn(f"^{pattern}", replacement, name)
        if hits:
            return renamed
    return name


def _read_gsv_config(parameters: Mapping[str, Any]) -> VprModelConfig:
    """Translate the hyperparameters of gsv_xs; `layers_to_freeze` froze nothing there."""
    values = {name: parameters[name] for name in GSV_MODEL_ARGUMENTS if name in parameters}
    config = VprModelConfig.parse({**values, "pretrained": False, "layers_to_freeze": NO_FREEZING})
    sides = [config.agg_config.get(name) for name in ("in_h", "in_w")]
    if config.agg_arch != "MixVPR" or not all(isinstance(side, int) for side in sides):
        return config.model_copy(update={"image_size": GSV_IMAGE_SIZE})
    stride = 2 ** (config.stages + 1)  # of a ResNet, the only backbones of gsv_xs
    size = [side * stride for side in sides if side is not None]
    return VprModelConfig.parse({**config.model_dump(), "image_size": size})


def _infer_config(
    aggregator: str, parameters: Mapping[str, Any], published: Mapping[str, Any], ours: Tensors
) -> VprModelConfig:
    backbone, stages = _infer_backbone(ours)
    arguments = _infer_arguments(aggregator, ours)
    side = 320
    if backbone.startswith("dinov2"):
        side = 322
    elif "backbone.net.0.weight" in published:
        side = 384
    elif "aggregation.1.p" in published:
        side = 512
    elif aggregator == "MixVPR":  # the map was square, at the stride of the last stage
        side = math.isqrt(ours["aggregator.rows.weight"].shape[1]) * 2 ** (stages + 1)
    size = [side, side]
    if parameters:  # of OpenVPRLab
        photos = parameters["datamodule"]
        size = photos.get("val_image_size") or photos["train_image_size"]
        given = parameters["aggregator"]["params"]
        arguments |= {name: given[name] for name in ("s1", "s2") if name in given}
    return VprModelConfig.parse(
        {
            "backbone_arch": backbone,
            "pretrained": False,
            "layers_to_freeze": NO_FREEZING,
            "layers_to_crop": [stages + 1] if stages < STAGES[backbone] else [],
            "backbone_norm": not backbone.startswith("dinov2") or "backbone.norm.weight" in ours,
            "agg_arch": aggregator,
            "agg_config": arguments,
            "image_size": size,
            "interpolation": "bicubic" if parameters or aggregator == "BoQ" else "bilinear",
        }
    )


def _infer_backbone(ours: Tensors) -> tuple[str, int]:
    """Return the name of the backbone and its number of stages."""
    if "backbone.stem.cls_token" in ours:
        width = ours["backbone.stem.cls_token"].shape[-1]
        return next(
            (f"dinov2_{size}", shape.depth)
            for size, shape in SHAPES.items()
            if shape.width == width
        )
    if "backbone.stages.3.28.weight" in ours:
        return "vgg16", STAGES["vgg16"]
    if "backbone.stages.7.0.weight" in ours:
        name = _EFFICIENTNETS[len(ours["backbone.stages.7.0.weight"])]
        if name == "efficientnet_b0" and "backbone.stages.0.1.block.0.0.weight" in ours:
            name = "efficientnet_b1"
        return name, STAGES[name]
    found = [re.match(r"backbone\.stages\.(\d+)\.(\d+)\.", name) for name in ours]
    last_blocks: dict[int, int] = {}
    for match in filter(None, found):
        stage, block = int(match[1]), int(match[2])
        last_blocks[stage] = max(block, last_blocks.get(stage, 0))
    counts = tuple(last_blocks[stage] + 1 for stage in sorted(last_blocks))
    first = tuple(ours["backbone.stages.0.0.conv1.weight"].shape)
    name = next(
        name
        for name, (shape, blocks) in _RESNETS.items()
        if shape == first and blocks[: len(counts)] == counts
    )
    return name, len(counts)


def _infer_arguments(aggregator: str, ours: Tensors) -> dict[str, Any]:
    """Return the arguments of the aggregator that decide the shapes of its tensors."""

    def size(name: str, axis: int = 0) -> int:
        return ours[f"aggregator.{name}"].shape[axis]

    match aggregator:
        case "SALAD":
            return {
                "num_clusters": size("scores.3.weight"),
                "cluster_dim": size("features.3.weight"),
                "token_dim": size("token.2.weight"),
                "published_order": True,
                "out_dim": size("projection.weight")
                if "aggregator.projection.weight" in ours
                else None,
            }
        case "BoQ":
            queries = size("blocks.0.queries", 1)
            return {
                "proj_channels": size("project.weight"),
                "num_queries": queries,
                "num_layers": size("rows.weight", 1) // queries,
                "row_dim": size("rows.weight"),
            }
        case "MixVPR":
            positions = size("rows.weight", 1)
            return {
                "out_channels": size("channels.weight"),
                "out_rows": size("rows.weight"),
                "mix_depth": sum(name.endswith(".widen.weight") for name in ours),
                "mlp_ratio": size("mixers.0.widen.weight") / positions,
            }
        case "ConvAP":
            return {"out_channels": size("channels.weight")}
        case "CosPlace":
            return {"out_dim": size("linear.weight")}
        case _:
            return {}
