"""The command's tree."""

from __future__ import annotations

import logging

import typer

from services.cli import (
    ask,
    bench,
    configuration,
    datasets,
    doctor,
    evaluate,
    import_anyloc,
    index,
    maps,
    migrate,
    processes,
    search,
    serve,
    storage,
    vocabulary,
)

app = typer.Typer(
    name="placewise",
    help="Photo in, place out: visual place recognition on your own photos.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.command("serve")(serve.serve)
app.command("search")(search.search)
app.command("gateway")(processes.gateway)
app.command("extractor")(processes.extractor)
app.command("steward")(processes.steward)
app.command("migrate")(migrate.migrate)
app.command("index")(index.index)
app.command("import-anyloc")(import_anyloc.import_anyloc)
app.command("query")(ask.query)
app.command("evaluate")(evaluate.evaluate)
app.add_typer(maps.app, name="maps")
app.add_typer(vocabulary.app, name="vocabulary")
app.add_typer(datasets.app, name="datasets")
app.add_typer(storage.app, name="storage")
app.add_typer(bench.app, name="bench")
app.command("config")(configuration.config)
app.command("doctor")(doctor.doctor)


def run() -> None:
    """Parse the command line and do it."""
    logging.basicConfig(
        level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s: %(message)s"
    )
    app()
