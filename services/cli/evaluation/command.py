"""`placewise evaluate` of the service: on a live map. The lab's adds data sets and predictions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.environment import lab_missing
from services.cli.output import JsonOption, KeyOption, MapOption, ServerOption

SampleOption = Annotated[
    int | None,
    typer.Option(min=1, help="Live map: number of photos to query with. Default: 1000."),
]
SeedOption = Annotated[int | None, typer.Option(min=0, help="Live map: random seed.")]
WordWeightsOption = Annotated[
    bool,
    typer.Option(
        "--word-weights",
        help="Live map: first fit weights of visual words on the map's places, and keep them "
        "if recall improves.",
    ),
]


def evaluate(
    data: Annotated[Path | None, typer.Option(hidden=True)] = None,
    predictions: Annotated[Path | None, typer.Option(hidden=True)] = None,
    sample: SampleOption = None,
    seed: SeedOption = None,
    word_weights: WordWeightsOption = False,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure retrieval recall in a live map.

    Evaluates the map with its own photos (leave-one-out) and its labelled queries.
    """
    for option, value in (("--data", data), ("--predictions", predictions)):
        if value is not None:
            raise lab_missing(f"`evaluate {option}`")
    from services.cli.evaluation.live_map import evaluate_map

    evaluate_map(sample, seed, word_weights, map_name, server, key, as_json)
