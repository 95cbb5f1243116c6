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
    describer_of_checkpoint,
    describer_of_extractor,
)
from services.cli.evaluate import Wanted
from services.cli.evaluate_output import check_out, finish, result_of
from services.cli.evaluate_server import ask_server
from services.cli.output import progress_bar
from services.trainer.evaluation.recalls import KS, Told, recalls
from services.trainer.evaluation.result import Result, Run
from shared.datasets.sets import EvaluationSet, evaluation_set_names, open_evaluation_set
from shared.errors import InvalidRequest, NotFound
from shared.recipes import get_recipe
from shared.settings import Settings


@dataclass(frozen=True, slots=True)
class Asking:
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
    asking: Asking,
    wanted: Wanted,
) -> None:
    """Evaluate the named sets below `data`, or all of them. Raises as what it calls does."""
    asking.check()
    check_out(wanted)
    settings = read_settings()
    chosen = names or evaluation_set_names(data)
    if not chosen:
        raise NotFound("no_evaluation_set", f"{data} holds no set to evaluate on.")
    asked = [open_evaluation_set(data, n, protocol=protocol, rule=rule) for n in chosen]
    results: list[Result] = []
    run: Run | None = None
    with progress_bar() as progress:
        for one in asked:
            if asking.checkpoint is None and asking.extractor is None:
                result, run = _by_server(one, asking, wanted, progress)
            else:
                describer = _describer(one, asking, settings, progress)
                result = _by_describer(one, describer, wanted, progress)
                run = Run(describer.name, describer.fingerprint, describer.about)
            results.append(result)
    assert run is not None, "there is a set"
    finish(run, results, wanted)


def _describer(
    asked: EvaluationSet, asking: Asking, settings: Settings, progress: Progress
) -> Describer:
    if asking.checkpoint is not None:
        return describer_of_checkpoint(asking.checkpoint, asking.image_size, settings)
    assert asking.extractor is not None
    recipe = get_recipe(asking.extractor, allow_test_extractors=settings.allow_test_extractors)
    return describer_of_extractor(
        recipe,
        asking.vocabulary,
        [shot.path for shot in asked.database],
        settings,
        progress,
        fit=asking.fit_vocabulary,
    )


def _by_describer(
    asked: EvaluationSet, describer: Describer, wanted: Wanted, progress: Progress
) -> Result:
    ks = [k for k in KS if k <= wanted.depth] + [wanted.depth]
    found = recalls(
        describer.describe,
        asked,
        ks=ks,
        faiss_gpu=wanted.faiss_gpu,
        told=told_by(progress, asked.name),
    )
    about: dict[str, Any] = {
        "dimension": found.dimension,
        "bytes_a_photo": 4 * found.dimension,
        "describe_ms_a_photo": describer.describe.milliseconds_a_photo(),
    }
    return result_of(asked, found.ranked, wanted, has_scores=True, about=about)


def _by_server(
    asked: EvaluationSet, asking: Asking, wanted: Wanted, progress: Progress
) -> tuple[Result, Run]:
    ranked, run, about = ask_server(
        asked, asking.server, asking.map_name, asking.key, wanted.depth, progress
    )
    return result_of(asked, ranked, wanted, has_scores=True, about=about), run


def told_by(progress: Progress, name: str) -> Told:
    """Bars for each thing that is done about a set."""
    bars: dict[str, Any] = {}

    def told(what: str, done: int, most: int) -> None:
        if what not in bars:
            bars[what] = progress.add_task(f"{name}: {what}", total=most)
        progress.update(bars[what], completed=done)

    return told
