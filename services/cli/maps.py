"""`placewise maps`: list, create, switch and delete maps."""

from __future__ import annotations

import sys
from typing import Annotated
from uuid import UUID

import typer

from placewise.answers import Map
from services.cli.client import ServerOptions, active_generation, wait_for_job
from services.cli.option_groups import CommandGroup
from services.cli.output import Table, format_pca, format_percent, print_result, progress_bar
from shared.errors import Conflict, InvalidRequest
from shared.extractor_config.configs import MAX_PCA_DIMENSION, MIN_PHOTOS_TO_FIT

app = CommandGroup(
    help="Manage maps: named photo databases, each with its own extractor and vocabulary."
)

MATCHING_HELP = (
    "Compute and match local features of its photos: on, off, or auto: until an evaluation finds "
    "that matches do not improve the answers."
)

ELSEWHERE_HELP = "Share of its queries that are from elsewhere, between 0 and 1."

MapName = Annotated[str, typer.Argument(metavar="NAME")]


@app.command("list")
def list_maps(common: ServerOptions) -> None:
    """List all maps with their photo counts and extractors; `--json` has all their settings."""
    with common.connect() as client:
        maps = client.maps()
    counts = ("photos", "searchable", "queries")
    table = Table("map", *counts, "extractor", "vocabulary", "dimension")
    for map_ in maps:
        table.add_row(
            map_.name,
            str(map_.photos),
            f"{map_.searchable} ({map_.failed_photos} failed)"
            if map_.failed_photos
            else str(map_.searchable),
            str(map_.labelled_queries),
            map_.extractor,
            map_.vocabulary or "",
            _format_dimension(map_),
        )
    print_result(maps, common.as_json, table)


def _format_dimension(map_: Map) -> str:
    if map_.dimension is None:
        return ""
    pca_note = "" if map_.pca_from is None else f" (PCA of {map_.pca_from})"
    return f"{map_.dimension}{pca_note}"


def _format_features(map_: Map) -> str:
    features = map_.local_features
    if features is None or not features.photos:
        return map_.matching
    used = {True: ", used", False: ", not used", None: ""}[features.used]
    return f"{map_.matching}: {features.photos} photos, {features.bytes / 1e6:.1f} MB{used}"


@app.command("create")
def create(
    common: ServerOptions,
    name: MapName,
    extractor: Annotated[
        str | None,
        typer.Option(
            help="Extractor of the map, with options as in EXTRACTOR. Default: that setting."
        ),
    ] = None,
    place_labels_are_paths: Annotated[
        bool | None,
        typer.Option(
            "--place-labels-are-paths/--place-labels-are-names",
            help="`/` separates the levels of place labels, as in `tower/floor 7/elevator`, or "
            "not. Default: evaluations decide that by the labels.",
        ),
    ] = None,
    rows: Annotated[
        str | None,
        typer.Option(
            help="Type of the stored descriptors: float16, or float32 in twice the space. "
            "Default: the setting DESCRIPTOR_ROWS."
        ),
    ] = None,
    matching: Annotated[str | None, typer.Option(help=f"{MATCHING_HELP} Default: auto.")] = None,
    elsewhere: Annotated[
        float | None, typer.Option(help=f"{ELSEWHERE_HELP} Default: 0.33.")
    ] = None,
) -> None:
    """Create an empty map."""
    with common.connect() as client:
        created = client.create_map(
            name,
            extractor,
            place_labels_are_paths=place_labels_are_paths,
            rows=rows,
            matching=matching,
            elsewhere=elsewhere,
        )
    print_result(created, common.as_json, f"Created map {name} with extractor {created.extractor}.")


@app.command("update")
def update(
    common: ServerOptions,
    name: MapName,
    auto_fit: Annotated[
        bool | None,
        typer.Option(
            "--auto-fit/--no-auto-fit",
            help=f"Fit a vocabulary at {MIN_PHOTOS_TO_FIT} photos, and whenever the map has "
            "doubled since the last fit.",
        ),
    ] = None,
    matching: Annotated[str | None, typer.Option(help=MATCHING_HELP)] = None,
    elsewhere: Annotated[float | None, typer.Option(help=ELSEWHERE_HELP)] = None,
) -> None:
    """Change automatic fits and matching of a map, and how many queries are from elsewhere.

    `--matching on` waits until photos without local features have them; searches continue.
    """
    if auto_fit is None and matching is None and elsewhere is None:
        raise InvalidRequest("no_option", "Specify --auto-fit, --matching or --elsewhere.")
    with common.connect(name) as client, progress_bar() as progress:
        updated = client.update_map(name, auto_fit=auto_fit, matching=matching, elsewhere=elsewhere)
        if matching == "on" and updated.model_change_id:
            wait_for_job(client, updated.model_change_id, progress, "local features")
            updated = next(map_ for map_ in client.maps() if map_.name == name)
    changes = [_describe_auto_fit(updated)] if auto_fit is not None else []
    changes += [f"matching {_format_features(updated)}"] if matching else []
    changes += [f"{format_percent(updated.elsewhere)} from elsewhere"] if elsewhere else []
    print_result(updated, common.as_json, f"Map {name}: {'; '.join(changes)}.")


def _describe_auto_fit(map_: Map) -> str:
    if map_.next_fit_photos is not None:
        return f"the next vocabulary is fitted at {map_.next_fit_photos} photos"
    if map_.auto_fit:
        return "its extractor uses no vocabulary, or its descriptors are reduced by PCA"
    return "no vocabulary is fitted automatically"


@app.command("switch")
def switch(
    common: ServerOptions,
    name: MapName,
    extractor: Annotated[
        str | None,
        typer.Option(help="Extractor name, for example gsv:NAME for an added model."),
    ] = None,
    vocabulary: Annotated[
        UUID | None,
        typer.Option(
            metavar="ID",
            help="Vocabulary of the map. Default: the one shipped with the extractor, if any.",
        ),
    ] = None,
    pca: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=MAX_PCA_DIMENSION,
            help="Dimensions to keep by PCA whitening, fitted on the map's descriptors; 0 for full "
            "descriptors.",
        ),
    ] = None,
) -> None:
    """Reindex a map with another extractor or vocabulary, or with shorter descriptors.

    Searches use the current descriptors until the new ones are complete.
    """
    if extractor is None and vocabulary is None and pca is None:
        raise InvalidRequest("no_option", "Specify --extractor, --vocabulary or --pca.")
    with common.connect(name) as client, progress_bar() as progress:
        if pca == 0 and extractor is None and vocabulary is None:
            active = active_generation(client)
            if active is None or active.pca_from is None:
                raise Conflict("not_reduced", "The map's descriptors are not reduced by PCA.")
            vocabulary = active.vocabulary_id
        started = client.start_generation(
            extractor=extractor, vocabulary_id=vocabulary, pca=pca or None
        )
        job = wait_for_job(client, started, progress, "switching")
    result = job.result or {}
    size = f"{result['dimension']} dimensions"
    if whitening := result.get("pca"):
        size = format_pca(whitening)
    print_result(
        job,
        common.as_json,
        f"Map {name} now uses {extractor or 'other descriptors'}: {result['photos']} photos, "
        f"{size}, {result['failed']} failed.",
    )


@app.command("delete")
def delete(
    common: ServerOptions,
    name: MapName,
    yes: Annotated[bool, typer.Option("--yes", help="Delete without confirmation.")] = False,
) -> None:
    """Delete a map and all its photos."""
    with common.connect() as client:
        photos = next((m.photos for m in client.maps() if m.name == name), None)
        if photos and not yes and not sys.stdin.isatty():
            raise Conflict(
                "not_confirmed",
                f"Map {name} contains {photos} photos. Pass --yes to delete them.",
            )
        if photos and not yes:
            typer.confirm(f"Delete map {name} and its {photos} photos?", abort=True)
        deleted = client.delete_map(name)
    print_result(deleted, common.as_json, deleted.message)
