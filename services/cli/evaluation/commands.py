"""`placewise evaluate`: how often the right place comes first, in a live map or on a data set.

`placewise compare DIR --extractors a,b,c`: recall, time and size of several descriptors.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from services.cli.environment import require_packages
from services.cli.output import JsonOption, KeyOption, MapOption, ServerOption, report_errors
from shared.errors import InvalidRequest

OptionValues = dict[str, object]

SIZE_PATTERN = re.compile(r"([1-9][0-9]{1,3})[x ]([1-9][0-9]{1,3})")


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """Where results go and what they show."""

    out: Path | None
    against: Path | None
    pairs: Path | None
    depth: int
    grids: int
    only_wrong: bool
    faiss_gpu: bool
    as_json: bool


def evaluate(
    data: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            file_okay=False,
            help="Evaluate a data set instead of a live map: a folder that `datasets check` knows. "
            "With --predictions: where the photos of the lists lie.",
        ),
    ] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", help="Of --data; may be repeated. Left out: all of them."),
    ] = None,
    protocol: Annotated[
        str | None, typer.Option(help="How the set is put together: msls-official, vme, ...")
    ] = None,
    rule: Annotated[
        str | None,
        typer.Option(help="Who is right: `radius 25`, `heading 25 40`, `frames 5`, `place-label`."),
    ] = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="Of `placewise train`: F.ckpt."),
    ] = None,
    image_size: Annotated[
        str,
        typer.Option(
            help="Of --checkpoint: `same` as in training, `native`, or HEIGHTxWIDTH in pixels."
        ),
    ] = "same",
    extractor: Annotated[
        str | None, typer.Option(help="By name, with options as in EXTRACTOR.")
    ] = None,
    vocabulary: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="Of VLAD: .npz, .npy or c_centers.pt."),
    ] = None,
    fit_vocabulary: Annotated[
        bool,
        typer.Option(
            "--fit-vocabulary",
            help="Of VLAD: learn one from the database's own photos, as where none is shipped.",
        ),
    ] = False,
    predictions: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="(queries, k) database indices, .npy: what was found."
        ),
    ] = None,
    ground_truth: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="With --predictions: what is right, .npy."),
    ] = None,
    database: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="With --predictions: the photos' names, .npy or text."
        ),
    ] = None,
    queries: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="With --predictions: the queries' names."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for predictions, metrics.json and report.html."),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(
            exists=True, file_okay=False, help="--out of another run: what was won and lost."
        ),
    ] = None,
    pairs: Annotated[
        Path | None,
        typer.Option(dir_okay=False, help="File for the pairs found, as hloc reads them."),
    ] = None,
    depth: Annotated[
        int, typer.Option(min=1, max=1000, help="Database photos ranked for each query.")
    ] = 20,
    grids: Annotated[
        int, typer.Option(min=0, max=500, help="Queries of a kind that the report shows.")
    ] = 12,
    only_wrong: Annotated[
        bool, typer.Option("--only-wrong", help="The report shows no query that was right.")
    ] = False,
    faiss_gpu: Annotated[
        bool, typer.Option("--faiss-gpu", "--faiss_gpu", help="Search on the GPU.")
    ] = False,
    sample: Annotated[
        int | None,
        typer.Option(min=1, help="Of a live map: photos to ask with; default 1000."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of a live map.")] = None,
    word_weights: Annotated[
        bool,
        typer.Option(
            "--word-weights",
            help="Of a live map: first learn which words of the vocabulary tell the map's places "
            "apart, and keep their weights where recall rises.",
        ),
    ] = False,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Ask a live map about its own photos; or with --data, evaluate on a data set.

    Without --data and --predictions: the map is asked about its own photos, each left out in turn,
    and about its labelled queries. With --data: a --checkpoint, an --extractor or a --server is
    asked about a data set.
    """
    wanted = ReportOptions(out, against, pairs, depth, grids, only_wrong, faiss_gpu, as_json)
    of_a_map: OptionValues = {"--sample": sample, "--seed": seed, "--word-weights": word_weights}
    of_photos: OptionValues = {
        "--checkpoint": checkpoint, "--extractor": extractor, "--vocabulary": vocabulary,
        "--fit-vocabulary": fit_vocabulary, "--protocol": protocol, "--rule": rule,
    }  # fmt: skip
    of_a_file: OptionValues = {
        "--ground-truth": ground_truth,
        "--database": database,
        "--queries": queries,
    }
    of_results: OptionValues = {"--out": out, "--against": against, "--pairs": pairs, "--set": sets}
    with report_errors(as_json):
        # Read when torch is loaded, which is below; see services/cli/__init__.py.
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        if predictions is not None:
            _reject_options("with --predictions", of_a_map | of_photos)
            if ground_truth is None:
                raise InvalidRequest("no_ground_truth", "Say what is right: --ground-truth GT.npy")
            require_packages()
            from services.cli.evaluation.results import evaluate_predictions

            evaluate_predictions(predictions, ground_truth, database, queries, data, sets, wanted)
            return
        if data is not None:
            _reject_options("with --data", of_a_map | of_a_file)
            require_packages()
            from services.cli.evaluation.data_sets import EvaluationTarget, evaluate_sets

            size = _parse_image_size(image_size, checkpoint)
            asking = EvaluationTarget(
                checkpoint, size, extractor, vocabulary, fit_vocabulary, server, map_name, key
            )
            evaluate_sets(data, sets, protocol, rule, asking, wanted)
            return
        _reject_options("without --data", of_photos | of_a_file | of_results)
        from services.cli.evaluation.live_map import evaluate_map

        evaluate_map(sample, seed, word_weights, map_name, server, key, as_json)


def _reject_options(context: str, options: OptionValues) -> None:
    given = [name for name, value in options.items() if value]
    if given:
        raise InvalidRequest("options_contradict", f"{', '.join(given)}: not {context}.")


def _parse_image_size(text: str, checkpoint: Path | None) -> str | tuple[int, int]:
    """`same`, `native` or (height, width) of `320x320`."""
    if checkpoint is None and text != "same":
        raise InvalidRequest(
            "options_contradict",
            "--image-size: only with --checkpoint; an extractor has its own preprocessing.",
        )
    if text in ("same", "native"):
        return text
    match = SIZE_PATTERN.fullmatch(text)
    if match is None:
        raise InvalidRequest(
            "bad_image_size", f"--image-size {text}: same, native or HEIGHTxWIDTH is needed."
        )
    return int(match[1]), int(match[2])


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
        from services.cli.evaluation.compare_extractors import compare_extractors

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
