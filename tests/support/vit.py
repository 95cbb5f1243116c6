"""Vision transformers with random weights, and a plain forward pass that shares no code with
timm or with `shared.descriptors`: what the DINOv2 backbone is held to.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file

from shared.descriptors.backbones.dinov2 import VitShape

Weights = dict[str, torch.Tensor]

PLAIN = VitShape("vit_small_patch14_dinov2", depth=4, width=32, heads=2)
SWIGLU = VitShape("vit_giant_patch14_dinov2", depth=3, width=48, heads=3)
WITH_REGISTERS = VitShape("vit_small_patch14_dinov2", depth=2, width=32, heads=2, registers=4)
SIDE = 37  # of the grid of learnt positions


def random_weights(shape: VitShape, blocks: int | None = None, seed: int = 0) -> Weights:
    """Every tensor of such a network under Meta's names; `blocks` of it, all if not said."""
    rng = np.random.default_rng(seed)

    def random(*size: int, scale: float, around: float = 0.0) -> torch.Tensor:
        values = around + scale * rng.standard_normal(size, dtype=np.float32)
        return torch.from_numpy(values.astype(np.float32))

    d = shape.width
    weights = {
        "cls_token": random(1, 1, d, scale=1.0),
        "pos_embed": random(1, 1 + SIDE * SIDE, d, scale=1.0),
        "mask_token": random(1, d, scale=1.0),
        "patch_embed.proj.weight": random(d, 3, 14, 14, scale=0.05),
        "patch_embed.proj.bias": random(d, scale=0.1),
        "norm.weight": random(d, scale=0.2, around=1.0),
        "norm.bias": random(d, scale=0.1),
    }
    if shape.registers:
        weights["register_tokens"] = random(1, shape.registers, d, scale=1.0)
    for number in range(shape.depth if blocks is None else blocks):
        at = f"blocks.{number}."
        if shape.timm_name.startswith("vit_giant"):
            hidden = (int(4 * d * 2 / 3) + 7) // 8 * 8
            mlp = {"w12": (2 * hidden, d), "w3": (d, hidden)}
        else:
            mlp = {"fc1": (4 * d, d), "fc2": (d, 4 * d)}
        linears = {"attn.qkv": (3 * d, d), "attn.proj": (d, d)}
        linears |= {f"mlp.{name}": size for name, size in mlp.items()}
        for name, size in linears.items():
            weights[f"{at}{name}.weight"] = random(*size, scale=1.5 / size[1] ** 0.5)
            weights[f"{at}{name}.bias"] = random(size[0], scale=0.1)
        for name in ("norm1", "norm2"):
            weights[f"{at}{name}.weight"] = random(d, scale=0.2, around=1.0)
            weights[f"{at}{name}.bias"] = random(d, scale=0.1)
        for name in ("ls1", "ls2"):
            weights[f"{at}{name}.gamma"] = random(d, scale=0.1, around=0.5)
    return weights


def chunked(weights: Weights, size: int = 2) -> Weights:
    """Meta's names as its sharded training writes them: blocks in chunks, counted through."""

    def name(match: re.Match[str]) -> str:
        return f"blocks.{int(match[1]) // size}.{match[1]}."

    return {re.sub(r"^blocks\.(\d+)\.", name, key): value for key, value in weights.items()}


def timms(weights: Weights) -> Weights:
    """The same network under timm's names."""
    out = {k: v for k, v in weights.items() if k not in ("mask_token", "register_tokens")}
    if "register_tokens" in weights:
        out["reg_token"] = weights["register_tokens"]
        out["cls_token"] = weights["cls_token"] + weights["pos_embed"][:, :1]
        out["pos_embed"] = weights["pos_embed"][:, 1:].clone()
    return {k.replace("mlp.w12", "mlp.fc1").replace("mlp.w3", "mlp.fc2"): v for k, v in out.items()}


def save(weights: Mapping[str, Any], path: Path) -> Path:
    """Write a `.safetensors` file, or a PyTorch file under any other suffix."""
    if path.suffix == ".safetensors":
        save_file(dict(weights), path)
    else:
        torch.save(dict(weights), path)
    return path


def plain_forward(
    weights: Weights, shape: VitShape, pixels: NDArray[np.uint8 | np.float32]
) -> list[dict[str, NDArray[np.float64]]]:
    """Each block's facets of the patches, L2-normalised: the whole network, in float64.

    (B, H, W, 3), 0 to 255 -> for each block (B, patches, width) by the facet's name.
    """
    w = {name: tensor.double().numpy() for name, tensor in weights.items()}
    batch, height, width = pixels.shape[:3]
    rows, columns = height // 14, width // 14
    scaled = (pixels / 255 - np.array([0.485, 0.456, 0.406])) / np.array([0.229, 0.224, 0.225])
    cut = scaled.reshape(batch, rows, 14, columns, 14, 3)
    patches = np.einsum("brycxk,dkyx->brcd", cut, w["patch_embed.proj.weight"])
    patches = patches.reshape(batch, rows * columns, -1) + w["patch_embed.proj.bias"]

    learnt = w["pos_embed"][0, 1:].reshape(SIDE, SIDE, -1)
    resize = antialiased_weights if shape.registers else bicubic_weights
    placed = learnt  # of the size that the network was trained at
    if (rows, columns) != (SIDE, SIDE):
        placed = np.einsum("rh,hwd,cw->rcd", resize(rows), learnt, resize(columns))
    first = w["cls_token"][0] + w["pos_embed"][0, :1]
    registers = w["register_tokens"][0] if shape.registers else first[:0]
    prefix = np.broadcast_to(
        np.concatenate([first, registers]), (batch, 1 + shape.registers, shape.width)
    )
    tokens = np.concatenate([prefix, patches + placed.reshape(1, rows * columns, -1)], axis=1)

    found = []
    for number in range(shape.depth):
        block = {k.split(".", 2)[2]: v for k, v in w.items() if k.startswith(f"blocks.{number}.")}
        joint = _linear(block, "attn.qkv", _layer_norm(block, "norm1", tokens))
        q, k, v = np.split(joint, 3, axis=-1)
        tokens = tokens + block["ls1.gamma"] * _linear(
            block, "attn.proj", _attend(q, k, v, shape.heads)
        )
        inner = _layer_norm(block, "norm2", tokens)
        tokens = tokens + block["ls2.gamma"] * _mlp(block, inner)
        facets = {"query": q, "key": k, "value": v, "token": tokens}
        found.append(
            {name: _unit(facet[:, 1 + shape.registers :]) for name, facet in facets.items()}
        )
    return found


def bicubic_weights(size: int) -> NDArray[np.float64]:
    """(size, SIDE): Meta's resampling along one side, by Keys' cubic with a = -0.75.

    The scale is (size + 0.1) / SIDE, the border is repeated.
    """
    weights = np.zeros((size, SIDE))
    for index in range(size):
        source = (index + 0.5) * SIDE / (size + 0.1) - 0.5
        begin = int(np.floor(source))
        for tap in range(begin - 1, begin + 3):
            weights[index, min(max(tap, 0), SIDE - 1)] += _cubic(abs(source - tap), -0.75)
    return weights


def antialiased_weights(size: int) -> NDArray[np.float64]:
    """(size, SIDE): resizing to exactly `size` with the cubic (a = -0.5) stretched over what it
    shrinks, as for networks with registers.
    """
    scale = SIDE / size
    stretch = max(scale, 1.0)
    centres = (np.arange(size) + 0.5) * scale
    taps = np.arange(SIDE)
    distances = np.abs((taps[None] + 0.5 - centres[:, None]) / stretch)
    weights = np.vectorize(_cubic)(distances, -0.5)
    normalised: NDArray[np.float64] = weights / weights.sum(axis=1, keepdims=True)
    return normalised


def _cubic(x: float, a: float) -> float:
    if x <= 1:
        return ((a + 2) * x - (a + 3)) * x * x + 1
    if x < 2:
        return ((a * x - 5 * a) * x + 8 * a) * x - 4 * a
    return 0.0


def _attend(
    q: NDArray[np.float64], k: NDArray[np.float64], v: NDArray[np.float64], heads: int
) -> NDArray[np.float64]:
    def split(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return x.reshape(*x.shape[:2], heads, -1).transpose(0, 2, 1, 3)

    scores = split(q) @ split(k).transpose(0, 1, 3, 2) / np.sqrt(q.shape[-1] / heads)
    weights = np.exp(scores - scores.max(axis=-1, keepdims=True))
    mixed = weights / weights.sum(axis=-1, keepdims=True) @ split(v)
    together: NDArray[np.float64] = mixed.transpose(0, 2, 1, 3).reshape(q.shape)
    return together


def _mlp(block: dict[str, NDArray[np.float64]], x: NDArray[np.float64]) -> NDArray[np.float64]:
    if "mlp.w12.weight" in block:
        gate, value = np.split(_linear(block, "mlp.w12", x), 2, axis=-1)
        return _linear(block, "mlp.w3", gate / (1 + np.exp(-gate)) * value)
    inner = _linear(block, "mlp.fc1", x)
    erf = torch.erf(torch.from_numpy(inner / np.sqrt(2))).numpy()
    return _linear(block, "mlp.fc2", inner * 0.5 * (1 + erf))


def _linear(
    block: dict[str, NDArray[np.float64]], name: str, x: NDArray[np.float64]
) -> NDArray[np.float64]:
    out: NDArray[np.float64] = x @ block[f"{name}.weight"].T + block[f"{name}.bias"]
    return out


def _layer_norm(
    block: dict[str, NDArray[np.float64]], name: str, x: NDArray[np.float64]
) -> NDArray[np.float64]:
    centred = x - x.mean(axis=-1, keepdims=True)
    scaled = centred / np.sqrt((centred**2).mean(axis=-1, keepdims=True) + 1e-6)
    out: NDArray[np.float64] = scaled * block[f"{name}.weight"] + block[f"{name}.bias"]
    return out


def _unit(x: NDArray[np.float64]) -> NDArray[np.float64]:
    out: NDArray[np.float64] = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return out
