"""`placewise reconstruct`: a model of the map's photos, in which queries have a pose."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated
from uuid import UUID

import typer
from pydantic import TypeAdapter, ValidationError
from rich.markup import escape
from rich.table import Column

from placewise.answers import Component, Reconstruction
from placewise.client import Client
from services.cli.client import MapOptions, wait_for_job
from services.cli.output import (
    Json,
    Table,
    first_names,
    format_percent,
    print_json,
    print_message,
    print_note,
    print_table,
    progress_bar,
)
from shared.errors import Conflict, InvalidRequest
from shared.geometry.colmap_model import ColmapModel, Origin, read_colmap_model

MAX_NAMES_SHOWN = 5


def reconstruct(
    common: MapOptions,
    model: Annotated[
        Path | None,
        typer.Option(
            "--import",
            metavar="MODEL",
            exists=True,
            file_okay=False,
            help="Folder of a COLMAP model (cameras and images, .bin or .txt), such as hloc's, "
            "whose poses are used. Its images have to be in the map: placewise index.",
        ),
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON,ALT",
            help="With --import: where the model's zero is, if its axes are east, north and up in "
            "metres. Without it, the model is aligned to the coordinates of its photos.",
        ),
    ] = None,
    from_scratch: Annotated[
        bool,
        typer.Option(
            "--from-scratch",
            help="Reconstruct all photos again, instead of adding new ones to the present model.",
        ),
    ] = False,
) -> None:
    """Reconstruct the map's photos, so that queries have a pose.

    Photos that show the same are reconstructed together and aligned to their coordinates. A later
    run adds the photos that are new. Interrupted, it goes on from its last step.
    """
    if (origin and not model) or (model and from_scratch):
        raise InvalidRequest(
            "options_contradict",
            "--origin goes with --import; --from-scratch goes with neither.",
        )
    place = None if origin is None else _parse_origin(origin)
    poses = read_colmap_model(model) if model else None
    if poses is not None and place is not None:
        poses = poses.model_copy(update={"origin": place})
    if model and (model / "images.bin").exists() and (model / "images.txt").exists():
        print_note(f"{model} has text files, too. As COLMAP does, the binary files are read.")
    with common.connect() as client, progress_bar() as progress:
        job = wait_for_job(client, _start(client, poses, from_scratch), progress, "reconstructing")
        made = client.reconstruction()
    if common.as_json:
        print_json({**made.as_json(), "result": job.result})
        return
    _print_reconstruction(made, job.result or {})
    if made.proposals:
        print_note(
            f"The coordinates of {made.proposals} photos disagree with it. Reconstruction under "
            "Advanced on the page proposes other ones."
        )


def _parse_origin(text: str) -> Origin:
    try:
        return TypeAdapter(Origin).validate_python(tuple(text.split(",")))
    except ValidationError as error:
        raise InvalidRequest(
            "bad_origin",
            f"--origin {text!r:.50} is no latitude, longitude and altitude: send degrees, degrees "
            "and metres, such as 45.0693,7.6853,241.5.",
        ) from error


def _start(client: Client, poses: ColmapModel | None, from_scratch: bool) -> UUID:
    """Start the job; without a model, return one that is running, as this command has left it."""
    if poses is not None:
        return client.import_reconstruction(poses.model_dump(mode="json")).job_id
    try:
        return client.reconstruct(from_scratch=from_scratch).job_id
    except Conflict as error:
        if error.code != "reconstruction_running":
            raise
        print_note("The map is being reconstructed already: waiting for that job.")
        return UUID(error.extra["job_id"])


def _print_reconstruction(made: Reconstruction, result: Json) -> None:
    table = Table(
        "component",
        Column("photos", justify="right"),
        Column("points", justify="right"),
        Column("error", justify="right", no_wrap=True),
        Column("localised", justify="right", no_wrap=True),
        "alignment",
    )
    for each in made.components:
        share = each.calibration["share_found"] if each.calibration else None
        table.add_row(
            str(each.number),
            str(each.photos),
            str(each.points),
            f"{each.mean_reprojection_error_pixels:.2f} px",
            "" if share is None else format_percent(share),
            escape(each.not_aligned or _format_alignment(each)),
        )
    print_table(table)
    print_message(
        f"{result['reconstructed']} of {result['photos']} photos are in {len(made.components)} "
        "components."
    )
    if names := result.get("unmatched_names"):
        shown = first_names(names, MAX_NAMES_SHOWN)
        print_note(
            f"{result['unmatched']} names of the model are not those of exactly one photo of the "
            f"map: {shown}"
        )
    if left_out := result["left_out_photos"]:
        print_note(f"{result['left_out']} photos are in no component.")
        for reason in sorted({each["reason"] for each in left_out}):
            names = [each["name"] for each in left_out if each["reason"] == reason]
            print_note(f"{reason}: {first_names(names, MAX_NAMES_SHOWN)}")


def _format_alignment(component: Component) -> str:
    if not component.located:
        return "at the given origin"
    text = (
        f"{component.alignment_rms_m:.2f} m from the coordinates of {component.agreeing} of "
        f"{component.located} photos"
    )
    return f"{text}; on a line, turned as upright cameras are" if component.is_on_line else text
