"""`placewise evaluate --word-weights` and `placewise query`: what they say of word weights."""

from __future__ import annotations

from pathlib import Path

from tests.support.photos import photo_bytes
from tests.support.server import CommandLine, ServerProcess

SETTINGS = {"extractor": "test-tiny-vlad", "auto_evaluate_photos": 0}


def test_a_small_map_gets_no_weights_and_the_reason_in_numbers(
    server: ServerProcess, tmp_path: Path
) -> None:
    placewise = CommandLine(server.home, server.home, **SETTINGS)
    placewise("evaluate", "--word-weights", "--json").refusal("nothing_to_evaluate")
    for number in range(6):
        assert server.upload(photo_bytes(number), latitude=number, longitude=7).status_code == 202
    fit = server.client.post("/api/v1/vocabularies", json={}).json()
    assert server.finished(fit["job_id"])["state"] == "succeeded"

    shown = placewise("evaluate", "--word-weights")
    assert shown.code == 0, shown.stderr
    assert "Word weights: not enough pairs." in shown.stdout
    assert "each half needs 50 pairs of each kind" in " ".join(shown.stdout.split())
    body = placewise("evaluate", "--word-weights", "--json").json()
    assert body["word_weights"]["outcome"] == "not enough pairs"
    assert body["word_weights"]["near_pairs"] == 0
    assert body["with_word_weights"] is None

    photo = tmp_path / "again.jpg"
    photo.write_bytes(photo_bytes(2))
    searched = placewise("query", photo, "--no-word-weights")
    assert searched.code == 0, searched.stderr
    assert "word weights: none" in searched.stdout
