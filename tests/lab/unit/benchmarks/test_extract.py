"""`placewise bench extract`: what it reports of an extractor."""

from __future__ import annotations

import pytest

from lab.benchmarks import extract
from tests.support.commands import run_json


def test_random_weights_are_named_and_the_passes_to_the_used_layer_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(extract, "MATRIX_SIZE", {"cpu": 64})
    monkeypatch.setattr(extract, "FIT_PHOTOS", 1)
    arguments = "--extractor anyloc-vits14:layer=1 --photos 2 --device cpu --batch 2 --rounds 1"
    report = run_json("bench", "extract", *arguments.split())
    assert "random weights" in report["title"]
    assert report["random_weights"]
    found = {figure["what"]: figure["measured"] for figure in report["figures"]}
    assert found["extraction, batches of 2"] > 0
    assert found["CPU time of a photo, batches of 2"] > 0
    # Of block 0 and what block 1 is needed for, with 257 tokens: between one block and three.
    assert 0.9 < found["forward pass of a photo"] < 3.0
