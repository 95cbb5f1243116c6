"""The tutorial of docs/how-to/train.md: drawn, trained on, evaluated, added, indexed, searched."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.server import CommandLine, ServerProcess

MAP = "city"
COMMAND_SECONDS = 600.0  # seconds of work, of which a busy machine makes minutes
CONFIG = Path(__file__).parents[3] / "configs" / "train-boq.yaml"
SMALL = {"max_steps": 1, "image_size": 64, "batch_size": 4, "num_workers": 0, "logger": "none"}


def recall(evaluated: Any) -> dict[str, Any]:
    """Of each set."""
    found = {name: figures["recall"] for name, figures in evaluated["sets"].items()}
    assert found
    return found


@pytest.fixture
def placewise(server: ServerProcess, tmp_path: Path) -> Callable[..., Any]:
    """`placewise` beside a server; its answers are JSON."""
    command = CommandLine(tmp_path, server.home)
    command.seconds = COMMAND_SECONDS
    return lambda *arguments: command(*arguments, "--json").json()


@pytest.mark.timeout(1800)
def test_a_model_is_trained_evaluated_added_and_answers(
    placewise: Callable[..., Any], tmp_path: Path
) -> None:
    city = tmp_path / "city"
    small = ("--places", "6", "--views", "3", "--queries", "3", "--size", "96x72")
    placewise("datasets", "synth", city, *small)

    folder = ("--data_root", city, "--default_root_dir", "runs", "--run_name", "short")
    options = [f"--{name}={value}" for name, value in SMALL.items()]
    trained = placewise("train", "--config", CONFIG, *folder, *options)
    best = Path(trained["best"]["path"])
    if not best.is_absolute():
        best = tmp_path / best
    assert trained["epochs"]

    evaluated = placewise("evaluate", "--data", city, "--checkpoint", best, "--out", "of-file")

    added = placewise("models", "add", best, "--name", "short")["result"]
    assert added["fingerprint"] == trained["best"]["fingerprint"]
    assert added["dimension"] == trained["best"]["dimension"]
    served = placewise("evaluate", "--data", city, "--extractor", "gsv:short", "--out", "of-added")
    assert recall(served) == recall(evaluated), "the figures carry over"

    made = placewise("maps", "create", MAP, "--extractor", "gsv:short")
    assert made["extractor"] == "gsv:short"
    database = sorted((city / "database").glob("*.jpg"))
    indexed = placewise("index", city / "database", "--map", MAP)
    assert indexed["searchable"] == len(database)
    query = min((city / "queries").glob("*.jpg"))
    found = placewise("query", query, "--map", MAP, "--top-k", "3")["similar_images"]
    names = {path.name for path in database}
    assert len({photo["original_filename"] for photo in found} & names) == 3
    # A photo of the map is its own best match: the stored descriptors are the model's.
    searched = database[len(database) // 2]
    (first,) = placewise("query", searched, "--map", MAP, "--top-k", "1")["similar_images"]
    assert first["original_filename"] == searched.name
    assert first["similarity_score"] > 1 - 1e-5
