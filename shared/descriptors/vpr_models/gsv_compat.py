"""Compatibility with gsv_xs checkpoints (research training code, PyTorch Lightning 1.8).

    hyper_parameters   backbone_arch, layers_to_crop, agg_arch, agg_config, lr, ... in one mapping
    state_dict         backbone.model.conv1 ..., aggregator.p ...

Names are translated to those of `VprModel`. The checkpoints do not store the image size: all
published runs were trained at 320 x 320; for MixVPR the size follows from its map.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from shared.descriptors.vpr_models.config import NO_FREEZING, VprModelConfig

GSV_IMAGE_SIZE = (320, 320)  # pixels
GSV_MODEL_ARGUMENTS = (
    "backbone_arch",
    "pretrained",
    "layers_to_freeze",
    "layers_to_crop",
    "agg_arch",
    "agg_config",
)

_RENAMED = (
    (r"backbone\.model\.conv1\.", "backbone.stem.0."),
    (r"backbone\.model\.bn1\.", "backbone.stem.1."),
    (r"aggregator\.p$", "aggregator.pool.p"),  # GeM
    (r"aggregator\.gem\.p$", "aggregator.pool.p"),  # CosPlace
    (r"aggregator\.fc\.", "aggregator.linear."),
    (r"aggregator\.channel_pool\.", "aggregator.channels."),  # ConvAP
    (r"aggregator\.channel_proj\.", "aggregator.channels."),  # MixVPR
    (r"aggregator\.row_proj\.", "aggregator.rows."),
    (r"aggregator\.mix\.(\d+)\.mix\.0\.", r"aggregator.mixers.\1.norm."),
    (r"aggregator\.mix\.(\d+)\.mix\.1\.", r"aggregator.mixers.\1.widen."),
    (r"aggregator\.mix\.(\d+)\.mix\.3\.", r"aggregator.mixers.\1.narrow."),
)


def is_gsv_checkpoint(parameters: Mapping[str, Any]) -> bool:
    """Whether these hyperparameters are those of a gsv_xs checkpoint."""
    return {"backbone_arch", "agg_arch"} <= parameters.keys()


def read_gsv_config(parameters: Mapping[str, Any]) -> VprModelConfig:
    """Translate the hyperparameters of a gsv_xs checkpoint.

    `layers_to_freeze` is ignored: it froze nothing in gsv_xs. Raises as `VprModelConfig.parse`.
    """
    values = {name: parameters[name] for name in GSV_MODEL_ARGUMENTS if name in parameters}
    config = VprModelConfig.parse({**values, "pretrained": False, "layers_to_freeze": NO_FREEZING})
    sides = [config.agg_config.get(name) for name in ("in_h", "in_w")]
    if config.agg_arch != "MixVPR" or not all(isinstance(side, int) for side in sides):
        return config.model_copy(update={"image_size": GSV_IMAGE_SIZE})
    stride = 2 ** (config.stages + 1)  # of a ResNet, the only backbones of gsv_xs
    size = [side * stride for side in sides if side is not None]
    return VprModelConfig.parse({**config.model_dump(), "image_size": size})


def rename_gsv_tensor(tensor: str) -> str:
    """Return a gsv_xs tensor's name in `VprModel.state_dict()`; unchanged if there is none."""
    for pattern, replacement in _RENAMED:
        renamed, hits = re.subn(f"^{pattern}", replacement, tensor)
        if hits:
            return renamed
    stage = re.match(r"backbone\.model\.layer(\d)\.(.*)", tensor)
    return f"backbone.stages.{int(stage[1]) - 1}.{stage[2]}" if stage else tensor
