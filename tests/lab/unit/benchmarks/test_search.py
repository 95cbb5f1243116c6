"""`placewise bench search`: its data, its comparison with brute force, and a whole tiny run."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
from rich.progress import Progress
from typer.testing import CliRunner

from lab.benchmarks.report import Report
from lab.benchmarks.search import measure
from lab.benchmarks.search.comparison import (
    MATCHED_CASE,
    compare_methods,
    load_worker,
    report_comparison,
)
from lab.benchmarks.search.growth import measure_growth
from lab.benchmarks.search.load import LoadOutcome, SearchObservation, count_wrong_answers
from lab.benchmarks.search.memory_traffic import count_bytes_read
from lab.benchmarks.search.methods import (
    BenchmarkQuery,
    BruteForce,
    PlacewiseSearch,
    Ranking,
    same_photos,
    same_ranking,
)
from lab.benchmarks.search.synthetic_map import (
    BLOCKS,
    SyntheticCity,
    SyntheticMap,
    create_synthetic_map,
    required_memory_bytes,
)
from lab.cli.bench import app
from services.search import catalog_sync
from shared.search_api.protocol import SearchHit, SearchResponse
from shared.storage.chunks import Rows

IDS = [UUID(int=number + 1) for number in range(6)]


def rows_of(seed: int, count: int, dimension: int = 64) -> Rows:
    rows = np.random.default_rng(seed).standard_normal((count, dimension))
    found: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return found


@contextlib.contextmanager
def world_of(
    home: Path, city: SyntheticCity, photos: int, chunk_rows: int
) -> Iterator[SyntheticMap]:
    budget = required_memory_bytes(photos, city.dimension)
    with create_synthetic_map(home, city.dimension, search_memory_budget=budget) as world:
        for rows in city.chunks(photos, chunk_rows):
            world.add(rows)
        yield world


def response_of(ranking: Ranking, version: int = 1) -> SearchResponse:
    return SearchResponse(
        hits=tuple(SearchHit(photo_id=photo_id, score=score) for photo_id, score in ranking),
        certificate="exhaustive",
        rows_scanned=6,
        rows_reranked=6,
        snapshot_version=version,
    )


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


def test_places_of_a_walk_are_shown_by_one_three_or_thirty_photos() -> None:
    city = SyntheticCity(7168, seed=3)
    for walk, count in enumerate((1, 3, 30)):
        looks = city.walk(walk).looks
        alike = np.einsum("nkd,nkd->n", looks[1:], looks[:-1]) / looks[0].size
        changes = np.flatnonzero(alike < 0.92) + 1
        assert np.all(changes % count == 0)
        assert len(changes) >= 249 // count - 1


def test_the_same_seed_makes_the_same_city_whatever_the_chunks() -> None:
    one = np.concatenate(list(SyntheticCity(512, 1).chunks(600, 100)))
    other = np.concatenate(list(SyntheticCity(512, 1).chunks(600, 1000)))
    np.testing.assert_array_equal(one, other)
    assert not np.array_equal(one, np.concatenate(list(SyntheticCity(512, 2).chunks(600, 1000))))


def test_brute_force_orders_equal_photos_by_their_ids_and_knows_who_is_there() -> None:
    rows = rows_of(1, 6)
    rows[4] = rows[1]
    oracle = BruteForce.of((rows[:4], rows[4:]), IDS, rows[1:2] * np.float32(3))
    best = oracle.best(0, 2)
    assert [photo_id for photo_id, _ in best] == [IDS[1], IDS[4]]
    assert best[0][1] == pytest.approx(1, abs=1e-6)
    live = np.array([True, False, True, True, True, False])
    assert [photo_id for photo_id, _ in oracle.best(0, 1, live=live)] == [IDS[4]]
    assert len(oracle.best(0, 6, min_score=0.99)) == 2
    assert len(oracle.best(0, 6, live=live)) == 4


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
    assert same_photos([(IDS[0], 0.91), (IDS[1], 0.81)], truth)
    assert not same_photos([(IDS[1], 0.81), (IDS[0], 0.91)], truth)


def test_answers_under_load_are_held_against_the_version_that_they_name() -> None:
    oracle = BruteForce.of([rows_of(1, 6)], IDS, rows_of(2, 1))
    everyone, without = np.ones(5, bool), np.ones(6, bool)
    best = oracle.best(0, 1)[0][0]
    without[IDS.index(best)] = False
    assert best != IDS[5], "the photo that is added is to be another one"
    outcome = LoadOutcome(versions=[1, 4], live=[everyone, without])
    before, after = (
        oracle.best(0, 2, live=np.append(everyone, False)),
        oracle.best(0, 2, live=without),
    )

    def wrong(ranking: Ranking, version: int, least: int = 1) -> int:
        outcome.answered = [SearchObservation(0, 2, least, response_of(ranking, version), 0.1)]
        return count_wrong_answers(outcome, oracle)

    assert wrong(before, 1) == wrong(before, 3) == wrong(after, 4) == wrong(after, 9) == 0
    assert wrong(before, 4) == 1, "the deleted photo is answered"
    assert wrong(after, 1) == 1
    assert wrong(before, 3, least=4) == 1, "older than it had to be"


def test_a_search_by_codes_touches_all_first_bits_and_the_rows_that_it_compares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalog_sync, "MIN_CODED_BYTES", 0)
    city = SyntheticCity(7168, 1)
    with world_of(tmp_path, city, 400, 200) as world:
        queries = city.revisits(400, 1)
        ours = PlacewiseSearch(world, load_worker(world), queries)
        with count_bytes_read() as count:
            ours.search(BenchmarkQuery(0, 3))
        assert ours.certificates == {"statistical"}
        codes, row = 7168 // 8, 4 * 7168
        assert count.size_bytes >= 400 * codes + 3 * row
        assert count.size_bytes < 400 * row
        assert (count.size_bytes - 400 * codes) % codes == 0


def test_memory_is_enough_for_codes_and_not_for_the_rows_of_a_coded_map() -> None:
    assert required_memory_bytes(10_000, 98_304) == 10_000 * 12_288
    assert required_memory_bytes(1000, 512) >= 1000 * 4 * 512


def test_whole_run_finds_no_wrong_answer_and_measures_everything(tmp_path: Path) -> None:
    with Progress(disable=True) as progress:
        report = measure(
            progress,
            photos=[60],
            dimensions=[7168],
            queries=2,
            growth=False,
            load_seconds=0.5,
            folder=tmp_path,
        )
        measure_growth(report, progress, sizes=[3000])
    figures = {figure.what: figure.measured for figure in report.figures}
    assert figures["60 x 7,168: wrong results of Placewise"] == 0
    assert figures["load: wrong results"] == figures["load: errors"] == 0
    assert figures["load: results"] > 0
    assert figures["growth: scan of 3,000 codes, p50"] > 0
    (comparison,) = report.details["comparisons"]
    assert len(comparison["rows"]) == 5 * 7
    exact = [row for row in comparison["rows"] if "Binary" not in row["method"]]
    assert not any(row["differ"] for row in exact)
    json.dumps(report.as_json())
    assert not list(tmp_path.iterdir()), "what was made is removed"


def test_a_wrong_answer_of_ours_is_a_missed_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = PlacewiseSearch.search

    def last_two_change_places(self: PlacewiseSearch, query: BenchmarkQuery) -> Ranking:
        found = list(right(self, query))
        return [*found[:-2], *reversed(found[-2:])]

    monkeypatch.setattr(PlacewiseSearch, "search", last_two_change_places)
    city = SyntheticCity(512, 1)
    with world_of(tmp_path, city, 60, 60) as world, Progress(disable=True) as progress:
        compared = compare_methods(world, city, 2, progress)
    report = Report("anything")
    report_comparison(report, compared)
    assert report.missed
    assert compared.row(MATCHED_CASE, PlacewiseSearch.name).differ == 2


def test_command_asks_for_what_its_options_say(monkeypatch: pytest.MonkeyPatch) -> None:
    requests: list[dict[str, object]] = []

    def fake(_progress: Progress, **options: object) -> Report:
        requests.append(options)
        return Report("anything")

    monkeypatch.setattr("lab.benchmarks.search.measure", fake)
    for arguments in ([], ["--long"], ["--photos", "5,3", "--load", "2"]):
        assert CliRunner().invoke(app, ["search", *arguments]).exit_code == 0
    short, long, own = requests
    assert (short["photos"], short["growth"], short["load_seconds"]) == ([2000], False, 0)
    assert short["dimensions"] == [512, 7168, 98_304]
    assert (long["photos"], long["growth"]) == ([1000, 5000, 10_000], True)
    assert long["load_seconds"] == 60
    assert (own["photos"], own["load_seconds"]) == ([3, 5], 2)
