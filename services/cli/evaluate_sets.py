"""`placewise evaluate --data DIR`: a checkpoint, an extractor or a server asked about data sets.

Imports torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import Progress

from services.cli.configuration import read_settings
from services.cli.describe_sets import (
    Describer,
    checkpoint_describer,
    extractor_describer,
)
from services.cli.evaluate import ReportOptions
from services.cli.evaluate_output import check_output_folders, evaluate_rankings, output_results
from services.cli.evaluate_server import evaluate_server
from services.cli.output import progress_bar
from services.trainer.evaluation.recalls import DEFAULT_KS, ProgressCallback, evaluate_recall
from services.trainer.evaluation.result import EvaluationResult, EvaluationRun
from shared.datasets.sets import EvaluationSet, evaluation_set_names, open_evaluation_set
from shared.errors import InvalidRequest, NotFound
from shared.recipes import get_extractor_config
from shared.settings import Settings


@dataclass(frozen=True, slots=True)
class EvaluationTarget:
    """Who is asked."""

    checkpoint: Path | None
    image_size: str | tuple[int, int]
    extractor: str | None
    vocabulary: Path | None
    fit_vocabulary: bool
    server: str | None
    map_name: str | None
    key: str | None

    def check(self) -> None:
        """Exactly one; InvalidRequest (`options_contradict`, `no_model`)."""
        if self.checkpoint is not None and self.extractor is not None:
            raise InvalidRequest("options_contradict", "--checkpoint and --extractor: give one.")
        if self.extractor is None and (self.vocabulary is not None or self.fit_vocabulary):
            raise InvalidRequest(
                "options_contradict", "--vocabulary, --fit-vocabulary: only with --extractor."
            )
        if self.vocabulary is not None and self.fit_vocabulary:
            raise InvalidRequest("options_contradict", "--vocabulary and --fit-vocabulary: one.")
        if self.checkpoint is None and self.extractor is None and self.server is None:
            raise InvalidRequest(
                "no_model",
                "Say what is to be evaluated: --checkpoint F.ckpt, --extractor NAME or "
                "--server URL.",
            )


def evaluate_sets(
    data: Path,
    names: Sequence[str] | None,
    protocol: str | None,
    rule: str | None,
    target: EvaluationTarget,
    options: ReportOptions,
) -> None:
    """Evaluate the named sets below `data`, or all of them. Raises as what it calls does."""
    target.check()
    check_output_folders(options)
    settings = read_settings()
    chosen = names or evaluation_set_names(data)
    if not chosen:
        raise NotFound("no_evaluation_set", f"{data} holds no set to evaluate on.")
    asked = [open_evaluation_set(data, n, protocol=protocol, rule=rule) for n in chosen]
    results: list[EvaluationResult] = []
    run: EvaluationRun | None = None
    with progress_bar() as progress:
        for one in asked:
            if target.checkpoint is None and target.extractor is None:
                result, run = _evaluate_on_server(one, target, options, progress)
            else:
                describer = _make_describer(one, target, settings, progress)
                result = _evaluate_describer(one, describer, options, progress)
                run = EvaluationRun(describer.name, describer.fingerprint, describer.about)
            results.append(result)
    assert run is not None, "there is a set"
    output_results(run, results, options)


def _make_describer(
    evaluation_set: EvaluationSet, target: EvaluationTarget, settings: Settings, progress: Progress
) -> Describer:
    if target.checkpoint is not None:
        return checkpoint_describer(target.checkpoint, target.image_size, settings)
    assert target.extractor is not None
    recipe = get_extractor_config(
        target.extractor, allow_test_extractors=settings.allow_test_extractors
    )
    return extractor_describer(
        recipe,
        target.vocabulary,
        [shot.path for shot in evaluation_set.database],
        settings,
        progress,
        fit=target.fit_vocabulary,
    )


def _evaluate_describer(
    evaluation_set: EvaluationSet, describer: Describer, options: ReportOptions, progress: Progress
) -> EvaluationResult:
    told = progress_bars(progress, evaluation_set.name)
    describer.describe.on_lookup = lambda done, most: told("known photos", done, most)
    found = evaluate_recall(
        describer.describe,
        evaluation_set,
        ks=[*(k for k in DEFAULT_KS if k <= options.depth), options.depth],
        faiss_gpu=options.faiss_gpu,
        on_progress=told,
    )
    about: dict[str, Any] = {
        "dimension": found.dimension,
        "bytes_a_photo": 4 * found.dimension,
        "describe_ms_a_photo": describer.describe.milliseconds_a_photo(),
    }
    return evaluate_rankings(evaluation_set, found.ranked, options, has_scores=True, about=about)


def _evaluate_on_server(
    evaluation_set: EvaluationSet,
    target: EvaluationTarget,
    options: ReportOptions,
    progress: Progress,
) -> tuple[EvaluationResult, EvaluationRun]:
    ranked, run, about = evaluate_server(
        evaluation_set, target.server, target.map_name, target.key, options.depth, progress
    )
    return evaluate_rankings(evaluation_set, ranked, options, has_scores=True, about=about), run


def progress_bars(progress: Progress, name: str) -> ProgressCallback:
    """Bars for each thing that is done about a set."""
    bars: dict[str, Any] = {}

    def told(what: str, done: int, most: int) -> None:
        if what not in bars:
            bars[what] = progress.add_task(f"{name}: {what}", total=most)
        progress.update(bars[what], completed=done, total=most)

    return told
