"""An explanation's shares add up to the similarity, by clusters and by patches."""

from __future__ import annotations

import base64
import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from torch.nn.functional import normalize

from shared.descriptors.aggregators.clustering import soft_vlad, vlad
from shared.descriptors.aggregators.pooling import average_pooling
from shared.descriptors.explanation import (
    NEGATIVE_COLOUR,
    POSITIVE_COLOUR,
    draw_overlay,
    explain_similarities,
)
from shared.descriptors.vocabulary import ClusterCentres, parse_centres
from shared.extractor_config.configs import EXTRACTOR_CONFIGS, ExtractorConfig

pytestmark = pytest.mark.numerics

WIDTH, PATCHES, CLUSTERS = 24, 60, 7
VLAD = EXTRACTOR_CONFIGS["test-tiny-vlad"]
SOFT = replace(VLAD, aggregator="soft-vlad", temperature=3.0)
MEAN = EXTRACTOR_CONFIGS["test-tiny-avg"]


def features(seed: int, count: int = PATCHES) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return normalize(torch.randn(count, WIDTH, generator=generator), dim=-1)


@pytest.fixture
def centres() -> ClusterCentres:
    return parse_centres((0.5 * features(99, CLUSTERS)).numpy())


def described(
    config: ExtractorConfig, photo: torch.Tensor, centres: ClusterCentres
) -> torch.Tensor:
    c = torch.from_numpy(centres.array)
    if config.aggregator == "avg":
        return average_pooling(photo[None])[0]
    if config.aggregator == "vlad":
        return vlad(photo[None], c)[0]
    return soft_vlad(photo[None], c, config.temperature)[0]


@pytest.mark.parametrize("config", [VLAD, SOFT, MEAN], ids=lambda config: config.aggregator)
def test_shares_of_patches_and_of_clusters_add_up_to_the_cosine(
    config: ExtractorConfig, centres: ClusterCentres
) -> None:
    query = features(1)
    query[5] = 0  # a patch without direction
    rows = torch.stack([described(config, features(seed), centres) for seed in (2, 3, 4)])
    cosines = (rows @ described(config, query, centres)).numpy()
    found = explain_similarities(
        config, query, centres if config.needs_vocabulary else None, rows.numpy()
    )
    assert len(found) == len(cosines)
    for shares, cosine in zip(found, cosines, strict=True):
        assert shares.patches.shape == (PATCHES,)
        assert shares.patches.sum() == pytest.approx(cosine, abs=2e-6)
        assert shares.patches[5] == 0
        if config.needs_vocabulary:
            assert shares.clusters is not None
            assert shares.clusters.shape == (CLUSTERS,)
            assert shares.clusters.sum() == pytest.approx(cosine, abs=2e-6)
        else:
            assert shares.clusters is None


def test_share_of_a_cluster_is_the_product_of_its_two_blocks(centres: ClusterCentres) -> None:
    query, other = (described(VLAD, features(seed), centres) for seed in (1, 2))
    (shares,) = explain_similarities(VLAD, features(1), centres, other[None].numpy())
    blocks = (query * other).reshape(CLUSTERS, WIDTH).sum(dim=1)
    assert shares.clusters == pytest.approx(blocks.numpy(), abs=1e-6)


@pytest.mark.parametrize("config", [VLAD, SOFT], ids=lambda config: config.aggregator)
def test_weighted_shares_add_up_to_the_weighted_score(
    config: ExtractorConfig, centres: ClusterCentres
) -> None:
    words = (0.0, 2.0, 0.5, 1.0, 0.0, 3.0, 0.1)
    query, other = (described(config, features(seed), centres) for seed in (1, 2))
    weighted = normalize(query * torch.tensor(words).repeat_interleave(WIDTH), dim=0)
    (shares,) = explain_similarities(config, features(1), centres, other[None].numpy(), words)
    assert shares.clusters is not None
    assert shares.clusters[[0, 4]].tolist() == [0, 0]
    for kind in (shares.clusters, shares.patches):
        assert kind.sum() == pytest.approx(float(weighted @ other), abs=2e-6)


def test_cluster_that_one_photo_does_not_use_has_no_share(centres: ClusterCentres) -> None:
    near = normalize(torch.from_numpy(centres.array[:2]).repeat(5, 1) + 0.05 * features(7, 10))
    row = described(VLAD, features(2), centres)
    (shares,) = explain_similarities(VLAD, near, centres, row[None].numpy())
    assert shares.clusters is not None
    assert np.flatnonzero(shares.clusters).tolist() == [0, 1]


def test_photo_without_any_direction_explains_nothing_and_divides_by_nothing(
    centres: ClusterCentres,
) -> None:
    row = described(VLAD, features(2), centres)
    blank = torch.zeros(PATCHES, WIDTH)
    (by_clusters,) = explain_similarities(VLAD, blank, centres, row[None].numpy())
    (by_patches,) = explain_similarities(MEAN, blank, None, features(3, 1).numpy())
    assert not by_clusters.patches.any()
    assert not by_patches.patches.any()


def test_descriptor_that_is_no_sum_is_refused() -> None:
    with pytest.raises(ValueError, match="gem"):
        explain_similarities(
            replace(MEAN, aggregator="gem"), features(1), None, features(2, 1).numpy()
        )


def pixels_of(overlay: str) -> NDArray[np.uint8]:
    head, _, data = overlay.partition(",")
    assert head == "data:image/png;base64"
    with Image.open(io.BytesIO(base64.b64decode(data))) as image:
        assert image.mode == "RGBA"
        return np.asarray(image)


def test_overlay_has_a_pixel_for_each_patch_and_is_clear_where_nothing_is_added() -> None:
    shares = np.array([[0.4, 0.0, -0.2], [0.1, 0.0, 0.0]])
    overlay, full = draw_overlay(shares)
    pixels = pixels_of(overlay)
    assert full == 0.4
    assert pixels.shape == (2, 3, 4)
    assert pixels[..., 3].tolist() == [[255, 0, 128], [64, 0, 0]]
    assert tuple(pixels[0, 0, :3]) == POSITIVE_COLOUR
    assert tuple(pixels[0, 2, :3]) == NEGATIVE_COLOUR
    overlay, full = draw_overlay(np.zeros((3, 4)))
    assert full == 0
    assert not pixels_of(overlay)[..., 3].any()
