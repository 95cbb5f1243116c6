"""Extractors: recipes (`shared.extractor_config.configs`) with their weights loaded, at work on
pixels."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.aggregation import average_pooling, gem_pooling, soft_vlad, vlad
from shared.descriptors.backbones import Backbone
from shared.descriptors.backbones.dinov2 import SHAPES, Dinov2
from shared.descriptors.backbones.efficientnet_lite0 import EfficientNetLite0
from shared.descriptors.backbones.synthetic import SlowBackbone, TinyBackbone
from shared.descriptors.backbones.torchhub import TorchHubBackbone
from shared.descriptors.backbones.trained import TrainedBackbone
from shared.descriptors.inference import (
    BatchSizeLimit,
    PhotoTooLargeForGpu,
    Precision,
    autocast,
    run_in_batches,
)
from shared.descriptors.pca_whitening import PcaProjection
from shared.descriptors.vocabulary import ClusterCentres, decode_centres
from shared.errors import Misconfigured, Unprocessable
from shared.extractor_config.configs import (
    SLOW_TEST_BACKBONE,
    TORCHHUB_BACKBONE,
    TRAINED_BACKBONE,
    ExtractorConfig,
)
from shared.imaging.decode import DECODER
from shared.imaging.preprocessing import Pixels, Preprocessing, get_preprocessing

SHIPPED_VOCABULARIES = Path(__file__).parent / "vocabularies"


def _dinov2(recipe: ExtractorConfig, device: torch.device, weights: Path | None) -> Backbone:
    assert recipe.layer is not None
    assert recipe.facet is not None
    size = recipe.backbone.removeprefix("dinov2-")
    return Dinov2(size, recipe.layer, recipe.facet, device, weights)


def _slow(recipe: ExtractorConfig, device: torch.device, _weights: Path | None) -> Backbone:
    assert recipe.width is not None
    return SlowBackbone(recipe.width, recipe.milliseconds / 1000, device)


def _torchhub(recipe: ExtractorConfig, device: torch.device, _weights: Path | None) -> Backbone:
    assert recipe.hub is not None
    return TorchHubBackbone(recipe.hub, device)


def _trained(recipe: ExtractorConfig, device: torch.device, _weights: Path | None) -> Backbone:
    assert recipe.trained is not None
    assert recipe.trained.file is not None, "an added model is loaded by who knows the catalog"
    return TrainedBackbone.from_checkpoint(recipe.name, Path(recipe.trained.file), device)


BACKBONES: dict[str, Callable[[ExtractorConfig, torch.device, Path | None], Backbone]] = {
    "efficientnet-lite0": lambda _recipe, device, _weights: EfficientNetLite0(device),
    SLOW_TEST_BACKBONE: _slow,
    "test-tiny": lambda _recipe, device, _weights: TinyBackbone(device),
    TORCHHUB_BACKBONE: _torchhub,
    TRAINED_BACKBONE: _trained,
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
        recipe: ExtractorConfig,
        device: torch.device,
        *,
        precision: Precision = "float32",
        dino_weights: Path | None = None,
        backbone: Backbone | None = None,
        limit: BatchSizeLimit | None = None,
    ) -> None:
        """`dino_weights`: DINO_WEIGHTS, for the recipes on DINOv2; None takes timm's on the hub.
        `backbone`: one that is loaded already, of the same `recipe.local_features`, as that of an
        added model has to be; `limit` is what is known of it.

        Raises Misconfigured (`weights_missing`, `weights_unfit`, `torchhub_unfit`), and for a
        checkpoint as `TrainedModel.of_checkpoint`.
        """
        self.recipe = recipe
        self.precision: Precision = precision
        self.limit = limit or BatchSizeLimit()
        self.backbone = backbone or BACKBONES[recipe.backbone](recipe, device, dino_weights)
        self.preprocessing: Preprocessing = _preprocessing(recipe, self.backbone)
        told = recipe.width
        assert told in (None, self.backbone.width), "the recipe tells others the width"

    def at(self, precision: Precision) -> Extractor:
        """The same weights computing in `precision`."""
        if precision == self.precision:
            return self
        return Extractor(
            self.recipe,
            self.backbone.device,
            precision=precision,
            backbone=self.backbone,
            limit=self.limit,
        )

    def shipped_vocabulary(self) -> tuple[ClusterCentres, dict[str, Any]] | None:
        """The vocabulary that comes with the extractor, with its provenance; None without one."""
        if self.recipe.shipped_vocabulary is None:
            return None
        path = SHIPPED_VOCABULARIES / self.recipe.shipped_vocabulary
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

    def spec(
        self, centres: ClusterCentres | None, projection: PcaProjection | None = None
    ) -> dict[str, Any]:
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
            "precision": self.precision,
            "decoder": DECODER,
            "dimension": self.dimension(centres, projection),
        }
        if projection is not None:
            spec["whitening"] = {
                "sha256": projection.sha256,
                "from_dimension": projection.dimension,
            }
        if self.recipe.aggregator == "soft-vlad":
            spec["temperature"] = self.recipe.temperature
        if isinstance(self.backbone, TorchHubBackbone):
            spec["code_fingerprint"] = self.backbone.code_fingerprint
        if isinstance(self.backbone, TrainedBackbone):
            spec |= self.backbone.as_spec()
        return spec

    def dimension(
        self, centres: ClusterCentres | None, projection: PcaProjection | None = None
    ) -> int:
        """Length of a descriptor."""
        if projection is not None:
            return projection.kept
        return self.backbone.width * (centres.clusters if centres else 1)

    def warm_up(self, photos: int) -> None:
        """One pass as large as any of a batch of `photos`: kernels are chosen, memory is taken, and
        what does not fit is found out before a photo waits for it.

        Misconfigured (`gpu_out_of_memory`) where not even one photo of the usual size fits.
        """
        height, width = self.preprocessing.typical_size
        at_once = self.limit.photos(photos, height * width)
        blank = [np.zeros((height, width, 3), np.uint8)] * at_once
        try:
            for _ in self._run_in_batches(blank, lambda features: features):
                pass
        except PhotoTooLargeForGpu as error:
            raise Misconfigured(
                "gpu_out_of_memory",
                f"The GPU holds the weights of {self.recipe.name}, but not one photo beside them. "
                "See what else uses it (`nvidia-smi`), or set a smaller extractor or DEVICE=cpu.",
            ) from error

    def features(self, pixels: Pixels) -> torch.Tensor:
        """(B, H, W, 3) of one size -> (B, patches, width) float32 local features on the device."""
        with autocast(self.precision, self.backbone.device):
            return self.backbone.features(torch.from_numpy(np.ascontiguousarray(pixels)))

    def local_features(self, photos: Collection[Pixels]) -> list[torch.Tensor]:
        """Of each photo, in their order, (patches, width) float32 on the CPU; any sizes.

        Raises PhotoDoesNotFit.
        """
        found: list[torch.Tensor] = [torch.empty(0)] * len(photos)
        for places, features in self._run_in_batches(photos, torch.Tensor.cpu):
            for place, one in zip(places, features, strict=True):
                found[place] = one
        return found

    def describe(
        self,
        photos: Collection[Pixels],
        centres: ClusterCentres | None,
        projection: PcaProjection | None = None,
    ) -> NDArray[np.float32]:
        """Photos (H, W, 3) as `preprocessing` brings them, of any sizes -> (n, dimension) float32.

        Rows in the photos' order, of length 1; or 0, see `shared.descriptors.aggregation`; or
        NaN throughout
        where the network's features are not finite: these must not be stored (`not_finite_error`).

        Raises PhotoDoesNotFit for a photo that is too much for the GPU even alone.
        """
        if self.recipe.needs_vocabulary and centres is None:
            raise ValueError(f"{self.recipe.name} needs a vocabulary")
        on_device = None
        if centres is not None:
            on_device = torch.from_numpy(centres.array).to(self.backbone.device)

        def row(features: torch.Tensor) -> torch.Tensor:
            described = self._aggregate(features, on_device)
            return (described if projection is None else projection(described)).cpu()

        rows = np.empty((len(photos), self.dimension(centres, projection)), np.float32)
        for places, found in self._run_in_batches(photos, row):
            rows[places] = found.numpy()
        return rows

    def _run_in_batches(
        self, photos: Collection[Pixels], then: Callable[[torch.Tensor], torch.Tensor]
    ) -> Iterator[tuple[list[int], torch.Tensor]]:
        """Places in `photos`, and what `then` makes of the local features of those."""
        return run_in_batches(
            photos, lambda pixels: then(self.features(pixels)), self.limit, self.backbone.device
        )

    def _aggregate(self, features: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
        """(B, patches, width), (K, width) -> (B, dimension)."""
        match self.recipe.aggregator:
            case "avg":
                rows = average_pooling(features)
            case "gem":
                rows = gem_pooling(features)
            case "vlad":
                assert centres is not None
                rows = vlad(features, centres)
            case "soft-vlad":
                assert centres is not None
                rows = soft_vlad(features, centres, self.recipe.temperature)
            case "none":
                rows = features[:, 0]
            case other:
                raise ValueError(f"there is no aggregator {other!r}")
        # Said outright: a comparison or a clamp on the way may hide a NaN.
        finite = torch.isfinite(features).flatten(1).all(dim=1, keepdim=True)
        return torch.where(finite, rows, torch.nan)


def _preprocessing(recipe: ExtractorConfig, backbone: Backbone) -> Preprocessing:
    if recipe.preprocessing is not None:
        return get_preprocessing(recipe.preprocessing)
    assert isinstance(backbone, TrainedBackbone), "only a trained model brings its own"
    return backbone.preprocessing


def not_finite_error() -> Unprocessable:
    """Why a photo whose row is NaN has no descriptor."""
    return Unprocessable(
        "features_not_finite",
        "The network's features of this photo are not finite numbers: it has no descriptor. If "
        "this is said of many photos, check the weights (`placewise doctor`) and the GPU.",
    )


def spec_fingerprint(spec: dict[str, Any]) -> str:
    """sha256 of the spec's canonical JSON."""
    return hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()
