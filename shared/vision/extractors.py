"""Extractors: recipes (`shared.recipes`) with their weights loaded, at work on pixels."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import normalize

from shared.errors import Misconfigured
from shared.recipes import SLOW, TORCHHUB, Recipe
from shared.vision.backbones import Backbone
from shared.vision.backbones.dinov2 import SHAPES, Dinov2
from shared.vision.backbones.efficientnet_lite0 import EfficientNetLite0
from shared.vision.backbones.slow import SlowBackbone
from shared.vision.backbones.tiny import TinyBackbone
from shared.vision.backbones.torchhub import HubModule
from shared.vision.decode import DECODER
from shared.vision.preprocessing import Preprocessing, get_preprocessing
from shared.vision.vlad import vlad
from shared.vision.vocabulary import Centres, decode_centres

SHIPPED = Path(__file__).parent / "vocabularies"


def _dinov2(recipe: Recipe, device: torch.device, weights: Path | None) -> Backbone:
    assert recipe.layer is not None
    assert recipe.facet is not None
    size = recipe.backbone.removeprefix("dinov2-")
    return Dinov2(size, recipe.layer, recipe.facet, device, weights)


def _slow(recipe: Recipe, device: torch.device, _weights: Path | None) -> Backbone:
    assert recipe.width is not None
    return SlowBackbone(recipe.width, recipe.milliseconds / 1000, device)


def _torchhub(recipe: Recipe, device: torch.device, _weights: Path | None) -> Backbone:
    assert recipe.hub is not None
    return HubModule(recipe.hub, device)


BACKBONES: dict[str, Callable[[Recipe, torch.device, Path | None], Backbone]] = {
    "efficientnet-lite0": lambda _recipe, device, _weights: EfficientNetLite0(device),
    SLOW: _slow,
    "test-tiny": lambda _recipe, device, _weights: TinyBackbone(device),
    TORCHHUB: _torchhub,
    **{f"dinov2-{size}": _dinov2 for size in SHAPES},
}


def choose_device(device: str) -> torch.device:
    """The device called `auto`, `cpu` or `cuda`; `auto` is CUDA where there is one."""
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if device == "cuda" and not torch.cuda.is_available():
        raise Misconfigured(
            "cuda_missing",
            "DEVICE=cuda, but PyTorch finds no CUDA device. Check the driver with `nvidia-smi` "
            "and the PyTorch build, or set DEVICE=auto.",
        )
    return torch.device(device)


class Extractor:
    """A recipe with its weights loaded: the backbone is shared by all its vocabularies."""

    def __init__(
        self,
        recipe: Recipe,
        device: torch.device,
        *,
        dino_weights: Path | None = None,
        backbone: Backbone | None = None,
    ) -> None:
        """`dino_weights`: DINO_WEIGHTS, for the recipes on DINOv2; None takes timm's on the hub.
        `backbone`: one that is loaded already, of the same `recipe.local_features`.

        Raises Misconfigured (`weights_missing`, `weights_unfit`, `torchhub_unfit`).
        """
        self.recipe = recipe
        self.preprocessing: Preprocessing = get_preprocessing(recipe.preprocessing)
        self.backbone = backbone or BACKBONES[recipe.backbone](recipe, device, dino_weights)
        told = recipe.width
        assert told in (None, self.backbone.width), "the recipe tells others the width"

    def shipped_vocabulary(self) -> tuple[Centres, dict[str, Any]] | None:
        """The vocabulary that comes with the extractor, with its provenance; None without one."""
        if self.recipe.shipped_vocabulary is None:
            return None
        path = SHIPPED / self.recipe.shipped_vocabulary
        centres = decode_centres(path.read_bytes(), width=self.backbone.width)
        provenance = json.loads(path.with_suffix(".json").read_text())
        if provenance["backbone_fingerprint"] != self.backbone.fingerprint:
            raise Misconfigured(
                "vocabulary_unfit",
                f"The shipped vocabulary {path.name} was learnt with other weights "
                f"({provenance['backbone_fingerprint'][:12]}) than those installed "
                f"({self.backbone.fingerprint[:12]}). Install the pinned packages: `make setup`.",
            )
        return centres, provenance

    def spec(self, centres: Centres | None) -> dict[str, Any]:
        """Everything that decides a descriptor's value."""
        spec: dict[str, Any] = {
            "extractor": self.recipe.name,
            "backbone": self.backbone.name,
            "backbone_fingerprint": self.backbone.fingerprint,
            "layer": self.backbone.layer,
            "facet": self.backbone.facet,
            "preprocessing": self.preprocessing.as_spec(),
            "aggregator": self.recipe.aggregator,
            "vocabulary_sha256": centres.sha256 if centres else None,
            "clusters": centres.clusters if centres else None,
            "precision": "float32",
            "decoder": DECODER,
            "dimension": self.dimension(centres),
        }
        if isinstance(self.backbone, HubModule):
            spec["code_fingerprint"] = self.backbone.code_fingerprint
        return spec

    def dimension(self, centres: Centres | None) -> int:
        """Length of a descriptor."""
        return self.backbone.width * (centres.clusters if centres else 1)

    def features(self, pixels: NDArray[np.uint8]) -> torch.Tensor:
        """(B, H, W, 3) uint8 -> (B, patches, width) float32 local features on the device."""
        return self.backbone.features(torch.from_numpy(np.ascontiguousarray(pixels)))

    def describe(self, pixels: NDArray[np.uint8], centres: Centres | None) -> NDArray[np.float32]:
        """(B, H, W, 3) uint8 RGB -> (B, dimension) float32 unit rows."""
        features = self.features(pixels)
        if self.recipe.needs_vocabulary:
            if centres is None:
                raise ValueError(f"{self.recipe.name} needs a vocabulary")
            on_device = torch.from_numpy(centres.array).to(features.device)
            rows = vlad(features, on_device)
        else:
            rows = normalize(features.mean(dim=1), dim=-1)
        return rows.cpu().numpy().astype(np.float32, copy=False)


def spec_fingerprint(spec: dict[str, Any]) -> str:
    """sha256 of the spec's canonical JSON."""
    return hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()
