"""torch.hub entries as extractors: what they describe, what pins them, and what is refused."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from shared.descriptors.backbones import torchhub as torchhub_module
from shared.descriptors.backbones.torchhub import TorchHubBackbone
from shared.descriptors.extractor import Extractor, spec_fingerprint
from shared.errors import Misconfigured
from shared.extractor_config.configs import get_extractor_config
from tests.support.hub import COMMIT, MIT, NETWORKS, write_hub
from tests.support.photos import photo_image

CPU = torch.device("cpu")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_hub(tmp_path / "hub")


@pytest.fixture(autouse=True)
def torch_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """torch.hub's own folder, empty."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return tmp_path / "torch" / "hub"


def extractor(folder: Path, entry: str) -> Extractor:
    config = get_extractor_config(f"torchhub:{folder}:{entry}", allow_test_extractors=False)
    return Extractor(config, CPU)


def refusal(folder: Path, entry: str, code: str = "torchhub_unusable") -> str:
    with pytest.raises(Misconfigured) as caught:
        extractor(folder, entry)
    assert caught.value.code == code
    for way in ("(1)", "(2)", "(3)"):
        assert way in caught.value.detail
    return caught.value.detail


def pixels_of(made: Extractor, *numbers: int) -> NDArray[np.uint8]:
    return np.stack([np.asarray(made.preprocessing.apply(photo_image(n))) for n in numbers])


# --- what it makes ---------------------------------------------------------------------------


def test_descriptors_are_those_of_the_network_on_normalised_pixels(folder: Path) -> None:
    made = extractor(folder, "colours:dimension=40")
    pixels = pixels_of(made, 1, 2)
    rows = made.describe(pixels, None)

    scaled = (pixels / 255 - np.array([0.485, 0.456, 0.406])) / np.array([0.229, 0.224, 0.225])
    cells = scaled.reshape(2, 8, 28, 8, 28, 3).mean(axis=(2, 4)).transpose(0, 3, 1, 2)
    draw = torch.Generator().manual_seed(7)
    projection = torch.randn(192, 40, generator=draw).double().numpy()
    expected = cells.reshape(2, 192) @ projection
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(rows, expected, atol=1e-5)
    assert rows.dtype == np.float32


def test_dimension_is_found_by_describing_and_of_several_answers_the_first_counts(
    folder: Path,
) -> None:
    made = extractor(folder, "colours:dimension=40,input.size=32x48")
    spec = made.spec(None)
    assert (spec["dimension"], made.dimension(None)) == (40, 40)
    assert (spec["aggregator"], spec["vocabulary_sha256"], spec["facet"]) == ("none", None, None)
    assert spec["preprocessing"] == {"name": "resize32x48", "version": 1}
    assert pixels_of(made, 1).shape == (1, 32, 48, 3)
    assert made.shipped_vocabulary() is None
    one, both = extractor(folder, "colours"), extractor(folder, "with_attention")
    pixels = pixels_of(one, 3)
    np.testing.assert_array_equal(both.describe(pixels, None), one.describe(pixels, None))


# --- what pins it ----------------------------------------------------------------------------


def test_the_spec_names_the_code_the_arguments_and_the_weights_and_nothing_else(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    monkeypatch.setattr(sys, "pycache_prefix", None)
    first = extractor(folder, "colours").spec(None)
    assert extractor(folder, "colours").spec(None) == first
    assert not list(folder.rglob("*.pyc")), "loading changes nothing in the folder"
    for name in (".git/HEAD", "__pycache__/networks.pyc", ".DS_Store"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("x")
    assert extractor(folder, "colours").spec(None) == first, "these are no code"

    def changed(entry: str) -> set[str]:
        spec = extractor(folder, entry).spec(None)
        return {key for key in first if first[key] != spec[key]}

    assert changed("colours:scale=2.0") == {"extractor", "backbone", "backbone_fingerprint"}
    (folder / "settings.json").write_text("{}")
    assert changed("colours") == {"code_fingerprint"}, "code that only reads otherwise"


def test_changed_code_is_another_spec_and_is_what_runs(folder: Path) -> None:
    before = extractor(folder, "colours")
    source = folder / "networks.py"
    source.write_text(NETWORKS.replace("manual_seed(7)", "manual_seed(8)"))  # of the same length
    after = extractor(folder, "colours")
    assert spec_fingerprint(after.spec(None)) != spec_fingerprint(before.spec(None))
    assert after.spec(None)["code_fingerprint"] != before.spec(None)["code_fingerprint"]
    assert after.backbone.fingerprint != before.backbone.fingerprint
    pixels = pixels_of(after, 1)
    assert not np.allclose(after.describe(pixels, None), before.describe(pixels, None))


def test_repositories_with_equal_module_names_are_kept_apart(folder: Path, tmp_path: Path) -> None:
    other = write_hub(tmp_path / "other")
    (other / "networks.py").write_text(NETWORKS.replace("dimension=24", "dimension=8"))
    assert "networks" not in sys.modules
    assert extractor(folder, "prints").dimension(None) == 24
    assert extractor(other, "prints").dimension(None) == 8
    assert "networks" not in sys.modules


@pytest.mark.parametrize(
    ("name", "text", "shown"),
    [
        ("LICENSE", MIT, "MIT License (LICENSE)"),
        (
            "COPYING.txt",
            "GNU GPL\nVersion 3, 29 June 2007\n...",
            "GNU GPL, Version 3, 29 June 2007",
        ),
        ("licence.md", "\n  Apache License\n  Version 2.0\n", "Apache License, Version 2.0"),
        ("README.md", "MIT License", "none found"),
    ],
)
def test_licence_of_the_code_is_read_or_reported_as_missing(
    tmp_path: Path, name: str, text: str, shown: str
) -> None:
    folder = write_hub(tmp_path / "bare", licence=None)
    (folder / name).write_text(text)
    assert extractor(folder, "colours").backbone.licence.startswith(shown)


# --- what is refused -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("missing_entry", "missing_entry"),
        ("fails", "KeyError: 'no such backbone'"),
        ("colours:depth=3", "depth"),
        ("a_number", "returns a int"),
        ("maps", "(2, 4, 224, 224)"),
        ("not_finite", "NaN"),
        ("zero", "zero"),
        ("of_the_batch", "depends on the other photos of its batch"),
        ("one_size", "only 320 x 320 will do"),
        ("colours:dimension=200000", "200000 dimensions"),
        ("asks", "It asks a question"),
    ],
)
def test_an_entry_that_is_no_extractor_is_refused_with_the_reason(
    folder: Path, entry: str, message: str
) -> None:
    assert message in refusal(folder, entry)


def test_output_of_torch_hub_code_does_not_reach_stdout(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    extractor(folder, "prints")
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "printed by the code of others" in printed.err


def test_missing_packages_folders_and_weights_are_errors_with_the_three_ways(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shared.descriptors.weight_files.RETRY_PAUSE_SECONDS", 0)
    assert "can't be downloaded" in refusal(folder, "from_network", "weights_missing")
    hubconf = folder / "hubconf.py"
    hubconf.write_text(hubconf.read_text().replace('["torch"]', '["torch", "no_such_package"]'))
    assert "no_such_package" in refusal(folder, "colours")
    reported = refusal(tmp_path / "gone", "colours", "weights_missing")
    assert f"there is no {tmp_path / 'gone' / 'hubconf.py'}" in reported
    assert "placewise models fetch torchhub:" in reported


def test_a_repository_in_torch_hubs_folder_is_taken_without_the_network(
    folder: Path, torch_home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torchhub_module, "GITHUB", "http://127.0.0.1:9")
    monkeypatch.setattr("shared.descriptors.weight_files.RETRY_PAUSE_SECONDS", 0)
    name = f"torchhub:somebody/places@{COMMIT}:colours"
    config = get_extractor_config(name, allow_test_extractors=False)
    with pytest.raises(Misconfigured) as caught:
        Extractor(config, CPU)
    assert caught.value.code == "weights_missing"
    shutil.copytree(folder, torch_home / f"somebody_places_{COMMIT}")
    found = Extractor(config, CPU)
    assert found.backbone.card["source"] == f"somebody/places@{COMMIT}"
    assert isinstance(found.backbone, TorchHubBackbone)
    assert found.spec(None)["code_fingerprint"] == torchhub_module.code_fingerprint(folder)
