"""Aggregators: patch features of a photo to one descriptor.

POOLINGS are those of pretrained backbones, AGGREGATORS those of the networks that `placewise train`
trains, with the interface in `base`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from shared.descriptors.aggregators.base import Aggregator
from shared.descriptors.aggregators.clustering import SALAD, NetVLAD, soft_vlad, vlad
from shared.descriptors.aggregators.mixing import BoQ, MixVPR
from shared.descriptors.aggregators.pooling import (
    AveragePooling,
    ConvAP,
    CosPlace,
    GeM,
    average_pooling,
    gem_pooling,
)

POOLINGS: dict[str, Callable[[torch.Tensor, torch.Tensor, float], torch.Tensor]] = {
    "vlad": lambda features, centres, _temperature: vlad(features, centres),
    "soft-vlad": soft_vlad,
    "gem": lambda features, _centres, _temperature: gem_pooling(features),
    "avg": lambda features, _centres, _temperature: average_pooling(features),
    "none": lambda features, _centres, _temperature: features[:, 0],
}
"""By `ExtractorConfig.aggregator`: (B, patches, D) features, (K, D) centres, which only VLAD reads,
and the temperature of soft VLAD -> (B, dimension) unit rows."""

AGGREGATORS: dict[str, type[Aggregator]] = {
    "CosPlace": CosPlace,
    "AVG": AveragePooling,
    "GeM": GeM,
    "ConvAP": ConvAP,
    "MixVPR": MixVPR,
    "NetVLAD": NetVLAD,
    "SALAD": SALAD,
    "BoQ": BoQ,
}
"""By canonical name. A configuration selects the longest that its name contains, in any case."""
