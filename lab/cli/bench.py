"""`placewise bench`: run the benchmarks of a checkout.

The benchmark programs are in `lab/benchmarks/` and start their own PostgreSQL, Redis and S3
servers. A benchmark that misses its target exits with code 1.
"""

from __future__ import annotations

import functools
import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from services.cli.output import JsonOption, print_json, print_table, progress_bar
from shared.errors import Misconfigured

app = typer.Typer(help="Run benchmarks on this machine.", no_args_is_help=True)

DEV_PACKAGES = (
    "lab",
    "tests",
    "faiss",
    "psutil",
    "pytest",
    "testcontainers",
    "threadpoolctl",
)


def _parse_integers(text: str) -> list[int]:
    try:
        numbers = sorted({int(part) for part in text.split(",")})
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not a list of integers such as 1,2,4") from None
    if numbers[0] < 1:
        raise typer.BadParameter("numbers must be at least 1")
    return numbers


def _integers_option(help_text: str, *names: str) -> Any:
    return typer.Option(
        *names, help=f"{help_text}, comma-separated.", parser=_parse_integers, metavar="INTEGERS"
    )


BatchOption = Annotated[int, typer.Option(min=1, help="Maximum batch size.")]
DeviceOption = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Device.")]
ExtractorOption = Annotated[str, typer.Option(help="Extractor name, with options as in EXTRACTOR.")]
PlacesOption = Annotated[int, typer.Option(min=20, help="Number of places in the generated city.")]
SimulatedWorkOption = Annotated[int, typer.Option(min=0, help="Simulated work per photo.")]


def _benchmark(module: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a command that passes its options to `lab.benchmarks.MODULE.measure`.

    The decorated function declares the options and the help.
    """

    def register(declaration: Callable[..., None]) -> Callable[..., None]:
        @app.command(declaration.__name__.replace("_", "-"))
        @functools.wraps(declaration)
        def run(as_json: bool, **options: Any) -> None:
            _run_benchmark(module, as_json, **options)

        return run

    return register


@_benchmark("spine")
def spine(
    photos: Annotated[int, typer.Option(min=2)] = 200,
    queries: Annotated[int, typer.Option(min=1)] = 50,
    as_json: JsonOption = False,
) -> None:
    """Measure upload, description and query latency of an embedded server."""


@_benchmark("scaling")
def scaling(
    workers: Annotated[Any, _integers_option("Numbers of extractor processes")] = "1,2,4,8",
    photos: Annotated[int, typer.Option(min=1, help="Photos per extractor.")] = 60,
    milliseconds: SimulatedWorkOption = 500,
    batch: BatchOption = 4,
    as_json: JsonOption = False,
) -> None:
    """Measure how throughput scales with extractors, and check that no photo is done twice."""


@_benchmark("pipeline")
def pipeline(
    widths: Annotated[Any, _integers_option("Descriptor dimensions")] = "7168,98304",
    photos: Annotated[int, typer.Option(min=1)] = 320,
    batch: BatchOption = 32,
    rounds: Annotated[int, typer.Option(min=1, help="Upload rounds per gateway.")] = 5,
    as_json: JsonOption = False,
) -> None:
    """Measure CPU time per photo outside the model, and upload throughput."""


@_benchmark("descriptors.extract")
def extract(
    extractor: ExtractorOption = "anyloc-vits14",
    photos: Annotated[int, typer.Option(min=1)] = 32,
    device: DeviceOption = "auto",
    precision: Annotated[
        Literal["auto", "float32", "bfloat16"], typer.Option(help="Precision.")
    ] = "auto",
    batches: Annotated[Any, _integers_option("Maximum batch sizes", "--batch")] = "16",
    rounds: Annotated[int, typer.Option(min=1, help="Passes over all photos per method.")] = 3,
    as_json: JsonOption = False,
) -> None:
    """Compare extraction throughput with AnyLoc as published and with the device's peak.

    Without local weights, random weights are used, and the title of the report says so.
    """


@_benchmark("descriptors.precision")
def precision(
    extractor: ExtractorOption = "efficientnet-lite0-vlad",
    places: Annotated[
        int, typer.Option(min=2, help="Number of places in the generated city.")
    ] = 60,
    queries: Annotated[int, typer.Option(min=1)] = 60,
    device: DeviceOption = "auto",
    batch: BatchOption = 16,
    as_json: JsonOption = False,
) -> None:
    """Compare patches, descriptors and recall in bfloat16 with those in float32."""


@_benchmark("descriptors.train")
def train(
    places: PlacesOption = 300,
    epochs: Annotated[int, typer.Option(min=1)] = 20,
    image_size: Annotated[
        int, typer.Option(min=32, help="Image height and width in pixels.")
    ] = 112,
    photos: Annotated[
        int, typer.Option(min=64, help="Photos for the throughput measurement.")
    ] = 512,
    workers: Annotated[int, typer.Option(min=1, help="Data loader processes.")] = 2,
    device: Annotated[Literal["auto", "cpu", "gpu", "mps"], typer.Option(help="Device.")] = "auto",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the city and the network.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure training throughput, data loading stalls and the recall that training achieves."""


@_benchmark("places.estimates")
def estimates(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Evaluation sets with coordinates or places. Default: tower in "
            "PLACEWISE_TEST_DATA.",
            exists=True,
        ),
    ] = None,
    splits: Annotated[int, typer.Option(min=0, help="Random splits of each set.")] = 5,
    as_json: JsonOption = False,
) -> None:
    """Measure how often place estimates answer, how often they are right, and their calibration."""


@_benchmark("query_latency")
def query_latency(
    backlog: Annotated[int, typer.Option(min=1, help="Number of queued uploads.")] = 5000,
    seconds: Annotated[float, typer.Option(min=1, help="Duration of the measurement.")] = 60,
    milliseconds: SimulatedWorkOption = 50,
    batch: BatchOption = 16,
    as_json: JsonOption = False,
) -> None:
    """Measure query latency while thousands of uploads are queued."""


@_benchmark("descriptors.rerank")
def rerank(
    places: PlacesOption = 150,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the city.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure recall@1 and latency with `rerank=10`, 25 and 50.

    With PLACEWISE_TEST_DATA, also report the ranks of true places for real photos.
    """


@app.command("search")
def search(
    photos: Annotated[Any, _integers_option("Numbers of photos in the map")] = "2000",
    dimensions: Annotated[
        Any, _integers_option("Descriptor dimensions, multiples of 64")
    ] = "512,7168,98304",
    queries: Annotated[int, typer.Option(min=2, help="Queries of each kind.")] = 20,
    growth: Annotated[
        bool, typer.Option("--growth", help="Also scan the sign codes of up to a million photos.")
    ] = False,
    load: Annotated[
        float,
        typer.Option(
            "--load", min=0, help="Duration of a load test with 32 concurrent clients, in seconds."
        ),
    ] = 0,
    full: Annotated[
        bool,
        typer.Option("--long", help="Use 1,000, 5,000 and 10,000 photos, --growth and --load 60."),
    ] = False,
    folder: Annotated[
        Path | None,
        typer.Option(
            exists=True, file_okay=False, help="Folder for the map; requires 4 GB of disk."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare search latency with NumPy, faiss and full chunk reads, and check the results."""
    _run_benchmark(
        "search",
        as_json,
        photos=[1000, 5000, 10_000] if full else photos,
        dimensions=dimensions,
        queries=queries,
        growth=growth or full,
        load_seconds=load or (60.0 if full else 0.0),
        folder=folder,
    )


@_benchmark("search.rivals")
def rivals(
    photos: Annotated[int, typer.Option(min=100, help="Number of photos in the map.")] = 10_000,
    dimension: Annotated[
        int, typer.Option(min=64, help="Descriptor dimension, a multiple of 64.")
    ] = 98_304,
    pca: Annotated[
        int,
        typer.Option(
            min=2, max=4000, help="Dimension for engines that can't index whole descriptors."
        ),
    ] = 1024,
    queries: Annotated[int, typer.Option(min=2)] = 50,
    folder: Annotated[
        Path | None,
        typer.Option(
            exists=True, file_okay=False, help="Folder for the files; 9 GB for 10,000 photos."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare search with faiss, Qdrant, LanceDB and pgvector.

    Requires more packages: uv pip install --group rivals
    """


@_benchmark("catalog.command")
def catalog(
    photos: Annotated[int, typer.Option(min=100_000, help="Number of rows to create.")] = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Check that no statement of the services scans a large table sequentially.

    Creates a temporary database on the server of DATABASE_URL and drops it at the end.
    """


@_benchmark("chaos")
def chaos(
    photos: Annotated[
        int, typer.Option(min=30, help="Photos to upload while services are killed.")
    ] = 2000,
    fault_seconds: Annotated[float, typer.Option(min=0.1, help="Duration of each outage.")] = 30,
    seed: Annotated[int, typer.Option(help="Seed of the order and times of faults.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Kill every service and server in turn; check that nothing is lost, duplicated or stuck."""


@_benchmark("rolling")
def rolling(as_json: JsonOption = False) -> None:
    """Restart every service in turn; check that no request fails and no job is lost."""


@_benchmark("slow_clients")
def slow_clients(
    seconds: Annotated[float, typer.Option(min=1, help="Duration of each phase.")] = 30,
    idle: Annotated[int, typer.Option(min=0, help="Number of idle connections.")] = 1100,
    bodies: Annotated[
        int, typer.Option(min=0, help="Number of uploads at one byte per second.")
    ] = 32,
    streams: Annotated[int, typer.Option(min=0, help="Number of event streams.")] = 500,
    as_json: JsonOption = False,
) -> None:
    """Measure the latency of other calls under slow clients.

    The server's limit of open files is 1,024.
    """


@app.command("scale")
def scale(
    inputs: Annotated[
        list[str] | None,
        typer.Option("--set", help="Override an input, such as price_gpu_hour=2. Can be repeated."),
    ] = None,
    measured: Annotated[
        bool, typer.Option("--measure", help="Measure inputs on this machine where possible.")
    ] = False,
    page: Annotated[
        Path | None,
        typer.Option(
            "--markdown",
            exists=True,
            dir_okay=False,
            help="Update the tables of this page (docs/scale.md).",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Estimate machines, storage and cost for 10 thousand, 1 million and 100 million photos."""
    if page is not None and (inputs or measured):
        raise typer.BadParameter("edit the inputs in the page instead of --set or --measure")
    program = _load_benchmark("scale")
    values = program.measure_inputs() if measured else {}
    values |= program.parse_assignments(inputs or [])
    sizing = program.Sizing(values, page.read_text(encoding="utf-8") if page else None)
    if page is not None:
        page.write_text(sizing.updated_page(), encoding="utf-8")
    if as_json:
        print_json(sizing.as_json())
    elif page is None:
        for table in sizing.terminal_tables():
            print_table(table)


def _run_benchmark(name: str, as_json: bool, **options: Any) -> None:
    # Must be set before torch is loaded; see services/cli/__init__.py.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    program = _load_benchmark(name)
    with progress_bar() as progress:
        report = program.measure(progress, **options)
    if as_json:
        print_json(report.as_json())
    else:
        for table in (*report.tables, report.table()):
            print_table(table)
    if report.missed:
        raise typer.Exit(1)


def _load_benchmark(name: str) -> Any:
    """Import `lab.benchmarks.NAME`; Misconfigured (`no_benchmarks`) if a dev package is missing."""
    try:
        return importlib.import_module(f"lab.benchmarks.{name}")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in DEV_PACKAGES:
            raise
        raise Misconfigured(
            "no_benchmarks",
            "`placewise bench` requires a checkout of Placewise with the dev extra: "
            f"{error}. In the checkout, run make setup, then .venv/bin/placewise bench.",
        ) from error
