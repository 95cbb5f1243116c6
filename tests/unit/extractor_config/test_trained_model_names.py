"""Names of trained models, and where each of the two kinds may stand."""

from __future__ import annotations

import pytest

from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.extractor_config.configs import get_extractor_config
from shared.extractor_config.names import parse_trained_model_name


def test_a_name_means_a_model_that_was_added_and_a_path_means_a_file() -> None:
    added = parse_trained_model_name("gsv:night-walks.2")
    assert (added.registered, added.file) == ("night-walks.2", None)
    file = parse_trained_model_name("gsv:/models/best epoch.ckpt")
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
