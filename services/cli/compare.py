"""`placewise compare --map`: which extractor is best for the photos of a map.

The command of the lab, which replaces this one, adds data sets.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from services.cli.environment import lab_missing
from services.cli.output import JsonOption, MapOption

DEFAULT_PHOTOS = 1000
ExtractorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--extractor",
        metavar="NAME",
        help="Map: another extractor, such as A+B or torchscript:/PATH. Can be repeated.",
    ),
]
PhotosOption = Annotated[
    int, typer.Option("--photos", min=20, help="Map: number of photos that are described.")
]
WeightsOption = Annotated[
    bool,
    typer.Option("--weights", help="Map: choose the weights of each A+B on the map's own photos."),
]


def compare(
    data: Annotated[Path | None, typer.Argument(hidden=True)] = None,
    extractors: Annotated[str | None, typer.Option(hidden=True)] = None,
    extractor: ExtractorOption = None,
    photos: PhotosOption = DEFAULT_PHOTOS,
    weights: WeightsOption = False,
    map_name: MapOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare extractors on the labelled queries or the photos of a map of this machine.

    The one in use, and all whose weights are here: recall with interval, answers, CPU time, bytes.
    """
    if data is not None or extractors is not None:
        raise lab_missing("`compare DIR`")
    # Must be set before torch is loaded below; see services/cli/__init__.py.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from services.cli.descriptors.compare_on_map import compare_on_map

    compare_on_map(map_name, extractor, photos, weights, as_json)
