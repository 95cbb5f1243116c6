"""Aggregators by name: maps of local features to one descriptor. One module each."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, get_type_hints

from pydantic import ConfigDict, ValidationError, create_model

from shared.descriptors.vpr_models.aggregators.base import Aggregator, FeatureMapShape
from shared.descriptors.vpr_models.aggregators.clustering import SALAD, NetVLAD
from shared.descriptors.vpr_models.aggregators.mixing import BoQ, MixVPR
from shared.descriptors.vpr_models.aggregators.pooling import AveragePooling, ConvAP, CosPlace, GeM
from shared.descriptors.vpr_models.config import VprModelConfig
from shared.errors import Unprocessable

__all__ = ["Aggregator", "FeatureMapShape", "build_aggregator"]

_AGGREGATORS: dict[str, type[Aggregator]] = {
    "CosPlace": CosPlace,
    "AVG": AveragePooling,
    "GeM": GeM,
    "ConvAP": ConvAP,
    "MixVPR": MixVPR,
    "NetVLAD": NetVLAD,
    "SALAD": SALAD,
    "BoQ": BoQ,
}


def build_aggregator(
    config: VprModelConfig, shape: FeatureMapShape
) -> tuple[Aggregator, dict[str, Any]]:
    """The aggregator for maps of `shape`, and all of its arguments.

    Raises Unprocessable: `bad_agg_config` (an argument that it does not have, of a wrong type, or
    another size than the map's), `image_size_unfit`.
    """
    kind = _AGGREGATORS[config.agg_arch]
    found = {name: getattr(shape, field) for name, field in kind.inferred.items()}
    for name, size in found.items():
        given = config.agg_config.get(name, size)
        if given != size:
            raise _bad(
                config,
                f"{name}={given}, but {config.backbone_arch} with layers_to_crop="
                f"{list(config.layers_to_crop)} makes {shape.channels} channels of {shape.height} "
                f"x {shape.width} at image_size {list(config.image_size)}. Leave {name} out.",
            )
    arguments = _checked(config, kind, {**config.agg_config, **found})
    aggregator = kind(**arguments)
    return aggregator, arguments


def _checked(
    config: VprModelConfig, kind: type[Aggregator], given: Mapping[str, Any]
) -> dict[str, Any]:
    """All arguments of `kind`, with its defaults; of the types that its signature says."""
    hints = get_type_hints(kind.__init__, include_extras=True)
    fields: dict[str, Any] = {
        name: (hints[name], ... if parameter.default is parameter.empty else parameter.default)
        for name, parameter in inspect.signature(kind).parameters.items()
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
            raise _bad(config, f"it has no argument {name}; it has {', '.join(fields)}") from error
        raise _bad(config, f"{name}={given.get(name)!r}: {first['msg']}") from error


def _bad(config: VprModelConfig, reason: str) -> Unprocessable:
    return Unprocessable("bad_agg_config", f"agg_config of {config.agg_arch}: {reason}")
