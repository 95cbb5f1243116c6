"""`placewise query PHOTO`: find the photos most similar to a photo and estimate its place."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.progress_bar import ProgressBar
from rich.table import Column

from placewise.answers import CameraPose, Estimate, Matches
from services.cli.client import MapOptions
from services.cli.output import Table, format_percent, print_json, print_message, print_table
from shared.search_api.protocol import MAX_MATCHED_PHOTOS

BAR_WIDTH = 20  # characters
CALIBRATION_SOURCES = {
    "prior": "on generated maps; this map has few photos",
    "own_photos": "on photos of this map",
    "labelled_queries": "on labelled queries",
}


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """Options of the search, by the names of their parameters in `Client.similar`."""

    top_k: Annotated[int, typer.Option(min=1, max=100, help="Maximum number of results.")] = 10
    min_score: Annotated[
        float | None, typer.Option(min=-1, max=1, help="Minimum cosine similarity.")
    ] = None
    near: Annotated[str | None, typer.Option(help="Only photos within LAT,LON,RADIUS_M.")] = None
    box: Annotated[str | None, typer.Option(help="Only photos within S,W,N,E (degrees).")] = None
    captured_after: Annotated[
        str | None, typer.Option(help="Only photos taken after this ISO 8601 time.")
    ] = None
    captured_before: Annotated[
        str | None, typer.Option(help="Only photos taken before this ISO 8601 time.")
    ] = None
    place: Annotated[str | None, typer.Option(help="Only photos with this place label.")] = None
    tags: Annotated[
        str | None, typer.Option(help="Only photos that have all of these comma-separated tags.")
    ] = None
    tags_like: Annotated[
        str | None,
        typer.Option(help="Only photos whose tags contain all of these comma-separated parts."),
    ] = None
    matches: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=MAX_MATCHED_PHOTOS,
            help="Match the local features of the first N results. Default: as the map decides.",
            metavar="N",
        ),
    ] = None
    rerank: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MAX_MATCHED_PHOTOS,
            help="Match the first N results, and order them by their matching points.",
            metavar="N",
        ),
    ] = None
    pose: Annotated[
        bool,
        typer.Option("--pose", help="Compute where the camera stood and looked, and how exactly."),
    ] = False
    focal_length: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            max=100,
            help="With --pose: focal length of the camera as a multiple of the photo's longer "
            "side. Default: that of the EXIF, or else it is estimated.",
        ),
    ] = None
    certainty: Annotated[
        float | None,
        typer.Option(
            max=1,
            help="Share of the answers that must be right, above 0: the estimate answers at the "
            "finest level that is certain enough. Default: the server's CERTAINTY.",
        ),
    ] = None
    elsewhere: Annotated[
        float | None,
        typer.Option(
            help="Share of your queries that are from elsewhere than the map, between 0 and 1. "
            "Default: the map's.",
        ),
    ] = None
    guarantee: Annotated[
        float | None,
        typer.Option(
            help="Share of all queries that may get a wrong answer, instead of --certainty. Takes "
            "labelled queries."
        ),
    ] = None


def query(
    options: SearchOptions,
    common: MapOptions,
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", exists=True, dir_okay=False)],
) -> None:
    """Find the indexed photos most similar to PHOTO. The query photo is not stored."""
    with common.connect() as client:
        answer = client.similar(photo, **asdict(options))
        target = common.describe_target(client)
    if common.as_json:
        print_json(answer)
        return
    levels = answer.estimate.levels
    table = Table(
        "rank",
        Column("score", no_wrap=True),
        *([Column("match", justify="right", no_wrap=True)] if levels else []),
        *([Column("points", justify="right", no_wrap=True)] if answer.matches else []),
        "photo",
        Column("latitude", no_wrap=True),
        Column("longitude", no_wrap=True),
        "place",
    )
    for rank, match in enumerate(answer.similar_images, start=1):
        table.add_row(
            str(rank),
            f"{match.similarity_score:.4f}",
            *([format_percent(match.match_probability)] if levels else []),
            *(["" if match.inliers is None else str(match.inliers)] if answer.matches else []),
            escape(match.relative_path or match.original_filename),
            _format_degrees(match.latitude),
            _format_degrees(match.longitude),
            escape(match.place or ""),
        )
    print_table(table)
    print_message(_format_estimate(answer.estimate))
    if levels:
        print_table(_levels_table(answer.estimate))
    if answer.matches:
        print_message(_format_matches(answer.matches))
    if answer.no_pose is not None:
        print_message(f"No pose: {answer.no_pose}")
    if answer.pose:
        print_table(_pose_table(answer.pose))
    print_message(
        f"{answer.rows_scanned} photos compared (certificate: {answer.certificate}), "
        f"vocabulary: {answer.vocabulary}\n"
        f"Searched {target}"
    )


def _pose_table(pose: CameraPose) -> Table:
    """Name and value of what is known about a pose."""
    camera = pose.camera
    table = Table("pose", "value", caption=pose.reason)
    for name, value, unit, digits in (
        ("latitude", pose.latitude, "", 7),
        ("longitude", pose.longitude, "", 7),
        ("altitude", pose.altitude_m, " m", 2),
        ("68 % within", pose.radius_68_m, " m", 2),
        ("95 % within", pose.radius_95_m, " m", 2),
        ("heading", pose.heading, "°", 1),
        ("heading, 68 % within", pose.heading_68_degrees, "°", 1),
        ("pitch", pose.pitch, "°", 1),
        ("roll", pose.roll, "°", 1),
    ):
        if value is not None:
            table.add_row(name, f"{value:.{digits}f}{unit}")
    table.add_row("in component", str(pose.component))
    table.add_row("x, y, z", ", ".join(f"{value:.4f}" for value in pose.position))
    table.add_row("points", f"{pose.inliers} of {pose.matches} agree")
    table.add_row(
        "focal length", f"{camera.focal_pixels:.0f} of {camera.width} px, {camera.source}"
    )
    return table


def _format_matches(matches: Matches) -> str:
    """How many photos were matched, or why none was."""
    if matches.reason is not None:
        return f"No matching points: {matches.reason}"
    missing = f"; {matches.missing} have no local features" if matches.missing else ""
    return f"{matches.compared} photos were matched{missing}."


def _levels_table(estimate: Estimate) -> Table:
    """Probabilities of the levels and of "not in this map", at most 80 columns wide."""
    radii = (("68", estimate.radius_68_m), ("95", estimate.radius_95_m))
    rings = ", ".join(f"{share} % within {_format_m(m)}" for share, m in radii if m is not None)
    source = str(estimate.calibration_source)
    table = Table(
        "level",
        Column("probability", justify="right", no_wrap=True),
        Column("", width=BAR_WIDTH),
        caption=f"{f'Position: {rings}. ' if rings else ''}Probabilities were fitted "
        f"{CALIBRATION_SOURCES.get(source, f'on {source}')}.",
    )
    for level in estimate.levels:
        name = level.place or f"within {_format_m(level.radius_m or 0)}"
        if level.whole_map:
            name = "in this map"
        table.add_row(
            escape(name), format_percent(level.probability), _probability_bar(level.probability)
        )
    outside = estimate.not_in_map_probability
    table.add_section()
    table.add_row("not in this map", format_percent(outside), _probability_bar(outside or 0))
    return table


def _probability_bar(probability: float) -> ProgressBar:
    return ProgressBar(
        total=1,
        completed=probability,
        width=BAR_WIDTH,
        complete_style="green",
        finished_style="green",
    )


def _format_m(length_m: float) -> str:
    return f"{length_m:.0f} m" if length_m < 999.5 else f"{round(length_m / 1000, 1):g} km"


def _format_estimate(estimate: Estimate) -> str:
    """The headline, with the place that it does not name, and the reason if it says more."""
    parts = [estimate.place] if estimate.place and not estimate.levels else []
    if estimate.latitude is not None:
        parts.append(f"{_format_degrees(estimate.latitude)}, {_format_degrees(estimate.longitude)}")
    return "\n".join(dict.fromkeys([". ".join([estimate.headline, *parts]), estimate.reason]))


def _format_degrees(value: float | None) -> str:
    return "" if value is None else f"{value:.6f}"
