"""`placewise models`: weights that are here, and weights that are fetched from local servers."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
import torch

from shared.descriptors import weight_files
from shared.descriptors.backbones import torchhub as torchhub_module
from shared.descriptors.backbones.dinov2 import SHAPES
from tests.support.api_responses import JOB
from tests.support.commands import run, run_json
from tests.support.fake_server import running_server
from tests.support.files_server import FilesServer, files_server
from tests.support.hub import COMMIT, write_hub
from tests.support.vit import random_weights, save

models = partial(run_json, "models")
VITS = "anyloc-vits14:layer=0"
VITS_FILE = "/timm/vit_small_patch14_dinov2.lvd142m/resolve/main/model.safetensors"
REPOSITORY = f"torchhub:somebody/places@{COMMIT}:colours"


@pytest.fixture(scope="module")
def vits_weights(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """What `VITS` needs, as timm's repository has it: about 9 MB."""
    path = tmp_path_factory.mktemp("weights") / "model.safetensors"
    return save(random_weights(SHAPES["vits14"], blocks=1), path).read_bytes()


@pytest.fixture(autouse=True)
def caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Empty caches of this user."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "huggingface"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr(weight_files, "RETRY_PAUSE_SECONDS", 0)
    return tmp_path


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, vits_weights: bytes) -> Iterator[FilesServer]:
    """What Hugging Face and GitHub are for these tests."""
    from huggingface_hub import constants

    with files_server() as started:
        started.files[VITS_FILE] = vits_weights
        template = f"{started.url}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
        monkeypatch.setattr(constants, "ENDPOINT", started.url)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(torchhub_module, "GITHUB", started.url)
        yield started


def listed(name: str) -> dict[str, Any]:
    found: dict[str, Any] = next(w for w in models("list") if w["extractor"] == name)
    return found


def repository_zip(tmp_path: Path, comment: str = COMMIT) -> bytes:
    """A commit as GitHub packs it: in a folder of its own, the commit in the comment."""
    folder = write_hub(tmp_path / "somebody-places-0123456")
    with ZipFile(tmp_path / "packed.zip", "w") as packed:
        packed.comment = comment.encode()
        for path in folder.iterdir():
            packed.write(path, path.relative_to(tmp_path))
    return (tmp_path / "packed.zip").read_bytes()


# --- list ------------------------------------------------------------------------------------


def test_list_shows_available_weights_and_how_to_get_missing_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("EXTRACTOR")
    here = listed("efficientnet-lite0-vlad")
    assert (here["available"], here["licence"]) == (True, "Apache-2.0")
    assert here["size_bytes"] == Path(here["path"]).stat().st_size
    missing = listed("anyloc-vitg14")
    assert (missing["available"], missing["path"]) == (False, None)
    assert "timm/vit_giant_patch14_dinov2.lvd142m" in missing["source"]
    assert "placewise models fetch anyloc-vitg14" in missing["note"]
    assert not [w for w in models("list") if w["extractor"].startswith("test-")]


def test_weights_that_the_setting_names_are_listed_where_they_fit(
    caches: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = save(random_weights(SHAPES["vits14"], blocks=1), caches / "vits.pth")
    monkeypatch.setenv("DINO_WEIGHTS", str(file))
    monkeypatch.setenv("EXTRACTOR", VITS)
    found = listed(VITS)
    assert (found["path"], found["source"]) == (str(file), "DINO_WEIGHTS")
    other = listed("anyloc-vitb14")
    assert not other["available"]
    assert "these look like the weights of dinov2-vits14" in other["note"]


# --- fetch: DINOv2 ---------------------------------------------------------------------------


def test_weights_are_fetched_ahead_of_time_and_from_where_an_earlier_fetch_ended(
    server: FilesServer, vits_weights: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.break_after = [3_000_000]
    with monkeypatch.context() as once:
        once.setattr(weight_files, "MAX_DOWNLOAD_ATTEMPTS", 1)
        run("models", "fetch", VITS, code=1)
    server.requests.clear()
    fetched = models("fetch", VITS)
    # huggingface_hub asks for more than files.
    assert [part for path, part in server.requests if path == VITS_FILE] == ["bytes=3000000-"]
    assert Path(fetched["path"]).read_bytes() == vits_weights
    assert (fetched["available"], fetched["dimension"]) == (True, 64 * 384)
    count = len(server.requests)
    assert models("fetch", VITS) == fetched
    assert len(server.requests) == count, "a file that is present is not requested again"


# --- fetch: torch.hub ------------------------------------------------------------------------


def test_a_repository_is_fetched_at_its_commit_and_tried(
    server: FilesServer, caches: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.files[f"/somebody/places/zipball/{COMMIT}"] = repository_zip(caches)
    fetched = models("fetch", REPOSITORY)
    assert fetched["dimension"] == 24
    assert fetched["licence"] == "MIT License (LICENSE)"
    assert fetched["size_bytes"] == 192 * 24 * 4
    assert Path(fetched["path"]) == caches / "torch" / "hub" / f"somebody_places_{COMMIT}"
    assert [p.name for p in (caches / "torch" / "hub").iterdir() if p.is_dir()] == [
        f"somebody_places_{COMMIT}"
    ]

    monkeypatch.setenv("CODE_ALLOWED", REPOSITORY)
    server.files.clear()
    found = listed(REPOSITORY)
    assert (found["available"], found["path"]) == (True, fetched["path"])


def test_weights_of_an_entry_are_downloaded_resumably(server: FilesServer, caches: Path) -> None:
    projection = np.random.default_rng(1).standard_normal((192, 24)).astype(np.float32)
    file = save({"projection": torch.from_numpy(projection)}, caches / "weights.pth")
    server.files["/weights.pth"] = file.read_bytes()
    server.break_after = [10_000]
    folder = write_hub(caches / "hub")
    hubconf = folder / "hubconf.py"
    hubconf.write_text(hubconf.read_text().replace("http://127.0.0.1:9", server.url))
    fetched = models("fetch", f"torchhub:{folder}:from_network")
    assert fetched["available"]
    assert server.requests == [("/weights.pth", None), ("/weights.pth", "bytes=10000-")]
    assert (caches / "torch" / "hub" / "checkpoints" / "weights.pth").exists()


@pytest.mark.parametrize("packed", ["of another commit", "no archive"])
def test_an_archive_of_something_else_is_refused(
    server: FilesServer, caches: Path, packed: str
) -> None:
    archive = repository_zip(caches, comment="f" * 40) if packed == "of another commit" else b"<p>"
    server.files[f"/somebody/places/zipball/{COMMIT}"] = archive
    assert models("fetch", REPOSITORY, code=1)["code"] == "download_corrupt"
    assert not (caches / "torch" / "hub" / f"somebody_places_{COMMIT}").exists()


def test_fetch_prints_the_setting_that_allows_the_code(caches: Path) -> None:
    name = f"torchhub:{write_hub(caches / 'hub', licence=None)}:colours"
    reported = run("models", "fetch", name).output.replace("\n", "")
    assert f"CODE_ALLOWED={name}" in reported
    assert "Licence: none found" in reported


def test_an_extractor_for_tests_has_nothing_to_fetch() -> None:
    assert models("fetch", "test-tiny-avg", code=1)["code"] == "no_weights"
    assert models("fetch", "anyloc", code=1)["code"] == "unknown_extractor"


def test_a_checkpoint_is_uploaded_under_the_name_of_its_file(tmp_path: Path) -> None:
    checkpoint = tmp_path / "best.ckpt"
    checkpoint.write_bytes(b"w" * 300_000)
    made = {"extractor": "gsv:lab", "dimension": 512, "size_bytes": 1, "fingerprint": "f" * 64}
    with running_server() as gateway:
        gateway.will_answer(200, {"models": []})
        started = {
            "job_id": JOB["job_id"],
            "status": "queued",
            "status_url": "",
            "result_url": None,
        }
        gateway.will_answer(202, started)
        ended = {**JOB, "state": "succeeded", "result": {**made, "already_there": False}}
        gateway.will_answer(200, ended)
        result = run("models", "add", checkpoint, "--name", "lab", "--server", gateway.url)
    assert "gsv:lab: 512 dimensions" in result.stdout
    body = gateway.requests[1][2]
    assert checkpoint.read_bytes() in body
    assert b'filename="best.ckpt"' in body
