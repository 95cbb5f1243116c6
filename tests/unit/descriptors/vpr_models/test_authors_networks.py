"""Published networks that are more than a ResNet: the descriptors of their authors' architecture.

The architectures are written here from their papers, in plain tensor operations, with the names
that their tensors have in the published files.
"""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import nn
from torch.nn.functional import normalize
from torchvision import models

from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.errors import Unprocessable

Tensors = dict[str, torch.Tensor]


def draw_weights(module: nn.Module) -> None:
    """Draw weights under which maps neither vanish nor explode, and statistics of BatchNorms."""
    torch.manual_seed(0)
    module.to_empty(device="cpu").eval()
    for part in module.modules():
        if isinstance(part, nn.Conv2d):
            nn.init.kaiming_normal_(part.weight, nonlinearity="relu")
            if part.bias is not None:
                nn.init.normal_(part.bias, std=0.1)
        if isinstance(part, nn.BatchNorm2d):
            nn.init.uniform_(part.weight, 0.5, 1.5)
            nn.init.normal_(part.bias)
            nn.init.normal_(part.running_mean)  # type: ignore[arg-type]
            nn.init.uniform_(part.running_var, 0.5, 1.5)  # type: ignore[arg-type]
            part.num_batches_tracked.zero_()  # type: ignore[union-attr]


def cosplace_layers(backbone: str) -> nn.Sequential:
    """CosPlace's backbone of torchvision, without its last activation (VGG-16) and its pooling."""
    if backbone == "vgg16":
        return nn.Sequential(*list(models.vgg16().features)[:-2])
    name = backbone.removesuffix(" nested")
    features = models.get_model(name).features
    return nn.Sequential(features) if backbone.endswith("nested") else nn.Sequential(*features)


def cosplace(backbone: str) -> tuple[nn.Sequential, Tensors]:
    """The layers, and all tensors by their names: GeM's p, and the projection to 32 numbers."""
    with torch.device("meta"):
        layers = cosplace_layers(backbone)
    draw_weights(layers)
    channels = [m.out_channels for m in layers.modules() if isinstance(m, nn.Conv2d)][-1]
    head = {
        "aggregation.1.p": torch.tensor([2.5]),
        "aggregation.3.weight": torch.randn(32, channels),
        "aggregation.3.bias": torch.randn(32),
    }
    return layers, {f"backbone.{n}": t for n, t in layers.state_dict().items()} | head


@pytest.mark.parametrize(
    ("backbone", "recognised"),
    [
        ("vgg16", "vgg16"),
        ("efficientnet_b0", "efficientnet_b0"),
        ("efficientnet_b1", "efficientnet_b1"),
        ("efficientnet_b2 nested", "efficientnet_b2"),
    ],
)
@torch.inference_mode()
def test_cosplace_describes_as_its_authors_network(
    backbone: str, recognised: str, tmp_path: Path
) -> None:
    layers, tensors = cosplace(backbone)
    torch.save(tensors, tmp_path / "published.torch")
    loaded = load_checkpoint(tmp_path / "published.torch")
    assert (loaded.config.backbone_arch, loaded.config.image_size) == (recognised, (512, 512))
    photos = torch.randn(2, 3, 64, 96)
    maps = normalize(layers(photos), dim=1).clamp(min=1e-6)
    p = tensors["aggregation.1.p"]
    pooled = maps.pow(p).mean(dim=(2, 3)).pow(1 / p)
    rows = pooled @ tensors["aggregation.3.weight"].T + tensors["aggregation.3.bias"]
    torch.testing.assert_close(loaded.model(photos), normalize(rows), rtol=1e-4, atol=1e-5)


CLUSTERS, CLUSTER_DIM, TOKEN_DIM, ROW = 4, 8, 6, 10
WIDTH = 384  # of the smallest DINOv2


def megaloc() -> Tensors:
    torch.manual_seed(0)
    # Only the head differs from SALAD: the transformer is compared with a reference elsewhere.
    vit = load_vit()
    head = {}
    layers: dict[str, list[tuple[int, ...]]] = {
        "token_features": [(512, WIDTH), (TOKEN_DIM, 512)],
        "cluster_features": [(512, WIDTH, 1, 1), (CLUSTER_DIM, 512, 1, 1)],
        "score": [(512, WIDTH, 1, 1), (CLUSTERS, 512, 1, 1)],
    }
    for name, sizes in layers.items():
        last = 2 if name == "token_features" else 3
        for number, size in zip((0, last), sizes, strict=True):
            head[f"agg.{name}.{number}.weight"] = torch.randn(size) / size[1] ** 0.5
            head[f"agg.{name}.{number}.bias"] = torch.randn(size[0])
    head["agg.dust_bin"] = torch.tensor(0.7)
    head["linear.weight"] = torch.randn(ROW, CLUSTERS * CLUSTER_DIM + TOKEN_DIM)
    head["linear.bias"] = torch.randn(ROW) / 10
    named = {f"backbone.model.{name}": tensor for name, tensor in vit.items()}
    return named | {f"aggregator.{name}": tensor for name, tensor in head.items()}


def load_vit() -> Tensors:
    import timm

    vit: Any = timm.create_model("vit_small_patch14_dinov2", num_classes=0)
    nn.init.normal_(vit.pos_embed)
    return dict(vit.state_dict())


def sinkhorn(scores: NDArray[np.float64], dustbin: float) -> NDArray[np.float64]:
    """Three iterations for masses of 1 for features and clusters; the dustbin takes the rest."""
    clusters, features = scores.shape
    kernel = np.exp(np.vstack([scores, np.full(features, dustbin)]))
    masses = np.array([1.0] * clusters + [features - clusters])
    v = np.ones(features)
    for _ in range(3):
        u = masses / (kernel @ v)
        v = 1 / (kernel.T @ u)
    found: NDArray[np.float64] = (u[:, None] * kernel * v)[:clusters]
    return found


def megaloc_head(t: Tensors, maps: torch.Tensor, token: torch.Tensor) -> NDArray[np.float64]:
    """A row, from the (C, h, w) map and the (C,) class token."""
    w = {n.removeprefix("aggregator."): v.double().numpy() for n, v in t.items() if "agg" in n}

    def mlp(name: str, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(positions, C) -> (positions, out)"""
        last = 2 if name == "token_features" else 3
        for number in (0, last):
            weight = w[f"agg.{name}.{number}.weight"].reshape(-1, x.shape[1])
            x = x @ weight.T + w[f"agg.{name}.{number}.bias"]
            x = np.maximum(x, 0) if number == 0 else x
        return x

    patches = maps.flatten(1).T.double().numpy()
    plan = sinkhorn(mlp("score", patches).T, float(w["agg.dust_bin"]))
    clusters = mlp("cluster_features", patches).T @ plan.T  # (cluster_dim, clusters)
    clusters /= np.linalg.norm(clusters, axis=0)
    first = mlp("token_features", token.double().numpy()[None])[0]
    row = np.concatenate([first / np.linalg.norm(first), clusters.ravel()])
    row = w["linear.weight"] @ (row / np.linalg.norm(row)) + w["linear.bias"]
    found: NDArray[np.float64] = row / np.linalg.norm(row)
    return found


@torch.inference_mode()
def test_megaloc_describes_as_its_authors_network(tmp_path: Path) -> None:
    tensors, path = megaloc(), tmp_path / "megaloc.safetensors"
    save_file(tensors, path)
    loaded = load_checkpoint(path)
    assert (loaded.config.backbone_arch, loaded.config.image_size) == ("dinov2_vits14", (322, 322))
    assert loaded.model.dimension == ROW
    photos = torch.randn(2, 3, 42, 56)
    maps, token = loaded.model.backbone(photos)
    expected = [megaloc_head(tensors, *each) for each in zip(maps, token, strict=True)]
    found = loaded.model(photos).double().numpy()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("before", "entry"),
    [
        ("module.", None),
        ("_orig_mod.", "model_state_dict"),
        ("model._orig_mod.module.", "state_dict"),
        ("net.", "weights"),
    ],
)
def test_prefixes_of_tensor_names_are_removed(
    before: str, entry: str | None, tmp_path: Path
) -> None:
    _, tensors = cosplace("efficientnet_b0")
    state: dict[str, Any] = OrderedDict((before + name, t) for name, t in tensors.items())
    torch.save({entry: state, "epoch_num": 3} if entry else state, tmp_path / "wrapped.pth")
    loaded = load_checkpoint(tmp_path / "wrapped.pth")
    assert loaded.config.backbone_arch == "efficientnet_b0"
    stored = loaded.model.state_dict()["backbone.stages.7.0.weight"]
    assert torch.equal(stored, tensors["backbone.8.0.weight"])


def test_file_with_several_networks_names_them(tmp_path: Path) -> None:
    state = {"student": {"a": torch.zeros(1)}, "teacher": {"a": torch.zeros(1)}}
    torch.save(state, tmp_path / "two.pth")
    with pytest.raises(Unprocessable, match=r"student, teacher") as caught:
        load_checkpoint(tmp_path / "two.pth")
    assert caught.value.code == "checkpoint_unusable"
