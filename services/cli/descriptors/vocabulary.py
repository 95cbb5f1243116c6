"""`placewise vocabulary`: fit, import, export and list VLAD vocabularies."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated
from uuid import UUID

import typer
from rich.table import Column

from placewise.answers import Generation, Job
from placewise.protocol import drop_none
from services.cli.client import MapOptions, active_generation, wait_for_job
from services.cli.option_groups import CommandGroup
from services.cli.output import (
    Json,
    Table,
    atomic_write,
    print_result,
    printable_path,
    progress_bar,
)
from shared.errors import InvalidRequest
from shared.extractor_config.configs import DEFAULT_SAMPLE_PHOTOS, MAX_CLUSTERS

app = CommandGroup(help="Manage VLAD vocabularies (cluster centres): fit, import, export, list.")


@app.command("fit")
def fit(
    common: MapOptions,
    clusters: Annotated[
        int | None,
        typer.Option(
            min=1, max=MAX_CLUSTERS, help="Number of cluster centres. Default: the extractor's."
        ),
    ] = None,
    sample: Annotated[
        int | None,
        typer.Option(
            min=1, help=f"Maximum number of photos to fit on. Default: {DEFAULT_SAMPLE_PHOTOS}."
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=2**31 - 1, help="Random seed.")] = None,
) -> None:
    """Fit a vocabulary on the map's photos, reindex them, and switch to the result."""
    parameters = drop_none(clusters=clusters, sample=sample, seed=seed)
    with common.connect() as client, progress_bar() as progress:
        job = wait_for_job(client, client.fit_vocabulary(**parameters), progress, "vocabulary")
    _print_generation(job, common.as_json)


@app.command("import")
def import_(
    common: MapOptions,
    file: Annotated[
        Path,
        typer.Argument(
            exists=True,
            dir_okay=False,
            help=".npz of `vocabulary export`, .npy, or AnyLoc's c_centers.pt",
        ),
    ],
) -> None:
    """Import a vocabulary, reindex the map with it, and switch to the result."""
    from shared.descriptors.vocabulary_file import read_vocabulary  # imports torch

    vocabulary = read_vocabulary(file)
    with (
        tempfile.TemporaryDirectory() as folder,
        common.connect() as client,
        progress_bar() as progress,
    ):
        normalised_file = Path(folder, f"{file.stem}{vocabulary.suffix}")
        normalised_file.write_bytes(vocabulary.encode())
        started = client.import_vocabulary(normalised_file)
        job = wait_for_job(client, started, progress, "vocabulary")
    _print_generation(job, common.as_json)


@app.command("export")
def export(
    common: MapOptions,
    vocabulary_id: Annotated[
        UUID, typer.Argument(metavar="ID", help="Vocabulary ID; see `vocabulary list`.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="FILE.npz", help="Output file, accepted by `import`.")
    ],
) -> None:
    """Write a vocabulary of the map to a file: .npz, or .npy if its provenance is unknown."""
    with common.connect() as client:
        data = client.vocabulary_file(vocabulary_id)
    suffix = ".npz" if data.startswith(b"PK") else ".npy"
    if out.suffix != suffix:
        raise InvalidRequest(
            "bad_out",
            f"{printable_path(out)}: the file name of this vocabulary must end in {suffix}.",
        )
    with atomic_write(out) as file:
        file.write(data)
    print_result(
        {"file": printable_path(out), "vocabulary_id": str(vocabulary_id), "bytes": len(data)},
        common.as_json,
        f"{printable_path(out)}: {len(data)} bytes.",
    )


@app.command("list")
def list_(common: MapOptions) -> None:
    """List the map's vocabularies, newest first. The active one is marked."""
    with common.connect() as client:
        vocabularies = client.vocabularies()
        active = active_generation(client)
    active_id = active and active.vocabulary_id
    # IDs are folded, not truncated, so that they can be copied.
    name = Column("vocabulary", overflow="fold", min_width=36)
    table = Table("active", name, "origin", "clusters", "dimension", "photos", "created")
    for v in vocabularies:
        is_active = v.vocabulary_id == active_id
        table.add_row(
            "*" if is_active else "",
            f"{v.vocabulary_id}\n{_format_provenance(v.provenance)}\nsha256 {v.sha256[:12]}"
            + _format_pca(active if is_active else None),
            v.origin,
            str(v.clusters),
            str(v.dimension),
            str(v.provenance.get("photos", "")),
            f"{v.created_at:%Y-%m-%d %H:%M:%S}",
        )
    listed = [{**v.as_json(), "active": v.vocabulary_id == active_id} for v in vocabularies]
    print_result(listed, common.as_json, table)


def _format_provenance(provenance: Json) -> str:
    if "backbone" not in provenance:
        return "of unknown origin"
    preprocessing = provenance["preprocessing"]
    parts = (*(provenance[key] for key in ("backbone", "layer", "facet")), preprocessing["name"])
    return " ".join(str(part) for part in parts if part is not None)


def _format_pca(generation: Generation | None) -> str:
    if generation is None or generation.pca_from is None:
        return ""
    return f"\nPCA: {generation.dimension} of {generation.pca_from} dimensions"


def _print_generation(job: Job, as_json: bool) -> None:
    result = job.result or {}
    print_result(
        job,
        as_json,
        f"Generation {result['generation_id']} is active: {result['photos']} photos, "
        f"{result['clusters']} clusters, {result['failed']} failed.",
    )
