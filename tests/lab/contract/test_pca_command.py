"""`placewise models fit-pca` on a file or a folder, and `describe --pca`: without a server."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from typer.testing import CliRunner

from services.cli.main import build_app
from shared.descriptors.pca_fit import fit_pca
from shared.descriptors.pca_whitening import PcaProjection, decode_whitening
from tests.support.photos import photo_bytes

PHOTOS = 9
KEPT = 4
LONGER = ("dimension", "whitening")  # what a projection changes of a spec


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECODE_PROCESSES", "1")
    monkeypatch.setenv("DEVICE", "cpu")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    for number in range(PHOTOS):
        (folder / f"{number}.jpg").write_bytes(photo_bytes(number))
    return folder


def run(*arguments: object, code: int = 0) -> dict[str, Any]:
    command = [str(argument) for argument in arguments]
    result = CliRunner().invoke(build_app([command[0]]), [*command, "--json"])
    assert result.exit_code == code, result.output
    answer: dict[str, Any] = json.loads(result.stdout)
    return answer


def unit_rows(count: int = 40, dimension: int = 16) -> NDArray[np.float32]:
    rows = np.random.default_rng(0).standard_normal((count, dimension)).astype(np.float32)
    units: NDArray[np.float32] = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return units


def test_a_folders_whitening_shortens_the_rows_of_the_same_extractor(
    folder: Path, tmp_path: Path
) -> None:
    file, photos = tmp_path / "city.safetensors", sorted(folder.glob("*.jpg"))
    (tmp_path / "broken").mkdir()
    fitted = run("models", "fit-pca", folder, "--dimension", KEPT, "--out", file)
    assert (fitted["from_dimension"], fitted["dimension"]) == (16, KEPT)
    assert (fitted["rows"], fitted["refused"]) == (PHOTOS, [])

    whole = run("describe", *photos, "--out", tmp_path / "whole.npy")
    rows = np.load(tmp_path / "whole.npy")
    expected = fit_pca(rows, KEPT)
    assert fitted["sha256"] == decode_whitening(file.read_bytes()).whitening.sha256
    shorter = run("describe", *photos, "--out", tmp_path / "short.npy", "--pca", file)
    found = np.load(tmp_path / "short.npy")
    by_hand = PcaProjection(expected, torch.device("cpu")).project(rows)
    np.testing.assert_allclose(found, by_hand, atol=1e-3)
    assert shorter["spec"] == {
        **whole["spec"],
        "dimension": KEPT,
        "whitening": {"sha256": fitted["sha256"], "from_dimension": 16},
    }

    # Of other features with as many numbers, it would spoil every row.
    other = run("describe", photos[0], "--out", tmp_path / "no.npy", "--pca", file,
                "--extractor", "test-tiny-vlad:aggregator=gem", code=1)  # fmt: skip
    assert other["code"] == "pca_unusable"
    assert "aggregator is 'gem', was 'avg'" in other["detail"]
    assert not (tmp_path / "no.npy").exists()


def test_a_folders_whitening_is_of_the_precision_that_photos_are_described_in(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PRECISION", "bfloat16")
    file, photo = tmp_path / "city.safetensors", folder / "0.jpg"
    run("models", "fit-pca", folder, "--dimension", KEPT, "--out", file)
    spec = decode_whitening(file.read_bytes()).spec
    assert spec is not None
    assert spec["precision"] == "bfloat16"
    shorter = run("describe", photo, "--out", tmp_path / "short.npy", "--pca", file)
    assert shorter["spec"] == {**spec, **{one: shorter["spec"][one] for one in LONGER}}


def test_a_whitening_is_fitted_on_a_file_of_rows(tmp_path: Path) -> None:
    rows = unit_rows()
    rows[7] = 0  # a photo without anything to describe says nothing
    np.save(tmp_path / "rows.npy", rows)
    file = tmp_path / "rows.safetensors"
    fitted = run("models", "fit-pca", tmp_path / "rows.npy", "--dimension", KEPT, "--out", file)
    found = decode_whitening(file.read_bytes())
    assert found.spec is None
    assert (fitted["rows"], found.whitening.rows) == (39, 39)
    expected = fit_pca(np.delete(rows, 7, axis=0), KEPT)
    np.testing.assert_allclose(found.whitening.directions, expected.directions, atol=1e-4)
    assert fitted["explained"] == pytest.approx(expected.explained)


@pytest.mark.parametrize(
    ("rows", "arguments", "code", "message"),
    [
        (unit_rows(4), ["--dimension", "4"], "pca_too_few_rows", "there are 4"),
        (2 * unit_rows(), [], "bad_rows", "Row 0 has the L2 norm 2"),
        (np.arange(12).reshape(3, 4), [], "bad_rows", "floating point"),
        (unit_rows()[0], [], "bad_rows", "rows"),
        (unit_rows(), ["--extractor", "test-tiny-avg"], "options_contradict", "--extractor"),
        (unit_rows(), ["--out", "no-folder/a.safetensors"], "bad_out", "does not exist"),
        (unit_rows(), ["--out", "a.npz"], "bad_out", ".safetensors"),
    ],
)
def test_what_can_not_be_fitted_is_refused_and_nothing_is_written(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    rows: NDArray[Any],
    arguments: list[str],
    code: str,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("rows.npy", rows)
    out = [] if "--out" in arguments else ["--out", "a.safetensors"]
    dimension = [] if "--dimension" in arguments else ["--dimension", "4"]
    problem = run("models", "fit-pca", "rows.npy", *arguments, *out, *dimension, code=1)
    assert problem["code"] == code, problem
    assert message in problem["detail"]
    assert [path.name for path in tmp_path.iterdir()] == ["rows.npy"]


def test_malformed_files_of_rows_and_whitenings_are_refused(folder: Path, tmp_path: Path) -> None:
    text = tmp_path / "rows.npy"
    text.write_text("no rows")
    assert run("models", "fit-pca", text, "--out", tmp_path / "a.safetensors", code=1)["code"] == (
        "bad_rows"
    )
    photo = folder / "0.jpg"
    refused = run("describe", photo, "--out", tmp_path / "no.npy", "--pca", text, code=1)
    assert refused["code"] == "pca_unusable"
