"""float32 and bfloat16: which is chosen, what a spec says, how far the two are apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from timm.layers.layer_scale import LayerScale

from shared.descriptors.aggregators.clustering import vlad
from shared.descriptors.backbones import normalise_features
from shared.descriptors.backbones.dinov2 import Dinov2, VitShape
from shared.descriptors.extractor import Extractor, spec_fingerprint
from shared.descriptors.inference import PRECISIONS, Precision, choose_precision
from shared.descriptors.vocabulary import ClusterCentres, parse_centres
from shared.extractor_config.configs import EXTRACTOR_CONFIGS, get_extractor_config
from tests.support.hub import COMMIT
from tests.support.photos import photo_image
from tests.support.vit import PLAIN, SWIGLU, random_weights, save

pytestmark = pytest.mark.numerics

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
NETWORKS = {"plain": PLAIN, "swiglu": SWIGLU}
LEAST_PATCH_COSINE = 0.999  # in the mean, of bfloat16 to float32
# Of a row to the one that a batch of another size made; docs/how-to/throughput.md promises it.
LEAST_COSINE_OF_BATCHES: dict[Precision, float] = {"float32": 0.9999, "bfloat16": 0.999}


def small_vit(shape: VitShape, folder: Path) -> Extractor:
    """A small network with random weights under the name of a large one."""
    file = save(random_weights(shape), folder / "weights.pth")
    backbone = Dinov2("vits14", shape.depth - 1, "value", CPU, file, shape=shape)
    config = replace(EXTRACTOR_CONFIGS["anyloc-vits14"], width=shape.width)
    return Extractor(config, CPU, backbone=backbone)


@pytest.fixture(params=["plain", "swiglu"])
def networks(request: pytest.FixtureRequest, tmp_path: Path) -> dict[Precision, Extractor]:
    """One transformer with random weights in both precisions."""
    single = small_vit(NETWORKS[request.param], tmp_path)
    return {precision: single.with_precision(precision) for precision in PRECISIONS}


def pixels(count: int) -> NDArray[np.uint8]:
    return np.stack([np.asarray(photo_image(n, 224, 224)) for n in range(count)])


def centres_of(extractor: Extractor) -> ClusterCentres:
    """Five patches of a photo."""
    features = extractor.features(pixels(1))[0]
    return parse_centres(features[:: len(features) // 5][:5].clone().numpy())


def test_auto_is_half_precision_for_dinov2_on_cuda_alone() -> None:
    dino, convolutions = (
        EXTRACTOR_CONFIGS["anyloc-vitg14"],
        EXTRACTOR_CONFIGS["efficientnet-lite0-vlad"],
    )
    theirs = get_extractor_config(
        f"torchhub:owner/name@{COMMIT}:entry", allow_test_extractors=False
    )
    assert choose_precision("auto", dino, CUDA) == "bfloat16"
    assert choose_precision("auto", dino, CPU) == "float32"
    assert choose_precision("auto", convolutions, CUDA) == "float32"
    assert choose_precision("auto", theirs, CUDA) == "float32"
    for config in (dino, convolutions, theirs):
        for precision in PRECISIONS:
            assert {choose_precision(precision, config, device) for device in (CPU, CUDA)} == {
                precision
            }


def test_precisions_have_different_specs_and_single_is_unchanged() -> None:
    single = Extractor(EXTRACTOR_CONFIGS["test-tiny-avg"], CPU)
    half = single.with_precision("bfloat16")
    assert single.spec(None)["precision"] == "float32"
    assert half.spec(None) == {**single.spec(None), "precision": "bfloat16"}
    assert spec_fingerprint(half.spec(None)) != spec_fingerprint(single.spec(None))
    assert half.backbone is single.backbone
    assert half.with_precision("float32").spec(None) == single.spec(None)


def test_half_precision_computes_otherwise_and_comes_near(
    networks: dict[Precision, Extractor],
) -> None:
    single, half = (networks[precision].features(pixels(2)) for precision in PRECISIONS)
    assert half.dtype == torch.float32
    assert not torch.equal(single, half)
    np.testing.assert_allclose(torch.linalg.norm(half, dim=-1), 1.0, atol=1e-5)
    assert float((single * half).sum(dim=-1).mean()) >= LEAST_PATCH_COSINE


def test_a_move_back_to_the_device_that_fails_is_repeated_and_its_network_is_as_before(
    networks: dict[Precision, Extractor], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = networks["float32"].features(pixels(1))
    networks["bfloat16"].features(pixels(1))
    vit = networks["float32"].backbone._vit  # type: ignore[attr-defined]
    monkeypatch.setattr(vit, "to", moving := Mock(side_effect=[torch.OutOfMemoryError(), vit]))
    with pytest.raises(torch.OutOfMemoryError):
        networks["float32"].features(pixels(1))
    assert all(torch.equal(networks["float32"].features(pixels(1)), before) for _ in range(2))
    assert moving.call_count == 2


def test_half_precision_converts_no_matrix_and_scales_no_branch_in_a_pass(
    networks: dict[Precision, Extractor],
) -> None:
    made = networks["bfloat16"]
    made.features(pixels(1))
    with torch.profiler.profile(record_shapes=True) as profile:
        made.features(pixels(1))
    vit = made.backbone._bfloat16_vit  # type: ignore[attr-defined]
    assert not any(isinstance(module, LayerScale) for module in vit.modules())
    matrices = {tuple(module.weight.shape) for module in vit.modules() if hasattr(module, "weight")}
    converted = {
        tuple(event.input_shapes[0])
        for event in profile.events()
        if event.name == "aten::_to_copy" and event.input_shapes
    }
    assert not matrices & converted


def test_aggregation_is_in_single_precision(networks: dict[Precision, Extractor]) -> None:
    half = networks["bfloat16"]
    centres = centres_of(half)
    expected = vlad(half.features(pixels(2)), torch.from_numpy(centres.array))
    rows = half.describe(pixels(2), centres)
    assert np.array_equal(rows, expected.numpy())
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_batch_size_changes_no_descriptor_beyond_the_stated_bound(
    networks: dict[Precision, Extractor], precision: Precision
) -> None:
    made = networks[precision]
    centres, photos = centres_of(networks["float32"]), pixels(5)
    alone = np.concatenate([made.describe(photos[n : n + 1], centres) for n in range(5)])
    for size in (2, 3, 5):
        together = made.describe(photos[:size], centres)
        cosines = (together * alone[:size]).sum(axis=1)
        assert cosines.min() >= LEAST_COSINE_OF_BATCHES[precision]


def test_single_precision_is_not_rounded_to_tf32(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        Extractor(EXTRACTOR_CONFIGS["test-tiny-avg"], CPU).features(
            np.zeros((1, 32, 32, 3), np.uint8)
        )
        assert not torch.backends.cudnn.allow_tf32
        assert not torch.backends.cuda.matmul.allow_tf32
        assert torch.get_float32_matmul_precision() == "highest"
    finally:
        torch.set_float32_matmul_precision(before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_patch_whose_length_overflows_differs_from_one_without_structure(
    dtype: torch.dtype,
) -> None:
    patches = torch.tensor([[3.0, 4.0], [0.0, 0.0], [3e38, 3e38], [float("inf"), 0.0]], dtype=dtype)
    units = normalise_features(patches)
    assert units.dtype == torch.float32
    np.testing.assert_allclose(units[:2], [[0.6, 0.8], [0.0, 0.0]], atol=1e-6)
    assert units[2:].isnan().all()
