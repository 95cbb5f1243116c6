"""`placewise compare DIR --extractors a,b,c`: recall, time and size of several descriptors."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from services.cli.output import JsonOption, report_errors
from services.cli.trainer_packages import require_packages


def compare(
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", exists=True, file_okay=False, help="A data set: database and queries."
        ),
    ],
    extractors: Annotated[
        str,
        typer.Option(
            help="Separated by commas: names with options as in EXTRACTOR, or checkpoints (.ckpt); "
            "`+fit` learns VLAD's vocabulary from the database's own photos, `+pca512` shortens "
            "rows to 512 dimensions.",
        ),
    ],
    set_name: Annotated[
        str | None, typer.Option("--set", help="Which set of DIR, where it has several.")
    ] = None,
    protocol: Annotated[str | None, typer.Option(help="How the set is put together.")] = None,
    rule: Annotated[
        str | None,
        typer.Option(help="Who is right: `radius 25`, `heading 25 40`, `frames 5`, `place-label`."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for comparison.json and report.html.")
    ] = None,
    faiss_gpu: Annotated[
        bool, typer.Option("--faiss-gpu", "--faiss_gpu", help="Search on the GPU.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Describe one data set with each extractor, and print what each finds and takes.

    Rows are kept below PLACEWISE_HOME/descriptors: after an interruption, or with one extractor
    more, only what is missing is described.
    """
    # Read when torch is loaded, which is below; see services/cli/__init__.py.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with report_errors(as_json):
        require_packages()
        from services.cli.compare_extractors import compare_extractors

        compare_extractors(
            data,
            extractors,
            set_name=set_name,
            protocol=protocol,
            rule=rule,
            out=out,
            faiss_gpu=faiss_gpu,
            as_json=as_json,
        )
