"""`placewise vocabulary fit|import|list`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress
from rich.table import Column, Table

from services.cli.connect import connect
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    answers,
    explained,
    print_json,
    progress_bar,
)
from services.cli.wait import wait_with_bar
from shared.client import Client, Json

app = typer.Typer(help="VLAD's cluster centres: fit them on the map's own photos, import, list.")


@app.command("fit")
def fit(
    clusters: Annotated[
        int | None, typer.Option(min=1, help="Cluster centres; default: the extractor's.")
    ] = None,
    sample: Annotated[int | None, typer.Option(min=1, help="Photos to learn from.")] = None,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Learn a vocabulary from the map's photos, describe all of them anew, switch."""
    wanted = {"clusters": clusters, "sample": sample, "seed": seed}
    given = {name: value for name, value in wanted.items() if value is not None}
    with explained(as_json):
        with connect(server, map_name, key) as client, progress_bar() as progress:
            job = fit_and_wait(client, given, progress)
        _print_change(job, as_json)


@app.command("import")
def import_(
    file: Annotated[
        Path,
        typer.Argument(exists=True, dir_okay=False, help=".npy, or AnyLoc's c_centers.pt"),
    ],
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring a vocabulary, describe all photos with it, switch."""
    from shared.vision.vocabulary import (
        encode_centres,
        read_centres,
    )  # torch takes seconds

    with explained(as_json):
        data = encode_centres(read_centres(file))
        with (
            tempfile.TemporaryDirectory() as folder,
            connect(server, map_name, key) as client,
            progress_bar() as progress,
        ):
            plain = Path(folder, f"{file.stem}.npy")
            plain.write_bytes(data)
            started = client.import_vocabulary(plain)
            job = wait_with_bar(client, started["job_id"], progress, "vocabulary")
        _print_change(job, as_json)


@app.command("list")
def list_(
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """The map's vocabularies, newest first; the one that answers is marked."""
    with explained(as_json):
        with connect(server, map_name, key) as client:
            found = client.vocabularies()
            active = {g["vocabulary_id"] for g in client.generations() if g["state"] == "active"}
        if as_json:
            print_json([{**v, "active": v["vocabulary_id"] in active} for v in found])
            return
        # Ids are folded, never cut: they are there to be copied.
        name = Column("vocabulary", overflow="fold", min_width=36)
        table = Table("", name, "origin", "clusters", "dimension", "photos", "made")
        for v in found:
            table.add_row(
                "*" if v["vocabulary_id"] in active else "",
                v["vocabulary_id"],
                v["origin"],
                str(v["clusters"]),
                str(v["dimension"]),
                str(v["provenance"].get("photos", "")),
                v["created_at"],
            )
        answers.print(table)


def fit_and_wait(client: Client, wanted: dict[str, int], progress: Progress) -> Json:
    """Fit on the map's photos and wait until the new generation answers."""
    return wait_with_bar(client, client.fit_vocabulary(**wanted)["job_id"], progress, "vocabulary")


def _print_change(job: Json, as_json: bool) -> None:
    if as_json:
        print_json(job)
        return
    result = job["result"]
    answers.print(
        f"Generation {result['generation_id']} answers: {result['photos']} photos, "
        f"{result['clusters']} clusters, {result['failed']} failed.",
        soft_wrap=True,
    )
