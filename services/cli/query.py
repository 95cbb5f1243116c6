"""`placewise query PHOTO`: which known place is this?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Column, Table

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
from shared.client import Json
from shared.search_api.comparison import MAX_RERANK_CANDIDATES

MAX_CLUSTERS_SHOWN = 3  # shown of an explanation


def query(
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", exists=True, dir_okay=False)],
    top_k: Annotated[int, typer.Option(min=1, max=100, help="How many photos to answer.")] = 10,
    min_score: Annotated[float | None, typer.Option(min=-1, max=1)] = None,
    near: Annotated[
        str | None, typer.Option(help="LAT,LON,RADIUS_M: only photos taken there.")
    ] = None,
    box: Annotated[str | None, typer.Option(help="S,W,N,E in degrees.")] = None,
    captured_after: Annotated[str | None, typer.Option(help="ISO 8601.")] = None,
    captured_before: Annotated[str | None, typer.Option(help="ISO 8601.")] = None,
    place: Annotated[str | None, typer.Option(help="Only photos with this label.")] = None,
    tags: Annotated[str | None, typer.Option(help="Separated by commas: all are wanted.")] = None,
    word_weights: Annotated[
        bool,
        typer.Option(
            "--word-weights/--no-word-weights", help="Rank by the map's word weights, if any."
        ),
    ] = True,
    rerank: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MAX_RERANK_CANDIDATES,
            help="Compare the first N photos patch by patch.",
            metavar="N",
        ),
    ] = None,
    explain: Annotated[
        bool, typer.Option(help="Say of each photo what makes it similar; --json has the overlays.")
    ] = False,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the indexed photos most similar to a photo, which is not stored."""
    with report_errors(as_json):
        with connect(server, map_name, key) as client:
            answer = client.similar_to_file(
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
        weighted = answer["word_weights"] == "applied"
        table = Table(
            "rank",
            Column("score", no_wrap=True),
            *([Column("weighted", no_wrap=True)] if weighted else []),
            *([Column("reranked", no_wrap=True)] if rerank else []),
            Column("photo", overflow="fold"),
            Column("latitude", no_wrap=True),
            Column("longitude", no_wrap=True),
            "place",
            *([Column("made of", overflow="fold")] if explain else []),
        )
        for rank, found in enumerate(answer["similar_images"], start=1):
            table.add_row(
                str(rank),
                f"{found['similarity_score']:.4f}",
                *([f"{found['weighted_score']:.4f}"] if weighted else []),
                *([_format_score(found["rerank_score"])] if rerank else []),
                found["original_filename"],
                _format_degrees(found["latitude"]),
                _format_degrees(found["longitude"]),
                found["place"] or "",
                *([_format_explanation(found["explanation"])] if explain else []),
            )
        console.print(table)
        console.print(_format_estimate(answer["estimate"]), soft_wrap=True)
        console.print(
            f"{answer['rows_scanned']} photos compared ({answer['certificate']}), "
            f"vocabulary: {answer['vocabulary']}, word weights: {answer['word_weights']}",
            soft_wrap=True,
        )


def _format_score(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"


def _format_explanation(explanation: Json | None) -> str:
    """The clusters that add most to the score; without a vocabulary, its grid."""
    if explanation is None:
        return ""
    if explanation["clusters"] is None:
        return f"{explanation['rows']} x {explanation['columns']} patches"
    most = explanation["clusters"][:MAX_CLUSTERS_SHOWN]
    return ", ".join(f"cluster {one['cluster']}: {one['share']:+.4f}" for one in most)


def _format_estimate(estimate: Json) -> str:
    """The estimate in one line."""
    if estimate["in_map"] is False:
        return str(estimate["reason"])
    where = [estimate["place"]] if estimate["place"] else []
    if estimate["latitude"] is not None:
        where.append(
            f"{estimate['latitude']:.6f}, {estimate['longitude']:.6f} "
            f"(right means within {estimate['radius_m']:g} m)"
        )
    if not where:
        return f"No place: {estimate['reason']}"
    sure = (
        f"confidence {estimate['confidence']:.0%}"
        if estimate["confidence"] is not None
        else "confidence uncalibrated"
    )
    known = "" if estimate["in_map"] else "; whether it is in the map at all can't be told yet"
    return f"Estimate: {'; '.join(where)}, {sure}{known}"


def _format_degrees(value: float | None) -> str:
    return "" if value is None else f"{value:.6f}"
