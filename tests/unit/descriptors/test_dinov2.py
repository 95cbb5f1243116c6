"""DINOv2's features: held to a plain forward pass of the whole network, and no work beyond them."""

from __future__ import annotations

import functools
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.nn.modules.module import register_module_forward_hook

from shared.descriptors.backbones.dinov2 import SHAPES, Dinov2, VitShape
from shared.extractor_config.configs import EXTRACTOR_CONFIGS, FACETS
from tests.support.vit import PLAIN, SIDE, SWIGLU, WITH_REGISTERS, random_weights, save
from tests.unit.descriptors.dinov2_reference import plain_forward

pytestmark = pytest.mark.numerics

CPU = torch.device("cpu")
NETWORKS = {"plain": PLAIN, "swiglu": SWIGLU, "registers": WITH_REGISTERS}
CLOSE = 1e-4  # of unit vectors, in float32, to the same network in float64


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Each network's weights as Meta publishes them."""
    folder = tmp_path_factory.mktemp("weights")
    return {
        name: save(random_weights(shape), folder / f"{name}.pth")
        for name, shape in NETWORKS.items()
    }


def load(file: Path, shape: VitShape, layer: int, facet: str) -> Dinov2:
    return Dinov2("vits14", layer, facet, CPU, file, shape=shape)


@functools.cache
def photos(height: int, width: int) -> NDArray[np.uint8]:
    count = 1 if height > 300 else 2
    rng = np.random.default_rng(height)
    return rng.integers(0, 256, (count, height, width, 3), dtype=np.uint8)


@functools.cache
def expected(network: str, size: tuple[int, int]) -> list[dict[str, NDArray[np.float64]]]:
    shape = NETWORKS[network]
    return plain_forward(random_weights(shape), shape, photos(*size))


@pytest.mark.parametrize(
    ("network", "size", "facet"),
    [
        *((network, (126, 70), facet) for network in NETWORKS for facet in FACETS),
        ("plain", (224, 224), "value"),
        ("plain", (518, 518), "value"),
    ],
)
def test_features_are_those_of_a_whole_forward_pass(
    files: dict[str, Path], network: str, size: tuple[int, int], facet: str
) -> None:
    shape = NETWORKS[network]
    for layer in range(shape.depth):
        backbone = load(files[network], shape, layer, facet)
        features = backbone.features(torch.from_numpy(photos(*size)))
        assert features.dtype == torch.float32
        reference = expected(network, size)[layer][facet]
        assert features.shape == reference.shape
        np.testing.assert_allclose(features, reference, atol=2e-5, err_msg=f"layer {layer}")


@pytest.mark.parametrize("size", SHAPES)
def test_features_of_each_published_depth_are_those_of_a_whole_forward_pass(
    size: str, tmp_path: Path
) -> None:
    """All blocks and heads, each head narrowed to 4 numbers; what AnyLoc takes of it."""
    published, layer = SHAPES[size], EXTRACTOR_CONFIGS[f"anyloc-{size}"].layer
    assert layer is not None
    shape = replace(published, width=4 * published.heads)
    weights = random_weights(shape)
    file = save(weights, tmp_path / "weights.pth")
    reference = plain_forward(weights, shape, photos(70, 98))[layer]["value"]
    features = load(file, shape, layer, "value").features(torch.from_numpy(photos(70, 98)))
    np.testing.assert_allclose(features, reference, atol=CLOSE)


def test_pixels_between_whole_numbers_are_not_rounded(files: dict[str, Path]) -> None:
    """What a preprocessing interpolated reaches the network as it is, and is normalised once."""
    backbone = load(files["plain"], PLAIN, 1, "value")
    whole = torch.from_numpy(photos(126, 70))
    np.testing.assert_array_equal(backbone.features(whole.float()), backbone.features(whole))
    between = whole.float() + 0.4
    reference = plain_forward(random_weights(PLAIN), PLAIN, between.numpy())[1]["value"]
    np.testing.assert_allclose(backbone.features(between), reference, atol=2e-5)
    assert float((backbone.features(between) - backbone.features(whole)).abs().max()) > 1e-4


@pytest.mark.parametrize("facet", FACETS)
@pytest.mark.parametrize("layer", range(PLAIN.depth))
def test_nothing_runs_after_the_facet_is_known(
    files: dict[str, Path], layer: int, facet: str
) -> None:
    backbone = load(files["plain"], PLAIN, layer, facet)
    ran: Counter[Any] = Counter()

    def count(module: torch.nn.Module, _inputs: object, _output: object) -> None:
        if isinstance(module, torch.nn.Linear):
            ran[module.in_features, module.out_features] += 1
        ran[type(module).__name__] += 1

    with register_module_forward_hook(count):
        backbone.features(torch.from_numpy(photos(126, 70)))
    whole_blocks = layer + 1 if facet == "token" else layer
    width = PLAIN.width
    assert ran["Block"] == ran[width, 3 * width] == ran[width, 4 * width] == whole_blocks
    # The projection after each attention, and the one third of the last block's qkv.
    assert ran[width, width] == (whole_blocks if facet == "token" else whole_blocks + 1)


def test_unused_weights_are_not_loaded(files: dict[str, Path]) -> None:
    def parameters(facet: str) -> int:
        tensors: list[torch.Tensor] = [*load(files["plain"], PLAIN, 1, facet)._vit.parameters()]
        assert all(tensor.device == CPU for tensor in tensors)
        return sum(tensor.untyped_storage().nbytes() for tensor in tensors) // 4

    width = PLAIN.width
    block = 12 * width**2 + (3 + 1 + 4 + 1) * width + 6 * width
    before = (2 + SIDE * SIDE + 3 * 14 * 14 + 1) * width
    assert parameters("token") == before + 2 * block
    assert parameters("value") == before + block + width**2 + 3 * width


def test_photos_of_no_whole_patches_are_refused(files: dict[str, Path]) -> None:
    backbone = load(files["plain"], PLAIN, 0, "value")
    with pytest.raises(ValueError, match="100 x 70 pixels are not a multiple of the patch size 14"):
        backbone.features(torch.zeros((1, 100, 70, 3), dtype=torch.uint8))


# --- the published networks ------------------------------------------------------------------


@pytest.mark.parametrize("size", SHAPES)
def test_shapes_are_those_of_timms_networks_and_of_the_configurations(size: str) -> None:
    import timm

    shape, config = SHAPES[size], EXTRACTOR_CONFIGS[f"anyloc-{size}"]
    assert (shape.depth, shape.width) == (config.depth, config.width)
    with torch.device("meta"):
        network: Any = timm.create_model(shape.timm_name, pretrained=False)
        assert len(network.blocks) == shape.depth
        assert network.embed_dim == shape.width
        assert network.blocks[0].attn.num_heads == shape.heads
        parameters = sum(tensor.numel() for tensor in network.parameters())
        assert parameters <= config.parameters < 1.01 * parameters
        assert network.pos_embed.shape == (1, 1 + SIDE * SIDE, shape.width)
    assert network.pretrained_cfg["mean"] == (0.485, 0.456, 0.406)
    assert network.pretrained_cfg["std"] == (0.229, 0.224, 0.225)
