"""`placewise models list|fetch`; what is added stands in `services.cli.descriptors.models`.

`placewise models add|added|remove`: models of `placewise train` that describe maps.
"""

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

from services.cli.client import connect, wait_for_job
from services.cli.descriptors.local_weights import (
    LocalWeights,
    WeightsRecord,
    inspect_weights,
    list_recipes,
    save_record,
    torchhub_key,
)
from services.cli.environment import read_settings
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    console,
    err_console,
    print_json,
    progress_bar,
    report_errors,
)
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.extractor_config.configs import get_extractor_config
from shared.extractor_config.names import TorchHubEntry

if TYPE_CHECKING:
    from shared.descriptors.weight_files import OnProgress


AddedModelName = Annotated[str, typer.Argument(metavar="NAME", help="As `models added` says.")]


def add(
    checkpoint: Annotated[
        Path,
        typer.Argument(metavar="CHECKPOINT", exists=True, dir_okay=False, help="A .ckpt file."),
    ],
    name: Annotated[
        str, typer.Option("--name", metavar="NAME", help="Maps call it gsv:NAME, for good.")
    ],
    licence: Annotated[str | None, typer.Option("--licence", help="Of the weights.")] = None,
    note: Annotated[str | None, typer.Option("--note", help="For people.")] = None,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make a checkpoint of `placewise train` a model that maps can be described with.

    It is sent to the server, whose extractor checks it; what describes photos is kept, and nothing
    else. `--map` only says whose job list shows it.
    """
    with report_errors(as_json):
        with connect(server, map_name, key) as client, progress_bar() as progress:
            client.models()  # a wrong address or key is said before the file is sent
            sending = progress.add_task("sending (bytes)", total=checkpoint.stat().st_size)
            started = client.add_model(
                checkpoint,
                name,
                licence=licence,
                note=note,
                on_sent=lambda sent_bytes: progress.update(sending, completed=sent_bytes),
            )
            job = wait_for_job(client, started["job_id"], progress, "checking")
        if as_json:
            print_json(job)
            return
        list_added = job["result"]
        console.print(
            f"{list_added['extractor']}: {list_added['dimension']} dimensions, "
            f"{list_added['size_bytes'] / 1e6:.1f} MB, fingerprint {list_added['fingerprint'][:12]}"
            f"{'; it was there already' if list_added['already_there'] else ''}.",
            soft_wrap=True,
            markup=False,
        )


def list_added(
    server: ServerOption = None, key: KeyOption = None, as_json: JsonOption = False
) -> None:
    """The models that were added, with the maps that are described with them."""
    with report_errors(as_json):
        with connect(server, None, key) as client:
            found = client.models()
        if as_json:
            print_json(found)
            return
        name = Column("extractor", overflow="fold", min_width=12)
        table = Table(name, "network", "image", "dimension", "size", "licence", "maps", "note")
        for model in found:
            table.add_row(
                escape(model["extractor"]),
                f"{model['config']['backbone_arch']} {model['config']['agg_arch']}",
                "{}x{}".format(*model["image_size"]),
                str(model["dimension"]),
                f"{model['size_bytes'] / 1e6:.1f} MB",
                escape(model["licence"]),
                escape(", ".join(model["maps"])),
                escape(model["note"] or ""),
            )
        console.print(table)


def remove(
    name: AddedModelName,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Remove a model that no map is described with. Its name never means other weights."""
    with report_errors(as_json):
        with connect(server, None, key) as client:
            removed = client.remove_model(name)
        if as_json:
            print_json(removed)
            return
        console.print(removed["message"], soft_wrap=True, markup=False)


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
    from shared.descriptors.backbones.dinov2_weights import find_or_download_weights

    find_or_download_weights(backbone.removeprefix("dinov2-"), settings.dino_weights, on_progress)


def _fetch_torchhub(hub: TorchHubEntry, on_progress: OnProgress) -> int:
    """Load it once; returns the length of its descriptors."""
    import torch

    from shared.descriptors.backbones.torchhub import TorchHubBackbone

    made = TorchHubBackbone(hub, torch.device("cpu"), on_progress=on_progress)
    save_record(
        torchhub_key(hub, made.code_fingerprint),
        WeightsRecord(made.fingerprint, made.card["size_bytes"]),
    )
    return made.width


def _print_weights(weights: LocalWeights, dimension: int | None) -> None:
    for line in (
        (
            f"{weights.extractor}: {dimension} dimensions, "
            f"{_format_megabytes(weights.size_bytes)} of weights."
        ),
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
