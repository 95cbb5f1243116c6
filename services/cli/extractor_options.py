"""Choosing an extractor on the command line: by its name, or by its parts."""

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

# `dinov2_vits14`, as its publisher writes it.
BACKBONES = {
    recipe.backbone.replace("dinov2-", "dinov2_"): name
    for name, recipe in EXTRACTOR_CONFIGS.items()
    if not recipe.for_tests
}

PreprocessingOption = Annotated[
    str | None,
    typer.Option(
        "--preprocessing",
        help=f"How photos are brought to size: {', '.join(PREPROCESSING_NAMES)}; left out: the "
        "extractor's own.",
    ),
]
BackboneOption = Annotated[
    str | None,
    typer.Option("--backbone", help=f"Instead of --extractor: {', '.join(BACKBONES)}."),
]
LayerOption = Annotated[int | None, typer.Option("--layer", help="Block of a transformer, from 0.")]
FacetOption = Annotated[
    str | None, typer.Option("--facet", help=f"What is taken of it: {', '.join(FACETS)}.")
]
AggregatorOption = Annotated[
    str | None,
    typer.Option(
        "--aggregator",
        help=f"What makes one descriptor of them: {', '.join(EXTRACTOR_AGGREGATORS)}.",
    ),
]
TemperatureOption = Annotated[
    float | None, typer.Option("--temperature", help="Of soft-vlad: how hard; left out: 1.")
]


def extractor_name(
    extractor: str | None, backbone: str | None, **options: str | int | float | None
) -> str:
    """The name of the extractor that has one or the other, with the options that are not None.

    InvalidRequest: `unknown_backbone`, `two_extractors`, `no_extractor` (options, but of what?).
    """
    if extractor is None and backbone is None:
        named = ", ".join(f"--{option}" for option, value in options.items() if value is not None)
        raise InvalidRequest("no_extractor", f"{named}: say of which --extractor, too.")
    if extractor is not None and backbone is not None:
        raise InvalidRequest(
            "two_extractors", "--extractor and --backbone say the same thing: give one of them."
        )
    if backbone is not None and backbone not in BACKBONES:
        raise InvalidRequest(
            "unknown_backbone",
            f"There is no backbone {backbone!r}. Known: {', '.join(BACKBONES)}.",
        )
    return add_extractor_options(extractor or BACKBONES[str(backbone)], options)
