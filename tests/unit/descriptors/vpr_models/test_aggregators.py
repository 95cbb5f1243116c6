"""Aggregators against their papers' formulas, worked out in numpy from their own weights."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from shared.descriptors.aggregators.base import Aggregator
from shared.descriptors.aggregators.clustering import SALAD, NetVLAD
from shared.descriptors.aggregators.mixing import BoQ, MixVPR
from shared.descriptors.aggregators.pooling import AveragePooling, ConvAP, CosPlace, GeM

pytestmark = pytest.mark.numerics

Array = NDArray[np.float64]
Weights = dict[str, Array]
Formula = Callable[[Array, Weights], Array]

CHANNELS, HEIGHT, WIDTH = 6, 5, 4


def some_maps(channels: int = CHANNELS, seed: int = 0) -> torch.Tensor:
    values = np.random.default_rng(seed).standard_normal((3, channels, HEIGHT, WIDTH))
    return torch.from_numpy(values.astype(np.float32))


def randomised(aggregator: Aggregator, seed: int = 1) -> tuple[Aggregator, Weights]:
    """In evaluation mode with other weights than its first ones, which hide what is left out."""
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in aggregator.named_parameters():
            if not name.endswith(".p"):
                parameter.add_(0.3 * torch.randn(parameter.shape, generator=random))
    weights = {n: v.double().numpy() for n, v in aggregator.state_dict().items()}
    return aggregator.eval(), weights


def unit(row: Any) -> Array:
    flat = np.asarray(row, np.float64).ravel()
    found: Array = flat / math.sqrt(math.fsum(flat**2))
    return found


def linear(weights: Weights, name: str, x: Array) -> Array:
    """(..., in) -> (..., out); a 1 x 1 convolution is one, too."""
    matrix = weights[f"{name}.weight"]
    found: Array = x @ matrix.reshape(matrix.shape[:2]).T + weights[f"{name}.bias"]
    return found


def layer_norm(weights: Weights, name: str, x: Array) -> Array:
    centred = x - x.mean(axis=-1, keepdims=True)
    scaled = centred / np.sqrt(x.var(axis=-1, keepdims=True) + 1e-5)
    found: Array = scaled * weights[f"{name}.weight"] + weights[f"{name}.bias"]
    return found


def softmax(x: Array) -> Array:
    powers = np.exp(x - x.max(axis=-1, keepdims=True))
    found: Array = powers / powers.sum(axis=-1, keepdims=True)
    return found


def check(aggregator: Aggregator, formula: Formula, dtype: torch.dtype = torch.float32) -> None:
    aggregator, weights = randomised(aggregator)
    maps = some_maps()
    rows = aggregator(maps, None) if aggregator.takes_token else aggregator(maps)
    assert rows.dtype == torch.float32
    assert rows.shape == (3, aggregator.dimension)
    expected = [unit(formula(photo.double().numpy(), weights)) for photo in maps]
    if dtype != rows.dtype:
        rows = aggregator.to(dtype)(maps.to(dtype))
    np.testing.assert_allclose(rows.detach(), np.stack(expected), atol=2e-6)


def test_average_and_gem_are_means_of_each_channel() -> None:
    maps = torch.tensor([[[[1.0, 3.0], [0.0, -7.0]], [[2.0, 2.0], [2.0, 2.0]]]])
    np.testing.assert_allclose(AveragePooling(2)(maps), [unit([-0.75, 2.0])], atol=1e-7)
    # (1 + 27 + 0 + 0) / 4 is 7: what is negative counts as eps
    np.testing.assert_allclose(GeM(2)(maps).detach(), [unit([7 ** (1 / 3), 2.0])], atol=1e-6)


def test_gem_takes_another_power_and_learns_it() -> None:
    gem = GeM(CHANNELS, p=4.5)
    maps = some_maps()
    means = np.maximum(maps.double().numpy(), 1e-6) ** 4.5
    expected = [unit(photo.mean(axis=(1, 2)) ** (1 / 4.5)) for photo in means]
    rows = gem(maps)
    np.testing.assert_allclose(rows.detach(), expected, atol=1e-6)
    rows[0, 0].backward()
    assert float(gem.pool.p.grad) != 0  # type: ignore[arg-type]


def test_gem_computes_in_float32_where_cubes_leave_the_range_of_float16() -> None:
    maps = 100 * some_maps().abs()  # 100 cubed is more than float16's 65,504
    rows = GeM(CHANNELS)(maps.half()).detach()
    assert rows.dtype == torch.float32
    np.testing.assert_allclose(rows, GeM(CHANNELS)(maps).detach(), atol=1e-3)


def test_cosplace_is_a_linear_layer_on_gem_of_normalised_features() -> None:
    def formula(photo: Array, w: Weights) -> Array:
        features = photo / np.sqrt((photo**2).sum(axis=0))
        pooled = (np.maximum(features, 1e-6) ** 3).mean(axis=(1, 2)) ** (1 / 3)
        return linear(w, "linear", pooled)

    check(CosPlace(CHANNELS, 9), formula)


def test_convap_is_the_mean_of_projected_features_in_each_cell() -> None:
    def formula(photo: Array, w: Weights) -> Array:
        y = linear(w, "channels", photo.transpose(1, 2, 0))
        # 5 rows in 2 cells share the middle one; 4 columns in 3 cells share those between.
        rows, columns = [(0, 3), (2, 5)], [(0, 2), (1, 3), (2, 4)]
        cells = [[y[a:b, c:d].mean(axis=(0, 1)) for c, d in columns] for a, b in rows]
        return np.array(cells).transpose(2, 0, 1)  # channel-major

    check(ConvAP(CHANNELS, 7, s1=2, s2=3), formula)


def test_mixvpr_mixes_positions_then_projects_channels_then_rows() -> None:
    def formula(photo: Array, w: Weights) -> Array:
        x = photo.reshape(CHANNELS, HEIGHT * WIDTH)
        for layer in range(2):
            at = f"mixers.{layer}"
            hidden = linear(w, f"{at}.widen", layer_norm(w, f"{at}.norm", x))
            x = x + linear(w, f"{at}.narrow", np.maximum(hidden, 0))
        narrowed = linear(w, "channels", x.T).T  # (out_channels, hw)
        return linear(w, "rows", narrowed)  # (out_channels, out_rows)

    mixvpr = MixVPR(CHANNELS, HEIGHT, WIDTH, out_channels=8, mix_depth=2, mlp_ratio=1.5, out_rows=3)
    assert mixvpr.state_dict()["mixers.0.widen.weight"].shape == (30, 20)
    check(mixvpr, formula)


def test_netvlad_sums_residuals_by_soft_assignment() -> None:
    def formula(photo: Array, w: Weights) -> Array:
        blocks = np.zeros((3, CHANNELS))
        for feature in photo.reshape(CHANNELS, -1).T:
            x = unit(feature)
            shares = softmax(w["weight"] @ x + w["bias"])
            for k in range(3):
                blocks[k] += shares[k] * (x - w["centres"][k])
        return np.stack([unit(block) for block in blocks])

    check(NetVLAD(CHANNELS, clusters=3, alpha=2.0), formula)


def salad_row(photo: Array, token: Array, w: Weights, clusters: int) -> Array:
    def mlp(name: str, x: Array, last: int) -> Array:
        return linear(w, f"{name}.{last}", np.maximum(linear(w, f"{name}.0", x), 0))

    x = photo.reshape(len(photo), -1).T  # (n, C)
    n = len(x)
    features, scores = mlp("features", x, 3), mlp("scores", x, 3)
    # Sinkhorn's scalings, without logarithms: rows are clusters and the dustbin.
    kernel = np.exp(np.vstack([scores.T, np.full((1, n), w["dustbin"])]))
    room = np.array([1.0] * clusters + [n - clusters])
    by_feature = np.ones(n)
    for _ in range(3):
        by_cluster = room / (kernel @ by_feature)
        by_feature = 1 / (kernel.T @ by_cluster)
    plan = by_cluster[:, None] * kernel * by_feature
    blocks = [unit(plan[k] @ features) for k in range(clusters)]
    return np.concatenate([unit(mlp("token", token, 2)), *blocks])


def test_salad_assigns_by_optimal_transport_and_leaves_the_rest_in_the_dustbin() -> None:
    def formula(photo: Array, w: Weights) -> Array:
        return salad_row(photo, photo.mean(axis=(1, 2)), w, clusters=4)

    check(SALAD(CHANNELS, num_clusters=4, cluster_dim=3, token_dim=5), formula)


def test_salad_takes_the_class_token_where_there_is_one() -> None:
    salad, weights = randomised(SALAD(CHANNELS, num_clusters=4, cluster_dim=3, token_dim=5))
    maps, token = some_maps(), torch.randn(3, CHANNELS, generator=torch.Generator().manual_seed(2))
    rows = salad(maps, token).detach()
    for row, photo, one in zip(rows, maps, token, strict=True):
        expected = unit(salad_row(photo.double().numpy(), one.double().numpy(), weights, 4))
        np.testing.assert_allclose(row, expected, atol=2e-6)


def attention(w: Weights, name: str, queries: Array, keys: Array) -> Array:
    """Multi-head attention (Vaswani et al. 2017) with one head for each 64 numbers."""
    width = queries.shape[1]
    matrices = np.split(w[f"{name}.in_proj_weight"], 3)
    biases = np.split(w[f"{name}.in_proj_bias"], 3)
    q, k, v = (x @ m.T + b for x, m, b in zip((queries, keys, keys), matrices, biases, strict=True))
    heads = [
        softmax(q[:, at : at + 64] @ k[:, at : at + 64].T / 8.0) @ v[:, at : at + 64]
        for at in range(0, width, 64)
    ]
    return linear(w, f"{name}.out_proj", np.concatenate(heads, axis=1))


def test_boq_attends_to_each_blocks_features_with_learned_queries() -> None:
    def formula(photo: Array, w: Weights) -> Array:
        padded = np.pad(photo, ((0, 0), (1, 1), (1, 1)))
        windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
        projected = np.einsum("chwyx,dcyx->hwd", windows, w["project.weight"]) + w["project.bias"]
        x = layer_norm(w, "norm", projected.reshape(-1, 128))
        found = []
        for number in range(2):
            b = {k.removeprefix(f"blocks.{number}."): v for k, v in w.items()}
            x = layer_norm(b, "encoder.norm1", x + attention(b, "encoder.self_attn", x, x))
            hidden = np.maximum(linear(b, "encoder.linear1", x), 0)
            x = layer_norm(b, "encoder.norm2", x + linear(b, "encoder.linear2", hidden))
            learnt = b["queries"][0]
            searched = layer_norm(
                b, "norm_queries", learnt + attention(b, "among_queries", learnt, learnt)
            )
            found.append(layer_norm(b, "norm_out", attention(b, "to_positions", searched, x)))
        return linear(w, "rows", np.concatenate(found).T)  # (width, row_dim)

    boq = BoQ(CHANNELS, proj_channels=128, num_queries=5, num_layers=2, row_dim=3)
    check(boq, formula, torch.float64)  # the last bits of its many sums in float32 reach the bound


@pytest.mark.parametrize(
    "aggregator",
    [
        AveragePooling(CHANNELS),
        GeM(CHANNELS),
        CosPlace(CHANNELS, 9),
        ConvAP(CHANNELS, 7),
        MixVPR(CHANNELS, HEIGHT, WIDTH),
        NetVLAD(CHANNELS, clusters=3),
        SALAD(CHANNELS, num_clusters=4),
        BoQ(CHANNELS, proj_channels=64, num_queries=5),
    ],
    ids=lambda aggregator: type(aggregator).__name__,
)
def test_a_descriptor_does_not_depend_on_the_batch_and_every_weight_learns(
    aggregator: Aggregator,
) -> None:
    aggregator.eval()
    maps = some_maps()

    def describe(batch: torch.Tensor) -> torch.Tensor:
        rows: torch.Tensor = (
            aggregator(batch, None) if aggregator.takes_token else aggregator(batch)
        )
        return rows

    rows = describe(maps)
    alone = torch.cat([describe(maps[i : i + 1]) for i in range(3)])
    np.testing.assert_allclose(rows.detach(), alone.detach(), atol=1e-6)
    np.testing.assert_allclose(rows.detach().norm(dim=1), np.ones(3), atol=1e-5)
    aggregator.train()
    loss: torch.Tensor = describe(maps.requires_grad_())[:, ::2].sum()
    torch.autograd.backward(loss)
    assert not [n for n, p in aggregator.named_parameters() if p.grad is None]
