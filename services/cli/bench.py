"""`placewise bench`: what this machine does, and whether it is what is wanted.

The measuring programs lie in `benchmarks/` of a checkout: they start PostgreSQL, Redis and an S3
store of their own. One that misses a wanted figure ends with exit code 1.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Annotated, Any

import typer

from services.cli.output import JsonOption, console, print_json, progress_bar, report_errors
from shared.errors import Misconfigured

app = typer.Typer(help="Measure this machine.", no_args_is_help=True)

DeviceOption = Annotated[str, typer.Option("--device", help="auto, cpu or cuda.")]

DEV_PACKAGES = (
    "benchmarks",
    "tests",
    "faiss",
    "psutil",
    "pytest",
    "testcontainers",
    "threadpoolctl",
)


@app.command("spine")
def spine(
    photos: Annotated[int, typer.Option(min=2)] = 200,
    queries: Annotated[int, typer.Option(min=1)] = 50,
    as_json: JsonOption = False,
) -> None:
    """How long do upload, description and both kinds of query take on an embedded server?"""
    _run_benchmark("spine", as_json, photos=photos, queries=queries)


@app.command("scaling")
def scaling(
    workers: Annotated[str, typer.Option(help="Numbers of extractors.")] = "1,2,4,8",
    photos: Annotated[int, typer.Option(min=1, help="For each extractor.")] = 60,
    milliseconds: Annotated[int, typer.Option(min=0, help="Slept for each photo.")] = 500,
    batch: Annotated[int, typer.Option(min=1, help="Most photos in one batch.")] = 4,
    as_json: JsonOption = False,
) -> None:
    """Do more extractors describe as many more photos, and none of them twice?"""
    numbers = _parse_integers(workers)
    _run_benchmark(
        "scaling", as_json, workers=numbers, photos=photos, milliseconds=milliseconds, batch=batch
    )


@app.command("pipeline")
def pipeline(
    widths: Annotated[str, typer.Option(help="Dimensions of the descriptors.")] = "7168,98304",
    photos: Annotated[int, typer.Option(min=1)] = 320,
    batch: Annotated[int, typer.Option(min=1, help="Most photos in one batch.")] = 32,
    rounds: Annotated[int, typer.Option(min=1, help="Of uploads to either gateway.")] = 5,
    as_json: JsonOption = False,
) -> None:
    """How much CPU time does a photo take around the model, and how fast are uploads?"""
    _run_benchmark(
        "pipeline",
        as_json,
        widths=_parse_integers(widths),
        photos=photos,
        batch=batch,
        rounds=rounds,
    )


@app.command("extract")
def extract(
    extractor: Annotated[
        str, typer.Option("--extractor", help="By name, with options as in EXTRACTOR.")
    ] = "anyloc-vits14",
    photos: Annotated[int, typer.Option(min=1)] = 32,
    device: DeviceOption = "auto",
    precision: Annotated[
        str, typer.Option(help="auto, float32 or bfloat16, as PRECISION.")
    ] = "auto",
    batch: Annotated[int, typer.Option(min=1, help="Most photos in one batch.")] = 16,
    rounds: Annotated[int, typer.Option(min=1, help="Of all photos, by either way.")] = 3,
    as_json: JsonOption = False,
) -> None:
    """How fast do photos become descriptors, beside AnyLoc as published and this device's ceiling?

    Without weights on this machine, random ones are measured, and the title says so.
    """
    _check_choice(device, "--device", "auto", "cpu", "cuda")
    _check_choice(precision, "--precision", "auto", "float32", "bfloat16")
    _run_benchmark(
        "extract",
        as_json,
        extractor=extractor,
        photos=photos,
        device=device,
        precision=precision,
        batch=batch,
        rounds=rounds,
    )


@app.command("precision")
def precision(
    extractor: Annotated[
        str, typer.Option("--extractor", help="By name, with options as in EXTRACTOR.")
    ] = "efficientnet-lite0-vlad",
    places: Annotated[int, typer.Option(min=2, help="Of the generated city.")] = 60,
    queries: Annotated[int, typer.Option(min=1)] = 60,
    device: DeviceOption = "auto",
    batch: Annotated[int, typer.Option(min=1, help="Most photos in one batch.")] = 16,
    as_json: JsonOption = False,
) -> None:
    """What does bfloat16 change of patches, descriptors and recall, against float32?"""
    _check_choice(device, "--device", "auto", "cpu", "cuda")
    _run_benchmark(
        "precision",
        as_json,
        extractor=extractor,
        places=places,
        queries=queries,
        device=device,
        batch=batch,
    )


@app.command("train")
def train(
    places: Annotated[int, typer.Option(min=20, help="Of the generated city.")] = 300,
    epochs: Annotated[int, typer.Option(min=1)] = 20,
    image_size: Annotated[int, typer.Option(min=32, help="Pixels of a side.")] = 112,
    photos: Annotated[int, typer.Option(min=64, help="For the figures of speed.")] = 512,
    workers: Annotated[int, typer.Option(min=1, help="Processes that read photos.")] = 2,
    device: Annotated[str, typer.Option("--device", help="auto, cpu, gpu or mps.")] = "auto",
    grid: Annotated[
        bool, typer.Option("--grid", help="Three aggregators x two losses as well.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the city and the network.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """How fast is training, does it wait for photos, and is what it learns real?"""
    _check_choice(device, "--device", "auto", "cpu", "gpu", "mps")
    _run_benchmark(
        "train",
        as_json,
        places=places,
        epochs=epochs,
        image_size=image_size,
        photos=photos,
        workers=workers,
        device=device,
        grid=grid,
        seed=seed,
    )


@app.command("query-latency")
def query_latency(
    backlog: Annotated[int, typer.Option(min=1, help="Uploads that wait.")] = 5000,
    seconds: Annotated[float, typer.Option(min=1, help="How long queries are asked.")] = 60,
    milliseconds: Annotated[int, typer.Option(min=0, help="Slept for each photo.")] = 50,
    batch: Annotated[int, typer.Option(min=1, help="Most photos in one batch.")] = 16,
    as_json: JsonOption = False,
) -> None:
    """How long does a query photo take while thousands of uploads wait?"""
    _run_benchmark(
        "query_latency",
        as_json,
        backlog=backlog,
        seconds=seconds,
        milliseconds=milliseconds,
        batch=batch,
    )


@app.command("rerank")
def rerank(
    places: Annotated[int, typer.Option(min=20, help="Of a generated city.")] = 150,
    seed: Annotated[int, typer.Option(min=0, help="Which city.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """How often does the right place come first with `rerank=10`, 25 and 50, and what does it take?

    With PLACEWISE_TEST_DATA also the ranks of the true places of real photos.
    """
    _run_benchmark("rerank", as_json, places=places, seed=seed)


@app.command("search")
def search(
    photos: Annotated[str, typer.Option(help="Numbers of photos in the map.")] = "2000",
    dimensions: Annotated[
        str, typer.Option(help="Of the descriptors; multiples of 64.")
    ] = "512,7168,98304",
    queries: Annotated[int, typer.Option(min=2, help="Of each kind.")] = 20,
    growth: Annotated[
        bool, typer.Option("--growth", help="Scan the codes of up to a million photos.")
    ] = False,
    load: Annotated[
        float, typer.Option("--load", min=0, help="Seconds that 32 clients ask at once.")
    ] = 0,
    everything: Annotated[
        bool,
        typer.Option("--long", help="1,000, 5,000 and 10,000 photos, --growth, --load 60."),
    ] = False,
    folder: Annotated[
        Path | None,
        typer.Option(exists=True, file_okay=False, help="Where the map is made: 4 GB of disk."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """How fast is search, next to NumPy, faiss and reading every chunk, and is it ever wrong?"""
    _run_benchmark(
        "search",
        as_json,
        photos=_parse_integers("1000,5000,10000" if everything else photos),
        dimensions=_parse_integers(dimensions),
        queries=queries,
        growth=growth or everything,
        load_seconds=load or (60.0 if everything else 0.0),
        folder=folder,
    )


@app.command("catalog")
def catalog(
    photos: Annotated[int, typer.Option(min=100_000, help="Rows to make.")] = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Does any statement of the services read a large table from end to end?

    Fills a database of its own on the server of DATABASE_URL, and drops it in the end.
    """
    with report_errors(as_json):
        program = _load_benchmark("catalog.command")
    program.bench_catalog(photos, as_json)


@app.command("chaos")
def chaos(
    photos: Annotated[int, typer.Option(min=30, help="Uploaded while parts die.")] = 2000,
    fault_seconds: Annotated[
        float, typer.Option(min=0.1, help="How long a part stays away, where that has a length.")
    ] = 30,
    seed: Annotated[int, typer.Option(help="Decides the order and the moments.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Is anything lost, doubled, stuck or wrong while every part dies, one after the other?"""
    _run_benchmark("chaos", as_json, photos=photos, fault_seconds=fault_seconds, seed=seed)


@app.command("rolling")
def rolling(as_json: JsonOption = False) -> None:
    """Is a request refused or a job lost while every service is restarted, one after the other?"""
    _run_benchmark("rolling", as_json)


@app.command("slow-clients")
def slow_clients(
    seconds: Annotated[float, typer.Option(min=1, help="Of each phase.")] = 30,
    idle: Annotated[int, typer.Option(min=0, help="Connections that send nothing.")] = 1100,
    bodies: Annotated[int, typer.Option(min=0, help="Uploads of a byte a second.")] = 32,
    streams: Annotated[int, typer.Option(min=0, help="Event streams.")] = 500,
    as_json: JsonOption = False,
) -> None:
    """How long do other calls take while clients are slow on purpose? The server may open 1,024
    files."""
    _run_benchmark(
        "slow_clients", as_json, seconds=seconds, idle=idle, bodies=bodies, streams=streams
    )


@app.command("scale")
def scale(
    given: Annotated[
        list[str] | None,
        typer.Option("--set", help="An input, as price_gpu_hour=2; may be repeated."),
    ] = None,
    measured: Annotated[
        bool, typer.Option("--measure", help="Measure on this machine what it can tell.")
    ] = False,
    page: Annotated[
        Path | None,
        typer.Option(
            "--markdown",
            exists=True,
            dir_okay=False,
            help="Renew this page's tables: docs/scale.md",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """What do 10 thousand, 1 million and 100 million photos take: machines, bytes, money?"""
    with report_errors(as_json):
        program = _load_benchmark("scale")
        found = None
        if measured:
            with progress_bar() as progress:
                found = program.measure(progress)
        sizing = program.size_up(given or [], found)
        if page is not None:
            page.write_text(sizing.put_into(page.read_text(encoding="utf-8")), encoding="utf-8")
    if as_json:
        print_json(sizing.as_json())
    elif page is None:
        for sheet in sizing.sheets():
            console.print(sheet.table())


def _run_benchmark(name: str, as_json: bool, **options: Any) -> None:
    # As the command does before torch is loaded; see services/cli/__init__.py.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with report_errors(as_json):
        program = _load_benchmark(name)
        with progress_bar() as progress:
            report = program.measure(progress, **options)
    if as_json:
        print_json(report.as_json())
    else:
        for table in (*report.tables, report.table()):
            console.print(table)
    if report.missed:
        raise typer.Exit(1)


def _load_benchmark(name: str) -> Any:
    """The module `benchmarks.NAME`. Misconfigured (`no_benchmarks`) where it can't be loaded."""
    try:
        return importlib.import_module(f"benchmarks.{name}")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in DEV_PACKAGES:
            raise
        raise Misconfigured(
            "no_benchmarks",
            f"`placewise bench {name}` needs a checkout of Placewise with the dev extra: {error}. "
            "In the checkout: make setup, then .venv/bin/placewise bench.",
        ) from error


def _check_choice(value: str, option: str, *allowed: str) -> None:
    if value not in allowed:
        raise typer.BadParameter(f"{option} is one of {', '.join(allowed)}, not {value!r}")


def _parse_integers(text: str) -> list[int]:
    try:
        found = sorted({int(part) for part in text.split(",")})
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no list such as 1,2,4") from None
    if found[0] < 1:
        raise typer.BadParameter("numbers from 1 up")
    return found
