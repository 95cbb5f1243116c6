"""The published commands of the GSV-Cities predecessor, on small data and without a GPU."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import httpx2
import pytest
import torch

from tests.lab.training_runs import PUBLISHED_COMMAND, write_tiny_places
from tests.support.commands import run

REPOSITORY = Path(__file__).parents[4]
# What the small data and a machine without a GPU need; all other arguments are as published.
HERE = ["--accelerator", "cpu", "--num_workers", "0", "--max_epochs", "1", "--image_size", "64"]


@pytest.fixture(autouse=True)
def _weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Random weights of a ResNet-18 in torch.hub's cache, and no GPU."""
    from torchvision.models import resnet18

    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    cached = tmp_path / "torch" / "hub" / "checkpoints" / "resnet18-f37072fd.pth"
    cached.parent.mkdir(parents=True)
    torch.save(resnet18().state_dict(), cached)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def data(tmp_path: Path) -> list[str]:
    """Options that name the data: gsv_xs, SF_XS with val and test, TOKYO_XS with test."""
    places = write_tiny_places(tmp_path / "places")
    for set_folder in ("SF_XS/val", "SF_XS/test", "TOKYO_XS/test"):
        for role in ("database", "queries"):
            target = tmp_path / set_folder / role
            target.parent.mkdir(parents=True, exist_ok=True)
            target.symlink_to(places / role)
    roots = json.dumps([str(tmp_path / "SF_XS"), str(tmp_path / "TOKYO_XS")])
    return ["--data_root", str(places / "gsv_xs"), "--eval_roots", roots]


def test_the_published_command_trains_with_one_warning_about_faiss(data: list[str]) -> None:
    answer = run("train", *shlex.split(PUBLISHED_COMMAND), *data, *HERE, "--json")
    report = json.loads(answer.stdout)
    assert report["monitor"] == "sfxs_val/R1"
    assert report["arguments"]["faiss_gpu"] is True
    assert answer.stderr.count("faiss can't use a GPU") == 1
    assert Path("LOGS/resnet18").is_dir()


def test_all_obstacles_of_a_machine_are_in_one_message(data: list[str], tmp_path: Path) -> None:
    (tmp_path / "torch/hub/checkpoints/resnet18-f37072fd.pth").unlink()
    tokens = [
        *shlex.split(PUBLISHED_COMMAND),
        *data,
        "--weights",
        "nowhere.pth",
        "--accelerator",
        "mps",
    ]
    answer = run("train", *tokens, "--val_set_names", "sfxs_vla", code=1)
    for obstacle in ("no_gpu: ", "set_missing: ", "weights_missing: "):
        assert f"- {obstacle}" in answer.stderr
    assert answer.stderr.lstrip().startswith("several_obstacles: ")


def test_the_published_grid_without_weights_ends_with_a_leaderboard_of_28_failed_runs(
    data: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = str(REPOSITORY / "configs" / "predecessor-grid.yaml")
    small = [file, *data, *HERE, "--out", str(tmp_path / "grid")]
    run("grid", *small, "--dry-run")
    without_gpu = [*small, "--accelerator", "gpu"]
    found = run("grid", *without_gpu, "--dry-run", code=1)
    assert "every run can't start: no_gpu" in found.stderr
    (tmp_path / "torch/hub/checkpoints/resnet18-f37072fd.pth").unlink()
    tried: list[str] = []

    def download(url: str, *_: object, **_options: object) -> None:
        tried.append(url)
        raise httpx2.ConnectError("no network")

    monkeypatch.setattr("shared.descriptors.vpr_models.backbones.download_file", download)
    ended = run("grid", *small, code=1)
    assert len(tried) == 1, "each attempt takes minutes"
    assert ended.stdout.count("failed: weights_missing") == 28
    assert ended.stderr.count("no network") == 1
    assert (tmp_path / "grid/leaderboard.md").read_text().count("failed: weights_missing") == 28


def test_a_run_of_the_published_grid_is_trained_and_tested(data: list[str], tmp_path: Path) -> None:
    import yaml

    grid = yaml.safe_load((REPOSITORY / "configs" / "predecessor-grid.yaml").read_text())
    grid["runs"] = [run for run in grid["runs"] if run["name"].startswith("26-")]
    file = tmp_path / "one.yaml"
    file.write_text(yaml.safe_dump(grid))
    run("grid", str(file), *data, *HERE, "--out", str(tmp_path / "grid"))
    metrics = next((tmp_path / "grid").glob("26-*/metrics.json"))
    assert set(json.loads(metrics.read_text())["test"]) == {"sfxs_test", "tokyoxs_test"}
