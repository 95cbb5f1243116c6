"""`placewise evaluate` and `compare` on data sets: described, ranked, written, reported."""

from __future__ import annotations

import base64
import csv
import json
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lab.city.plan import CityOptions, make_plan
from lab.city.write import write_city
from lab.datasets.dataset import EvaluationSet
from lab.datasets.ground_truth_files import write_integer_lists
from lab.datasets.open_dataset import open_evaluation_set
from lab.datasets.utm_coordinates import pairwise_distances_m
from lab.evaluation.recall import recall_at_k
from lab.training.describing import ModelDescriber
from shared.descriptors.extractor import Extractor
from shared.descriptors.vpr_models.checkpoint import checkpoint_state, load_checkpoint
from shared.descriptors.vpr_models.config import VprModelConfig
from shared.descriptors.vpr_models.model import build_vpr_model
from shared.extractor_config.configs import get_extractor_config
from shared.imaging.decode import decode_photo
from tests.support.commands import run, run_json

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECODE_PROCESSES", "1")
    monkeypatch.setenv("BATCH_PHOTOS", "4")
    monkeypatch.setenv("DEVICE", "cpu")


@pytest.fixture(scope="session")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten photos of five places, and six queries, one of them outside of the map."""
    out = tmp_path_factory.mktemp("city") / "town"
    options = CityOptions(5, 2, 6, 1, 0, 0.17, 64, 64, False)
    write_city(make_plan(options), out)
    return out


@pytest.fixture(scope="session")
def town(city: Path) -> EvaluationSet:
    return open_evaluation_set(city)


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ResNet-18's first two stages and GeM, with random weights."""
    torch.manual_seed(0)
    config = VprModelConfig(
        pretrained=False, layers_to_crop=(3, 4), agg_arch="GeM", image_size=(48, 64)
    )
    path = tmp_path_factory.mktemp("trained") / "gem.ckpt"
    torch.save(checkpoint_state(build_vpr_model(config)), path)
    return path


def rows_of(shots: Any) -> np.ndarray[Any, np.dtype[np.float32]]:
    made = Extractor(get_extractor_config("test-tiny-avg", allow_test_extractors=True), CPU)
    pixels = [
        decode_photo(shot.path.read_bytes(), made.preprocessing, 10**9).pixels for shot in shots
    ]
    return made.describe(pixels, None)


def rank_by_similarity(queries: Any, database: Any, k: int) -> Any:
    return np.argsort(-(queries @ database.T), axis=1, kind="stable")[:, :k]


class _Page(HTMLParser):
    """Addresses that a page would fetch, and its pictures by their frames."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.framed: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if name in ("src", "href") and not (value or "").startswith("data:image/"):
                self.fetched.append(value or "")
            if tag == "img" and name == "class":
                self.framed.append(value or "")


def charts_of(page: str) -> list[tuple[str, ET.Element]]:
    """The titles and the SVGs of the charts on a page."""
    found = re.findall(r'<img src="data:image/svg\+xml;base64,([^"]+)" alt="([^"]+)">', page)
    return [(title, ET.fromstring(base64.b64decode(svg))) for svg, title in found]


def test_a_comparison_with_a_run_of_another_set_is_refused_before_anything_is_described(
    city: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = ["--data", city, "--extractor", "test-tiny-avg"]
    run("evaluate", *given, "--rule", "radius:10", "--out", tmp_path / "before")
    monkeypatch.setattr("lab.cli.evaluation.data_sets.make_describer", None)
    problem = run_json("evaluate", *given, "--against", tmp_path / "before", code=1)
    assert problem["code"] == "runs_not_comparable"


def test_an_evaluation_writes_figures_rankings_and_a_report_that_fetches_nothing(
    city: Path, town: EvaluationSet, tmp_path: Path
) -> None:
    out, pairs = tmp_path / "out", tmp_path / "pairs.txt"
    given = ["--data", city, "--extractor", "test-tiny-avg"]
    answer = run_json("evaluate", *given, "--out", out, "--pairs", pairs, "--depth", 7)
    ranked = rank_by_similarity(rows_of(town.queries), rows_of(town.database), 7)
    assert answer["recall"] == {
        str(k): pytest.approx(share)
        for k, share in recall_at_k(ranked, town.positives, (1, 5)).items()
    }
    assert answer["fingerprint"] == town.fingerprint
    assert (answer["rule"], answer["protocol"]) == ("radius 25 m", "placewise")
    assert (answer["dimension"], answer["bytes_a_photo"]) == (16, 2 * 16)
    assert answer["describe_ms_a_photo"] > 0
    assert {"placewise", "numpy", "torch"} <= set(answer["versions"])
    assert answer["run"]["fingerprint"]

    assert np.load(out / "predictions_town.npy").tolist() == ranked.tolist()
    with (out / "predictions_town.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 6 * 7
    first, best = lines[0], town.database[int(ranked[0, 0])]
    query = town.queries[0]
    assert (first["query"], first["rank"], first["match"]) == (query.name, "1", best.name)
    (metres,) = pairwise_distances_m([query], [best])
    assert float(first["metres"]) == pytest.approx(metres, abs=0.01)
    assert first["correct"] == ("true" if metres <= 25 else "false")
    assert pairs.read_text().splitlines()[0] == f"{query.name} {best.name}"

    places = answer["places"]
    assert places["source"] == "prior", "ten photos are too few to fit the model on"
    assert places["samples"] == 6
    assert [each["certainty"] for each in places["answers"]] == [0.8, 0.9, 0.95, 0.99]
    assert [each["level"] for each in places["levels"]] == [0, 1], "a radius, and the whole map"
    stored = json.loads((out / "metrics.json").read_text())["sets"]["town"]
    assert (stored["recall"], stored["places"]) == (answer["recall"], places)

    (row,) = csv.DictReader((out / "table.csv").read_text().splitlines())
    assert (row["name"], row["queries"]) == ("town", "6")
    assert float(row["R@1"]) == answer["recall"]["1"]
    intervals = answer["recall_interval"]["1"]
    assert [float(row[f"R@1 {bound}"]) for bound in ("low", "high")] == intervals

    text = (out / "report.html").read_text()
    page = _Page()
    page.feed(text)
    assert page.fetched == []
    shown = zip(ranked[:, :5], town.positives, strict=True)
    right = sum(int(np.isin(row, positives).sum()) for row, positives in shown)
    assert page.framed.count("query") == 6
    assert page.framed.count("right") == right
    assert page.framed.count("wrong") == 6 * 5 - right
    assert [title for title, _ in charts_of(text)] == [
        "Recall@k",
        "Precision and recall of the first match",
        "Distance of the first match",
        "Reliability of the probabilities of levels",
        "Map of queries and their first matches",
    ]
    assert town.fingerprint in text
    assert "Levels of places" in text
    of_a_map = ["--data", city, "--extractor", "test-tiny-avg", "--map", "town"]
    assert run_json("evaluate", *of_a_map, code=1)["code"] == "options_contradict"
    assert run_json("compare", "--out", tmp_path, code=1)["code"] == "options_contradict"


def test_a_ground_truth_file_replaces_that_of_a_set(
    city: Path, town: EvaluationSet, checkpoint: Path, tmp_path: Path
) -> None:
    """Every database photo is correct for the first query, and none for the others."""
    everything = [np.arange(len(town.database))] + [np.empty(0, np.int64)] * 5
    write_integer_lists(tmp_path / "gt.npy", everything)
    given = ["--data", city, "--checkpoint", checkpoint, "--ground-truth", tmp_path / "gt.npy"]
    answer = run_json("evaluate", *given, "--recall-at", "1,3")
    assert answer["recall"] == {"1": 1 / 6, "3": 1 / 6}
    assert answer["rule"] == "given by gt.npy"
    refused = run_json("evaluate", *given, "--rule", "radius 5", code=1)
    assert "--rule can't be used with --ground-truth" in refused["detail"]


def test_only_wrong_leaves_right_queries_out_of_the_report(city: Path, tmp_path: Path) -> None:
    given = ["--data", city, "--extractor", "test-tiny-avg", "--out", tmp_path]
    recall = run_json("evaluate", *given, "--only-wrong")["recall"]["1"]
    assert 0 < recall < 1, "the test needs both kinds"
    page = _Page()
    page.feed((tmp_path / "report.html").read_text())
    assert page.framed.count("query") == round(6 * (1 - recall))


def test_checkpoint_is_evaluated_at_the_size_it_was_trained_for(
    city: Path, town: EvaluationSet, checkpoint: Path
) -> None:
    answer = run_json("evaluate", "--data", city, "--checkpoint", checkpoint)
    assert answer["run"]["image size"] == "48 x 64"
    assert answer["dimension"] == 128
    model = load_checkpoint(checkpoint).model
    describe = ModelDescriber(model, CPU, (48, 64))
    queries, database = (
        np.concatenate(list(describe([shot.path for shot in shots])))
        for shots in (town.queries, town.database)
    )
    expected = recall_at_k(rank_by_similarity(queries, database, 5), town.positives, (1, 5))
    assert answer["recall"]["1"] == pytest.approx(expected[1])
    assert answer["recall"]["5"] == pytest.approx(expected[5])


def test_checkpoint_sees_photos_unresized_with_that_option(city: Path, checkpoint: Path) -> None:
    """The photos have 64 x 64 pixels."""
    native = run_json(
        "evaluate", "--data", city, "--checkpoint", checkpoint, "--image-size", "native"
    )
    brought = run_json(
        "evaluate", "--data", city, "--checkpoint", checkpoint, "--image-size", "64x64"
    )
    assert native["run"]["image size"] == "native"
    assert native["recall_curve"] == brought["recall_curve"]


def test_vocabulary_is_fitted_on_the_database_where_none_comes_with_the_extractor(
    city: Path,
) -> None:
    answer = run_json("evaluate", "--data", city, "--extractor", "test-tiny-vlad:clusters=3")
    assert answer["dimension"] == 3 * 16
    assert answer["run"]["vocabulary"] == "fitted on the database photos"


def test_photo_that_does_not_decode_is_named_and_nothing_is_measured(
    city: Path, tmp_path: Path, checkpoint: Path
) -> None:
    copy = tmp_path / "town"
    for path in city.rglob("*.jpg"):
        target = copy / path.relative_to(city)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    broken = sorted((copy / "database").iterdir())[3]
    broken.write_bytes(b"\xff\xd8\xff but no photo")
    for model in (["--extractor", "test-tiny-avg"], ["--checkpoint", checkpoint]):
        problem = run_json("evaluate", "--data", copy, *model, code=1)
        assert problem["code"] == "photos_refused"
        assert broken.name in problem["detail"]
        assert "1 of 10" in problem["detail"]


def test_own_rows_in_the_listed_order_have_the_recall_of_the_extractor_that_made_them(
    city: Path, town: EvaluationSet, tmp_path: Path
) -> None:
    listed = run_json("datasets", "list", city)
    files = []
    for role, photos in listed.items():
        out = tmp_path / f"{role}.npy"
        run("describe", *photos, "--out", out, "--extractor", "test-tiny-avg")
        np.save(out, 3 * np.load(out))  # rows need not have unit length
        files.append(out)
    own = run_json("evaluate", "--data", city, "--rows", *files)
    made = run_json("evaluate", "--data", city, "--extractor", "test-tiny-avg")
    for figure in ("recall", "recall_findable", "dimension", "bytes_a_photo"):
        assert own[figure] == made[figure], figure


def test_a_checkpoint_describes_photos_as_the_extractor_of_its_path_does(
    town: EvaluationSet, checkpoint: Path, tmp_path: Path
) -> None:
    photos = [photo.path for photo in town.queries[:2]]
    for name, model in (
        ("a", ["--checkpoint", checkpoint]),
        ("b", ["--extractor", f"gsv:{checkpoint}"]),
    ):
        run("describe", *photos, "--out", tmp_path / f"{name}.npy", *model)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), np.load(tmp_path / "b.npy"))
    both = ["--checkpoint", checkpoint, "--extractor", "test-tiny-avg"]
    answer = run_json("describe", *photos, "--out", tmp_path / "c.npy", *both, code=1)
    assert answer["code"] == "options_contradict"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (np.ones((9, 4)), "has 9 rows for the 10 photos of the database"),
        (np.ones((10, 3)), "has 3 columns and .* 4"),
        (np.ones(10), r"\(photos, D\) array"),
        (np.vstack([np.ones((7, 4)), np.zeros((3, 4))]), "Row 7 of .* is zero"),
        (np.full((10, 4), np.nan), "Row 0 of .* not finite"),
    ],
)
def test_rows_that_do_not_fit_the_set_are_refused(
    city: Path, tmp_path: Path, rows: np.ndarray[Any, Any], message: str
) -> None:
    np.save(tmp_path / "db.npy", rows)
    np.save(tmp_path / "q.npy", np.ones((6, 4)))
    arguments = ["evaluate", "--data", city, "--rows", tmp_path / "db.npy", tmp_path / "q.npy"]
    answer = run_json(*arguments, code=1)
    assert answer["code"] == "bad_rows"
    assert re.search(message, answer["detail"])


def test_people_are_shown_a_table(city: Path) -> None:
    shown = run("evaluate", "--data", city, "--extractor", "test-tiny-avg").stdout
    for part in ("R@1", "all 6 queries", "5 with a positive", "radius 25 m", "certainty", "0.95"):
        assert part in shown


def test_descriptors_are_compared_by_recall_time_and_size_and_described_once(
    city: Path, tmp_path: Path, checkpoint: Path
) -> None:
    vlad = "test-tiny-vlad:clusters=3,preprocessing=demo1024+fit+pca4"
    extractors = f"test-tiny-avg,{vlad},{checkpoint}"
    report = run_json("compare", city, "--extractors", extractors, "--out", tmp_path / "out")
    sizes = [one["bytes_a_photo"] for one in report["extractors"]]
    assert sizes == [16 * 2, 4 * 2, 128 * 2]
    assert all(one["milliseconds_a_photo"] > 0 for one in report["extractors"])
    assert report["extractors"][0]["against_first"] is None
    rows = csv.DictReader((tmp_path / "out" / "table.csv").read_text().splitlines())
    for row, one in zip(rows, report["extractors"], strict=True):
        assert (row["name"], float(row["R@1"])) == (one["extractor"], one["recall"]["1"])
    again = run_json("compare", city, "--extractors", extractors)
    for before, after in zip(report["extractors"], again["extractors"], strict=True):
        assert after["recall"] == before["recall"]
        if "+pca" not in before["extractor"]:  # projected anew
            assert after["milliseconds_a_photo"] == before["milliseconds_a_photo"]


@pytest.mark.parametrize(
    ("extractors", "code"),
    [
        ("test-tiny-avg+pca99999", "bad_extractors"),
        ("test-tiny-avg+fit", "bad_extractors"),
        ("nowhere.ckpt", "bad_extractors"),
        ("test-tiny-avg,no-such-extractor", "unknown_extractor"),
        ("test-tiny-avg+pca10", "pca_too_few_rows"),
    ],
)
def test_comparison_that_can_not_be_done_is_refused(city: Path, extractors: str, code: str) -> None:
    assert run_json("compare", city, "--extractors", extractors, code=1)["code"] == code
