"""Backbones of VPR models: pretrained networks as a stem and numbered stages.

ResNet (He et al. 2016) and ResNeXt (Xie et al. 2017) by torchvision: strides 4, 8, 16, 32.

Swin-T (Liu et al. 2021) by torchvision: strides 4, 8, 16, 32; photos of any size.

VGG-16 (Simonyan and Zisserman 2015) by torchvision, without its last activation and pooling:
strides 2, 4, 8, 16.

EfficientNet-B0 to B7 (Tan and Le 2019) by torchvision, and its Lite0 by timm: stages 1 to 7 are the
groups of blocks (strides 2, 4, 8, 16, 16, 32, 32), the 8th is the convolution to 1,280 channels
before the classifier.

DINOv2 (Oquab et al. 2023): the map is the patch tokens after the last norm, and the class token is
returned as well. A stage is a block: `layers_to_freeze` = depth - n trains the last n blocks. The
network is that of `shared.descriptors.backbones.dinov2`, with gradients.

Pretrained weights come from a cache or a given file. Random weights are never a fallback: missing
weights raise a Misconfigured that names the ways to get them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import httpx2
import torch
from torch import nn

from shared.descriptors.backbones.dinov2 import MEAN as IMAGENET_MEAN
from shared.descriptors.backbones.dinov2 import (
    PATCH,
    SHAPES,
    VitShape,
    build_empty_vit,
    load_vit_weights,
    resample_positions,
)
from shared.descriptors.backbones.dinov2 import STD as IMAGENET_STD
from shared.descriptors.backbones.dinov2_weights import find_or_download_weights, open_weights
from shared.descriptors.backbones.efficientnet_lite0 import MEAN, STD, published_network
from shared.descriptors.vpr_models.config import STAGES, VGG16_POOLINGS, VprModelConfig
from shared.descriptors.weight_files import (
    TENSOR_READ_ERRORS,
    download_file,
    first_error_line,
    open_tensor_file,
    shape_differences,
)
from shared.errors import Misconfigured


class FeatureMaps(NamedTuple):
    """The output of a backbone for a batch of photos."""

    maps: torch.Tensor
    """(B, C, h, w)."""
    token: torch.Tensor | None = None
    """(B, C) class tokens of a transformer; None for other networks."""


class StagedBackbone(nn.Module):
    """A network as a stem, stages and a norm, which can be cropped and frozen.

    Takes (B, 3, H, W) float32, normalised as for ImageNet; returns FeatureMaps.
    """

    patch: ClassVar[int] = 1
    """Height and width of a photo must be multiples of this, in pixels."""

    def __init__(
        self, stem: nn.Module, stages: Sequence[nn.Module], norm: nn.Module | None = None
    ) -> None:
        """`norm` follows the last stage."""
        super().__init__()
        self.stem = stem
        self.stages = nn.ModuleList(stages)
        self.norm = nn.Identity() if norm is None else norm
        self._frozen: list[nn.Module] = []

    def forward(self, photos: torch.Tensor) -> FeatureMaps:
        return FeatureMaps(self._run(photos))

    def _run(self, photos: torch.Tensor) -> torch.Tensor:
        features: torch.Tensor = self.stem(photos)
        for stage in self.stages:
            features = stage(features)
        normed: torch.Tensor = self.norm(features)
        return normed

    def crop(self, count: int) -> None:
        """Keep the first `count` stages."""
        self.stages = self.stages[:count]

    def freeze(self, count: int) -> None:
        """Freeze the stem and the first `count` stages; if these are all stages, the norm, too.

        Does nothing if `count` is negative. Frozen layers have no gradients and stay in evaluation
        mode: their BatchNorms neither use nor update batch statistics.
        """
        if count < 0:
            return
        self._frozen = [self.stem, *self.stages[:count]]
        if count >= len(self.stages):
            self._frozen.append(self.norm)
        for module in self._frozen:
            module.requires_grad_(False)

    def train(self, mode: bool = True) -> StagedBackbone:
        """Set the mode of all layers but the frozen ones."""
        super().train(mode)
        for module in self._frozen:
            module.eval()
        return self


class _Dinov2Backbone(StagedBackbone):
    """Patch tokens as a map, and the class token."""

    patch: ClassVar[int] = PATCH

    def forward(self, photos: torch.Tensor) -> FeatureMaps:
        rows, columns = photos.shape[-2] // PATCH, photos.shape[-1] // PATCH
        tokens = self._run(photos)
        maps = tokens[:, 1:].transpose(1, 2).reshape(len(tokens), -1, rows, columns)
        return FeatureMaps(maps, tokens[:, 0])


class _VitTokens(nn.Module):
    """Stem of a ViT: (B, 3, H, W) -> (B, 1 + patches, width), class token first.

    Patches are in row-major order.
    """

    def __init__(self, vit: Any) -> None:
        super().__init__()
        self.projection: nn.Module = vit.patch_embed.proj
        self.cls_token: nn.Parameter = vit.cls_token
        self.positions: nn.Parameter = vit.pos_embed

    def forward(self, photos: torch.Tensor) -> torch.Tensor:
        maps: torch.Tensor = self.projection(photos)
        rows, columns = maps.shape[-2:]
        patch_positions = resample_positions(self.positions[:, 1:], rows, columns)
        patches = maps.flatten(2).transpose(1, 2) + patch_positions
        first = self.cls_token + self.positions[:, :1]
        return torch.cat([first.expand(len(photos), -1, -1), patches], dim=1)


def build_dinov2(
    name: str, pretrained: bool, weights: Path | None, *, shape: VitShape | None = None
) -> StagedBackbone:
    """Build a DINOv2 backbone.

    Args:
        name: A key of `config.STAGES`.
        pretrained: Whether to load weights; else they are random.
        weights: A file in Meta's or timm's naming; None for timm's from the hub.
        shape: Overrides the shape of `name`, for tests.
    """
    size = name.removeprefix("dinov2_")
    shape = shape or SHAPES[size]
    if pretrained:
        vit = build_empty_vit(shape, shape.depth - 1, "token", with_norm=True)
        load_vit_weights(
            vit,
            open_weights(find_or_download_weights(size, weights), size),
            shape,
            size,
            torch.device("cpu"),
        )
    else:
        vit = build_empty_vit(
            shape, shape.depth - 1, "token", with_norm=True, device=torch.get_default_device()
        )
    vit.requires_grad_(True)
    return _Dinov2Backbone(_VitTokens(vit), list(vit.blocks), vit.norm)


def _load_torchvision_network(name: str, pretrained: bool, weights: Path | None) -> Any:
    """Build `torchvision.models.NAME`; without `weights` they are torchvision's IMAGENET1K_V1."""
    from torchvision import models  # imported here because it takes seconds

    network = models.get_model(name, weights=None)
    if pretrained:
        url = models.get_model_weights(name)["IMAGENET1K_V1"].url
        path = _find_or_download_torchvision_weights(name, url, weights)
        _load_weights(network, path, name)
    return network


def _find_or_download_torchvision_weights(name: str, url: str, given: Path | None) -> Path:
    """Return the weights file: `given`, else that of torch.hub's cache, downloaded if missing."""
    if given is not None:
        return _check_weights_file(given, name)
    filename = url.rpartition("/")[2]
    cached = Path(torch.hub.get_dir(), "checkpoints", filename)
    if not cached.exists():
        # torchvision's file names end with the first characters of the hash.
        sha256 = cached.stem.rpartition("-")[2]
        try:
            download_file(url, cached, sha256=sha256)
        except (OSError, httpx2.HTTPError) as error:
            reason = f"{url} can't be downloaded: {first_error_line(error)}."
            raise _pretrained_missing_error(name, url, reason) from error
    return cached


def _check_weights_file(path: Path, name: str) -> Path:
    """Return `path`; raise Misconfigured (`weights_missing`) unless it is a file."""
    if not path.is_file():
        what = "is not a file" if path.exists() else "does not exist"
        raise Misconfigured(
            "weights_missing",
            f"{path}, given as the pretrained weights of {name} (--weights), {what}.",
        )
    return path


def _load_weights(network: Any, path: Path, name: str) -> None:
    """Load a file's tensors; raise Misconfigured (`weights_unusable`) if they don't fit."""
    try:
        file = open_tensor_file(path)
    except TENSOR_READ_ERRORS as error:
        reason = f"it can't be read as a file of tensors: {first_error_line(error)}"
        raise _pretrained_unusable_error(path, name, reason) from error
    # Files of old releases lack num_batches_tracked, which is not used.
    expected = {
        n: tuple(tensor.shape)
        for n, tensor in network.state_dict().items()
        if n in file.shapes or not n.endswith("num_batches_tracked")
    }
    differences = shape_differences(file.shapes, expected)
    if differences:
        raise _pretrained_unusable_error(path, name, differences)
    network.load_state_dict({n: file.read(n) for n in expected}, strict=False)


def _pretrained_unusable_error(path: Path, name: str, reason: str) -> Misconfigured:
    return Misconfigured(
        "weights_unusable", f"The weights {path} can't be used for {name}: {reason}."
    )


def _pretrained_missing_error(name: str, url: str, reason: str) -> Misconfigured:
    folder = Path(torch.hub.get_dir(), "checkpoints")
    return Misconfigured(
        "weights_missing",
        f"{reason} Ways to get the pretrained weights of {name}: (1) with internet access they are "
        f"downloaded on first use; (2) copy {url} from another machine to {folder}; (3) pass a "
        "file of them with --weights FILE; (4) --pretrained False starts with random weights, "
        "which needs far more photos and epochs.",
    )


def _build_resnet(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    """Build a ResNet or ResNeXt; `name` is a key of `config.STAGES`."""
    network = _load_torchvision_network(name, pretrained, weights)
    stem = nn.Sequential(network.conv1, network.bn1, network.relu, network.maxpool)
    return StagedBackbone(stem, [network.layer1, network.layer2, network.layer3, network.layer4])


class _SwinBackbone(StagedBackbone):
    """Swin transformer with its map in channels-first order."""

    def forward(self, photos: torch.Tensor) -> FeatureMaps:
        return FeatureMaps(self._run(photos).permute(0, 3, 1, 2))  # from channels-last

    def crop(self, count: int) -> None:
        """Keep the first `count` stages; the norm belongs to the last stage."""
        if count < len(self.stages):
            self.norm = nn.Identity()
        super().crop(count)


def _build_swin(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    """Build a Swin transformer; each stage begins with its patch merging."""
    network = _load_torchvision_network(name, pretrained, weights)
    stem, first, *later = network.features
    merged = [
        nn.Sequential(merge, blocks) for merge, blocks in zip(later[::2], later[1::2], strict=True)
    ]
    return _SwinBackbone(stem, [first, *merged], network.norm)


def _build_vgg16(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    """Build VGG-16; its modules keep their numbers in torchvision's network."""
    layers = _load_torchvision_network(name, pretrained, weights).features
    begins = [*VGG16_POOLINGS, len(layers) - 2]
    stages = [layers[begin:end] for begin, end in itertools.pairwise(begins)]
    return StagedBackbone(layers[: begins[0]], stages)


def _build_efficientnet(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    """Build an EfficientNet of torchvision."""
    stem, *stages = _load_torchvision_network(name, pretrained, weights).features
    return StagedBackbone(stem, stages)


def _build_efficientnet_lite0(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    """Build EfficientNet-Lite0.

    Pretrained weights come from the package of the embedded default, or from a file in timm's
    naming.
    """
    import timm  # imported here because it takes seconds

    network: Any
    if pretrained and weights is None:
        network = published_network()
    else:
        network = timm.create_model("tf_efficientnet_lite0", pretrained=False)
        if pretrained and weights is not None:
            _load_weights(network, _check_weights_file(weights, name), name)
    stem = nn.Sequential(_Renormalise(), network.conv_stem, network.bn1)
    return StagedBackbone(stem, [*network.blocks, nn.Sequential(network.conv_head, network.bn2)])


class _Renormalise(nn.Module):
    """Converts pixels from ImageNet's normalisation to that of Lite0's training."""

    def __init__(self) -> None:
        super().__init__()
        mean, std = torch.tensor(IMAGENET_MEAN), torch.tensor(IMAGENET_STD)
        self.register_buffer("scale", (std / torch.tensor(STD)).view(3, 1, 1))
        self.register_buffer(
            "shift", ((mean - torch.tensor(MEAN)) / torch.tensor(STD)).view(3, 1, 1)
        )
        self.scale: torch.Tensor
        self.shift: torch.Tensor

    def forward(self, photos: torch.Tensor) -> torch.Tensor:
        return photos * self.scale + self.shift


BackboneBuilder = Callable[[str, bool, Path | None], StagedBackbone]

_BUILDERS: dict[str, BackboneBuilder] = {
    **dict.fromkeys(
        ("resnet18", "resnet34", "resnet50", "resnet101", "resnet152", "resnext50_32x4d"),
        _build_resnet,
    ),
    "vgg16": _build_vgg16,
    **{f"efficientnet_b{size}": _build_efficientnet for size in range(8)},
    "efficientnet_lite0": _build_efficientnet_lite0,
    "swin_t": _build_swin,
    **{f"dinov2_{size}": build_dinov2 for size in SHAPES},
}


class _OwnBackbone(StagedBackbone):
    """A network of the user without stages: it is trained or frozen as a whole."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__(network, [])

    def forward(self, photos: torch.Tensor) -> FeatureMaps:
        maps = self._run(photos)
        if not isinstance(maps, torch.Tensor) or maps.ndim != 4:
            raise Misconfigured(
                "backbone_unusable",
                f"The backbone {type(self.stem).__name__} must return maps (B, C, h, w) of "
                f"(B, 3, H, W) photos, not {tuple(getattr(maps, 'shape', [type(maps)]))}.",
            )
        return FeatureMaps(maps)


def register_backbone(name: str, build: Callable[[bool], nn.Module]) -> None:
    """Add a backbone of the user.

    Args:
        name: `package.module:function`.
        build: Makes the network, with pretrained or random weights: (B, 3, H, W) float32 photos,
            normalised as for ImageNet, to (B, C, h, w) maps.
    """
    STAGES[name] = 0
    _BUILDERS[name] = lambda _name, pretrained, _weights: _OwnBackbone(build(pretrained))


def build_backbone(config: VprModelConfig, weights: Path | None) -> StagedBackbone:
    """Build the backbone of a config, cropped and frozen, in evaluation mode.

    Args:
        weights: A file of pretrained weights; None for those of the hub's cache.

    Raises:
        Misconfigured: `weights_missing`, `weights_unusable`, `download_corrupt`.
    """
    name = config.backbone_arch
    backbone = _BUILDERS[name](name, config.pretrained, weights)
    assert len(backbone.stages) == STAGES[name]
    if not config.backbone_norm:
        backbone.norm = nn.Identity()
    backbone.crop(config.stages)
    backbone.freeze(config.layers_to_freeze)
    return backbone.eval()
