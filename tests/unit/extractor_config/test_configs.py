"""Recipes: extractors by name and options, one name for one extractor, and what is refused."""

from __future__ import annotations

import subprocess
import sys

import pytest

from shared.errors import Misconfigured
from shared.extractor_config.configs import (
    EXTRACTOR_AGGREGATORS,
    EXTRACTOR_CONFIGS,
    PREPROCESSING_NAMES,
    ExtractorConfig,
    add_extractor_options,
    get_extractor_config,
    pooled_config,
)
from shared.imaging.preprocessing import PREPROCESSINGS as IN_VISION
from shared.imaging.preprocessing import get_preprocessing

ANYLOC_OPTIONS = "Its options: aggregator, clusters, facet, layer, preprocessing."


def config(name: str) -> ExtractorConfig:
    return get_extractor_config(name, allow_test_extractors=False)


def refusal(name: str, code: str) -> str:
    """The detail with which the name is refused."""
    with pytest.raises(Misconfigured) as caught:
        config(name)
    assert caught.value.code == code
    return caught.value.detail


@pytest.mark.parametrize("name", ["test-tiny-avg", "test-tiny-vlad", "test-slow-avg"])
def test_test_extractors_are_refused_unless_allowed(name: str) -> None:
    assert "ALLOW_TEST_EXTRACTORS" in refusal(name, "test_extractor")
    refusal(f"{name}:clusters=3", "test_extractor")
    assert get_extractor_config(name, allow_test_extractors=True).name == name


@pytest.mark.parametrize("name", ["anyloc", "", "anyloc:layer=9", ":clusters=3", "ANYLOC-VITB14"])
def test_unknown_extractor_names_the_known_but_not_those_for_tests(name: str) -> None:
    detail = refusal(name, "unknown_extractor")
    for known in ("efficientnet-lite0-vlad", "anyloc-vits14", "anyloc-vitg14"):
        assert known in detail
    assert "test-" not in detail


@pytest.mark.parametrize(
    ("name", "layer", "dimension"),
    [
        ("anyloc-vits14", 10, 64 * 384),
        ("anyloc-vitb14", 10, 64 * 768),
        ("anyloc-vitl14", 20, 64 * 1024),
        ("anyloc-vitg14", 31, 98_304),
    ],
)
def test_anyloc_takes_the_value_facet_of_its_authors_layer(
    name: str, layer: int, dimension: int
) -> None:
    found = config(name)
    assert (found.layer, found.facet, found.dimension) == (layer, "value", dimension)
    assert found.needs_vocabulary
    assert found.shipped_vocabulary is None


def test_dimension_follows_the_clusters_of_vlad_only() -> None:
    assert config("efficientnet-lite0-vlad").dimension == 7168
    assert config("efficientnet-lite0-vlad128").dimension == 128 * 112
    assert config("efficientnet-lite0-vlad:clusters=8").dimension == 8 * 112
    assert EXTRACTOR_CONFIGS["test-tiny-avg"].dimension == 16


@pytest.mark.parametrize(
    ("written", "canonical"),
    [
        ("anyloc-vitb14:layer=9,facet=key,clusters=32", "clusters=32,facet=key,layer=9"),
        ("anyloc-vitb14:facet=key,clusters=32,layer=9", "clusters=32,facet=key,layer=9"),
        ("anyloc-vitb14:layer=10,facet=token", "facet=token"),
        ("anyloc-vitb14:clusters=0032", "clusters=32"),
        ("anyloc-vitb14:layer=10,facet=value,clusters=64", ""),
        ("anyloc-vitb14:preprocessing=square224,aggregator=vlad", ""),
        (
            "anyloc-vitb14:preprocessing=demo1024,aggregator=gem,layer=9",
            "aggregator=gem,layer=9,preprocessing=demo1024",
        ),
        (
            "anyloc-vitb14:temperature=02.50,aggregator=soft-vlad",
            "aggregator=soft-vlad,temperature=2.5",
        ),
        ("anyloc-vitb14:temperature=1.0,aggregator=soft-vlad", "aggregator=soft-vlad"),
        (
            "anyloc-vitb14:aggregator=soft-vlad,temperature=100",
            "aggregator=soft-vlad,temperature=100",
        ),
    ],
)
def test_equivalent_names_have_one_canonical_form(written: str, canonical: str) -> None:
    found = config(written)
    assert found.name == ("anyloc-vitb14:" + canonical).rstrip(":")
    assert config(found.name) == found


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("anyloc-vitb14:depth=9", ["'depth'", ANYLOC_OPTIONS]),
        ("anyloc-vitb14:", ["''", ANYLOC_OPTIONS]),
        ("anyloc-vitb14:layer=9,", ["''", ANYLOC_OPTIONS]),
        ("anyloc-vitb14:layer", ["layer=", "0 to 11"]),
        ("anyloc-vitb14:layer=12", ["layer=12", "0 to 11", "12 blocks"]),
        ("anyloc-vitg14:layer=40", ["layer=40", "0 to 39"]),
        ("anyloc-vitb14:layer=-1", ["layer=-1", "0 to 11"]),
        ("anyloc-vitb14:layer=+9", ["layer=+9"]),
        ("anyloc-vitb14:layer=nine", ["layer=nine"]),
        ("anyloc-vitb14:facet=values", ["facet=values", "query, key, value, token"]),
        ("anyloc-vitb14:clusters=0", ["clusters=0", "1 to 4096"]),
        ("anyloc-vitb14:clusters=4097", ["clusters=4097", "1 to 4096"]),
        ("anyloc-vitb14:layer=9,layer=8", ["layer", "twice"]),
        ("efficientnet-lite0-vlad:layer=3", ["'layer'", "aggregator, clusters, preprocessing."]),
        ("anyloc-vitb14:preprocessing=square32", ["square32", "square224, demo1024, paper480x640"]),
        ("anyloc-vitb14:aggregator=mean", ["aggregator=mean", "vlad, soft-vlad, gem, avg"]),
        ("anyloc-vitb14:clusters=8,aggregator=gem", ["'clusters' with gem", "aggregator, facet"]),
        ("anyloc-vitb14:temperature=2", ["'temperature'", ANYLOC_OPTIONS]),
        *(
            (f"anyloc-vitb14:aggregator=soft-vlad,temperature={value}", ["above 0 and up to 1000"])
            for value in ("0", "0.0", "1001", "-1", "inf", "nan", "1e2", "1.2345678", "")
        ),
    ],
)
def test_bad_options_are_named_with_what_is_allowed(name: str, fields: list[str]) -> None:
    detail = refusal(name, "bad_extractor_option")
    assert name.partition(":")[0] in detail
    for words in fields:
        assert words in detail


def test_shipped_vocabulary_begins_a_map_whatever_number_later_fits_make() -> None:
    own = config("efficientnet-lite0-vlad")
    assert own.shipped_vocabulary is not None
    assert config("efficientnet-lite0-vlad:clusters=8").shipped_vocabulary == own.shipped_vocabulary


def test_area_preprocessing_is_for_convolutional_backbones() -> None:
    found = config("efficientnet-lite0-vlad:preprocessing=area288x384")
    assert found.preprocessing == config("efficientnet-lite0-vlad128").preprocessing
    with pytest.raises(Misconfigured, match="preprocessing is one of square224, demo1024"):
        config("anyloc-vitb14:preprocessing=area288x384")


def test_aggregators_without_a_vocabulary_have_the_length_of_a_local_feature() -> None:
    for aggregator in ("gem", "avg"):
        found = config(f"efficientnet-lite0-vlad:aggregator={aggregator}")
        assert (found.dimension, found.needs_vocabulary) == (112, False)
        assert found.shipped_vocabulary is None
    soft = config("efficientnet-lite0-vlad:aggregator=soft-vlad")
    assert (soft.dimension, soft.needs_vocabulary) == (7168, True)
    assert soft.shipped_vocabulary is not None


def test_names_take_further_options() -> None:
    assert add_extractor_options("anyloc-vitb14", {"layer": None}) == "anyloc-vitb14"
    assert add_extractor_options("anyloc-vitb14", {"layer": 9}) == "anyloc-vitb14:layer=9"
    further = add_extractor_options("anyloc-vitb14:layer=9", {"facet": "key", "layer": None})
    assert further == "anyloc-vitb14:layer=9,facet=key"


def test_preprocessings_are_those_that_vision_has() -> None:
    assert set(IN_VISION) == {*PREPROCESSING_NAMES, "native1024", "square32"}
    for found in EXTRACTOR_CONFIGS.values():
        assert found.preprocessing is not None
        assert get_preprocessing(found.preprocessing).name == found.preprocessing
        assert found.aggregator in (*EXTRACTOR_AGGREGATORS, "none")


def test_only_what_changes_the_local_features_needs_another_backbone() -> None:
    own = config("anyloc-vitb14").backbone_key
    for option in ("clusters=8", "aggregator=gem", "preprocessing=demo1024"):
        assert config(f"anyloc-vitb14:{option}").backbone_key == own
    for other in ("anyloc-vitb14:layer=9", "anyloc-vitb14:facet=key", "anyloc-vits14"):
        assert config(other).backbone_key != own


def test_extractors_are_chosen_without_torch() -> None:
    code = "import shared.extractor_config.configs, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("name", "pooled"),
    [
        ("anyloc-vitg14", "anyloc-vitg14:aggregator=gem"),
        (
            "anyloc-vits14:clusters=32,temperature=2,aggregator=soft-vlad",
            "anyloc-vits14:aggregator=gem",
        ),
        (
            "anyloc-vitb14:aggregator=soft-vlad,facet=key,layer=9,preprocessing=demo1024",
            "anyloc-vitb14:aggregator=gem,facet=key,layer=9,preprocessing=demo1024",
        ),
    ],
)
def test_the_pooled_form_of_a_vlad_extractor_keeps_its_local_features(
    name: str, pooled: str
) -> None:
    found = pooled_config(config(name))
    assert found.name == pooled
    assert found.backbone_key == config(name).backbone_key
    assert found.preprocessing == config(name).preprocessing
    assert not found.needs_vocabulary
