"""Place models: what a configuration means, and what the backbones make, freeze and leave out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
import torch
import torchvision
from safetensors.torch import save_file

from shared.descriptors.aggregators import AGGREGATORS
from shared.descriptors.backbones import normalise_features, normalise_pixels
from shared.descriptors.backbones.efficientnet_lite0 import EfficientNetLite0
from shared.descriptors.vpr_models import backbones as backbones_module
from shared.descriptors.vpr_models.backbones import StagedBackbone, build_backbone, build_dinov2
from shared.descriptors.vpr_models.config import STAGES, VprModelConfig
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.errors import Misconfigured, Unprocessable
from shared.extractor_config.names import IMAGENET_MEAN, IMAGENET_STD
from tests.support.vit import PLAIN, random_weights, save
from tests.unit.descriptors.dinov2_reference import plain_forward

pytestmark = pytest.mark.numerics

CPU = torch.device("cpu")


def config(**changes: Any) -> VprModelConfig:
    return VprModelConfig.parse({"pretrained": False, "image_size": (64, 96), **changes})


def laid_out(**changes: Any) -> VprModel:
    """A model without memory for its weights: shapes alone."""
    with torch.device("meta"):
        return build_vpr_model(config(**changes))


def noise(height: int = 64, width: int = 96, count: int = 2) -> torch.Tensor:
    return torch.randn(count, 3, height, width, generator=torch.Generator().manual_seed(0))


# Channels and stride of the whole backbone, and with its last stages cropped.
@pytest.mark.parametrize(
    ("name", "whole", "crop", "cropped"),
    [
        ("resnet18", (512, 32), 4, (256, 16)),
        ("resnet50", (2048, 32), 4, (1024, 16)),
        ("resnext50_32x4d", (2048, 32), 3, (512, 8)),
        ("vgg16", (512, 16), 4, (512, 8)),
        ("efficientnet_b0", (1280, 32), 6, (112, 16)),
        ("efficientnet_lite0", (1280, 32), 8, (320, 32)),
        ("swin_t", (768, 32), 4, (384, 16)),
        ("dinov2_vits14", (384, 14), 4, (384, 14)),
        ("dinov2_vitg14", (1536, 14), 4, (1536, 14)),
    ],
)
def test_each_backbone_makes_the_map_that_is_documented(
    name: str, whole: tuple[int, int], crop: int, cropped: tuple[int, int]
) -> None:
    side = 84 if name.startswith("dinov2") else 64
    photos = torch.empty(2, 3, side, 2 * side, device="meta")
    model = laid_out(backbone_arch=name, image_size=(side, 2 * side))
    backbone = model.backbone
    assert len(backbone.stages) == STAGES[name] == model.config.stages
    assert model.dimension == whole[0]
    for channels, stride in (whole, cropped):
        maps, token = backbone(photos)
        assert maps.shape == (2, channels, side // stride, 2 * side // stride)
        assert (token is not None) == name.startswith("dinov2")
        backbone.crop(config(backbone_arch=name, layers_to_crop=[crop]).stages)


@pytest.mark.parametrize(
    ("aggregator", "dimension"),
    [
        ("AVG", 256),
        ("GeM", 256),
        ("CosPlace", 512),
        ("ConvAP", 2048),
        ("MixVPR", 512),
        ("NetVLAD", 16_384),
        ("SALAD", 8_448),
        ("BoQ", 16_384),
    ],
)
def test_without_arguments_an_aggregator_has_the_published_size(
    aggregator: str, dimension: int
) -> None:
    model = laid_out(agg_arch=aggregator, layers_to_crop=[4], image_size=(320, 320))
    assert model.dimension == dimension
    assert model(torch.empty(2, 3, 320, 320, device="meta")).shape == (2, dimension)


def test_backbone_and_aggregator_names_match_as_in_the_predecessor() -> None:
    assert config(backbone_arch="ResNeXt50").backbone_arch == "resnext50_32x4d"
    assert config(backbone_arch="dinov2-b").backbone_arch == "dinov2_vitb14"
    for written, meant in (("gempool", "GeM"), ("COSPLACE", "CosPlace"), ("my_mixvpr", "MixVPR")):
        assert config(agg_arch=written).agg_arch == meant


def test_an_aggregator_whose_name_contains_that_of_another_can_be_selected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(AGGREGATORS, "MaskedGeM", AGGREGATORS["GeM"])
    assert config(agg_arch="MaskedGeM").agg_arch == "MaskedGeM"
    assert config(agg_arch="GeM").agg_arch == "GeM"


def test_configuration_of_a_model_is_completed_without_changing_the_argument() -> None:
    given = config(agg_arch="mixvpr", agg_config={"out_rows": 2})
    model = laid_out(agg_arch="mixvpr", agg_config={"out_rows": 2})
    assert given.agg_config == {"out_rows": 2}
    assert model.config.agg_config == {
        "in_channels": 512,
        "in_h": 2,
        "in_w": 3,
        "out_channels": 128,
        "mix_depth": 1,
        "mlp_ratio": 1.0,
        "out_rows": 2,
    }
    assert laid_out(**model.config.model_dump()).config == model.config
    assert config().agg_config == {}


@pytest.mark.parametrize(
    ("changes", "code", "message"),
    [
        ({"backbone_arch": "alexnet"}, "unknown_backbone", "resnet18, resnet34"),
        ({"agg_arch": "fisher"}, "unknown_aggregator", "CosPlace, AVG, GeM"),
        ({"layers_to_freeze": 5}, "bad_model_config", "from -1"),
        ({"layers_to_crop": [1]}, "bad_model_config", "from 2 to 4"),
        ({"image_size": [64]}, "bad_model_config", "image_size"),
        ({"backbone_norm": False}, "bad_model_config", "resnet18 has no final norm"),
        ({"colour": "red"}, "bad_model_config", "colour"),
        ({"agg_config": {"p": 3}}, "bad_agg_config", "no argument p"),
        ({"agg_arch": "GeM", "agg_config": {"p": "3"}}, "bad_agg_config", "p='3'"),
        ({"agg_arch": "GeM", "agg_config": {"p": float("nan")}}, "bad_agg_config", "p=nan"),
        ({"agg_arch": "GeM", "agg_config": {"p": float("inf")}}, "bad_agg_config", "p=inf"),
        ({"agg_arch": "CosPlace", "agg_config": {"in_dim": 256}}, "bad_agg_config", "512 channels"),
        ({"agg_arch": "MixVPR", "agg_config": {"in_h": 20}}, "bad_agg_config", "2 x 3"),
        ({"agg_arch": "BoQ", "agg_config": {"proj_channels": 100}}, "bad_agg_config", "64"),
        ({"agg_arch": "SALAD"}, "image_size_unsupported", "64 clusters"),
        ({"backbone_arch": "dinov2_vits14"}, "image_size_unsupported", "70 x 98"),
    ],
)
def test_invalid_network_configurations_are_refused_with_the_reason(
    changes: dict[str, Any], code: str, message: str
) -> None:
    with pytest.raises(Unprocessable, match=message) as refused:
        laid_out(**changes)
    assert refused.value.code == code


def test_mixvpr_and_salad_refuse_photos_of_a_size_that_they_were_not_made_for() -> None:
    mixvpr = laid_out(agg_arch="MixVPR")
    salad = laid_out(agg_arch="SALAD", image_size=(320, 320))
    for model, size in ((mixvpr, (96, 64)), (salad, (256, 256))):
        with pytest.raises(Unprocessable, match="built for") as refused:
            model(torch.empty(1, 3, *size, device="meta"))
        assert refused.value.code == "image_size_unsupported"
    gem = laid_out(agg_arch="GeM")
    assert gem(torch.empty(1, 3, 96, 64, device="meta")).shape == (1, 512)


def test_cropping_leaves_the_layers_before_as_they_are() -> None:
    torch.manual_seed(0)
    whole = build_backbone(config(), None)
    expected: list[torch.Tensor] = []
    whole.stages[1].register_forward_hook(lambda _m, _i, out: expected.append(out))
    torch.manual_seed(0)
    cropped = build_backbone(config(layers_to_crop=[3]), None)
    with torch.inference_mode():
        whole(noise())
        assert torch.equal(cropped(noise()).maps, expected[0])
    assert config(layers_to_crop=[3]).stages == config(layers_to_crop=[4, 3]).stages == 2
    assert not any(name.startswith("stages.2") for name in cropped.state_dict())


def after_a_step(backbone: StagedBackbone) -> set[str]:
    """Names of the tensors, statistics of BatchNorms included, that a step of training changes."""
    before = {name: tensor.clone() for name, tensor in backbone.state_dict().items()}
    backbone.train()
    optimizer = torch.optim.SGD(backbone.parameters(), lr=1.0)
    backbone(noise()).maps.square().sum().backward()
    optimizer.step()
    after = backbone.state_dict()
    return {name for name, tensor in before.items() if not torch.equal(tensor, after[name])}


@pytest.mark.parametrize("name", ["resnet18", "efficientnet_lite0"])
def test_frozen_stages_keep_their_weights_and_their_batchnorm_statistics(name: str) -> None:
    torch.manual_seed(0)
    changed = after_a_step(build_backbone(config(backbone_arch=name, layers_to_freeze=2), None))
    frozen = ("stem.", "stages.0.", "stages.1.")
    assert not [tensor for tensor in changed if tensor.startswith(frozen)]
    assert any(tensor.startswith("stages.2.") for tensor in changed)
    assert any(tensor.startswith("stages.2.") and "running_mean" in tensor for tensor in changed)


def test_nothing_is_frozen_with_minus_one_and_the_stem_alone_with_zero() -> None:
    torch.manual_seed(0)
    free = after_a_step(build_backbone(config(layers_to_freeze=-1), None))
    assert {"stem.0.weight", "stem.1.running_mean", "stages.0.0.conv1.weight"} <= free
    stem = after_a_step(build_backbone(config(layers_to_freeze=0), None))
    assert not [tensor for tensor in stem if tensor.startswith("stem.")]
    assert "stages.0.0.conv1.weight" in stem


def test_the_last_blocks_of_a_transformer_can_be_trained_alone() -> None:
    torch.manual_seed(0)
    backbone = build_dinov2("dinov2_vits14", False, None, shape=PLAIN)
    backbone.freeze(PLAIN.depth - 1)
    backbone.train()
    backbone(noise(56, 70)).maps.square().sum().backward()
    learning = {n.split(".")[1] for n, p in backbone.named_parameters() if p.grad is not None}
    assert learning == {"3", "weight", "bias"}  # the last block, and the norm after it
    backbone.freeze(PLAIN.depth)
    assert not [n for n, p in backbone.named_parameters() if p.requires_grad]


def test_dinov2_makes_the_tokens_of_a_whole_forward_pass_and_norms_them(tmp_path: Path) -> None:
    weights = random_weights(PLAIN)
    file = save(weights, tmp_path / "weights.pth")
    pixels = np.random.default_rng(0).integers(0, 256, (2, 56, 70, 3), dtype=np.uint8)
    photos = normalise_pixels(torch.from_numpy(pixels), IMAGENET_MEAN, IMAGENET_STD)
    backbone = build_dinov2("dinov2_vits14", True, file, shape=PLAIN).eval()
    assert torch.equal(backbone.state_dict()["norm.weight"], weights["norm.weight"])
    with torch.inference_mode():
        maps, token = backbone(photos)
        backbone.norm = torch.nn.Identity()
        plain = backbone(photos).maps
    assert maps.shape == (2, PLAIN.width, 4, 5)
    assert token is not None
    assert token.shape == (2, PLAIN.width)
    expected = plain_forward(weights, PLAIN, pixels)[-1]["token"]
    features = normalise_features(plain.flatten(2).transpose(1, 2))
    np.testing.assert_allclose(features, expected, atol=1e-4)
    normed = torch.nn.functional.layer_norm(
        plain.permute(0, 2, 3, 1),
        (PLAIN.width,),
        weights["norm.weight"],
        weights["norm.bias"],
        eps=1e-6,
    )
    np.testing.assert_allclose(maps.permute(0, 2, 3, 1), normed, atol=1e-4)


def test_lite0_with_its_published_weights_is_the_embedded_defaults_network() -> None:
    """Which takes another mean and deviation than ImageNet's."""
    pixels = np.random.default_rng(0).integers(0, 256, (1, 64, 96, 3), dtype=np.uint8)
    chosen = config(backbone_arch="efficientnet_lite0", pretrained=True, layers_to_crop=[6])
    photos = normalise_pixels(torch.from_numpy(pixels), IMAGENET_MEAN, IMAGENET_STD)
    with torch.inference_mode():
        maps = build_backbone(chosen, None)(photos).maps
    expected = EfficientNetLite0(CPU).features(torch.from_numpy(pixels))
    features = normalise_features(maps.flatten(2).transpose(1, 2))
    np.testing.assert_allclose(features, expected, atol=1e-4)


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """torch.hub's cache, empty, on a machine that reaches no hub."""

    def fail(url: str, target: Path, **_: object) -> None:
        raise httpx2.ConnectError("no route to host")

    monkeypatch.setattr(backbones_module, "download_file", fail)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    return folder


def test_pretrained_weights_come_from_the_cache_or_from_a_file(no_network: Path) -> None:
    torch.manual_seed(5)
    published = torchvision.models.resnet18().state_dict()
    expected = published["layer2.1.conv2.weight"]
    file = no_network / "mine.safetensors"
    save_file(published, file)
    given = build_vpr_model(config(pretrained=True), weights=file)
    assert torch.equal(given.state_dict()["backbone.stages.1.1.conv2.weight"], expected)
    torch.save(published, no_network / "resnet18-f37072fd.pth")
    cached = build_vpr_model(config(pretrained=True))
    assert torch.equal(cached.state_dict()["backbone.stages.1.1.conv2.weight"], expected)


def test_missing_pretrained_weights_raise_an_error(no_network: Path) -> None:
    for name, weights in (("resnet18", None), ("resnet18", no_network / "none.pth"),
                          ("efficientnet_lite0", no_network / "none.pth")):  # fmt: skip
        with pytest.raises(Misconfigured) as refused:
            build_vpr_model(config(backbone_arch=name, pretrained=True), weights=weights)
        assert refused.value.code == "weights_missing"
    with pytest.raises(Misconfigured, match=r"no route to host.*\(1\).*\(2\).*\(3\).*\(4\)"):
        build_vpr_model(config(pretrained=True))


def test_another_networks_weights_are_refused(no_network: Path) -> None:
    torch.save(torchvision.models.resnet34().state_dict(), no_network / "resnet18-f37072fd.pth")
    # A ResNet-34 has all of a ResNet-18's tensors, and more.
    torch.save({"fc.weight": torch.zeros(2)}, no_network / "other.pth")
    (no_network / "torn.pth").write_bytes(b"PK\x03\x04 torn")
    for name in ("resnet18-f37072fd.pth", "other.pth", "torn.pth"):
        with pytest.raises(Misconfigured) as refused:
            build_vpr_model(config(pretrained=True), weights=no_network / name)
        assert refused.value.code == "weights_unusable"


@pytest.mark.parametrize("name", ["dinov2_vits14", "swin_t"])
def test_the_final_norm_can_be_left_out(name: str) -> None:
    size = {"image_size": (56, 56)}
    whole = laid_out(backbone_arch=name, **size)
    bare = laid_out(backbone_arch=name, backbone_norm=False, **size)
    left_out = whole.state_dict().keys() - bare.state_dict().keys()
    assert left_out == {"backbone.norm.weight", "backbone.norm.bias"}
    # Stored only if it is left out: otherwise the fingerprints of earlier models would change.
    assert "backbone_norm" not in whole.config.model_dump()
    stored = bare.config.model_dump(mode="json")
    assert stored["backbone_norm"] is False
    assert not VprModelConfig.parse(stored).backbone_norm
