"""`placewise bench search`: its data, its comparison with brute force, and a whole tiny run."""

from __future__ import annotations

import json
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
from rich.progress import Progress
from typer.testing import CliRunner

from lab.benchmarks.report import Report
from lab.benchmarks.search import (
    MATCHED_CASE,
    PLACEWISE,
    BruteForce,
    Ranking,
    SearchMethod,
    compare_methods,
    measure_growth,
    placewise_search,
    same_ranking,
)
from lab.benchmarks.synthetic_map import (
    BLOCKS,
    SyntheticCity,
    create_synthetic_map,
    required_memory_bytes,
)
from services.cli.main import build_app
from services.search.snapshot import Snapshot
from services.search.worker import SearchWorker
from shared.storage.chunks import Row, Rows

IDS = [UUID(int=number + 1) for number in range(6)]


def rows_of(seed: int, count: int, dimension: int = 64) -> Rows:
    rows = np.random.default_rng(seed).standard_normal((count, dimension))
    found: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return found


def test_descriptors_have_the_structure_of_vlad() -> None:
    city = SyntheticCity(7168, seed=3)
    rows = np.concatenate(list(city.chunks(1300, 500)))
    assert rows.shape == (1300, 7168)
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-6)
    lengths = np.linalg.norm(rows.reshape(-1, BLOCKS, 112), axis=2)
    words = (lengths > 0).sum(axis=1)
    assert 42 < np.median(words) < 50
    assert words.max() > words.min() + 10
    np.testing.assert_allclose(lengths.max(axis=1) ** 2 * words, 1, atol=1e-4)
    strangers = rows[:250] @ rows[500:750].T
    assert 0.07 < strangers.mean() < 0.12
    assert 0.02 < strangers.std() < 0.05
    best = -np.sort(-(city.revisits(1300, 30) @ rows.T), axis=1)
    assert 0.5 < np.median(best[:, 0]) < 0.7
    assert 0.3 < np.median(best[:, 9]) < 0.55
    best = -np.sort(-(city.out_of_map_rows(20) @ rows.T), axis=1)
    assert best[:, 9].max() < 0.25


def test_brute_force_orders_equal_photos_by_their_ids() -> None:
    rows = rows_of(1, 6)
    rows[4] = rows[1]
    oracle = BruteForce((rows[:4], rows[4:]), IDS, rows[1:2] * np.float32(3))
    best = oracle.best(0, 2)
    assert [photo_id for photo_id, _ in best] == [IDS[1], IDS[4]]
    assert best[0][1] == pytest.approx(1, abs=1e-6)


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


def test_growth_is_measured_by_the_size_of_the_map() -> None:
    report = Report("anything")
    with Progress(disable=True) as progress:
        measure_growth(report, progress, sizes=[3000])
    figures = {figure.what: figure.measured for figure in report.figures}
    assert figures["growth: scan of 3,000 codes, p50"] > 0


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
