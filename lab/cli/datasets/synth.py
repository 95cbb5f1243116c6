"""`placewise datasets synth`: generate a synthetic city in the layouts of public data sets."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Annotated

import typer

from lab.city.plan import CityOptions, make_plan
from lab.city.write import NOT_COMPARABLE, check_output_empty, describe_city, write_city
from services.cli.output import JsonOption, print_result, progress_bar

SIZE_PATTERN = re.compile(r"(\d{2,4})x(\d{2,4})")


def parse_size(text: str) -> tuple[int, int]:
    """Parse `320x240` to (width, height).

    Raises typer.BadParameter: Invalid format, or a side outside 64 to 1920.
    """
    match = SIZE_PATTERN.fullmatch(text)
    if match is None or not all(64 <= int(side) <= 1920 for side in match.groups()):
        raise typer.BadParameter("must be WxH with sides from 64 to 1920, such as 320x240.")
    return int(match[1]), int(match[2])


def synth(
    out: Annotated[Path, typer.Argument(help="Output folder; must be empty or not exist.")],
    places: Annotated[int, typer.Option(min=1, max=20_000, help="Number of places.")] = 1000,
    views: Annotated[int, typer.Option(min=1, max=32, help="Database photos per place.")] = 4,
    queries: Annotated[
        int | None, typer.Option(min=1, max=100_000, help="Number of queries. Default: places / 2.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the city.")] = 0,
    catalogue_seed: Annotated[
        int, typer.Option(min=0, help="Seed of the style: walls, colours, windows.")
    ] = 0,
    out_of_map: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, help="Share of queries outside the map."),
    ] = 0.1,
    size: Annotated[str, typer.Option(metavar="WxH", help="Photo size in pixels.")] = "320x240",
    train: Annotated[
        bool, typer.Option(help="Also generate a training set; nearly half of the run time.")
    ] = True,
    rides: Annotated[
        int,
        typer.Option(
            metavar="FRAMES",
            min=0,
            max=100_000,
            help="Also generate a ride of so many frames through the city, in winter and at night: "
            "one frame per second, with stops, a detour outside the map and a jump.",
        ),
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Generate a synthetic city with a database, queries and a training set.

    The output is deterministic for given arguments. Photos in OUT/database and OUT/queries have
    @UTM@ names, those in OUT/rides/SEASON too. OUT/gsv_xs is the training set, with separate
    streets. OUT/city.json contains the arguments and the kind of each query.
    """
    width, height = parse_size(size)
    query_count = queries if queries is not None else max(1, places // 2)
    options = CityOptions(
        places, views, query_count, seed, catalogue_seed, out_of_map, width, height, train, rides
    )
    check_output_empty(out)
    started = time.perf_counter()
    plan = make_plan(options)
    with progress_bar() as progress:
        bar = progress.add_task("rendering", total=len(plan.photos))
        write_city(plan, out, lambda count: progress.advance(bar, count))
    seconds = time.perf_counter() - started
    rate = len(plan.photos) / seconds
    description = describe_city(plan)
    counts = description["counts"]
    print_result(
        {
            "out": str(out),
            "note": NOT_COMPARABLE,
            **{key: description[key] for key in ("arguments", "counts", "query_kinds")},
            "drawing": {"seconds": seconds, "photos_per_second": rate},
        },
        as_json,
        f"{out}: {counts['database']} database photos, {counts['query']} queries, "
        f"{counts.get('train', 0)} training photos; rendered at {rate:.0f} photos/s, "
        f"{seconds:.0f} s in total. {NOT_COMPARABLE.capitalize()}.",
    )
