"""A plain forward pass of DINOv2 in float64 that shares no code with timm or with Placewise."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.backbones.dinov2 import VitShape
from tests.support.vit import SIDE, Weights


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
