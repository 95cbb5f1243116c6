"""`placewise bench extract` and `bench precision`: what they compare is the same thing twice."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from rich.progress import Progress
from torch.nn.functional import normalize
from typer.testing import CliRunner

from lab.benchmarks.descriptors import extract, precision
from lab.benchmarks.descriptors.extract import vlad_in_loops
from lab.benchmarks.report import Report
from lab.cli.bench import app
from shared.descriptors.aggregation import vlad

runner = CliRunner()


def figures(report: Report) -> dict[str, float]:
    return {figure.what: figure.measured for figure in report.figures}


def test_vlad_in_loops_is_the_vlad_of_the_formula() -> None:
    rng = np.random.default_rng(1)
    features = normalize(torch.from_numpy(rng.standard_normal((50, 16)).astype(np.float32)), dim=-1)
    centres = torch.from_numpy(rng.standard_normal((60, 16)).astype(np.float32))  # some unused
    ours = vlad(features[None], centres)[0]
    np.testing.assert_allclose(vlad_in_loops(features, centres), ours, atol=1e-6)


def test_reference_makes_the_same_descriptors_by_the_whole_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(extract, "MATRIX_SIZE", {"cpu": 64})
    monkeypatch.setattr(extract, "FIT_PHOTOS", 1)
    report = extract.measure(
        Progress(disable=True),
        extractor="anyloc-vits14:layer=1",
        photos=2,
        device="cpu",
        batches=[2],
        precision="auto",
        rounds=1,
    )
    found = figures(report)
    assert found["largest difference of two numbers"] < 1e-4
    assert found["least cosine of two descriptors"] > 0.9999
    assert "random weights" in report.title
    assert report.details["random_weights"]
    assert min(found["CPU time of a photo as published"], found["CPU time of a photo"]) > 0
    # Of block 0 and what block 1 is needed for, with 257 tokens: between one block and three.
    assert 0.9 < found["forward pass of a photo"] < 3.0


def test_other_extractors_are_measured_without_a_reference(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(extract, "MATRIX_SIZE", {"cpu": 64})
    report = extract.measure(
        Progress(disable=True),
        extractor="test-tiny-vlad",
        photos=2,
        device="cpu",
        batches=[2],
        precision="float32",
        rounds=1,
    )
    assert "times as fast" not in figures(report)
    assert figures(report)["this pipeline"] > 0
    assert not report.missed
    assert "random" not in report.title


def test_precisions_are_compared_on_the_photos_of_a_city() -> None:
    report = precision.measure(
        Progress(disable=True),
        extractor="test-tiny-vlad:aggregator=avg",
        places=2,
        queries=2,
        device="cpu",
        batch=4,
    )
    found = figures(report)
    assert 0.99 < found["patches, least cosine"] < found["patches, mean cosine"] < 1
    assert 0.99 < found["descriptors, least cosine"] < found["descriptors, mean cosine"] < 1
    assert found["difference of right queries"] <= 2


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [
        ("extract", "--precision", "float16"),
        ("extract", "--device", "tpu"),
        ("precision", "--device", "tpu"),
    ],
)
def test_what_is_not_known_is_refused(command: str, option: str, value: str) -> None:
    ended = runner.invoke(app, [command, option, value])
    assert ended.exit_code == 2
    assert value in ended.output
