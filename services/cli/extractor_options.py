"""Command-line options that select an extractor, by name or by its components."""

from __future__ import annotations

from typing import Annotated

import typer

from shared.errors import InvalidRequest
from shared.extractor_config.configs import (
    EXTRACTOR_AGGREGATORS,
    EXTRACTOR_CONFIGS,
    FACETS,
    PREPROCESSING_NAMES,
    add_extractor_options,
)

# Keyed by the publisher's names, such as `dinov2_vits14`.
BACKBONES = {
    config.backbone.replace("dinov2-", "dinov2_"): name
    for name, config in EXTRACTOR_CONFIGS.items()
    if not config.for_tests
}

PreprocessingOption = Annotated[
    str | None,
    typer.Option(
        "--preprocessing",
        help=f"Resizing and cropping: {', '.join(PREPROCESSING_NAMES)}. "
        "Default: the extractor's own.",
    ),
]
BackboneOption = Annotated[
    str | None,
    typer.Option("--backbone", help=f"Backbone, instead of --extractor: {', '.join(BACKBONES)}."),
]
LayerOption = Annotated[
    int | None, typer.Option("--layer", help="Transformer block, counted from 0.")
]
FacetOption = Annotated[
    str | None,
    typer.Option("--facet", help=f"Facet of the transformer layer: {', '.join(FACETS)}."),
]
AggregatorOption = Annotated[
    str | None,
    typer.Option(
        "--aggregator",
        help=f"Aggregation of local features: {', '.join(EXTRACTOR_AGGREGATORS)}.",
    ),
]
TemperatureOption = Annotated[
    float | None,
    typer.Option("--temperature", help="Softmax temperature of soft-vlad. Default: 1."),
]


def extractor_name(
    extractor: str | None, backbone: str | None, **options: str | int | float | None
) -> str:
    """Build the full extractor name from `--extractor` or `--backbone` and further options.

    Args:
        extractor: An extractor's name.
        backbone: A key of `BACKBONES`, instead of `extractor`.
        options: Extractor options by name; None means that the option was not given.

    Raises:
        InvalidRequest: `unknown_backbone`; `two_extractors` if both are given; `no_extractor` if
            options are given with neither.
    """
    if extractor is None and backbone is None:
        named = ", ".join(f"--{option}" for option, value in options.items() if value is not None)
        raise InvalidRequest("no_extractor", f"{named} requires --extractor. Add --extractor NAME.")
    if extractor is not None and backbone is not None:
        raise InvalidRequest(
            "two_extractors", "--extractor and --backbone exclude each other. Use one of them."
        )
    if backbone is not None and backbone not in BACKBONES:
        raise InvalidRequest(
            "unknown_backbone",
            f"Unknown backbone {backbone!r}. Available: {', '.join(BACKBONES)}.",
        )
    return add_extractor_options(extractor or BACKBONES[str(backbone)], options)
