"""`placewise pca fit|undo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.client import connect, wait_for_job
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    console,
    print_failures,
    print_json,
    progress_bar,
    report_errors,
)
from shared.client import Json
from shared.errors import Conflict, InvalidRequest
from shared.extractor_config.configs import MAX_PCA_DIMENSION

app = typer.Typer(help="PCA whitening: shorter descriptors, less memory, faster search.")


@app.command("fit")
def fit(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="[ROWS.npy|DIR]",
            exists=True,
            help="Learn from rows of `describe`, or from the photos below a folder, instead of the "
            "map's descriptors, without a server.",
        ),
    ] = None,
    dimension: Annotated[
        int,
        typer.Option("--dimension", min=1, max=MAX_PCA_DIMENSION, help="Of the descriptors then."),
    ] = 512,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.safetensors", help="With ROWS.npy or DIR: what to write."),
    ] = None,
    extractor: Annotated[
        str | None, typer.Option(help="With DIR: by name; default: the one of new maps.")
    ] = None,
    vocabulary: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="With DIR: of VLAD.")
    ] = None,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Learn from the map's descriptors how to shorten them, shorten all, switch.

    With ROWS.npy or DIR: write a file that `describe --pca` takes.
    """
    with report_errors(as_json):
        if source is not None:
            _fit_file(source, out, dimension, extractor, vocabulary, map_name, as_json)
            return
        if out is not None or extractor is not None or vocabulary is not None:
            raise InvalidRequest(
                "options_contradict",
                "--out, --extractor, --vocabulary: only for pca fit ROWS.npy and pca fit DIR.",
            )
        with connect(server, map_name, key) as client, progress_bar() as progress:
            started = client.start_generation(pca=dimension)
            job = wait_for_job(client, started["job_id"], progress, "pca")
        _print_generation(job, as_json)


@app.command("undo")
def undo(
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Describe the map's photos anew without PCA, with the vocabulary that they had, switch."""
    with report_errors(as_json):
        with connect(server, map_name, key) as client, progress_bar() as progress:
            active = next((g for g in client.generations() if g["state"] == "active"), None)
            if active is None or active["pca_from"] is None:
                raise Conflict("not_reduced", "The map's descriptors are whole: nothing to undo.")
            started = client.start_generation(vocabulary_id=active["vocabulary_id"])
            job = wait_for_job(client, started["job_id"], progress, "whole descriptors")
        _print_generation(job, as_json)


def _fit_file(
    source: Path,
    out: Path | None,
    dimension: int,
    extractor: str | None,
    vocabulary: Path | None,
    map_name: str | None,
    as_json: bool,
) -> None:
    # Not --server and --key: the environment may hold them for all commands.
    if map_name is not None:
        raise InvalidRequest("options_contradict", "--map: only for a fit on a map's descriptors.")
    if out is None:
        raise InvalidRequest("bad_out", "Say where to write: --out FILE.safetensors")
    from services.cli.descriptors.local_fit import fit_pca_locally  # torch takes seconds

    with progress_bar() as progress:
        fitted = fit_pca_locally(
            source, out, dimension, extractor=extractor, vocabulary=vocabulary, progress=progress
        )
    if as_json:
        print_json(fitted)
        return
    print_failures(fitted, "refused")
    console.print(f"{fitted['file']}: {_format_pca(fitted)}.", soft_wrap=True, markup=False)


def _print_generation(job: Json, as_json: bool) -> None:
    if as_json:
        print_json(job)
        return
    result = job["result"]
    about = f"{result['dimension']} dimensions"
    console.print(
        f"Generation {result['generation_id']} answers: {result['photos']} photos, "
        f"{_format_pca(result['pca']) if result['pca'] else about}, {result['failed']} failed.",
        soft_wrap=True,
    )


def _format_pca(pca: Json) -> str:
    return (
        f"{pca['dimension']} of {pca['from_dimension']} dimensions with {pca['explained']:.1%} of "
        f"the variance of {pca['rows']} rows"
    )
