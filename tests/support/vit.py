"""Weights of small vision transformers, drawn at random, in the formats that are published."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

from shared.descriptors.backbones.dinov2 import VitShape

Weights = dict[str, torch.Tensor]

PLAIN = VitShape("vit_small_patch14_dinov2", depth=4, width=32, heads=2)
SWIGLU = VitShape("vit_giant_patch14_dinov2", depth=3, width=48, heads=3)
WITH_REGISTERS = VitShape("vit_small_patch14_dinov2", depth=2, width=32, heads=2, registers=4)
SIDE = 37  # of the grid of learnt positions


def random_weights(shape: VitShape, blocks: int | None = None) -> Weights:
    """Every tensor of such a network under Meta's names; `blocks` limits their number."""
    rng = np.random.default_rng(0)

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


def chunked(weights: Weights) -> Weights:
    """Meta's names as its sharded training writes them: blocks in chunks, counted through."""

    def name(match: re.Match[str]) -> str:
        return f"blocks.{int(match[1]) // 2}.{match[1]}."

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
