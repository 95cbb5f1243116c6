"""Checkpoints of other training code, with random weights under the published names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.config import VprModelConfig
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.descriptors.vpr_models.published_checkpoints import read_published_checkpoint
from shared.errors import Unprocessable

RESNET_OF_GSV = {
    "backbone.stem.0.": "backbone.model.conv1.",
    "backbone.stem.1.": "backbone.model.bn1.",
    **{f"backbone.stages.{n}.": f"backbone.model.layer{n + 1}." for n in range(4)},
}
RESNET_OF_COSPLACE = {
    "backbone.stem.": "backbone.",
    **{f"backbone.stages.{n}.": f"backbone.{n + 4}." for n in range(4)},
    "aggregator.pool.p": "aggregation.1.p",
    "aggregator.linear.": "aggregation.3.",
}
RESNET_OF_BOQ = {
    "backbone.stem.": "backbone.net.",
    **{f"backbone.stages.{n}.": f"backbone.net.{n + 4}." for n in range(4)},
}
RESNET_OF_OPENVPRLAB = {
    "backbone.stem.": "backbone.frozen_layers.0.",
    "backbone.stages.0.": "backbone.frozen_layers.1.",
    "backbone.stages.1.": "backbone.unfrozen_layers.0.",
    "backbone.stages.2.": "backbone.unfrozen_layers.1.",
}
UNFROZEN_RESNET_OF_OPENVPRLAB = {
    "backbone.stem.": "backbone.unfrozen_layers.0.",
    **{f"backbone.stages.{n}.": f"backbone.unfrozen_layers.{n + 1}." for n in range(3)},
}
MIXVPR = {
    "aggregator.channels.": "aggregator.channel_proj.",
    "aggregator.rows.": "aggregator.row_proj.",
    **{
        f"aggregator.mixers.{n}.{ours}.": f"aggregator.mix.{n}.mix.{theirs}."
        for n in range(2)
        for ours, theirs in (("norm", 0), ("widen", 1), ("narrow", 3))
    },
}
BOQ = {
    "aggregator.project.": "aggregator.proj_c.",
    "aggregator.norm.": "aggregator.norm_input.",
    "aggregator.rows.": "aggregator.fc.",
    **{
        f"aggregator.blocks.{n}.{ours}": f"aggregator.boqs.{n}.{theirs}"
        for n in range(2)
        for ours, theirs in (
            ("among_queries.", "self_attn."),
            ("norm_queries.", "norm_q."),
            ("to_positions.", "cross_attn."),
            ("", ""),
        )
    },
}
SALAD = {
    "aggregator.token.": "aggregator.token_features.",
    "aggregator.features.": "aggregator.cluster_features.",
    "aggregator.scores.": "aggregator.score.",
    "aggregator.dustbin": "aggregator.dust_bin",
}
CONVAP = {"aggregator.channels.": "aggregator.channel_pool."}


def dinov2(attribute: str) -> dict[str, str]:
    return {
        "backbone.stem.projection.": f"backbone.{attribute}.patch_embed.proj.",
        "backbone.stem.cls_token": f"backbone.{attribute}.cls_token",
        "backbone.stem.positions": f"backbone.{attribute}.pos_embed",
        "backbone.stages.": f"backbone.{attribute}.blocks.",
        "backbone.norm.": f"backbone.{attribute}.norm.",
    }


def make_model(backbone: str, aggregator: str, arguments: dict[str, Any], side: int) -> VprModel:
    torch.manual_seed(0)
    return build_vpr_model(
        VprModelConfig.parse(
            {
                "backbone_arch": backbone,
                "pretrained": False,
                "layers_to_crop": [4]
                if backbone == "resnet18" and aggregator != "CosPlace"
                else [],
                "backbone_norm": backbone.startswith("res") or aggregator == "SALAD",
                "agg_arch": aggregator,
                "agg_config": arguments,
                "image_size": (side, side),
            }
        )
    )


def rename(model: VprModel, names: dict[str, str]) -> dict[str, torch.Tensor]:
    """Return the tensors by published names."""
    renamed = {}
    for name, tensor in model.state_dict().items():
        ours = next((ours for ours in names if name.startswith(ours)), "")
        renamed[names.get(ours, "") + name.removeprefix(ours)] = tensor
    return renamed


def assert_loads_as(
    path: Path, state: Any, model: VprModel, size: int, interpolation: str = "bilinear"
) -> None:
    torch.save(state, path)
    loaded = load_checkpoint(path)
    photos_only = {"image_size", "interpolation", "layers_to_freeze"}
    expected = model.config.model_dump(exclude=photos_only)
    assert loaded.config.model_dump(exclude=photos_only) == expected
    assert loaded.config.image_size == (size, size)
    assert loaded.config.interpolation == interpolation
    photos = torch.randn(2, 3, *model.config.image_size)
    with torch.inference_mode():
        torch.testing.assert_close(loaded.model(photos), model(photos))
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.model.state_dict()[name], tensor), name


@pytest.mark.parametrize(
    ("aggregator", "arguments", "names", "published_name", "size"),
    [
        ("MixVPR", {"out_channels": 8, "out_rows": 2, "mix_depth": 2}, RESNET_OF_GSV | MIXVPR,
         "aggregator.mix.1.mix.3.weight", 64),
        ("ConvAP", {"out_channels": 8}, RESNET_OF_GSV | CONVAP,
         "aggregator.channel_pool.bias", 320),
        ("AVG", {}, RESNET_OF_GSV, "backbone.model.layer3.1.bn2.running_var", 320),
        ("CosPlace", {"out_dim": 8}, RESNET_OF_COSPLACE, "aggregation.3.weight", 512),
        ("BoQ", {"proj_channels": 64, "num_queries": 4, "row_dim": 2}, RESNET_OF_BOQ | BOQ,
         "aggregator.boqs.1.encoder.self_attn.in_proj_weight", 384),
    ],
)  # fmt: skip
def test_published_tensors_of_a_resnet_are_loaded_as_the_network_that_they_belong_to(
    aggregator: str,
    arguments: dict[str, Any],
    names: dict[str, str],
    published_name: str,
    size: int,
    tmp_path: Path,
) -> None:
    model = make_model("resnet18", aggregator, arguments, 64)
    tensors = rename(model, names)
    assert published_name in tensors
    interpolation = "bicubic" if aggregator == "BoQ" else "bilinear"
    assert_loads_as(tmp_path / "published.pth", tensors, model, size, interpolation)
    if aggregator == "CosPlace":  # also from a checkpoint of its training
        state = {"model_state_dict": tensors, "epoch_num": 3}
        assert_loads_as(tmp_path / "last_checkpoint.pth", state, model, size)


@pytest.mark.parametrize(
    ("aggregator", "arguments", "names"),
    [
        ("SALAD", {"num_clusters": 4, "cluster_dim": 8, "token_dim": 6, "published_order": True},
         dinov2("model") | SALAD),
        ("BoQ", {"proj_channels": 64, "num_queries": 4, "row_dim": 2}, dinov2("dino") | BOQ),
    ],
)  # fmt: skip
def test_published_tensors_of_dinov2_are_loaded_as_the_network_that_they_belong_to(
    aggregator: str, arguments: dict[str, Any], names: dict[str, str], tmp_path: Path
) -> None:
    model = make_model("dinov2_vits14", aggregator, arguments, 42)
    tensors = rename(model, names)
    attribute = "model" if aggregator == "SALAD" else "dino"
    tensors[f"backbone.{attribute}.mask_token"] = torch.zeros(1, 384)
    for part in ("weight", "bias"):  # in the file of BoQ, too, although its network skips the norm
        tensors.setdefault(f"backbone.{attribute}.norm.{part}", torch.zeros(384))
    interpolation = "bicubic" if aggregator == "BoQ" else "bilinear"
    assert_loads_as(tmp_path / "published.pth", tensors, model, 322, interpolation)


@pytest.mark.parametrize("names", [RESNET_OF_OPENVPRLAB, UNFROZEN_RESNET_OF_OPENVPRLAB])
def test_lightning_checkpoints_of_openvprlab_are_loaded_with_their_size_and_interpolation(
    names: dict[str, str], tmp_path: Path
) -> None:
    model = make_model("resnet18", "ConvAP", {"out_channels": 8, "s1": 3, "s2": 1}, 64)
    state = {
        "state_dict": rename(model, names | CONVAP) | {"loss_function.weight": torch.zeros(2)},
        "hyper_parameters": {
            "backbone": {"class": "ResNet", "params": {"backbone_name": "resnet18"}},
            "aggregator": {"class": "ConvAP", "params": {"in_channels": 256, "s1": 3, "s2": 1}},
            "datamodule": {"train_image_size": [224, 224], "val_image_size": [288, 288]},
        },
        "epoch": 3,
    }
    assert_loads_as(tmp_path / "epoch.ckpt", state, model, 288, "bicubic")


RECOGNISED = "resnet34 resnet50 resnet101 resnet152 resnext50_32x4d dinov2_vitb14 dinov2_vitl14"


@pytest.mark.parametrize("backbone", RECOGNISED.split())
def test_the_backbone_is_recognised_by_its_tensors(backbone: str) -> None:
    is_resnet = not backbone.startswith("dinov2")
    with torch.device("meta"):
        model = make_model(backbone, "BoQ", {"proj_channels": 64, "num_queries": 4}, 42)
    names = RESNET_OF_BOQ if is_resnet else dinov2("dino")
    config, tensors = read_published_checkpoint({}, rename(model, names | BOQ))
    assert config.backbone_arch == backbone
    assert config.stages == model.config.stages
    assert tensors.keys() == model.state_dict().keys()


@pytest.mark.parametrize(
    ("aggregator", "arguments", "names", "size"),
    [
        ("AVG", {}, {}, 320),
        ("GeM", {"p": 3}, {"aggregator.pool.p": "aggregator.p"}, 320),
        ("CosPlace", {"in_dim": 512, "out_dim": 8},
         {"aggregator.pool.p": "aggregator.gem.p", "aggregator.linear.": "aggregator.fc."}, 320),
        ("ConvAP", {"in_channels": 256, "out_channels": 8}, CONVAP, 320),
        ("MixVPR", {"in_channels": 256, "in_h": 4, "in_w": 4, "mix_depth": 2}, MIXVPR, 64),
    ],
)  # fmt: skip
def test_lightning_checkpoints_of_gsv_xs_are_loaded_with_their_hyperparameters(
    aggregator: str, arguments: dict[str, Any], names: dict[str, str], size: int, tmp_path: Path
) -> None:
    model = make_model("resnet18", aggregator, arguments, 64)
    training = {"lr": 2e-4, "loss_name": "MultiSimilarityLoss", "faiss_gpu": True}
    parameters = {
        "backbone_arch": "resnet18",
        "pretrained": True,
        "layers_to_freeze": 2,
        "layers_to_crop": list(model.config.layers_to_crop),
        "agg_arch": aggregator,
        "agg_config": arguments,
        **training,
    }
    tensors = rename(model, RESNET_OF_GSV | names)
    state = {"state_dict": tensors, "hyper_parameters": parameters, "epoch": 29}
    assert_loads_as(tmp_path / "theirs.ckpt", state, model, size)
    loaded = load_checkpoint(tmp_path / "theirs.ckpt")
    assert loaded.config.layers_to_freeze == -1  # its setting froze nothing
    assert loaded.about == {**training, "epoch": 29}


@pytest.mark.parametrize(
    "tensors",
    [
        {"backbone.0.weight": torch.zeros(64, 3, 3, 3), "aggregation.1.p": torch.ones(1)},
        {"features.0.weight": torch.zeros(64, 3, 3, 3)},
        {1: torch.zeros(1)},
    ],
)
def test_the_refusal_of_an_unknown_network_names_the_way_through_torch_hub(
    tensors: dict[Any, Any], tmp_path: Path
) -> None:
    torch.save(tensors, tmp_path / "vgg16.pth")
    with pytest.raises(Unprocessable) as refused:
        load_checkpoint(tmp_path / "vgg16.pth")
    assert refused.value.code == "checkpoint_unusable"
    assert "not those of a known network" in refused.value.detail
    assert "torchhub:OWNER/NAME@COMMIT:ENTRY" in refused.value.detail


def test_salad_in_the_published_order_has_the_same_numbers_transposed() -> None:
    sizes = {"num_clusters": 4, "cluster_dim": 8, "token_dim": 6}
    model = make_model("resnet18", "SALAD", sizes, 64)
    published = make_model("resnet18", "SALAD", sizes | {"published_order": True}, 64)
    published.load_state_dict(model.state_dict())
    photos = torch.randn(2, 3, 64, 64)
    with torch.inference_mode():
        ours, theirs = model(photos), published(photos)
    torch.testing.assert_close(theirs[:, :6], ours[:, :6])
    torch.testing.assert_close(
        theirs[:, 6:].reshape(2, 8, 4), ours[:, 6:].reshape(2, 4, 8).transpose(1, 2)
    )
    # The stored configuration, and so the fingerprint, of older models is unchanged.
    assert "published_order" not in model.config.agg_config
    assert published.config.agg_config["published_order"]
