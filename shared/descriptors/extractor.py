"""Extractors: turn batches of decoded photos into global descriptors.

An `Extractor` is an `ExtractorConfig` with its backbone's weights loaded on a device. The
descriptor's value is determined by `Extractor.spec`, which every generation stores.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.aggregators import POOLINGS
from shared.descriptors.backbones import Backbone, backbone_class
from shared.descriptors.inference import (
    BatchSizeLimit,
    Precision,
    autocast,
    model_fits_gpu,
    run_in_batches,
)
from shared.descriptors.pca_whitening import PcaProjection
from shared.descriptors.vocabulary import ClusterCentres, decode_centres
from shared.errors import Misconfigured, Unprocessable
from shared.extractor_config.configs import ExtractorConfig
from shared.imaging.decode import DECODER
from shared.imaging.preprocessing import Pixels, get_preprocessing

SHIPPED_VOCABULARIES = Path(__file__).parent / "vocabularies"


def choose_device(device: str) -> torch.device:
    """Resolve `auto`, `cpu` or `cuda` to a device; `auto` is CUDA if available, else CPU.

    Raises Misconfigured (`cuda_missing`) if CUDA is requested but not available.
    """
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
    """A loaded extractor. One backbone serves any number of vocabularies."""

    def __init__(
        self,
        config: ExtractorConfig,
        device: torch.device,
        *,
        precision: Precision = "float32",
        dino_weights: Path | None = None,
        backbone: Backbone | None = None,
        limit: BatchSizeLimit | None = None,
    ) -> None:
        """Load the backbone's weights, unless `backbone` is given.

        Args:
            dino_weights: The setting DINO_WEIGHTS, for DINOv2 backbones; None means timm's weights
                from the Hugging Face hub.
            backbone: A loaded backbone with the same `config.backbone_key`. Required for a
                registered model.
            limit: The batch size limit that was measured for `backbone`.

        Raises:
            Misconfigured: `weights_missing`, `weights_unusable`, `torchhub_unusable`,
                `gpu_out_of_memory`.
            PlacewiseError: For a checkpoint, as `TrainedBackbone.load` raises.
        """
        self.config = config
        self.precision: Precision = precision
        self.limit = limit or BatchSizeLimit(device)
        with model_fits_gpu(config.name):
            self.backbone = backbone or backbone_class(config).load(config, device, dino_weights)
        if config.preprocessing is None:
            assert self.backbone.preprocessing is not None
            self.preprocessing = self.backbone.preprocessing
        else:
            self.preprocessing = get_preprocessing(config.preprocessing)
        assert config.width in (None, self.backbone.width), "config.width must match the backbone"

    def with_precision(self, precision: Precision) -> Extractor:
        """Return an extractor with the same weights that computes in `precision`."""
        if precision == self.precision:
            return self
        return Extractor(
            self.config,
            self.backbone.device,
            precision=precision,
            backbone=self.backbone,
            limit=self.limit,
        )

    def shipped_vocabulary(self) -> tuple[ClusterCentres, dict[str, Any]] | None:
        """Return the vocabulary shipped with the extractor and its provenance, or None.

        Raises Misconfigured (`vocabulary_unusable`) if it was fitted with other weights.
        """
        if self.config.shipped_vocabulary is None:
            return None
        path = SHIPPED_VOCABULARIES / self.config.shipped_vocabulary
        centres = decode_centres(path.read_bytes())
        provenance = json.loads(path.with_suffix(".json").read_text())
        if provenance["backbone_fingerprint"] != self.backbone.fingerprint:
            raise Misconfigured(
                "vocabulary_unusable",
                f"The shipped vocabulary {path.name} was fitted with other weights "
                f"({provenance['backbone_fingerprint'][:12]}) than those installed "
                f"({self.backbone.fingerprint[:12]}). Install the pinned packages: `make setup`.",
            )
        return centres, provenance

    def spec(
        self, centres: ClusterCentres | None, projection: PcaProjection | None = None
    ) -> dict[str, Any]:
        """Return the extractor spec: everything that determines a descriptor's value (JSON)."""
        spec: dict[str, Any] = {
            "extractor": self.config.name,
            "backbone": self.backbone.name,
            "backbone_fingerprint": self.backbone.fingerprint,
            "layer": self.backbone.layer,
            "facet": self.backbone.facet,
            "preprocessing": self.preprocessing.as_spec(),
            "aggregator": self.config.aggregator,
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
        if self.config.aggregator == "soft-vlad":
            spec["temperature"] = self.config.temperature
        return spec | self.backbone.own_spec()

    def dimension(
        self, centres: ClusterCentres | None, projection: PcaProjection | None = None
    ) -> int:
        """Return the number of dimensions of a descriptor."""
        if projection is not None:
            return projection.components
        return self.backbone.width * (centres.clusters if centres else 1)

    def warm_up(self, photos: int) -> None:
        """Run one forward pass of the largest size that a batch of `photos` photos needs.

        It selects kernels, allocates memory and detects an out-of-memory condition before the
        first job.

        Raises Misconfigured (`gpu_out_of_memory`) if not even one photo of the usual size fits.
        """
        height, width = self.preprocessing.typical_size
        batch_size = self.limit.photos(photos, height * width)
        blank = [np.zeros((height, width, 3), np.uint8)] * batch_size
        with model_fits_gpu(self.config.name):
            for _ in self._run_in_batches(blank, lambda features: features):
                pass

    def features(self, pixels: Pixels) -> torch.Tensor:
        """Compute (B, patches, width) float32 features of (B, H, W, 3) pixels, on the device."""
        with autocast(self.precision, self.backbone.device):
            return self.backbone.features(torch.from_numpy(np.ascontiguousarray(pixels)))

    def patch_features(self, photos: Collection[Pixels]) -> list[torch.Tensor]:
        """Return the patch features of photos of any sizes, in their order.

        Returns:
            One (patches, width) float32 tensor for each photo, on the CPU.

        Raises:
            PhotoTooLargeForGpu: One photo alone exceeds the GPU's memory.
        """
        results: list[torch.Tensor] = [torch.empty(0)] * len(photos)
        for indices, features in self._run_in_batches(photos, torch.Tensor.cpu):
            for index, photo_features in zip(indices, features, strict=True):
                results[index] = photo_features
        return results

    def describe(
        self,
        photos: Collection[Pixels],
        centres: ClusterCentres | None,
        projection: PcaProjection | None = None,
    ) -> NDArray[np.float32]:
        """Compute the global descriptors of photos.

        Args:
            photos: (H, W, 3) pixels as `preprocessing` returns them; sizes may differ.
            centres: The vocabulary; required if `config.needs_vocabulary`.
            projection: A PCA whitening to apply to the descriptors.

        Returns:
            (n, dimension) float32 rows in the photos' order. Rows have length 1, or 0 for a photo
            without structure (see `shared.descriptors.aggregators`). A row is NaN throughout if the
            network's features are not finite; such a row must not be stored (`not_finite_error`).

        Raises:
            PhotoTooLargeForGpu: One photo alone exceeds the GPU's memory.
            ValueError: The extractor needs a vocabulary and `centres` is None.
        """
        if self.config.needs_vocabulary and centres is None:
            raise ValueError(f"{self.config.name} needs a vocabulary")
        on_device = None
        if centres is not None:
            on_device = torch.from_numpy(centres.array).to(self.backbone.device)

        def to_rows(features: torch.Tensor) -> torch.Tensor:
            descriptors = self._aggregate(features, on_device)
            rows = descriptors if projection is None else projection(descriptors)
            host = rows.to("cpu", non_blocking=True)  # from a GPU into pinned memory
            if rows.is_cuda:
                torch.cuda.synchronize(rows.device)
            return host

        rows = np.empty((len(photos), self.dimension(centres, projection)), np.float32)
        for indices, batch_rows in self._run_in_batches(photos, to_rows):
            rows[indices] = batch_rows.numpy()
        return rows

    def _run_in_batches(
        self, photos: Collection[Pixels], transform: Callable[[torch.Tensor], torch.Tensor]
    ) -> Iterator[tuple[list[int], torch.Tensor]]:
        """Yield, per batch, indices into `photos` and `transform` of their patch features."""
        return run_in_batches(
            photos,
            lambda pixels: transform(self.features(pixels)),
            self.limit,
            self.backbone.device,
        )

    def _aggregate(self, features: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
        """(B, patches, width), (K, width) -> (B, dimension)."""
        centres = features.new_empty(0) if centres is None else centres
        rows = POOLINGS[self.config.aggregator](features, centres, self.config.temperature)
        # Set explicitly: a comparison or a clamp in the aggregator may hide a NaN.
        finite = torch.isfinite(features).flatten(1).all(dim=1, keepdim=True)
        return torch.where(finite, rows, torch.nan)


def not_finite_error() -> Unprocessable:
    """Return the error for a photo whose descriptor row is NaN."""
    return Unprocessable(
        "features_not_finite",
        "The network's features of this photo are not finite numbers, so it has no descriptor. "
        "If many photos fail with this error, check the weights (`placewise doctor`) and the GPU.",
    )


def spec_fingerprint(spec: dict[str, Any]) -> str:
    """Return the sha256 of the spec's canonical JSON, hexadecimal."""
    return hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()
