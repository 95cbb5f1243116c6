"""`placewise describe`: the rows of an upload, in a file, without a server."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from shared.descriptors.aggregators.clustering import soft_vlad
from shared.descriptors.backbones.dinov2 import SHAPES, Dinov2
from shared.descriptors.backbones.synthetic import TinyBackbone
from shared.descriptors.extractor import Extractor
from shared.extractor_config.configs import get_extractor_config
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import get_preprocessing
from tests.support.commands import run, run_json
from tests.support.photos import encoded, photo_image
from tests.support.vit import random_weights, save

describe = partial(run_json, "describe")
CPU = torch.device("cpu")
SIZES = [(64, 48), (48, 64), (64, 48), (90, 70), (64, 48)]


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECODE_PROCESSES", "1")
    monkeypatch.setenv("BATCH_PHOTOS", "2")
    monkeypatch.setenv("DEVICE", "cpu")


@pytest.fixture
def photos(tmp_path: Path) -> list[Path]:
    found = []
    for number, size in enumerate(SIZES):
        # In no alphabetical order: the rows are to come as they were given.
        path = tmp_path / f"photo {(number * 3) % 5} [{number}].png"
        path.write_bytes(encoded(photo_image(number, *size), "PNG"))
        found.append(path)
    return found


@pytest.fixture
def out(tmp_path: Path) -> Path:
    folder = tmp_path / "rows"
    folder.mkdir()
    return folder / "rows.npy"


def expected(name: str, photos: list[Path]) -> np.ndarray[Any, Any]:
    made = Extractor(get_extractor_config(name, allow_test_extractors=True), CPU)
    pixels = [decode_photo(path.read_bytes(), made.preprocessing, 10**9).pixels for path in photos]
    return np.stack([made.describe([one], None)[0] for one in pixels])


def test_rows_are_the_extractors_in_the_order_given(photos: list[Path], out: Path) -> None:
    answer = describe(*photos, "--out", out)  # the default extractor
    rows = np.load(out)
    assert (rows.dtype, rows.shape) == (np.float32, (5, 16))
    np.testing.assert_allclose(rows, expected("test-tiny-avg", photos), atol=1e-6)
    assert (answer["file"], answer["rows"], answer["dimension"]) == (str(out), 5, 16)
    assert answer["spec"]["extractor"] == "test-tiny-avg"
    assert {"load", "describe", "total"} == set(answer["seconds"])
    assert [path.name for path in out.parent.iterdir()] == ["rows.npy"]


def test_dinov2_is_described_with_weights_and_vocabulary_from_files(
    out: Path, tmp_path: Path
) -> None:
    """The published ViT-S in size, with random weights, as AnyLoc's demo would take it."""
    photo = tmp_path / "photo.png"
    photo.write_bytes(encoded(photo_image(1, 75, 61), "PNG"))
    weights = save(random_weights(SHAPES["vits14"]), tmp_path / "weights.pth")
    array = np.random.default_rng(0).standard_normal((4, 384)).astype(np.float32)
    torch.save(torch.from_numpy(array), tmp_path / "c_centers.pt")
    answer = describe(
        photo, "--out", out, "--weights", weights, "--vocabulary", tmp_path / "c_centers.pt",
        "--extractor",
        "anyloc-vits14:layer=11,facet=key,preprocessing=demo1024,aggregator=soft-vlad",
    )  # fmt: skip
    assert answer["spec"]["extractor"] == (
        "anyloc-vits14:aggregator=soft-vlad,facet=key,layer=11,preprocessing=demo1024"
    )
    pixels = get_preprocessing("demo1024").apply(photo_image(1, 75, 61))
    assert pixels.shape == (56, 70, 3)
    features = Dinov2("vits14", 11, "key", CPU, weights).features(
        torch.from_numpy(np.stack([pixels]))
    )
    reference = soft_vlad(features, torch.from_numpy(array), 1.0)
    np.testing.assert_allclose(np.load(out), reference, atol=1e-5)


def test_every_photo_that_cannot_be_described_is_named_and_nothing_is_written(
    photos: list[Path], out: Path, tmp_path: Path
) -> None:
    out.write_bytes(b"what was there before")
    text = tmp_path / "notes [b].jpg"
    text.write_text("no photo")
    missing = tmp_path / "missing.jpg"
    given = [photos[0], text, photos[1], photos[2], missing, tmp_path, photos[3]]
    problem = describe(*given, "--out", out, code=1)
    assert problem["code"] == "photos_refused"
    assert "3 of 7 photos" in problem["detail"]
    named = [(entry["photo"], entry["code"]) for entry in problem["refused"]]
    assert named == [
        (str(text), "undecodable_photo"),
        (str(missing), "photo_unreadable"),
        (str(tmp_path), "photo_unreadable"),
    ]
    assert out.read_bytes() == b"what was there before"
    assert [path.name for path in out.parent.iterdir()] == ["rows.npy"]
    shown = run("describe", text, "--out", out, code=1)
    assert "notes [b].jpg: The photo can't be decoded" in shown.stderr


def test_descriptor_that_is_not_finite_is_not_written(
    photos: list[Path], out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = TinyBackbone.features

    def overflow(self: TinyBackbone, pixels: torch.Tensor) -> torch.Tensor:
        features = real(self, pixels).clone()
        features[0] = torch.inf
        return features

    monkeypatch.setattr(TinyBackbone, "features", overflow)
    problem = describe(*photos, "--out", out, code=1)
    assert problem["code"] == "features_not_finite"
    assert str(photos[0]) in problem["detail"]
    assert list(out.parent.iterdir()) == []


def test_photo_that_the_gpu_can_not_hold_is_named(
    photos: list[Path], out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, passes = Extractor.features, iter(range(10))

    def features(made: Extractor, pixels: Any) -> torch.Tensor:
        if next(passes) in (1, 3):  # the second batch, then its second photo alone
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return real(made, pixels)

    monkeypatch.setattr(Extractor, "features", features)
    problem = describe(*photos, "--out", out, code=1)
    assert problem["code"] == "photos_refused"
    (refused,) = problem["refused"]
    assert (refused["photo"], refused["code"]) == (str(photos[3]), "gpu_out_of_memory")
    assert list(out.parent.iterdir()) == []


def test_interrupted_run_leaves_nothing_behind(
    photos: list[Path], out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any) -> None:
        assert len(list(out.parent.iterdir())) == 1, "rows are written as they come"
        raise KeyboardInterrupt

    monkeypatch.setattr(Extractor, "describe", interrupted)
    run("describe", *photos, "--out", out, code=130)
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--extractor", "anyloc-vits14", "--checkpoint", "{centres}"], "options_contradict", ""),
        (["--extractor", "test-tiny-avg:layer=3"], "bad_extractor_option", "'layer'"),
        (["--weights", "{centres}"], "weights_unused", "test-tiny-avg"),
        (["--extractor", "anyloc-vits14"], "vocabulary_missing", "--vocabulary FILE"),
        (["--extractor", "test-tiny-avg", "--vocabulary", "{centres}"],
         "vocabulary_unusable", "no"),
        (["--extractor", "anyloc-vits14", "--vocabulary", "{centres}"],
         "vocabulary_unusable", "384"),
    ],
)  # fmt: skip
def test_contradicting_options_are_refused_before_anything_is_loaded(
    photos: list[Path], out: Path, tmp_path: Path, arguments: list[str], code: str, message: str
) -> None:
    centres = tmp_path / "centres.npy"
    np.save(centres, np.eye(3, 16, dtype=np.float32))
    filled = [argument.format(centres=centres) for argument in arguments]
    problem = describe(*photos, "--out", out, *filled, code=1)
    assert problem["code"] == code, problem
    assert message in problem["detail"]


def test_folder_that_is_not_there_is_named(photos: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "nowhere" / "rows.npy"
    problem = describe(photos[0], "--out", out, code=1)
    assert problem["code"] == "out_unwritable"
    assert str(out) in problem["detail"]


def test_the_installed_program_describes_photos(photos: list[Path], out: Path) -> None:
    """As people call it: its children import the program anew."""
    program = [sys.executable, "-c", "from services.cli import main; main()"]
    ended = subprocess.run(
        [*program, "describe", *map(str, photos), "--out", str(out)],
        env=os.environ,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "5 rows of 16 dimensions" in ended.stdout.replace("\n", " ")
    assert np.load(out).shape == (5, 16)


def test_h5_file_holds_hlocs_global_features_by_name(
    photos: list[Path], out: Path, tmp_path: Path
) -> None:
    features = out.with_suffix(".h5")
    describe(*photos, "--out", features, "--root", tmp_path)
    reference = expected("test-tiny-avg", photos)
    with h5py.File(features) as file:
        assert set(file) == {photo.name for photo in photos}
        for photo, row in zip(photos, reference, strict=True):
            found = file[photo.name]["global_descriptor"]
            assert found.dtype == np.float32
            np.testing.assert_allclose(found[()], row, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["{photo}", "--out", "{out}.npy", "--root", "{folder}"], "options_contradict"),
        (["{photo}", "--out", "{out}.h5", "--root", "{out}"], "bad_names"),
        (["{photo}", "{photo}", "--out", "{out}.h5"], "bad_names"),
    ],
)
def test_names_that_an_h5_file_can_not_hold_are_refused(
    photos: list[Path], out: Path, tmp_path: Path, arguments: list[str], code: str
) -> None:
    fields = {"photo": photos[0], "out": out.parent, "folder": tmp_path}
    problem = describe(*(argument.format(**fields) for argument in arguments), code=1)
    assert problem["code"] == code
