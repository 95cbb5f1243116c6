"""`placewise bench search`: its data, its comparison with brute force, and a whole tiny run."""

from __future__ import annotations

import json
from pathlib import Path
from uuid import UUID

import numpy as np
from rich.progress import Progress
from typer.testing import CliRunner

from lab.benchmarks.report import Report
from lab.benchmarks.search import (
    MATCHED_CASE,
    PLACEWISE,
    Ranking,
    SearchMethod,
    compare_methods,
    placewise_search,
    same_ranking,
)
from lab.benchmarks.synthetic_map import SyntheticCity, create_synthetic_map, required_memory_bytes
from services.cli.main import build_app
from services.search.snapshot import Snapshot
from services.search.worker import SearchWorker
from shared.storage.chunks import Row

IDS = [UUID(int=number + 1) for number in range(6)]


def test_another_order_another_photo_another_score_and_a_missing_one_are_no_right_answers() -> None:
    truth = [(IDS[0], 0.9), (IDS[1], 0.8)]
    assert same_ranking([(IDS[0], 0.9 + 1e-12), (IDS[1], 0.8)], truth)
    for found in (
        [(IDS[1], 0.8), (IDS[0], 0.9)],
        [(IDS[0], 0.9), (IDS[2], 0.8)],
        [(IDS[0], 0.9 + 1e-8), (IDS[1], 0.8)],
        [(IDS[0], 0.9)],
        [*truth, (IDS[2], 0.1)],
        [],
    ):
        assert not same_ranking(found, truth)
    assert same_ranking([(IDS[0], 0.91), (IDS[1], 0.81)], truth, tolerance=np.inf)
    assert not same_ranking([(IDS[1], 0.81), (IDS[0], 0.91)], truth, tolerance=np.inf)


def test_whole_run_finds_no_wrong_answer_and_measures_everything(tmp_path: Path) -> None:
    ended = CliRunner().invoke(
        build_app(["bench"]),
        [
            *["bench", "search", "--photos", "60", "--dimensions", "7168", "--queries", "2"],
            *["--folder", str(tmp_path), "--json"],
        ],
    )
    report = json.loads(ended.stdout)
    figures = {figure["what"]: figure["measured"] for figure in report["figures"]}
    assert figures["60 x 7,168: wrong results of Placewise"] == 0
    assert figures["cold: wrong results"] == 0
    (comparison,) = report["comparisons"]
    assert len(comparison["rows"]) == 4 * 5
    assert not any(row["wrong"] for row in comparison["rows"])
    assert not list(tmp_path.iterdir()), "what was made is removed"


def test_a_wrong_answer_of_ours_is_a_missed_figure(tmp_path: Path) -> None:
    def with_last_two_exchanged(worker: SearchWorker, snapshot: Snapshot) -> SearchMethod:
        right = placewise_search(worker, snapshot)

        def search(query: Row, k: int) -> Ranking:
            found = list(right(query, k))
            return [*found[:-2], *reversed(found[-2:])]

        return search

    city, report = SyntheticCity(512, 1), Report("anything")
    budget = required_memory_bytes(60, city.dimension)
    with (
        create_synthetic_map(tmp_path, city.dimension, search_memory_budget=budget) as world,
        Progress(disable=True) as progress,
    ):
        for rows in city.chunks(60, 60):
            world.add(rows)
        compare_methods(report, world, city, 2, progress, with_last_two_exchanged)
    assert report.missed
    (compared,) = report.details["comparisons"]
    assert {"case": MATCHED_CASE.name, "method": PLACEWISE, "wrong": 2}.items() <= (
        compared["rows"][0].items()
    )
