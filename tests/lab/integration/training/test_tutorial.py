"""The tutorial of docs/how-to/train.md on small data: train, compare, add, switch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from lab.training.arguments import build_arguments, load_yaml
from lab.training.grid import load_grid_plan
from services.cli.main import build_app
from services.steward.tasks.model_changes import advance_model_changes
from shared.catalog.database.session import Catalog
from shared.jobs import InProcessWakeups
from tests.integration.in_process_api import Service
from tests.lab.training_runs import write_tiny_places

CONFIGS = Path(__file__).parents[4] / "configs"


@pytest.fixture
def catalog(sqlite_catalog: Catalog) -> Catalog:
    return sqlite_catalog


def command(name: str, *tokens: str) -> Any:
    answer = CliRunner().invoke(build_app([name]), [name, *tokens, "--json"])
    assert answer.exit_code == 0, answer.output
    return json.loads(answer.stdout)


def finished(service: Service, job_id: str) -> Any:
    for _ in range(20):
        service.drain()
        advance_model_changes(service.catalog, InProcessWakeups())
        job = service.json("GET", f"/jobs/{job_id}")
        if job["state"] not in ("queued", "running"):
            assert job["state"] == "succeeded", job
            return job
    raise AssertionError("the job did not end")


def test_the_tutorials_network_is_trained_compared_with_the_default_and_served(
    service: Service, tmp_path: Path
) -> None:
    places = write_tiny_places(tmp_path / "places")
    report = command(
        "train", "--config", str(CONFIGS / "train-boq.yaml"), "--data_root", str(places),
        "--default_root_dir", str(tmp_path / "runs"), "--run_name", "boq", "--max_steps", "1",
        "--image_size", "64", "--batch_size", "4", "--num_workers", "0", "--logger", "none",
    )  # fmt: skip
    checkpoint = tmp_path / "runs" / "boq" / "checkpoints" / "last.ckpt"
    assert Path(report["last"]) == checkpoint
    compared = command(
        "compare", str(places), "--extractors", f"efficientnet-lite0-vlad128,{checkpoint}"
    )
    names = [each["extractor"] for each in compared["extractors"]]
    assert names == ["efficientnet-lite0-vlad128", str(checkpoint)]

    first, _ = service.indexed(1, 2)
    added = service(
        "POST",
        "/models",
        files={"file": ("last.ckpt", checkpoint.read_bytes())},
        data={"name": "boq", "licence": "MIT"},
    )
    finished(service, added.json()["job_id"])
    switched = service("POST", "/generations", json={"extractor": "gsv:boq"})
    finished(service, switched.json()["job_id"])
    answer = service.json("POST", f"/similarity/{first}")
    assert len(answer["similar_images"]) == 1
    stats = service.json("GET", "/database/stats")
    assert (stats["extractor"], stats["feature_dimension"]) == ("gsv:boq", 4096)


def test_the_grid_of_aggregators_trains_each_as_the_tutorial_trains_boq() -> None:
    tutorial = build_arguments(load_yaml(CONFIGS / "train-boq.yaml"))
    plan = load_grid_plan(CONFIGS / "grid-aggregators.yaml", {})
    runs = [build_arguments(planned.arguments) for planned in plan.runs]
    assert tutorial in runs
    network = {"agg_arch", "agg_config"}
    assert {run.model_dump_json(exclude=network) for run in runs} == {
        tutorial.model_dump_json(exclude=network)
    }
