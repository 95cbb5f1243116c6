"""Several descriptors on one data set: what each finds, takes and weighs. Imports torch."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import Progress
from rich.table import Column, Table

from services.cli.configuration import read_settings
from services.cli.describe_sets import (
    Describer,
    describer_of_checkpoint,
    describer_of_extractor,
)
from services.cli.evaluate_sets import told_by
from services.cli.output import answers, print_json, progress_bar, shown
from services.trainer.evaluation.bootstrap import Difference, paired
from services.trainer.evaluation.clusters import clusters_of
from services.trainer.evaluation.measure import Measured, measure
from services.trainer.evaluation.nearest import nearest
from services.trainer.evaluation.pareto import pareto_front
from services.trainer.evaluation.recalls import KS, rows_of_set
from services.trainer.evaluation.report.comparison import Compared, comparison_page
from services.trainer.evaluation.whiten import whiten
from services.trainer.evaluation.write import versions
from shared.datasets.sets import EvaluationSet, open_evaluation_set
from shared.errors import InvalidRequest, Misconfigured
from shared.recipes import MOST_PCA, get_recipe
from shared.settings import Settings
from shared.vision.extractors import choose_device

FLOAT32_BYTES = 4
PCA = re.compile(r"pca([1-9][0-9]{0,4})")


@dataclass(frozen=True, slots=True)
class Entry:
    """One descriptor of a comparison."""

    written: str
    name: str
    """an extractor's name with its options, or a checkpoint's path"""
    fit: bool = False
    pca: int | None = None


def read_entries(text: str) -> list[Entry]:
    """`a,b:layer=9,facet=key+pca512,run.ckpt` -> three; InvalidRequest (`bad_extractors`)."""
    parts: list[str] = []
    for part in text.split(","):
        # A comma also separates the options of one extractor.
        if parts and "=" in part.partition("+")[0] and ":" in parts[-1] and ":" not in part:
            parts[-1] += "," + part
        else:
            parts.append(part.strip())
    return [_entry(part) for part in parts]


def _entry(written: str) -> Entry:
    name, *additions = written.split("+")
    fit, pca = False, None
    for addition in additions:
        match = PCA.fullmatch(addition)
        if addition == "fit":
            fit = True
        elif match and int(match[1]) <= MOST_PCA:
            pca = int(match[1])
        else:
            raise InvalidRequest(
                "bad_extractors",
                f"{written}: +{addition} is not known. There are +fit, and +pcaN to N dimensions, "
                f"up to {MOST_PCA}.",
            )
    if not name:
        raise InvalidRequest("bad_extractors", f"--extractors: {written!r} names no extractor.")
    return Entry(written, name, fit, pca)


def compare_extractors(
    data: Path,
    extractors: str,
    *,
    set_name: str | None,
    protocol: str | None,
    rule: str | None,
    out: Path | None,
    faiss_gpu: bool,
    as_json: bool,
) -> None:
    """Raises as reading the set, loading the extractors and describing does."""
    entries = read_entries(extractors)
    settings = read_settings()
    _check(entries, settings, out)
    asked = open_evaluation_set(data, set_name, protocol=protocol, rule=rule)
    clusters = clusters_of(asked.queries)
    found: list[tuple[Compared, Measured]] = []
    with progress_bar() as progress:
        for entry in entries:
            about, measured = _measure(entry, asked, settings, faiss_gpu, progress)
            first = found[0][1] if found else None
            difference: Difference | None = None
            if first is not None:
                (difference,) = paired(measured.within[:, :1], first.within[:, :1], clusters.of)
            found.append((Compared(entry.written, measured, difference, **about), measured))
    compared = [one for one, _ in found]
    report = _as_json(asked, compared)
    if out is not None:
        _write(out, report, comparison_page(asked, compared))
    if as_json:
        print_json(report)
        return
    _print(asked, compared)
    if out is not None:
        answers.print(shown(out / "report.html"), soft_wrap=True, markup=False)


def _check(entries: Sequence[Entry], settings: Settings, out: Path | None) -> None:
    """All names, before the first of them takes its hours."""
    for entry in entries:
        if entry.name.endswith(".ckpt"):
            if not Path(entry.name).is_file():
                raise InvalidRequest("bad_extractors", f"There is no checkpoint {entry.name}.")
            if entry.fit:
                raise InvalidRequest(
                    "bad_extractors", f"{entry.written}: a checkpoint has no vocabulary to fit."
                )
            continue
        recipe = get_recipe(entry.name, allow_test_extractors=settings.allow_test_extractors)
        if entry.fit and not recipe.needs_vocabulary:
            raise InvalidRequest(
                "bad_extractors", f"{entry.written}: {recipe.name} uses no vocabulary to fit."
            )
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Misconfigured(
                "out_unwritable", f"{out} can't be written: {error.strerror}."
            ) from error


def _measure(
    entry: Entry, asked: EvaluationSet, settings: Settings, faiss_gpu: bool, progress: Progress
) -> tuple[dict[str, Any], Measured]:
    describer = _describer(entry, asked, settings, progress)
    told = told_by(progress, entry.written)
    with rows_of_set(describer.describe, asked, told=told) as (database, queries):
        took = describer.describe.milliseconds_a_photo()
        if entry.pca is not None:
            short = whiten(database, queries, entry.pca, choose_device(settings.device), told)
            database, queries = short.database, short.queries
            took = None if took is None else took + short.milliseconds_a_photo
        ranked = nearest(
            queries,
            database,
            max(KS),
            faiss_gpu=faiss_gpu,
            told=lambda done, most: told("search", done, most),
        )
        dimension = database.shape[1]
    measured = measure(
        ranked.indices, asked.positives, clusters_of(asked.queries), scores=ranked.scores
    )
    return {
        "dimension": dimension,
        "bytes_a_photo": FLOAT32_BYTES * dimension,
        "milliseconds_a_photo": took,
        "fingerprint": describer.fingerprint,
        "device": str(describer.about.get("device", "")),
    }, measured


def _describer(
    entry: Entry, asked: EvaluationSet, settings: Settings, progress: Progress
) -> Describer:
    if entry.name.endswith(".ckpt"):
        return describer_of_checkpoint(Path(entry.name), "same", settings)
    recipe = get_recipe(entry.name, allow_test_extractors=settings.allow_test_extractors)
    database = [shot.path for shot in asked.database]
    return describer_of_extractor(recipe, None, database, settings, progress, fit=entry.fit)


def _as_json(asked: EvaluationSet, compared: Sequence[Compared]) -> dict[str, Any]:
    recalls = [one.recall_at_1 for one in compared]
    by_size = pareto_front([one.bytes_a_photo for one in compared], recalls)
    by_time = pareto_front([one.milliseconds for one in compared], recalls)
    return {
        "set": asked.name,
        "protocol": asked.protocol,
        "rule": asked.rule,
        "fingerprint": asked.fingerprint,
        "versions": versions(),
        "extractors": [
            {**one.as_json(), "pareto_by_size": size, "pareto_by_time": duration}
            for one, size, duration in zip(compared, by_size, by_time, strict=True)
        ],
    }


def _write(out: Path, report: dict[str, Any], page: str) -> None:
    try:
        text = json.dumps(report, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        (out / "comparison.json").write_text(text, encoding="utf-8")
        (out / "report.html").write_text(page, encoding="utf-8")
    except OSError as error:
        raise Misconfigured(
            "out_unwritable", f"{out} can't be written: {error.strerror}."
        ) from error


def _print(asked: EvaluationSet, compared: Sequence[Compared]) -> None:
    ks = list(compared[0].measured.recalls.of_all)
    columns = (*(f"R@{k}" for k in ks), "95 % of R@1", "ms", "bytes", "against the first")
    table = Table(asked.name, *(Column(name, justify="right", no_wrap=True) for name in columns))
    for one in compared:
        interval = one.measured.recall_intervals
        table.add_row(
            one.name,
            *(f"{100 * share:.1f}" for share in one.measured.recalls.of_all.values()),
            f"{100 * interval[0].low:.1f} to {100 * interval[0].high:.1f}" if interval else "-",
            "-" if one.milliseconds_a_photo is None else f"{one.milliseconds_a_photo:.1f}",
            f"{one.bytes_a_photo:,}",
            one.against_first(),
        )
    answers.print(table)
    clusters = compared[0].measured.clusters
    answers.print(
        f"Right: {asked.rule}; protocol {asked.protocol}; fingerprint {asked.fingerprint[:16]}; "
        f"intervals over {clusters.count} {clusters.kind}. ms: network and aggregation of one "
        "photo, measured when its row was made. bytes: float32.",
        soft_wrap=True,
        markup=False,
    )
