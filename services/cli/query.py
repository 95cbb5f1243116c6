"""`placewise query PHOTO`: find the photos most similar to a photo and estimate its place."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Column, Table

from placewise.answers import Estimate, Explanation
from services.cli.client import connect
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    console,
    print_json,
    report_errors,
)
from shared.search_api.comparison import MAX_RERANK_CANDIDATES

MAX_CLUSTERS_SHOWN = 3  # per explanation


def query(
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", exists=True, dir_okay=False)],
    top_k: Annotated[int, typer.Option(min=1, max=100, help="Maximum number of results.")] = 10,
    min_score: Annotated[
        float | None, typer.Option(min=-1, max=1, help="Minimum cosine similarity.")
    ] = None,
    near: Annotated[str | None, typer.Option(help="Only photos within LAT,LON,RADIUS_M.")] = None,
    box: Annotated[str | None, typer.Option(help="Only photos within S,W,N,E (degrees).")] = None,
    captured_after: Annotated[
        str | None, typer.Option(help="Only photos taken after this ISO 8601 time.")
    ] = None,
    captured_before: Annotated[
        str | None, typer.Option(help="Only photos taken before this ISO 8601 time.")
    ] = None,
    place: Annotated[str | None, typer.Option(help="Only photos with this place label.")] = None,
    tags: Annotated[
        str | None, typer.Option(help="Only photos that have all of these comma-separated tags.")
    ] = None,
    word_weights: Annotated[
        bool,
        typer.Option(
            "--word-weights/--no-word-weights",
            help="Rank by the map's word weights, if it has any.",
        ),
    ] = True,
    rerank: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MAX_RERANK_CANDIDATES,
            help="Rerank the first N results by comparing patches.",
            metavar="N",
        ),
    ] = None,
    explain: Annotated[
        bool,
        typer.Option(
            help="Show which image parts make each result similar. --json includes the overlays."
        ),
    ] = False,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the indexed photos most similar to PHOTO. The query photo is not stored."""
    with report_errors(as_json):
        with connect(server, map_name, key) as client:
            answer = client.similar(
                photo,
                top_k=top_k,
                min_score=min_score,
                rerank=rerank,
                explain=explain,
                near=near,
                box=box,
                captured_after=captured_after,
                captured_before=captured_before,
                place=place,
                tags=tags,
                word_weights=None if word_weights else False,
            )
        if as_json:
            print_json(answer)
            return
        weighted = answer.word_weights == "applied"
        table = Table(
            "rank",
            Column("score", no_wrap=True),
            *([Column("weighted", no_wrap=True)] if weighted else []),
            *([Column("reranked", no_wrap=True)] if rerank else []),
            Column("photo", overflow="fold"),
            Column("latitude", no_wrap=True),
            Column("longitude", no_wrap=True),
            "place",
            *([Column("explained by", overflow="fold")] if explain else []),
        )
        for rank, match in enumerate(answer.similar_images, start=1):
            table.add_row(
                str(rank),
                f"{match.similarity_score:.4f}",
                *([_format_score(match.weighted_score)] if weighted else []),
                *([_format_score(match.rerank_score)] if rerank else []),
                match.original_filename,
                _format_degrees(match.latitude),
                _format_degrees(match.longitude),
                match.place or "",
                *([_format_explanation(match.explanation)] if explain else []),
            )
        console.print(table)
        console.print(_format_estimate(answer.estimate), soft_wrap=True)
        console.print(
            f"{answer.rows_scanned} photos compared (certificate: {answer.certificate}), "
            f"vocabulary: {answer.vocabulary}, word weights: {answer.word_weights}",
            soft_wrap=True,
        )


def _format_score(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"


def _format_explanation(explanation: Explanation | None) -> str:
    """The clusters that contribute most to the score; without a vocabulary, the patch grid."""
    if explanation is None:
        return ""
    if explanation.clusters is None:
        return f"{explanation.rows} x {explanation.columns} patches"
    top = explanation.clusters[:MAX_CLUSTERS_SHOWN]
    return ", ".join(f"cluster {item.cluster}: {item.share:+.4f}" for item in top)


def _format_estimate(estimate: Estimate) -> str:
    """The estimate in one line."""
    if estimate.in_map is False:
        return estimate.reason
    parts = [estimate.place] if estimate.place else []
    if estimate.latitude is not None:
        parts.append(
            f"{estimate.latitude:.6f}, {estimate.longitude:.6f} "
            f"(positive-match radius {estimate.radius_m:g} m)"
        )
    if not parts:
        return f"No place estimate: {estimate.reason}"
    confidence = (
        f"confidence {estimate.confidence:.0%}"
        if estimate.confidence is not None
        else "confidence uncalibrated"
    )
    in_map_note = "" if estimate.in_map else "; can't tell yet whether the place is in the map"
    return f"Estimate: {'; '.join(parts)}, {confidence}{in_map_note}"


def _format_degrees(value: float | None) -> str:
    return "" if value is None else f"{value:.6f}"
