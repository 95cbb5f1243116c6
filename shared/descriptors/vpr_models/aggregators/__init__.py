"""Aggregators of VPR models: maps of local features to one descriptor.

`build_aggregator` builds one by its name. `base` has the interface.
"""

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
    """Build the aggregator for maps of `shape`; return it with all of its arguments.

    Raises:
        Unprocessable: `bad_agg_config` for an unknown argument, one of a wrong type, or a size that
            differs from the map's.
    """
    aggregator_class = _AGGREGATORS[config.agg_arch]
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
        name: (hints[name], ... if parameter.default is parameter.empty else parameter.default)
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
