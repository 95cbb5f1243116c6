"""What can be compared is known from the configuration and the spec, before anything is queued."""

from __future__ import annotations

from typing import Any

import pytest

from shared.errors import Unprocessable
from shared.extractor_config.configs import get_extractor_config
from shared.search_api.comparison import check_explainable, check_rerankable

HUB = "torchhub:/models/mine:my_entry"
VITB = "anyloc-vitb14"


def spec(dimension: int, clusters: int | None) -> dict[str, Any]:
    return {"dimension": dimension, "clusters": clusters}


def config_of(name: str) -> Any:
    return get_extractor_config(name, allow_test_extractors=True)


@pytest.mark.parametrize(
    ("name", "of_generation"),
    [
        ("efficientnet-lite0-vlad", spec(64 * 112, 64)),
        (f"{VITB}:aggregator=soft-vlad", spec(32 * 768, 32)),
        (f"{VITB}:aggregator=avg", spec(768, None)),
        (VITB, None),  # no photo has been described yet
    ],
)
def test_sums_over_patches_can_be_explained(
    name: str, of_generation: dict[str, Any] | None
) -> None:
    check_explainable(config_of(name), of_generation)
    check_rerankable(config_of(name))


@pytest.mark.parametrize(
    ("name", "of_generation", "why"),
    [
        (f"{VITB}:aggregator=gem", spec(768, None), "GeM"),
        (HUB, spec(8448, None), "one feature per photo"),
        (VITB, spec(512, 64), "PCA"),
        (f"{VITB}:aggregator=avg", spec(256, None), "PCA"),
    ],
)
def test_what_is_no_sum_over_patches_says_why(
    name: str, of_generation: dict[str, Any], why: str
) -> None:
    with pytest.raises(Unprocessable, match=why) as refused:
        check_explainable(config_of(name), of_generation)
    assert refused.value.code == "not_explainable"


def test_a_photo_is_reranked_by_its_patches_however_they_are_pooled() -> None:
    with pytest.raises(Unprocessable, match="compares patches") as refused:
        check_rerankable(config_of(HUB))
    assert refused.value.code == "not_rerankable"
    check_rerankable(config_of(f"{VITB}:aggregator=gem"))
