"""`placewise models list|fetch`; what is added stands in `services.cli.added_models`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)
from rich.table import Column, Table

from services.cli.added_models import add, list_added, remove
from services.cli.configuration import read_settings
from services.cli.fingerprints import WeightsRecord, save_record
from services.cli.output import JsonOption, console, err_console, print_json, report_errors
from services.cli.weights_here import LocalWeights, inspect_weights, list_recipes, torchhub_key
from shared.errors import Misconfigured
from shared.recipes import get_extractor_config
from shared.settings import Settings
from shared.torchhub_names import TorchHubEntry

if TYPE_CHECKING:
    from shared.vision.download import OnProgress

app = typer.Typer(
    help="Extractors' weights: what is on this machine, getting what is not, adding your own."
)
app.command("add")(add)
app.command("added")(list_added)
app.command("remove")(remove)


@app.command("list")
def list_(as_json: JsonOption = False) -> None:
    """Show each extractor with its weights. One that is seen for the first time is read whole."""
    with report_errors(as_json):
        settings = read_settings()
        with err_console.status("Looking for weights") as status:

            def reading(path: Path) -> None:
                status.update(f"Reading {path} for its fingerprint")

            found = [
                inspect_weights(recipe, settings, reading) for recipe in list_recipes(settings)
            ]
    if as_json:
        print_json([asdict(weights) for weights in found])
        return
    name = Column("extractor", overflow="fold", min_width=23)
    table = Table(name, "here", "size", Column("from", overflow="fold"), "licence", "fingerprint")
    for weights in found:
        table.add_row(
            escape(weights.extractor),
            "yes" if weights.here else "no",
            _format_megabytes(weights.size_bytes),
            escape(weights.source),
            escape(weights.licence),
            (weights.fingerprint or "")[:12],
        )
    console.print(table)


@app.command("fetch")
def fetch(
    name: Annotated[str, typer.Argument(metavar="NAME", help="An extractor's name.")],
    as_json: JsonOption = False,
) -> None:
    """Get an extractor's weights ahead of time; a download that broke off goes on.

    A torch.hub entry (torchhub:OWNER/NAME@COMMIT:ENTRY) is executed, which is how its weights come:
    look at its code first.
    """
    with report_errors(as_json):
        settings = read_settings()
        recipe = get_extractor_config(name, allow_test_extractors=settings.allow_test_extractors)
        if recipe.for_tests:
            raise Misconfigured("no_weights", f"The extractor {recipe.name} has no weights.")
        if recipe.trained is not None:
            raise Misconfigured(
                "no_weights",
                f"The weights of {recipe.name} lie in the object store, where extractors take them "
                "from: there is nothing to fetch.",
            )
        with _download_progress(recipe.name) as on_progress:
            dimension = recipe.dimension
            if recipe.hub is not None:
                dimension = _fetch_torchhub(recipe.hub, on_progress)
            elif recipe.depth is not None:
                _fetch_dinov2(recipe.backbone, settings, on_progress)
        found = inspect_weights(recipe, settings)
        if not found.here:
            raise Misconfigured("weights_unfit", found.note or "")
    if as_json:
        print_json({**asdict(found), "dimension": dimension})
        return
    _print_weights(found, dimension)
    if recipe.hub is not None and recipe.name not in settings.allowed_hub_extractors:
        console.print(
            f"Maps may use it once it is allowed: TORCHHUB_ALLOWED={escape(recipe.name)}",
            soft_wrap=True,
        )


def _fetch_dinov2(backbone: str, settings: Settings, on_progress: OnProgress) -> None:
    from shared.vision.backbones.dinov2_weights import find_or_download_weights

    find_or_download_weights(backbone.removeprefix("dinov2-"), settings.dino_weights, on_progress)


def _fetch_torchhub(hub: TorchHubEntry, on_progress: OnProgress) -> int:
    """Load it once; returns the length of its descriptors."""
    import torch

    from shared.vision.backbones.torchhub import TorchHubBackbone

    made = TorchHubBackbone(hub, torch.device("cpu"), on_progress=on_progress)
    save_record(
        torchhub_key(hub, made.code_fingerprint),
        WeightsRecord(made.fingerprint, made.card["size_bytes"]),
    )
    return made.width


def _print_weights(weights: LocalWeights, dimension: int | None) -> None:
    for line in (
        f"{weights.extractor}: {dimension} dimensions, {_format_megabytes(weights.size_bytes)} of weights.",
        f"They are from {weights.source}, and lie at {weights.path}.",
        f"Licence: {weights.licence}. Fingerprint: {weights.fingerprint}.",
    ):
        console.print(escape(line), soft_wrap=True)


@contextlib.contextmanager
def _download_progress(what: str) -> Iterator[OnProgress]:
    """A bar for what comes from the network, as soon as something comes."""
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
        console=err_console,
    ) as progress:
        bar = progress.add_task(escape(what), visible=False)

        def show(done: int, total: int | None) -> None:
            progress.update(bar, completed=done, total=total, visible=True)

        yield show


def _format_megabytes(size_bytes: int | None) -> str:
    return "" if size_bytes is None else f"{size_bytes / 1e6:.1f} MB"
