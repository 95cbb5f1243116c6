"""`placewise query PHOTO`: which known place is this?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from services.cli.connect import connect
from services.cli.output import (
    JsonOption,
    MapOption,
    ServerOption,
    answers,
    explained,
    print_json,
)


def query(
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", exists=True, dir_okay=False)],
    top_k: Annotated[int, typer.Option(min=1, max=100, help="How many photos to answer.")] = 10,
    min_score: Annotated[float | None, typer.Option(min=-1, max=1)] = None,
    map_name: MapOption = None,
    server: ServerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the indexed photos most similar to a photo, which is not stored."""
    with explained(as_json):
        with connect(server, map_name) as client:
            answer = client.similar_to_file(photo, top_k=top_k, min_score=min_score)
        if as_json:
            print_json(answer)
            return
        table = Table("rank", "score", "photo", "latitude", "longitude", "place")
        for rank, found in enumerate(answer["similar_images"], start=1):
            table.add_row(
                str(rank),
                f"{found['similarity_score']:.4f}",
                found["original_filename"],
                _degrees(found["latitude"]),
                _degrees(found["longitude"]),
                found["place"] or "",
            )
        answers.print(table)
        answers.print(
            f"{answer['rows_scanned']} photos compared ({answer['certificate']}), "
            f"vocabulary: {answer['vocabulary']}",
            soft_wrap=True,
        )


def _degrees(value: float | None) -> str:
    return "" if value is None else f"{value:.6f}"
