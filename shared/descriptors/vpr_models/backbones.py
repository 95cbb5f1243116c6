"""A backbone as a stem and numbered stages: what can be frozen and cropped is the same for all.

DINOv2 (Oquab et al. 2023) as a map: the patch tokens after the last norm, and the class token.

A stage is a block: `layers_to_freeze` of the depth less n trains the last n. The network is that of
`shared.descriptors.backbones.dinov2`, with gradients.

torchvision's networks with their published ImageNet weights, from the cache or a given file.

Random weights are never a fallback: what can't be had is a Misconfigured that names the ways.

ResNet (He et al. 2016) and ResNeXt (Xie et al. 2017) by torchvision: strides 4, 8, 16, 32.

Swin-T (Liu et al. 2021) by torchvision: strides 4, 8, 16, 32; photos of any size.

EfficientNet-B0 (Tan and Le 2019) by torchvision, and its Lite0 by timm.

Stages 1 to 7 are the groups of blocks (strides 2, 4, 8, 16, 16, 32, 32), the 8th is the convolution
to 1,280 channels before the classifier.

Backbones of place models by name: photos to maps of local features. One module per family.
"""

from __future__ import annotations

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
from shared.descriptors.vpr_models.config import STAGES, VprModelConfig
from shared.descriptors.weight_files import (
    TENSOR_READ_ERRORS,
    download_file,
    first_error_line,
    load_tensors,
)
from shared.errors import Misconfigured


class FeatureMaps(NamedTuple):
    """What a backbone makes of a batch of photos."""

    maps: torch.Tensor
    """(B, C, h, w)."""
    token: torch.Tensor | None = None
    """(B, C), a transformer's class token; None of networks that have none."""


class StagedBackbone(nn.Module):
    """(B, 3, H, W) float32, normalised as for ImageNet -> Features."""

    patch: ClassVar[int] = 1
    """Height and width of a photo have to be multiples of so many pixels."""

    def __init__(
        self, stem: nn.Module, stages: Sequence[nn.Module], norm: nn.Module | None = None
    ) -> None:
        """`norm` comes after the last stage."""
        super().__init__()
        self.stem = stem
        self.stages = nn.ModuleList(stages)
        self.norm = nn.Identity() if norm is None else norm
        self._frozen: list[nn.Module] = []

    def forward(self, photos: torch.Tensor) -> FeatureMaps:
        return FeatureMaps(self._run(photos))

    def _run(self, photos: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = self.stem(photos)
        for stage in self.stages:
            found = stage(found)
        normed: torch.Tensor = self.norm(found)
        return normed

    def crop(self, count: int) -> None:
        """Keep the first `count` stages."""
        self.stages = self.stages[:count]

    def freeze(self, count: int) -> None:
        """Freeze the stem and the first `count` stages, and with all of them what comes after;
        nothing where `count` is negative.

        Frozen layers have no gradients, and stay in evaluation mode: their BatchNorms neither use
        nor gather a batch's statistics.
        """
        if count < 0:
            return
        self._frozen = [self.stem, *self.stages[:count]]
        if count >= len(self.stages):
            self._frozen.append(self.norm)
        for module in self._frozen:
            module.requires_grad_(False)

    def train(self, mode: bool = True) -> StagedBackbone:
        super().train(mode)
        for module in self._frozen:
            module.eval()
        return self


class Dinov2Backbone(StagedBackbone):
    patch: ClassVar[int] = PATCH

    def forward(self, photos: torch.Tensor) -> FeatureMaps:
        rows, columns = photos.shape[-2] // PATCH, photos.shape[-1] // PATCH
        tokens = self._run(photos)
        maps = tokens[:, 1:].transpose(1, 2).reshape(len(tokens), -1, rows, columns)
        return FeatureMaps(maps, tokens[:, 0])


class VitTokens(nn.Module):
    """(B, 3, H, W) -> (B, 1 + patches, width): the class token, and patches row by row."""

    def __init__(self, vit: Any) -> None:
        super().__init__()
        self.projection: nn.Module = vit.patch_embed.proj
        self.cls_token: nn.Parameter = vit.cls_token
        self.positions: nn.Parameter = vit.pos_embed

    def forward(self, photos: torch.Tensor) -> torch.Tensor:
        maps: torch.Tensor = self.projection(photos)
        rows, columns = maps.shape[-2:]
        of_patches = resample_positions(self.positions[:, 1:], rows, columns)
        patches = maps.flatten(2).transpose(1, 2) + of_patches
        first = self.cls_token + self.positions[:, :1]
        return torch.cat([first.expand(len(photos), -1, -1), patches], dim=1)


def build_dinov2(
    name: str, pretrained: bool, weights: Path | None, *, shape: VitShape | None = None
) -> StagedBackbone:
    """`weights`: a file in Meta's or timm's naming, None for timm's on the hub. `shape` is that of
    `name` unless a test has a smaller one."""
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
    return Dinov2Backbone(VitTokens(vit), list(vit.blocks), vit.norm)


def load_torchvision_network(name: str, pretrained: bool, weights: Path | None) -> Any:
    """The network `torchvision.models.NAME`; without `pretrained` its tensors are random.

    `weights`: a `.pth` or `.safetensors` in torchvision's naming instead of its own IMAGENET1K_V1,
    which is looked for in torch.hub's cache and else downloaded. Raises Misconfigured:
    `weights_missing`, `weights_unfit`, `download_corrupt`.
    """
    from torchvision import models  # takes seconds, which not every command need pay

    network = models.get_model(name, weights=None)
    if pretrained:
        url = models.get_model_weights(name)["IMAGENET1K_V1"].url
        path = find_or_download_torchvision_weights(name, url, weights)
        load_state(network, read_tensors(path, name), path, name)
    return network


def find_or_download_torchvision_weights(name: str, url: str, given: Path | None) -> Path:
    """The file of the weights, downloaded to torch.hub's cache if need be."""
    if given is not None:
        return check_weights_file(given, name)
    filename = url.rpartition("/")[2]
    cached = Path(torch.hub.get_dir(), "checkpoints", filename)
    if not cached.exists():
        # By torchvision's custom the name ends with the beginning of the hash.
        sha256 = cached.stem.rpartition("-")[2]
        try:
            download_file(url, cached, sha256=sha256)
        except (OSError, httpx2.HTTPError) as error:
            reason = f"{url} can't be downloaded: {first_error_line(error)}."
            raise _pretrained_missing_error(name, url, reason) from error
    return cached


def check_weights_file(path: Path, name: str) -> Path:
    """`path`, if it is a file; else Misconfigured (`weights_missing`)."""
    if not path.is_file():
        what = "is not a file" if path.exists() else "does not exist"
        raise Misconfigured(
            "weights_missing",
            f"{path} {what}: it was named as the file of the pretrained weights of {name}.",
        )
    return path


def read_tensors(path: Path, name: str) -> dict[str, torch.Tensor]:
    """The tensors of a `.safetensors` or PyTorch file, by name; weights only, no code is run.

    Misconfigured (`weights_unfit`) for what is no such file.
    """
    from safetensors.torch import load_file

    try:
        with path.open("rb") as file:
            begin = file.read(9)
        if begin[8:] == b"{":
            return load_file(path)
        state = load_tensors(path)
    except TENSOR_READ_ERRORS as error:
        reason = f"it can't be read as a file of tensors: {first_error_line(error)}"
        raise pretrained_unfit_error(path, name, reason) from error
    if not isinstance(state, dict) or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise pretrained_unfit_error(path, name, "it holds something else than named tensors")
    return state


def load_state(network: Any, state: dict[str, torch.Tensor], path: Path, name: str) -> None:
    """Give the network its tensors; Misconfigured (`weights_unfit`) where they don't fit."""
    own: dict[str, torch.Tensor] = network.state_dict()
    # Files of old releases count no batches, and nothing depends on that count.
    state = {n: t for n, t in own.items() if n.endswith("num_batches_tracked")} | state
    faults = [f"no tensor {n}" for n in own if n not in state]
    faults += [f"a tensor {n} too many" for n in state if n not in own]
    faults += [
        f"{n} of {tuple(t.shape)}, not {tuple(own[n].shape)}"
        for n, t in state.items()
        if n in own and own[n].shape != t.shape
    ]
    if faults:
        more = f" and {len(faults) - 1} faults more" if len(faults) > 1 else ""
        raise pretrained_unfit_error(path, name, f"it has {faults[0]}{more}")
    network.load_state_dict(state)


def pretrained_unfit_error(path: Path, name: str, reason: str) -> Misconfigured:
    return Misconfigured("weights_unfit", f"The weights {path} can't be used for {name}: {reason}.")


def _pretrained_missing_error(name: str, url: str, reason: str) -> Misconfigured:
    folder = Path(torch.hub.get_dir(), "checkpoints")
    return Misconfigured(
        "weights_missing",
        f"{reason} Ways to get the pretrained weights of {name}: (1) with internet access they are "
        f"downloaded on first use; (2) bring {url} from another machine into {folder}; (3) name a "
        "file of them; (4) pretrained=False begins with random weights, which takes far more "
        "photos and epochs.",
    )


def build_resnet(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    """`name` as in `config.STAGES`."""
    network = load_torchvision_network(name, pretrained, weights)
    stem = nn.Sequential(network.conv1, network.bn1, network.relu, network.maxpool)
    return StagedBackbone(stem, [network.layer1, network.layer2, network.layer3, network.layer4])


class SwinBackbone(StagedBackbone):
    def forward(self, photos: torch.Tensor) -> FeatureMaps:
        return FeatureMaps(self._run(photos).permute(0, 3, 1, 2))  # channels come last in it

    def crop(self, count: int) -> None:
        """The last norm belongs to the last stage and goes with it."""
        if count < len(self.stages):
            self.norm = nn.Identity()
        super().crop(count)


def build_swin(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    network = load_torchvision_network(name, pretrained, weights)
    stem, first, *later = network.features
    merged = [
        nn.Sequential(merge, blocks) for merge, blocks in zip(later[::2], later[1::2], strict=True)
    ]
    return SwinBackbone(stem, [first, *merged], network.norm)


def build_efficientnet_b0(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    stem, *stages = load_torchvision_network(name, pretrained, weights).features
    return StagedBackbone(stem, stages)


def build_efficientnet_lite0(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    """Published weights come with the package of the embedded default, or from a file in timm's
    naming."""
    import timm  # takes seconds, which not every command need pay

    network: Any
    if not pretrained:
        network = timm.create_model("tf_efficientnet_lite0", pretrained=False)
    elif weights is None:
        network = published_network()
    else:
        network = timm.create_model("tf_efficientnet_lite0", pretrained=False)
        load_state(network, read_tensors(check_weights_file(weights, name), name), weights, name)
    stem = nn.Sequential(Renormalise(), network.conv_stem, network.bn1)
    return StagedBackbone(stem, [*network.blocks, nn.Sequential(network.conv_head, network.bn2)])


class Renormalise(nn.Module):
    """From ImageNet's mean and deviation to those that Lite0 was trained with."""

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
    "resnet18": build_resnet,
    "resnet34": build_resnet,
    "resnet50": build_resnet,
    "resnet101": build_resnet,
    "resnext50_32x4d": build_resnet,
    "efficientnet_b0": build_efficientnet_b0,
    "efficientnet_lite0": build_efficientnet_lite0,
    "swin_t": build_swin,
    "dinov2_vits14": build_dinov2,
    "dinov2_vitb14": build_dinov2,
    "dinov2_vitl14": build_dinov2,
    "dinov2_vitg14": build_dinov2,
}


def build_backbone(config: VprModelConfig, weights: Path | None) -> StagedBackbone:
    """The backbone, cropped and frozen as the config says, in evaluation mode.

    `weights`: a file of pretrained weights, None for those of the hub's cache. Raises
    Misconfigured: `weights_missing`, `weights_unfit`, `download_corrupt`.
    """
    name = config.backbone_arch
    backbone = _BUILDERS[name](name, config.pretrained, weights)
    assert len(backbone.stages) == STAGES[name]
    backbone.crop(config.stages)
    backbone.freeze(config.layers_to_freeze)
    return backbone.eval()
