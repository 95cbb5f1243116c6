"""Baselines of `datasets synth` that need a neural network. Imports torch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import timm
import torch
from numpy.typing import NDArray
from PIL import Image
from torch.nn.functional import normalize

from shared.descriptors.aggregators.clustering import vlad
from shared.descriptors.backbones import normalise_pixels
from shared.descriptors.backbones.efficientnet_lite0 import MEAN, STD
from shared.descriptors.extractor import Extractor, choose_device
from shared.descriptors.patches import fit_vocabulary, sample_photos
from shared.descriptors.pca_fit import fit_pca, sample_rows, sample_size
from shared.descriptors.pca_whitening import PcaProjection
from shared.extractor_config.configs import EXTRACTOR_CONFIGS

EXTRACTOR = "efficientnet-lite0-vlad128"
BATCH_PHOTOS = 16
FIT_SAMPLE_PHOTOS = 300
SEED = 0

Rows = NDArray[np.float32]


class NetworkBaselines:
    """Describes photos with an untrained network and with pretrained EfficientNet-Lite0 and VLAD.

    The extractor is measured with its shipped vocabulary and with a fitted one. Descriptors of the
    fitted one are also measured after PCA whitening.
    """

    names = (
        "untrained network",
        f"{EXTRACTOR}, shipped vocabulary",
        f"{EXTRACTOR}, fitted vocabulary",
    )
    pca_dimensions = (512, 256, 128)
    """PCA dimensions; those that exceed the number of database photos are skipped."""

    def __init__(self, database: Sequence[Path]) -> None:
        """Load the networks and fit the vocabulary.

        Args:
            database: Photos to fit the vocabulary and PCA on. They must come first in the photos
                passed to `describe`.
        """
        self._database = len(database)
        self.extractor = Extractor(EXTRACTOR_CONFIGS[EXTRACTOR], choose_device("auto"))
        device = self.extractor.backbone.device
        torch.manual_seed(SEED)
        self._untrained = timm.create_model(
            "tf_efficientnet_lite0", pretrained=False, features_only=True, out_indices=(3,)
        )
        self._untrained.eval().requires_grad_(False).to(device)
        shipped = self.extractor.shipped_vocabulary()
        assert shipped is not None
        self._shipped = torch.from_numpy(shipped[0].array).to(device)
        self._fitted = self._fit(database)

    @property
    def words(self) -> dict[str, int]:
        """Number of visual words of each baseline with a vocabulary."""
        return {self.names[1]: len(self._shipped), self.names[2]: len(self._fitted)}

    def _fit(self, database: Sequence[Path]) -> torch.Tensor:
        """Fit (clusters, width) centres in the same way as for a map."""
        sampled = sample_photos(
            len(database), FIT_SAMPLE_PHOTOS, self.extractor.backbone.width, SEED
        )
        photos = [database[index] for index in sampled]
        fitted = fit_vocabulary(
            self.extractor,
            (list(pixels) for pixels in self._batches(photos)),
            len(photos),
            clusters=self.extractor.config.clusters,
            seed=SEED,
        )
        return torch.from_numpy(fitted.centres.array).to(self.extractor.backbone.device)

    @torch.inference_mode()
    def describe(self, paths: Sequence[Path], advance: Callable[[int], None]) -> dict[str, Rows]:
        """Compute (photos, D) unit rows by baseline; `advance` receives each batch's size."""
        rows: dict[str, list[Rows]] = {name: [] for name in self.names}
        for pixels in self._batches(paths):
            features = self.extractor.features(pixels)
            batches = (
                self._untrained_rows(pixels),
                vlad(features, self._shipped),
                vlad(features, self._fitted),
            )
            for name, batch in zip(self.names, batches, strict=True):
                rows[name].append(batch.cpu().numpy())
            advance(len(pixels))
        described = {name: np.concatenate(parts) for name, parts in rows.items()}
        return described | self._whitened_rows(described[self.names[-1]])

    def _whitened_rows(self, rows: Rows) -> dict[str, Rows]:
        """Reduce the rows by PCA whitening in the same way as for a map."""
        reduced = {}
        for dimension in self.pca_dimensions:
            if self._database > dimension:
                size = sample_size(rows.shape[1], dimension)
                whitening = fit_pca(rows[sample_rows(self._database, size, SEED)], dimension)
                projection = PcaProjection(whitening, self.extractor.backbone.device)
                reduced[f"{self.names[-1]}, PCA to {dimension}"] = projection.project(rows)
        return reduced

    def _untrained_rows(self, pixels: NDArray[np.uint8]) -> torch.Tensor:
        on_device = torch.from_numpy(pixels).to(self.extractor.backbone.device)
        maps = self._untrained(normalise_pixels(on_device, MEAN, STD))[0]
        return normalize(normalize(maps.flatten(2), dim=1).mean(dim=-1), dim=-1)

    def _batches(self, paths: Sequence[Path]) -> Iterator[NDArray[np.uint8]]:
        """Batches of up to (BATCH_PHOTOS, H, W, 3) uint8 pixels, in the order of the paths."""

        def read(path: Path) -> NDArray[np.uint8]:
            with Image.open(path) as image:
                return np.asarray(self.extractor.preprocessing.apply(image.convert("RGB")))

        with ThreadPoolExecutor() as readers:
            for start in range(0, len(paths), BATCH_PHOTOS):
                yield np.stack(list(readers.map(read, paths[start : start + BATCH_PHOTOS])))
