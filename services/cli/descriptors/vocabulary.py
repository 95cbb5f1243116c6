"""`placewise vocabulary fit|import|export|list`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated
from uuid import UUID

import typer
from rich.progress import Progress
from rich.table import Column, Table

from services.cli.client import connect, wait_for_job
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    atomic_write,
    console,
    print_failures,
    print_json,
    printable_path,
    progress_bar,
    report_errors,
)
from shared.client import Client, Json
from shared.errors import InvalidRequest
from shared.extractor_config.configs import MAX_CLUSTERS

app = typer.Typer(help="VLAD's cluster centres: fit them on the map's own photos, import, list.")


@app.command("fit")
def fit(
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DIR]",
            exists=True,
            file_okay=False,
            help="Learn from the photos below it instead of the map's, without a server.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.npz", help="With DIR: what to write.")
    ] = None,
    extractor: Annotated[
        str | None, typer.Option(help="With DIR: by name; default: the one of new maps.")
    ] = None,
    clusters: Annotated[
        int | None,
        typer.Option(min=1, max=MAX_CLUSTERS, help="Cluster centres; default: the extractor's."),
    ] = None,
    sample: Annotated[
        int | None, typer.Option(min=1, help="Photos to learn from at most; default 1000.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=2**31 - 1)] = None,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Learn a vocabulary from the map's photos, describe all of them anew, switch.

    With DIR: learn it from a folder, and write it to a file that `import` takes.
    """
    with report_errors(as_json):
        if folder is not None:
            # Not --server and --key: the environment may hold them for all commands.
            _reject_options("a map", {"--map": map_name})
            if out is None:
                raise InvalidRequest("bad_out", "Say where to write: --out FILE.npz")
            _fit_folder(folder, out, extractor, clusters, sample, seed, as_json)
            return
        _reject_options("a folder (vocabulary fit DIR)", {"--out": out, "--extractor": extractor})
        wanted = {"clusters": clusters, "sample": sample, "seed": seed}
        given = {name: value for name, value in wanted.items() if value is not None}
        with connect(server, map_name, key) as client, progress_bar() as progress:
            job = fit_and_wait(client, given, progress)
        _print_generation(job, as_json)


@app.command("import")
def import_(
    file: Annotated[
        Path,
        typer.Argument(
            exists=True,
            dir_okay=False,
            help=".npz of `vocabulary fit DIR`, .npy, or AnyLoc's c_centers.pt",
        ),
    ],
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring a vocabulary, describe all photos with it, switch."""
    from shared.descriptors.vocabulary_file import read_vocabulary  # torch takes seconds

    with report_errors(as_json):
        brought = read_vocabulary(file)
        with (
            tempfile.TemporaryDirectory() as folder,
            connect(server, map_name, key) as client,
            progress_bar() as progress,
        ):
            checked = Path(folder, f"{file.stem}{brought.suffix}")
            checked.write_bytes(brought.encode())
            started = client.import_vocabulary(checked)
            job = wait_for_job(client, started["job_id"], progress, "vocabulary")
        _print_generation(job, as_json)


@app.command("export")
def export(
    vocabulary_id: Annotated[str, typer.Argument(metavar="ID", help="As `vocabulary list` says.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE.npz", help="What to write: `import` takes it.")
    ],
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write one of the map's vocabularies to a file: .npz, or .npy where its origin is unknown."""
    with report_errors(as_json):
        _validate_id(vocabulary_id)
        with connect(server, map_name, key) as client:
            data = client.vocabulary_file(vocabulary_id)
        suffix = ".npz" if data.startswith(b"PK") else ".npy"
        if out.suffix != suffix:
            raise InvalidRequest(
                "bad_out", f"{printable_path(out)}: this vocabulary's file ends in {suffix}."
            )
        with atomic_write(out) as file:
            file.write(data)
        if as_json:
            print_json(
                {"file": printable_path(out), "vocabulary_id": vocabulary_id, "bytes": len(data)}
            )
            return
        console.print(f"{printable_path(out)}: {len(data)} bytes.", soft_wrap=True, markup=False)


@app.command("list")
def list_(
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """The map's vocabularies, newest first; the one that answers is marked."""
    with report_errors(as_json):
        with connect(server, map_name, key) as client:
            found = client.vocabularies()
            answering = {
                g["vocabulary_id"]: g for g in client.generations() if g["state"] == "active"
            }
        active = answering.keys()
        if as_json:
            print_json([{**v, "active": v["vocabulary_id"] in active} for v in found])
            return
        # Ids are folded, never cut: they are there to be copied.
        name = Column("vocabulary", overflow="fold", min_width=36)
        table = Table("", name, "origin", "clusters", "dimension", "photos", "made")
        for v in found:
            table.add_row(
                "*" if v["vocabulary_id"] in active else "",
                f"{v['vocabulary_id']}\n{_format_provenance(v['provenance'])}\nsha256 "
                f"{v['sha256'][:12]}" + _format_pca(answering.get(v["vocabulary_id"])),
                v["origin"],
                str(v["clusters"]),
                str(v["dimension"]),
                str(v["provenance"].get("photos", "")),
                v["created_at"],
            )
        console.print(table)


def _validate_id(vocabulary_id: str) -> None:
    """InvalidRequest (`bad_id`): what is no id would be another path."""
    try:
        UUID(vocabulary_id)
    except ValueError:
        raise InvalidRequest(
            "bad_id", f"{vocabulary_id!r} is no vocabulary's id; `vocabulary list` shows them."
        ) from None


def _format_provenance(provenance: Json) -> str:
    if "backbone" not in provenance:
        return "of unknown origin"
    pixels = provenance["preprocessing"]
    parts = (provenance["backbone"], provenance["layer"], provenance["facet"], pixels["name"])
    return " ".join(str(part) for part in parts if part is not None)


def _format_pca(generation: Json | None) -> str:
    if generation is None or generation["pca_from"] is None:
        return ""
    return f"\nPCA: {generation['dimension']} of {generation['pca_from']} dimensions"


def _reject_options(source: str, options: dict[str, object]) -> None:
    """InvalidRequest (`options_contradict`) where one is given."""
    if wrong := [name for name, value in options.items() if value is not None]:
        raise InvalidRequest(
            "options_contradict", f"{', '.join(wrong)}: only for a fit on {source}."
        )


def _fit_folder(
    folder: Path,
    out: Path,
    extractor: str | None,
    clusters: int | None,
    sample: int | None,
    seed: int | None,
    as_json: bool,
) -> None:
    from services.cli.descriptors.local_fit import fit_vocabulary_on_folder  # torch takes seconds

    with progress_bar() as progress:
        fitted = fit_vocabulary_on_folder(
            folder,
            out,
            extractor=extractor,
            clusters=clusters,
            sample=sample,
            seed=seed,
            progress=progress,
        )
    if as_json:
        print_json(fitted)
        return
    print_failures(fitted, "refused")
    about = fitted["provenance"]
    console.print(
        f"{fitted['file']}: {fitted['clusters']} clusters of {fitted['dimension']} dimensions from "
        f"{about['photos']} photos, mean cosine {about['mean_cosine']:.4f}.",
        soft_wrap=True,
        markup=False,
    )


def fit_and_wait(client: Client, parameters: dict[str, int], progress: Progress) -> Json:
    """Fit on the map's photos and wait until the new generation answers."""
    return wait_for_job(
        client, client.fit_vocabulary(**parameters)["job_id"], progress, "vocabulary"
    )


def _print_generation(job: Json, as_json: bool) -> None:
    if as_json:
        print_json(job)
        return
    result = job["result"]
    console.print(
        f"Generation {result['generation_id']} answers: {result['photos']} photos, "
        f"{result['clusters']} clusters, {result['failed']} failed.",
        soft_wrap=True,
    )
