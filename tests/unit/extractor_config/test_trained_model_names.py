"""Names of trained models, and where each of the two kinds may stand."""

from __future__ import annotations

import pytest

from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.extractor_config.configs import get_extractor_config
from shared.extractor_config.names import parse_model_name


def test_a_name_means_a_model_that_was_added_and_a_path_means_a_file() -> None:
    added = parse_model_name("gsv:night-walks.2")
    assert (added.registered, added.file) == ("night-walks.2", None)
    file = parse_model_name("gsv:/models/best epoch.ckpt")
    assert (file.registered, file.file) == (None, "/models/best epoch.ckpt")
    assert [name.extractor for name in (added, file)] == [
        "gsv:night-walks.2",
        "gsv:/models/best epoch.ckpt",
    ]


@pytest.mark.parametrize(
    "name", ["gsv:", "gsv:a/b", "gsv:.hidden", "gsv:name:layer=3", "gsv:/" + "x" * 200, "gsv:é"]
)
def test_what_is_neither_is_refused(name: str) -> None:
    with pytest.raises(Misconfigured) as caught:
        get_extractor_config(name, allow_test_extractors=False)
    assert caught.value.code == "bad_model_name"


def test_only_the_loaded_model_knows_how_photos_are_resized() -> None:
    config = get_extractor_config("gsv:walks", allow_test_extractors=False)
    assert (config.name, config.aggregator) == ("gsv:walks", "none")
    assert (config.width, config.dimension, config.preprocessing) == (None, None, None)
    other = get_extractor_config("gsv:nights", allow_test_extractors=False)
    assert config.backbone_key != other.backbone_key


def test_maps_use_models_that_were_added_and_no_files(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings().extractor_config("gsv:walks").name == "gsv:walks"
    with pytest.raises(Misconfigured) as caught:
        Settings().extractor_config("gsv:/models/best.ckpt")
    assert caught.value.code == "model_not_added"
    assert "placewise models add /models/best.ckpt" in caught.value.detail
    monkeypatch.setenv("EXTRACTOR", "gsv:walks")
    assert Settings().new_map_extractor == "gsv:walks"
    monkeypatch.setenv("EXTRACTOR", "gsv:/models/best.ckpt")
    with pytest.raises(ValueError, match="placewise models add"):
        Settings()


@pytest.mark.parametrize(
    ("written", "canonical"),
    [
        ("onnx:town", "onnx:town"),
        ("onnx:town:input.size=0224x224,aggregator=none", "onnx:town"),
        (
            "torchscript:/a/b.pt:input.size=native,clusters=9,aggregator=vlad,input.range=255",
            "torchscript:/a/b.pt:aggregator=vlad,clusters=9,input.range=255,input.size=native",
        ),
        ("onnx:t:input.layout=nchw,input.std=.5/.5/.5", "onnx:t:input.std=0.5/0.5/0.5"),
    ],
)
def test_an_exported_network_has_one_name(written: str, canonical: str) -> None:
    config = get_extractor_config(written, allow_test_extractors=False)
    assert config.name == canonical
    assert get_extractor_config(canonical, allow_test_extractors=False) == config


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("onnx:", "bad_model_name"),
        ("torchscript:a/b", "bad_model_name"),
        ("onnx:t:", "bad_extractor_option"),
        ("onnx:t:input.size=8x8", "bad_extractor_option"),
        ("onnx:t:input.range=2", "bad_extractor_option"),
        ("onnx:t:input.range=1,input.mean=0/0/0", "bad_extractor_option"),
        ("onnx:t:input.crop=1", "bad_extractor_option"),
        ("onnx:t:clusters=9", "bad_extractor_option"),
        ("onnx:t:aggregator=max", "bad_extractor_option"),
        ("onnx:t:layer=3", "bad_extractor_option"),
        (f"onnx:/{'x' * 180}:input.size=1000x1000", "bad_extractor_option"),
    ],
)
def test_the_name_of_an_exported_network_that_can_not_be_read_is_refused(
    name: str, code: str
) -> None:
    with pytest.raises(Misconfigured) as caught:
        get_extractor_config(name, allow_test_extractors=False)
    assert caught.value.code == code
