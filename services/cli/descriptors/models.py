"""`placewise models`: extractor weights on this machine, and trained models added to a server.

`list` and `fetch` inspect and download weights locally; `add`, `added` and `remove` manage models
of `placewise train` and exported networks on a server.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Column

from placewise.protocol import printable_name
from services.cli.client import MapOptions, ServerOptions, wait_for_job
from services.cli.descriptors.local_weights import inspect_weights, list_extractor_configs
from services.cli.environment import read_settings
from services.cli.option_groups import CommandGroup
from services.cli.output import (
    JsonOption,
    Table,
    print_json,
    print_message,
    print_result,
    progress_bar,
)
from shared.errors import Misconfigured
from shared.extractor_config.configs import get_extractor_config

EXPORTED_NETWORK = {"backbone_arch": "exported", "agg_arch": ""}  # nothing else is known of it

app = CommandGroup(help="Manage extractor weights and trained models.")


@app.command("add")
def add(
    common: MapOptions,
    checkpoint: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            exists=True,
            dir_okay=False,
            help="Checkpoint of `placewise train` (.ckpt), TorchScript file or ONNX file (.onnx).",
        ),
    ],
    name: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Permanent name; maps refer to it as gsv:NAME, torchscript:NAME or onnx:NAME.",
        ),
    ],
    options: Annotated[
        str | None,
        typer.Option(
            help="TorchScript or ONNX file: what its network expects, and the aggregator, as in "
            "input.size=288x288,aggregator=vlad.",
        ),
    ] = None,
    licence: Annotated[str | None, typer.Option(help="Licence of the weights.")] = None,
    note: Annotated[str | None, typer.Option(help="Free-text note.")] = None,
) -> None:
    """Upload a checkpoint, TorchScript or ONNX file as an extractor for maps.

    The server's extractor validates the file and stores only what is needed to describe photos.
    `--map` only selects the map whose job list shows the job.
    """
    with common.connect() as client, progress_bar() as progress:
        client.models()  # fails before the upload if the URL or key is wrong
        with progress.open(checkpoint, "rb", description="uploading (bytes)") as file:
            started = client.add_model(
                file,
                name,
                options=options,
                licence=licence,
                note=note,
                filename=printable_name(checkpoint),
            )
        job = wait_for_job(client, started, progress, "checking")
    model = job.result or {}
    print_result(
        job,
        common.as_json,
        f"{model['extractor']}: {model['dimension']} dimensions, "
        f"{model['size_bytes'] / 1e6:.1f} MB, fingerprint {model['fingerprint'][:12]}"
        f"{'; already stored' if model['already_there'] else ''}.",
    )


@app.command("added")
def list_added(common: ServerOptions) -> None:
    """List added models and the maps that use them."""
    with common.connect() as client:
        models = client.models()
    name = Column("extractor", overflow="fold", min_width=12)
    table = Table(name, "network", "image", "dimension", "size", "licence", "maps", "note")
    for model in models:
        table.add_row(
            escape(model.extractor),
            "{backbone_arch} {agg_arch}".format(**{**EXPORTED_NETWORK, **model.config}),
            "{}x{}".format(*model.image_size) if model.image_size else "native",
            str(model.dimension),
            f"{model.size_bytes / 1e6:.1f} MB",
            escape(model.licence),
            escape(", ".join(model.maps)),
            escape(model.note or ""),
        )
    print_result(models, common.as_json, table)


@app.command("remove")
def remove(
    common: ServerOptions,
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Name of an added model; see `models added`.")
    ],
) -> None:
    """Remove a model that no map uses. Its name can't be reused for other weights."""
    with common.connect() as client:
        removed = client.remove_model(name)
    print_result(removed, common.as_json, removed.message)


@app.command("list")
def list_(as_json: JsonOption = False) -> None:
    """List extractors and their weights on this machine."""
    settings = read_settings()
    all_weights = [inspect_weights(config, settings) for config in list_extractor_configs(settings)]
    name = Column("extractor", overflow="fold", min_width=23)
    table = Table(name, "available", "size", "source", "licence")
    for weights in all_weights:
        table.add_row(
            escape(weights.extractor),
            "yes" if weights.available else "no",
            _format_megabytes(weights.size_bytes),
            escape(weights.source),
            escape(weights.licence),
        )
    print_result([asdict(weights) for weights in all_weights], as_json, table)


@app.command("fetch")
def fetch(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Extractor name.")],
    as_json: JsonOption = False,
) -> None:
    """Download the weights of an extractor. An interrupted download resumes.

    Weights of a torch.hub entry (torchhub:OWNER/NAME@COMMIT:ENTRY) are downloaded by running its
    code: review the code first.
    """
    settings = read_settings()
    config = get_extractor_config(name, allow_test_extractors=settings.allow_test_extractors)
    if config.for_tests:
        raise Misconfigured("no_weights", f"The extractor {config.name} has no weights.")
    if config.model is not None:
        raise Misconfigured(
            "no_weights",
            f"The weights of {config.name} are in the object store, from which extractors load "
            "them. There is nothing to fetch.",
        )
    from shared.descriptors.backbones import backbone_class  # imports torch

    with progress_bar() as progress:
        bar = progress.add_task(f"{escape(config.name)} (bytes)", visible=False)

        def on_progress(done: int, total: int | None) -> None:
            progress.update(bar, completed=done, total=total, visible=True)

        loaded = backbone_class(config).fetch(config, settings.dino_weights, on_progress)
    weights = inspect_weights(config, settings)
    dimension = config.dimension
    if loaded is not None:
        dimension = loaded.width
        weights = replace(weights, size_bytes=loaded.card["size_bytes"])
    if not weights.available:
        raise Misconfigured("weights_unusable", weights.note or "")
    if as_json:
        print_json({**asdict(weights), "dimension": dimension})
        return
    size_text = _format_megabytes(weights.size_bytes)
    print_message(f"{weights.extractor}: {dimension} dimensions, {size_text} of weights.")
    print_message(f"Source: {weights.source}. Path: {weights.path}.")
    print_message(f"Licence: {weights.licence}.")
    if config.hub is not None and config.name not in settings.allowed_hub_extractors:
        print_message(f"To allow maps to use it, set CODE_ALLOWED={config.name}")


def _format_megabytes(size_bytes: int | None) -> str:
    return "" if size_bytes is None else f"{size_bytes / 1e6:.1f} MB"
