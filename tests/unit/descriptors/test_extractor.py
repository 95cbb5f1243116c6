"""Extractors: what they refuse, what decides a descriptor, and the real weights at work."""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from shared.descriptors.aggregators.clustering import soft_vlad, vlad
from shared.descriptors.aggregators.pooling import average_pooling, gem_pooling
from shared.descriptors.extractor import Extractor, choose_device, spec_fingerprint
from shared.descriptors.vocabulary import parse_centres
from shared.errors import Misconfigured
from shared.extractor_config.configs import EXTRACTOR_CONFIGS, get_extractor_config

pytestmark = pytest.mark.numerics

CPU = torch.device("cpu")
DAISY = 985  # of ImageNet's classes


@pytest.fixture(scope="module")
def efficientnet() -> Extractor:
    return Extractor(EXTRACTOR_CONFIGS["efficientnet-lite0-vlad"], CPU)


@pytest.fixture(scope="module")
def tiny() -> Extractor:
    return Extractor(EXTRACTOR_CONFIGS["test-tiny-vlad"], CPU)


def photo_path(name: str) -> Path:
    spec = importlib.util.find_spec("sklearn")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent / "datasets" / "images" / name


def package_photo(name: str) -> Image.Image:
    return Image.open(photo_path(name)).convert("RGB")


def pixels_of(extractor: Extractor, photos: list[Image.Image]) -> NDArray[np.uint8]:
    return np.stack([extractor.preprocessing.apply(photo) for photo in photos])


def test_missing_cuda_is_an_error_and_not_a_slow_fallback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto") == CPU
    with pytest.raises(Misconfigured) as caught:
        choose_device("cuda")
    assert caught.value.code == "cuda_missing"


def test_fingerprint_changes_with_the_vocabulary_and_with_nothing_else(tiny: Extractor) -> None:
    rng = np.random.default_rng(0)
    array = rng.standard_normal((8, 16)).astype(np.float32)
    first = spec_fingerprint(tiny.spec(parse_centres(array)))
    assert spec_fingerprint(tiny.spec(parse_centres(array.copy()))) == first
    array[0, 0] += 1e-3
    assert spec_fingerprint(tiny.spec(parse_centres(array))) != first


def test_specs_of_stored_generations_mean_what_they_meant(efficientnet: Extractor) -> None:
    """A member more would have every photo described anew."""
    shipped = efficientnet.shipped_vocabulary()
    assert shipped is not None
    spec = efficientnet.spec(shipped[0])
    assert sorted(spec) == [
        "aggregator", "backbone", "backbone_fingerprint", "clusters", "decoder", "dimension",
        "extractor", "facet", "layer", "precision", "preprocessing", "vocabulary_sha256",
    ]  # fmt: skip
    assert spec["extractor"] == "efficientnet-lite0-vlad"
    assert spec["preprocessing"] == {"name": "square224", "version": 1}
    assert spec["aggregator"] == "vlad"


def chosen(options: str) -> Extractor:
    return Extractor(
        get_extractor_config(f"test-tiny-vlad:{options}", allow_test_extractors=True), CPU
    )


def test_specs_tell_aggregators_temperatures_and_preprocessings_apart() -> None:
    centres = parse_centres(np.random.default_rng(2).standard_normal((5, 16)).astype(np.float32))
    specs = [
        chosen(options).spec(None if "gem" in options or "avg" in options else centres)
        for options in (
            "aggregator=vlad", "aggregator=soft-vlad", "aggregator=soft-vlad,temperature=2",
            "aggregator=gem", "aggregator=avg", "preprocessing=demo1024", "preprocessing=round14",
        )
    ]  # fmt: skip
    assert len({spec_fingerprint({**spec, "extractor": ""}) for spec in specs}) == len(specs)
    assert [spec["dimension"] for spec in specs[:5]] == [80, 80, 80, 16, 16]
    assert [spec.get("temperature") for spec in specs[:4]] == [None, 1.0, 2.0, None]


AGGREGATIONS: dict[str, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
    "aggregator=vlad": vlad,
    "aggregator=soft-vlad": lambda features, centres: soft_vlad(features, centres, 1.0),
    "aggregator=soft-vlad,temperature=3.5": lambda features, centres: soft_vlad(
        features, centres, 3.5
    ),
    "aggregator=gem": lambda features, _centres: gem_pooling(features),
    "aggregator=avg": lambda features, _centres: average_pooling(features),
}


@pytest.mark.parametrize("options", AGGREGATIONS)
def test_the_aggregator_of_the_name_is_at_work_with_its_vocabulary(options: str) -> None:
    made = chosen(options)
    array = np.random.default_rng(2).standard_normal((5, 16)).astype(np.float32)
    centres = parse_centres(array) if made.config.needs_vocabulary else None
    photos = np.random.default_rng(3).integers(0, 256, (2, 32, 32, 3), dtype=np.uint8)
    expected = AGGREGATIONS[options](made.features(photos), torch.from_numpy(array))
    assert np.array_equal(made.describe(photos, centres), expected.numpy())
    if made.config.needs_vocabulary:
        with pytest.raises(ValueError, match="needs a vocabulary"):
            made.describe(photos, None)


@pytest.mark.parametrize("options", AGGREGATIONS)
@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_features_that_are_not_finite_make_a_row_of_nan_and_harm_no_other(
    options: str, broken: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = chosen(options)
    array = np.random.default_rng(2).standard_normal((5, 16)).astype(np.float32)
    centres = parse_centres(array) if made.config.needs_vocabulary else None
    photos = np.random.default_rng(3).integers(0, 256, (3, 32, 32, 3), dtype=np.uint8)
    sound = made.describe(photos, centres)
    features = made.features(photos).clone()
    features[1, 2, 3] = broken
    monkeypatch.setattr(made.backbone, "features", lambda _pixels: features)
    rows = made.describe(photos, centres)
    assert np.isnan(rows[1]).all()
    np.testing.assert_allclose(rows[[0, 2]], sound[[0, 2]], atol=1e-6)


def test_photos_of_one_size_pass_together_and_of_large_ones_fewer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = chosen("aggregator=avg")
    shapes = [(224, 224), (112, 448), (224, 224), (448, 448), (448, 448), (224, 224)]
    rng = np.random.default_rng(4)
    photos = [rng.integers(0, 256, (*shape, 3), dtype=np.uint8) for shape in shapes]
    passes: list[tuple[int, ...]] = []
    real = made.backbone.features

    def watch(pixels: torch.Tensor) -> torch.Tensor:
        passes.append(tuple(pixels.shape[:3]))
        return real(pixels)

    monkeypatch.setattr(made.backbone, "features", watch)
    together = made.describe(photos, None)
    assert passes == [(2, 224, 224), (1, 224, 224), (1, 112, 448), (1, 448, 448), (1, 448, 448)]
    for photo, row in zip(photos, together, strict=True):
        np.testing.assert_allclose(made.describe([photo], None)[0], row, atol=1e-6)
    local = made.patch_features(photos)
    assert [len(one) for one in local] == [height * width // 16 for height, width in shapes]
    for photo, one in zip(photos, local, strict=True):
        np.testing.assert_allclose(made.features(photo[None])[0], one, atol=1e-6)


def test_features_are_the_stride_16_map_of_a_network_that_recognises_a_daisy(
    efficientnet: Extractor,
) -> None:
    import timm

    from shared.descriptors.backbones.efficientnet_lite0 import _rename_tensors, weights_path

    model = timm.create_model("tf_efficientnet_lite0", pretrained=False)
    state = torch.load(weights_path(), map_location="cpu", weights_only=True)
    model.load_state_dict(_rename_tensors(state, model))
    model.eval()
    flower = pixels_of(efficientnet, [package_photo("flower.jpg")])
    batch = torch.from_numpy(flower).permute(0, 3, 1, 2).float() / 127.5 - 1
    with torch.inference_mode():
        every_stage: Any = model.forward_intermediates  # timm's models are untyped
        stride_16 = every_stage(batch, indices=[3], intermediates_only=True)[0]
        label = int(model(batch).argmax())
    expected = torch.nn.functional.normalize(stride_16.flatten(2).transpose(1, 2), dim=-1)
    np.testing.assert_allclose(efficientnet.features(flower), expected, atol=1e-4)
    assert label == DAISY


@pytest.fixture(scope="module")
def aspect_kept(efficientnet: Extractor) -> Extractor:
    return Extractor(
        EXTRACTOR_CONFIGS["efficientnet-lite0-vlad128"], CPU, backbone=efficientnet.backbone
    )


def test_default_extractor_distinguishes_places_whatever_the_aspect_ratio(
    aspect_kept: Extractor,
) -> None:
    shipped = aspect_kept.shipped_vocabulary()
    assert shipped is not None
    photos = [
        photo.crop((left, 20, left + width, 380))
        for photo in (package_photo("china.jpg"), package_photo("flower.jpg"))
        for left, width in ((40, 480), (60, 300))
    ]
    pixels = [aspect_kept.preprocessing.apply(photo) for photo in photos]
    assert pixels[0].shape != pixels[1].shape
    rows = aspect_kept.describe(pixels, shipped[0])
    assert rows.shape == (4, 128 * 112)
    scores = rows @ rows.T
    assert min(scores[0, 1], scores[2, 3]) > scores[:2, 2:].max() + 0.1


@pytest.mark.parametrize(
    ("name", "clusters"), [("efficientnet-lite0-vlad", 64), ("efficientnet-lite0-vlad128", 128)]
)
def test_provenance_of_a_shipped_vocabulary_names_its_file_and_photographs(
    efficientnet: Extractor, name: str, clusters: int
) -> None:
    extractor = Extractor(EXTRACTOR_CONFIGS[name], CPU, backbone=efficientnet.backbone)
    shipped = extractor.shipped_vocabulary()
    assert shipped is not None
    centres, provenance = shipped
    assert (centres.clusters, centres.dimension) == (clusters, 112)
    assert (provenance["clusters"], provenance["sha256"]) == (clusters, centres.sha256)
    assert provenance["preprocessing"] == extractor.preprocessing.as_spec()
    named = {name for entry in provenance["photographs"].values() for name in entry["files"]}
    hashes = provenance["photographs_sha256"]
    assert set(hashes) == named
    china = hashlib.sha256(photo_path("china.jpg").read_bytes()).hexdigest()
    assert hashes["china.jpg"] == china


def test_shipped_vocabulary_is_refused_with_other_weights(
    efficientnet: Extractor, tiny: Extractor, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert tiny.shipped_vocabulary() is None
    monkeypatch.setattr(efficientnet.backbone, "fingerprint", "0" * 64)
    with pytest.raises(Misconfigured) as caught:
        efficientnet.shipped_vocabulary()
    assert caught.value.code == "vocabulary_unusable"
