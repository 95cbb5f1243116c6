"""`placewise evaluate` and `placewise compare`.

`evaluate` measures retrieval recall in a live map or on a data set. `compare` measures recall, time
and size of several extractors on one data set. This module parses options; the modules that do the
work import torch and are imported when they are needed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from services.cli.client import MapOptions
from services.cli.environment import require_packages
from services.cli.evaluate import SampleOption, SeedOption, evaluate_map
from services.cli.output import JsonOption, MapOption
from shared.errors import InvalidRequest
from shared.tracks.motion import parse_motion

OptionValues = dict[str, object]


def _existing_file(help_text: str) -> Any:
    return typer.Option(exists=True, dir_okay=False, help=help_text)


def _existing_folder(help_text: str) -> Any:
    return typer.Option(exists=True, file_okay=False, help=help_text)


ProtocolOption = Annotated[
    str | None, typer.Option(help="Evaluation protocol, such as msls-official or vme.")
]
RuleOption = Annotated[
    str | None,
    typer.Option(
        help="Positive-match criterion: `radius 25`, `heading 25 40`, `frames 5`, `place-label`."
    ),
]
FaissGpuOption = Annotated[
    bool, typer.Option("--faiss-gpu", help="Run the nearest neighbour search on the GPU.")
]

SIZE_PATTERN = re.compile(r"([1-9][0-9]{1,3})[x ]([1-9][0-9]{1,3})")


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """Output options of an evaluation."""

    out: Path | None
    against: Path | None
    pairs: Path | None
    depth: int
    ks: tuple[int, ...] | None
    """Values of k of the reported recall@k; None for `DEFAULT_KS`"""
    grids: int
    only_wrong: bool
    faiss_gpu: bool
    place_labels_are_paths: bool
    as_json: bool


def evaluate(
    common: MapOptions,
    data: Annotated[
        Path | None,
        _existing_folder(
            "Evaluate on a data set (see `datasets check`) instead of a live map. "
            "With --ground-truth: root folder of the listed photos."
        ),
    ] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", help="Set of --data. Can be repeated. Default: all sets."),
    ] = None,
    protocol: ProtocolOption = None,
    rule: RuleOption = None,
    checkpoint: Annotated[
        Path | None, _existing_file("Checkpoint of a trained or published network to evaluate.")
    ] = None,
    image_size: Annotated[
        str,
        typer.Option(
            help="With --checkpoint: `same` as in training, `native`, or HEIGHTxWIDTH in pixels."
        ),
    ] = "same",
    extractor: Annotated[
        str | None, typer.Option(help="Extractor to evaluate, with options as in EXTRACTOR.")
    ] = None,
    vocabulary: Annotated[
        Path | None, _existing_file("VLAD vocabulary: .npz, .npy or c_centers.pt.")
    ] = None,
    fit_vocabulary: Annotated[
        bool,
        typer.Option(
            "--fit-vocabulary",
            help="Fit the VLAD vocabulary on the database photos. Default if none is shipped.",
        ),
    ] = False,
    rows: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            metavar="DATABASE.npy QUERIES.npy",
            exists=True,
            dir_okay=False,
            help="With --data and one --set: evaluate your own descriptors, one row per photo in "
            "the order that `datasets list` prints.",
        ),
    ] = None,
    predictions: Annotated[
        Path | None, _existing_file("Evaluate predictions: (queries, k) database indices, .npy.")
    ] = None,
    ground_truth: Annotated[
        Path | None,
        _existing_file(
            "Ground truth of --predictions, or of the one --set of --data, .npy. If omitted: "
            "that of --data and --set."
        ),
    ] = None,
    database: Annotated[
        Path | None, _existing_file("With --predictions: names of database photos, .npy or text.")
    ] = None,
    queries: Annotated[Path | None, _existing_file("With --predictions: names of queries.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Output folder: predictions, metrics.json, report.html, tables, figures."
        ),
    ] = None,
    against: Annotated[
        Path | None, _existing_folder("Compare with another run, given by its --out folder.")
    ] = None,
    pairs: Annotated[
        Path | None,
        typer.Option(dir_okay=False, help="Output file of retrieval pairs in hloc's format."),
    ] = None,
    depth: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of database photos ranked per query.")
    ] = 20,
    recall_at: Annotated[
        str | None, typer.Option(help="Values of k of the reported recalls. Default: 1,5,10,20.")
    ] = None,
    grids: Annotated[
        int,
        typer.Option(
            min=0, max=500, help="Maximum number of example queries per category in the report."
        ),
    ] = 12,
    only_wrong: Annotated[
        bool, typer.Option("--only-wrong", help="Show only failed queries in the report.")
    ] = False,
    faiss_gpu: FaissGpuOption = False,
    sequences: Annotated[
        bool,
        typer.Option(
            "--sequences",
            help="With --data: follow the sequences of the sets (rides, MSLS, folders of seasons) "
            "frame by frame, instead of ranking single photos.",
        ),
    ] = False,
    motion: Annotated[
        str,
        typer.Option(
            help="With --sequences: walk, bicycle, car, train, or a maximum speed in m/s."
        ),
    ] = "car",
    place_labels_are_paths: Annotated[
        bool,
        typer.Option(
            "--place-labels-are-paths",
            help="With --data: `/` separates the levels of place labels.",
        ),
    ] = False,
    sample: SampleOption = None,
    seed: SeedOption = None,
) -> None:
    """Measure retrieval recall in a live map or on a data set.

    Without --data and --predictions, evaluate the map with its own photos (leave-one-out) and its
    labelled queries. With --data, evaluate a --checkpoint, an --extractor or --rows on a data set.
    With --predictions, evaluate a file of predictions.
    """
    map_options: OptionValues = {"--sample": sample, "--seed": seed, "--map": common.map_name}
    model_options: OptionValues = {
        "--checkpoint": checkpoint, "--extractor": extractor, "--vocabulary": vocabulary,
        "--fit-vocabulary": fit_vocabulary, "--protocol": protocol, "--rule": rule, "--rows": rows,
        "--place-labels-are-paths": place_labels_are_paths,
    }  # fmt: skip
    lists: OptionValues = {"--database": database, "--queries": queries}
    file_options = lists | {"--ground-truth": ground_truth}
    output_options: OptionValues = {
        "--out": out, "--against": against, "--pairs": pairs, "--set": sets,
        "--sequences": sequences, "--recall-at": recall_at,
    }  # fmt: skip
    report_options = ReportOptions(
        out, against, pairs, depth, _parse_recall_at(recall_at, depth), grids, only_wrong,
        faiss_gpu, place_labels_are_paths, common.as_json,
    )  # fmt: skip
    if predictions is not None:
        rules: OptionValues = {"--protocol": protocol, "--rule": rule}
        models = {name: value for name, value in model_options.items() if name not in rules}
        _reject_options("with --predictions", map_options | models)
        if len(sets or ()) > 1:
            raise InvalidRequest(
                "which_set", "A predictions file belongs to one set. Pass --set once."
            )
        require_packages()
        from lab.cli.evaluation.results import evaluate_predictions, read_evaluation_set
        from lab.datasets.open_dataset import open_evaluation_set

        set_name = sets[0] if sets else None
        if ground_truth is not None:
            _reject_options("with --ground-truth", rules)
            evaluation_set = read_evaluation_set(ground_truth, database, queries, data, set_name)
        elif data is None:
            raise InvalidRequest(
                "no_ground_truth",
                "--predictions requires the data set, --data DIR --set NAME, or a ground "
                "truth file, --ground-truth GT.npy.",
            )
        else:
            _reject_options("without --ground-truth", file_options)
            evaluation_set = open_evaluation_set(data, set_name, protocol=protocol, rule=rule)
        evaluate_predictions(predictions, evaluation_set, report_options)
        return
    if data is not None:
        _reject_options("with --data", map_options | lists)
        if ground_truth is not None:
            _reject_options("with --ground-truth", {"--rule": rule})
        require_packages()
        from lab.cli.evaluation.data_sets import EvaluationTarget, evaluate_sets

        size = _parse_image_size(image_size, checkpoint)
        target = EvaluationTarget(checkpoint, size, extractor, rows, vocabulary, fit_vocabulary)
        if sequences:
            from lab.cli.evaluation.sequences import evaluate_sequences

            unused: OptionValues = {
                "--out": out, "--pairs": pairs, "--recall-at": recall_at,
                "--ground-truth": ground_truth, "--rows": rows,
            }  # fmt: skip
            _reject_options("with --sequences", unused)
            speeds = parse_motion(motion)
            evaluate_sequences(data, sets, protocol, rule, target, speeds, common.as_json)
            return
        evaluate_sets(data, sets, protocol, rule, ground_truth, target, report_options)
        return
    _reject_options("without --data", model_options | file_options | output_options)
    evaluate_map(common, sample, seed)


def _reject_options(context: str, options: OptionValues) -> None:
    invalid = [name for name, value in options.items() if value]
    if invalid:
        raise InvalidRequest("options_contradict", f"{', '.join(invalid)} can't be used {context}.")


def _parse_recall_at(text: str | None, depth: int) -> tuple[int, ...] | None:
    """Parse values of k such as `1,5,10,15`."""
    if text is None:
        return None
    values = [part.strip() for part in text.split(",")]
    ks = {int(value) for value in values if value.isdecimal()}
    if len(ks) != len(values) or not 1 <= min(ks, default=0) <= max(ks) <= depth:
        raise InvalidRequest(
            "bad_recall_at",
            f"--recall-at must be different numbers from 1 to --depth ({depth}), separated by "
            f"commas, not {text}.",
        )
    return tuple(sorted(ks))


def _parse_image_size(text: str, checkpoint: Path | None) -> str | tuple[int, int]:
    """Parse `same`, `native`, or HEIGHTxWIDTH such as `320x320` to (height, width)."""
    if checkpoint is None and text != "same":
        raise InvalidRequest(
            "options_contradict",
            "--image-size requires --checkpoint. Extractors have their own preprocessing.",
        )
    if text in ("same", "native"):
        return text
    match = SIZE_PATTERN.fullmatch(text)
    if match is None:
        raise InvalidRequest(
            "bad_image_size", f"--image-size must be same, native or HEIGHTxWIDTH, not {text}."
        )
    return int(match[1]), int(match[2])


def compare(
    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="DIR",
            exists=True,
            file_okay=False,
            help="Data set with a database and queries. Default: a map, see --map.",
        ),
    ] = None,
    extractors: Annotated[
        str | None,
        typer.Option(
            help="DIR: comma-separated extractor names with options as in EXTRACTOR, or "
            "checkpoints (.ckpt, .pth). `+fit` fits the VLAD vocabulary on the database photos; "
            "`+pca512` reduces descriptors to 512 dimensions by PCA whitening."
        ),
    ] = None,
    set_name: Annotated[
        str | None, typer.Option("--set", help="Set of DIR. Required if there are several.")
    ] = None,
    protocol: ProtocolOption = None,
    rule: RuleOption = None,
    out: Annotated[Path | None, typer.Option(help="DIR: output folder for table.csv.")] = None,
    faiss_gpu: FaissGpuOption = False,
    extractor: Annotated[
        list[str] | None,
        typer.Option(
            "--extractor",
            metavar="NAME",
            help="Map: another extractor, such as torchscript:/PATH. Can be repeated.",
        ),
    ] = None,
    photos: Annotated[
        int, typer.Option("--photos", min=20, help="Map: number of photos that are described.")
    ] = 1000,
    map_name: MapOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare recall, speed and size of several extractors on one data set, or on a map.

    Descriptors of a data set are cached in PLACEWISE_HOME/descriptors: a repeated run describes
    only what is missing. On a map of this machine, those whose weights are here are compared.
    """
    if data is None:
        from lab.cli.evaluation.compare_on_map import compare_on_map

        options = {"--set": set_name, "--protocol": protocol, "--rule": rule, "--out": out}
        _reject_options("without DIR", {"--extractors": extractors, **options})
        compare_on_map(map_name, extractor, photos, as_json)
        return
    if extractors is None:
        raise InvalidRequest("bad_extractors", "A data set requires --extractors.")
    require_packages()
    from lab.cli.evaluation.compare_extractors import compare_extractors

    compare_extractors(
        data, extractors, set_name=set_name, protocol=protocol, rule=rule, out=out,
        faiss_gpu=faiss_gpu, as_json=as_json,
    )  # fmt: skip
