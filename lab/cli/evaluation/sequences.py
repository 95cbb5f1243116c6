"""`placewise evaluate --data DIR --sequences`: single frames and tracks. Imports torch."""

from __future__ import annotations

import statistics
from pathlib import Path

import numpy as np
from rich.progress import Progress
from rich.table import Column

from lab.cli.evaluation.data_sets import EvaluationTarget, make_describer
from lab.datasets.dataset import EvaluationSet
from lab.datasets.open_dataset import evaluation_set_names, open_evaluation_set
from lab.evaluation.ranking import describe_evaluation_set
from lab.evaluation.sequences import (
    FrameResult,
    evaluate_sequence,
    prepare_map,
    sequence_figures,
    split_sequences,
)
from services.cli.environment import read_settings
from services.cli.output import (
    Json,
    Table,
    format_percent,
    print_json,
    print_message,
    print_table,
    progress_bar,
    stage_bars,
)
from shared.errors import InvalidRequest, NotFound
from shared.tracks.motion import MotionModel

METHODS = {
    "single": "single frames",
    "filter": "filter",
    "smoothed": "filter, forward and backward",
}


def evaluate_sequences(
    data: Path,
    names: list[str] | None,
    protocol: str | None,
    rule: str | None,
    target: EvaluationTarget,
    motion: MotionModel,
    as_json: bool,
) -> None:
    """Evaluate tracks on the sets below `data` that have sequences.

    Raises NotFound (`no_evaluation_set`, `no_sequences`), InvalidRequest (`options_contradict`,
    `no_model`), and errors of opening the sets.
    """
    target.check()
    if target.checkpoint is None and target.extractor is None:
        raise InvalidRequest(
            "options_contradict", "--sequences requires --checkpoint or --extractor."
        )
    figures: dict[str, Json] = {}
    with progress_bar() as progress:
        for name in names or evaluation_set_names(data):
            evaluation_set = open_evaluation_set(data, name, protocol=protocol, rule=rule)
            if split_sequences(evaluation_set.queries):
                figures[name] = _evaluate_set(evaluation_set, target, motion, progress)
    if not figures:
        raise NotFound(
            "no_sequences",
            f"No evaluation set in {data} has sequences. They need `rides/`, two folders of "
            "seasons, MSLS, or the columns `sequence` and `frame` of a CSV.",
        )
    if as_json:
        print_json({"motion": motion.name, "sets": figures})
        return
    for name, result in figures.items():
        _print_figures(name, result)


def _evaluate_set(
    evaluation_set: EvaluationSet,
    target: EvaluationTarget,
    motion: MotionModel,
    progress: Progress,
) -> Json:
    describer = make_describer(evaluation_set, target, read_settings(), progress)
    on_progress = stage_bars(progress, f"{evaluation_set.name}: ")
    with describe_evaluation_set(describer.describe, evaluation_set, on_progress) as matrices:
        database, queries = map(np.array, matrices)
    map_ = prepare_map(evaluation_set, database, motion)
    sequences: list[list[FrameResult]] = []
    milliseconds: list[float] = []
    members_of = split_sequences(evaluation_set.queries)
    for done, members in enumerate(members_of, start=1):
        frames, seconds = evaluate_sequence(map_, evaluation_set, members, queries[members], motion)
        sequences.append(frames)
        milliseconds.append(1000 * seconds)
        on_progress("tracking", done, len(members_of))
    by_sequence = {
        str(evaluation_set.queries[members[0]].sequence): sequence_figures([frames])
        for members, frames in zip(members_of, sequences, strict=True)
    }
    return {
        "rule": evaluation_set.rule,
        "database": len(database),
        "filter_ms_a_frame": statistics.fmean(milliseconds),
        **sequence_figures(sequences),
        "sequences": by_sequence,
    }


def _print_figures(name: str, figures: Json) -> None:
    print_message(
        f"{name}: {figures['frames']} frames ({figures['frames_outside']} outside the map) against "
        f"{figures['database']} photos; {figures['rule']}; "
        f"{figures['filter_ms_a_frame']:.1f} ms of CPU time a frame."
    )
    table = Table(
        "method", Column("recall", justify="right"), Column("at 99 % precision", justify="right")
    )
    for key, title in METHODS.items():
        precise = figures["recall_at_99_precision"].get(key)
        table.add_row(title, format_percent(figures["recall"][key]), format_percent(precise))
    print_table(table)
    rows = {
        "frames in the map with the status tracking": format_percent(figures["tracking"]),
        "right among them": format_percent(figures["tracking_precision"]),
        "calibration error (ECE)": f"{figures['calibration_error']:.3f}",
        "frames to localise": _frame_counts(figures["frames_to_localise"]),
        "frames to notice that the map was left": _frame_counts(figures["frames_to_notice_lost"]),
        "frames outside with the status tracking": format_percent(figures["claimed_outside"]),
    }
    table = Table("tracking", Column("value", justify="right"))
    for title, value in rows.items():
        table.add_row(title, value)
    print_table(table)


def _frame_counts(counts: list[int | None]) -> str:
    return ", ".join("never" if count is None else str(count) for count in counts) or "-"
