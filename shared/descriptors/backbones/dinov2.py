"""DINOv2 backbone (Oquab et al. 2023): a facet of one transformer block, as in AnyLoc.

    tokens = [class, registers, patches] + positions
    tokens = block(tokens)                        for every block before `layer`, counted from 0
    facet  = output of block `layer` (token), or norm1(tokens) @ W + b with the third of that
             block's qkv projection that computes queries, keys or values
    feature of a patch = facet / |facet|          class and register tokens dropped

AnyLoc runs a complete forward pass and captures the facet with a hook. This module stops after
computing the facet; the values are identical.
The blocks are timm's. Positions are resampled as in Meta's code, on which AnyLoc's published
vocabularies depend; timm's own resampling gives other features at any size but the training's.

In bfloat16, a second network holds the matrices as bfloat16, so that no pass converts them, and
each LayerScale in the matrix before it:

    scale * (W x + b) = (diag(scale) W) x + scale * b

Residual sums and norms stay float32.
"""

from __future__ import annotations

import copy
import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.nn import Conv2d, Identity, Linear, Parameter
from torch.nn.functional import interpolate

from shared.descriptors.backbones import (
    Backbone,
    StoredWeights,
    normalise_features,
    normalise_pixels,
)
from shared.descriptors.backbones.dinov2_weights import (
    check_tensor_shapes,
    find_local_weights,
    find_or_download_weights,
    hub_repository,
    open_weights,
    weights_unusable_error,
)
from shared.descriptors.weight_files import OnProgress, Shape, TensorFile
from shared.extractor_config.configs import FACETS, ExtractorConfig

PATCH = 14  # pixels
GRID = 37  # patches along a side of the 518 x 518 training photos
INTERPOLATE_OFFSET = 0.1  # from Meta's code, avoids rounding errors of the output size
META_DEVICE = torch.device("meta")
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet


@dataclass(frozen=True, slots=True)
class VitShape:
    """The size of a vision transformer with patches of 14 x 14 pixels."""

    timm_name: str
    """Name of timm's network with the same blocks (SwiGLU in the giant, else plain MLP)."""
    depth: int
    width: int
    heads: int
    registers: int = 0


SHAPES = {
    "vits14": VitShape("vit_small_patch14_dinov2", depth=12, width=384, heads=6),
    "vitb14": VitShape("vit_base_patch14_dinov2", depth=12, width=768, heads=12),
    "vitl14": VitShape("vit_large_patch14_dinov2", depth=24, width=1024, heads=16),
    "vitg14": VitShape("vit_giant_patch14_dinov2", depth=40, width=1536, heads=24),
}


class Dinov2(Backbone):
    """Backbone that computes one facet of one DINOv2 block."""

    licence = "Apache-2.0"

    def __init__(
        self,
        size: str,
        layer: int,
        facet: str,
        device: torch.device,
        weights: Path | None = None,
        *,
        shape: VitShape | None = None,
    ) -> None:
        """Load the blocks up to `layer`; holds one copy of their weights in memory.

        Args:
            size: A key of SHAPES.
            layer: Number of the block, from 0.
            facet: query, key, value or token.
            weights: The setting DINO_WEIGHTS; None for timm's weights from the hub.
            shape: Overrides the shape of `size`, for tests.

        Raises:
            Misconfigured: `weights_missing`, `weights_unusable`.
        """
        self._shape = shape or SHAPES[size]
        self.name = f"dinov2-{size}"
        self.width = self._shape.width
        self.layer = str(layer)
        self.facet = facet
        self.device = device
        file = open_weights(find_or_download_weights(size, weights), size)
        self._vit = build_empty_vit(self._shape, layer, facet)
        self.fingerprint = load_vit_weights(self._vit, file, self._shape, size, device)
        if facet != "token":
            _slice_qkv(self._vit.blocks[layer].attn, FACETS.index(facet))
        self.card: dict[str, Any] = {
            "network": self._shape.timm_name,
            "source": hub_repository(size) if weights is None else "DINO_WEIGHTS",
            "file": file.path.name,
            "size_bytes": file.path.stat().st_size,
        }
        self._bfloat16_vit: Any = None
        self._on_device: Any = None
        self._positions: dict[tuple[int, int], torch.Tensor] = {}

    @classmethod
    def load(cls, config: ExtractorConfig, device: torch.device, weights: Path | None) -> Dinov2:
        return cls(*_network(config), device, weights)

    @classmethod
    def weights_source(cls, config: ExtractorConfig, weights: Path | None) -> str:
        size, _, _ = _network(config)
        return f"Hugging Face: {hub_repository(size)}" if weights is None else "DINO_WEIGHTS"

    @classmethod
    def find_weights(cls, config: ExtractorConfig, weights: Path | None) -> StoredWeights:
        size, layer, facet = _network(config)
        path = find_local_weights(size, weights)
        file, shape = open_weights(path, size), SHAPES[size]
        vit = build_empty_vit(shape, layer, facet)
        check_tensor_shapes(file, _shapes(vit), size, shape.registers)
        return StoredWeights(path, cls.licence)

    @classmethod
    def fetch(cls, config: ExtractorConfig, weights: Path | None, on_progress: OnProgress) -> None:
        size, _, _ = _network(config)
        find_or_download_weights(size, weights, on_progress)

    @torch.inference_mode()
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        _, height, width, _ = pixels.shape
        if height % PATCH or width % PATCH:
            raise ValueError(
                f"{height} x {width} pixels are not a multiple of the patch size {PATCH}"
            )
        vit = self._vit_for_precision()
        batch = normalise_pixels(pixels.to(self.device), MEAN, STD)
        patches = vit.patch_embed.proj(batch).flatten(2).transpose(1, 2)
        tokens = self._with_positions(vit, patches, height // PATCH, width // PATCH)
        *earlier, last = vit.blocks
        for block in earlier:
            tokens = block(tokens)
        facet = last(tokens) if self.facet == "token" else last.attn.qkv(last.norm1(tokens))
        return normalise_features(facet[:, 1 + self._shape.registers :])

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return height // PATCH, width // PATCH

    def _vit_for_precision(self) -> Any:
        """Return the network for the current autocast; only the last one used is on the device."""
        vit, other = self._vit, self._bfloat16_vit
        if torch.is_autocast_enabled(self.device.type):
            vit, other = other or copy_in_bfloat16(vit), vit
            self._bfloat16_vit = vit
        if self._on_device is not vit:
            self._on_device = None  # a move that runs out of memory leaves some tensors behind
            if other is not None:
                other.cpu()
            self._on_device = vit.to(self.device)
        return vit

    def _with_positions(
        self, vit: Any, patches: torch.Tensor, rows: int, columns: int
    ) -> torch.Tensor:
        """(B, patches, width) -> (B, 1 + registers + patches, width)."""
        registers = self._shape.registers
        if (rows, columns) not in self._positions:
            patch_positions = vit.pos_embed if registers else vit.pos_embed[:, 1:]
            self._positions[rows, columns] = resample_positions(
                patch_positions, rows, columns, registers=registers
            )
        first = vit.cls_token if registers else vit.cls_token + vit.pos_embed[:, :1]
        prefix = torch.cat([first, vit.reg_token], dim=1) if registers else first
        positioned = patches + self._positions[rows, columns]
        return torch.cat([prefix.expand(len(patches), -1, -1), positioned], dim=1)


def _network(config: ExtractorConfig) -> tuple[str, int, str]:
    """Return size, layer and facet."""
    assert config.layer is not None
    assert config.facet is not None
    return config.backbone.removeprefix("dinov2-"), config.layer, config.facet


def resample_positions(
    positions: torch.Tensor, rows: int, columns: int, *, registers: int = 0
) -> torch.Tensor:
    """Resample (1, side * side, width) position embeddings to (1, rows * columns, width).

    As `interpolate_pos_encoding` of Meta's dinov2/models/vision_transformer.py with the arguments
    of its hub models: bicubic in float32. Networks without registers scale by (rows + 0.1) / side,
    without antialiasing; those with registers resize to the exact size, antialiased.
    """
    side = math.isqrt(positions.shape[1])
    if (rows, columns) == (side, side):
        return positions
    grid = positions.float().reshape(1, side, side, -1).permute(0, 3, 1, 2)
    if registers:
        resampled = interpolate(grid, size=(rows, columns), mode="bicubic", antialias=True)
    else:
        scale = ((rows + INTERPOLATE_OFFSET) / side, (columns + INTERPOLATE_OFFSET) / side)
        resampled = interpolate(grid, scale_factor=scale, mode="bicubic", antialias=False)
    return resampled.permute(0, 2, 3, 1).flatten(1, 2)


def build_empty_vit(
    shape: VitShape,
    layer: int,
    facet: str,
    *,
    with_norm: bool = False,
    device: torch.device = META_DEVICE,
) -> Any:
    """Build timm's network up to the layers that the facet needs.

    On the default `meta` device the tensors have no memory; on others they are random.
    `with_norm` keeps the network's last norm.
    """
    import timm  # imported here because it takes seconds

    with device:
        vit: Any = timm.create_model(
            shape.timm_name,
            pretrained=False,
            depth=layer + 1,
            embed_dim=shape.width,
            num_heads=shape.heads,
            reg_tokens=shape.registers,
            no_embed_class=shape.registers > 0,
            img_size=GRID * PATCH,
            num_classes=0,
        )
    if not with_norm:
        vit.norm = Identity()
    if facet != "token":
        last = vit.blocks[layer]
        last.ls1 = last.norm2 = last.mlp = last.ls2 = last.attn.proj = Identity()
    return vit.eval().requires_grad_(False)


def _shapes(vit: Any) -> dict[str, Shape]:
    return {name: tuple(tensor.shape) for name, tensor in vit.state_dict().items()}


def load_vit_weights(
    vit: Any, file: TensorFile, shape: VitShape, size: str, device: torch.device
) -> str:
    """Load the tensors into an empty network.

    Returns their sha256: name-sorted, as float32 bytes. Raises Misconfigured (`weights_unusable`).
    """
    expected = _shapes(vit)
    check_tensor_shapes(file, expected, size, shape.registers)
    digest = hashlib.sha256()
    state = {}
    for name in sorted(expected):
        stored = file.read(name)
        if not stored.is_floating_point() or not torch.isfinite(stored).all():
            raise weights_unusable_error(
                file.path, f"{name} holds numbers that are not finite floats", size
            )
        # Copied: the file may be changed or removed while the service runs.
        tensor = torch.empty(stored.shape, dtype=torch.float32).copy_(stored)
        digest.update(name.encode())
        digest.update(tensor.numpy().data)
        state[name] = tensor.to(device)
    vit.load_state_dict(state, assign=True)
    return digest.hexdigest()


def _slice_qkv(attention: Any, third: int) -> None:
    """Keep only the query, key or value rows of the joint qkv projection."""
    joint: Linear = attention.qkv
    width = joint.in_features
    rows = slice(third * width, (third + 1) * width)
    attention.qkv = Linear(width, width, device="meta").requires_grad_(False)
    parameters = {"weight": joint.weight[rows].clone(), "bias": joint.bias[rows].clone()}
    attention.qkv.load_state_dict(parameters, assign=True)


def copy_in_bfloat16(vit: Any) -> Any:
    """Return a copy with bfloat16 matrices, in which each LayerScale is part of the one before."""
    matrices = [module for module in vit.modules() if isinstance(module, Linear | Conv2d)]
    # What deepcopy finds here it does not copy: the float32 matrices are replaced below.
    copied = copy.deepcopy(vit, {id(matrix.weight): matrix.weight for matrix in matrices})
    for block in copied.blocks:
        for branch, scale, last in (("attn", "ls1", "proj"), ("mlp", "ls2", "fc2")):
            layer_scale = getattr(block, scale)
            if isinstance(layer_scale, Identity):
                continue
            matrix = getattr(getattr(block, branch), last)
            scaled = layer_scale.gamma.unsqueeze(1) * matrix.weight
            matrix.weight = Parameter(scaled.bfloat16(), requires_grad=False)
            matrix.bias = Parameter(layer_scale.gamma * matrix.bias, requires_grad=False)
            setattr(block, scale, Identity())
    for module in copied.modules():
        if isinstance(module, Linear | Conv2d):
            for name, single in list(module.named_parameters(recurse=False)):
                setattr(module, name, Parameter(single.bfloat16(), requires_grad=False))
    return copied
