"""`placewise pca`: reduce descriptors by PCA whitening, and undo it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from placewise.answers import Job
from services.cli.client import active_generation, connect, wait_for_job
from services.cli.output import (
    Json,
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    format_percent,
    print_failures,
    print_result,
    progress_bar,
)
from shared.errors import Conflict, InvalidRequest
from shared.extractor_config.configs import MAX_PCA_DIMENSION

app = typer.Typer(help="Reduce descriptors by PCA whitening: less memory, faster search.")


@app.command("fit")
def fit(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="[ROWS.npy|DIR]",
            exists=True,
            help="Fit on rows written by `describe` or on photos below a folder, without a server. "
            "Default: fit on the map's descriptors.",
        ),
    ] = None,
    dimension: Annotated[
        int,
        typer.Option(
            "--dimension", min=1, max=MAX_PCA_DIMENSION, help="Number of dimensions to keep."
        ),
    ] = 512,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.safetensors", help="With ROWS.npy or DIR: output file."),
    ] = None,
    extractor: Annotated[
        str | None, typer.Option(help="With DIR: extractor name. Default: the setting EXTRACTOR.")
    ] = None,
    vocabulary: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="With DIR: VLAD vocabulary.")
    ] = None,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fit a PCA whitening on the map's descriptors, and switch the map to reduced descriptors.

    With ROWS.npy or DIR, write the whitening to a file for `describe --pca`.
    """
    if source is not None:
        _fit_file(source, out, dimension, extractor, vocabulary, map_name, as_json)
        return
    if out is not None or extractor is not None or vocabulary is not None:
        raise InvalidRequest(
            "options_contradict",
            "--out, --extractor and --vocabulary require ROWS.npy or DIR.",
        )
    with connect(server, map_name, key) as client, progress_bar() as progress:
        started = client.start_generation(pca=dimension)
        job = wait_for_job(client, started, progress, "pca")
    _print_generation(job, as_json)


@app.command("undo")
def undo(
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Reindex the map without PCA, with its current vocabulary, and switch to the result."""
    with connect(server, map_name, key) as client, progress_bar() as progress:
        active = active_generation(client)
        if active is None or active.pca_from is None:
            raise Conflict("not_reduced", "The map's descriptors are not reduced by PCA.")
        started = client.start_generation(vocabulary_id=active.vocabulary_id)
        job = wait_for_job(client, started, progress, "reindexing")
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
    # --server and --key are not rejected: the environment may set them for all commands.
    if map_name is not None:
        raise InvalidRequest("options_contradict", "--map can't be combined with ROWS.npy or DIR.")
    if out is None:
        raise InvalidRequest("bad_out", "Specify the output file: --out FILE.safetensors")
    from services.cli.descriptors.local_fit import fit_pca_locally  # imports torch

    with progress_bar() as progress:
        fitted = fit_pca_locally(
            source, out, dimension, extractor=extractor, vocabulary=vocabulary, progress=progress
        )
    if not as_json:
        print_failures(fitted, "refused")
    print_result(fitted, as_json, f"{fitted['file']}: {_format_pca(fitted)}.")


def _print_generation(job: Job, as_json: bool) -> None:
    result = job.result or {}
    size = _format_pca(result["pca"]) if result["pca"] else f"{result['dimension']} dimensions"
    print_result(
        job,
        as_json,
        f"Generation {result['generation_id']} is active: {result['photos']} photos, "
        f"{size}, {result['failed']} failed.",
    )


def _format_pca(pca: Json) -> str:
    return (
        f"{pca['dimension']} of {pca['from_dimension']} dimensions with "
        f"{format_percent(pca['explained'])} of the variance of {pca['rows']} rows"
    )
