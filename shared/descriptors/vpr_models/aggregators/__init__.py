"""Aggregators of VPR models: maps of local features to one descriptor. `base` has the interface."""

from __future__ import annotations

from shared.descriptors.vpr_models.aggregators.base import Aggregator
from shared.descriptors.vpr_models.aggregators.clustering import SALAD, NetVLAD
from shared.descriptors.vpr_models.aggregators.mixing import BoQ, MixVPR
from shared.descriptors.vpr_models.aggregators.pooling import AveragePooling, ConvAP, CosPlace, GeM

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
"""By canonical name. A configuration selects one by any name that contains it, in any case."""
