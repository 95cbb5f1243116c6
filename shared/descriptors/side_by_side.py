"""Rows of two extractors side by side: one decoded photo, one row, one search.

    row = (sqrt(w_a) a, sqrt(w_b) b), with unit rows a and b and w_a + w_b = 1

so that the cosine of two rows is w_a times that of their first parts, plus w_b times that of their
second parts. The vocabulary is that of the part that needs one. A PCA whitening is of whole rows.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.backbones import MIN_NORM
from shared.descriptors.extractor import Extractor
from shared.descriptors.inference import Precision
from shared.descriptors.pca_whitening import PcaProjection
from shared.descriptors.vocabulary import ClusterCentres
from shared.extractor_config.configs import ExtractorConfig
from shared.imaging.preprocessing import Pixels, both_preprocessings

Rows = NDArray[np.float32]


def join_rows(parts: Sequence[Rows], weights: Sequence[float]) -> Rows:
    """Join (n, D_i) unit rows to (n, sum of D_i) ones.

    A part without structure, whose row is zero, leaves all of the length to the other. A row is
    NaN throughout if that of a part is.
    """
    scaled = [rows * np.float32(weight**0.5) for rows, weight in zip(parts, weights, strict=True)]
    rows = np.concatenate(scaled, axis=1)
    joined: Rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), MIN_NORM)
    return joined


class SideBySideExtractor(Extractor):
    """Two loaded extractors as one. What concerns patches and vocabularies is that of `_main`."""

    def __init__(self, config: ExtractorConfig, parts: Sequence[Extractor]) -> None:
        """Combine the loaded extractors of `config.parts`."""
        self.config = config
        self.parts = parts
        self._main_index = int(parts[1].config.needs_vocabulary)
        self._main = parts[self._main_index]
        self.precision = self._main.precision
        self.limit = self._main.limit
        self.backbone = self._main.backbone
        self.patch_preprocessing = self._main.patch_preprocessing
        self.preprocessing = both_preprocessings(*(part.preprocessing for part in parts))

    def with_precision(self, precision: Precision) -> Extractor:
        return SideBySideExtractor(
            self.config, [part.with_precision(precision) for part in self.parts]
        )

    def shipped_vocabulary(self) -> tuple[ClusterCentres, dict[str, Any]] | None:
        return self._main.shipped_vocabulary()

    def spec(
        self, centres: ClusterCentres | None, projection: PcaProjection | None = None
    ) -> dict[str, Any]:
        """Return the spec of the part with the vocabulary, with that of the other as `beside`."""
        (other,) = (part for part in self.parts if part is not self._main)
        return super().spec(centres, projection) | {
            "weights": list(self.config.weights),
            "beside": other.spec(None),
        }

    def dimension(
        self, centres: ClusterCentres | None, projection: PcaProjection | None = None
    ) -> int:
        if projection is not None:
            return projection.components
        return sum(part.dimension(self._centres_of(part, centres)) for part in self.parts)

    def warm_up(self, photos: int) -> None:
        for part in self.parts:
            part.warm_up(photos)

    def patch_features(self, photos: Collection[Pixels]) -> list[torch.Tensor]:
        return self._main.patch_features([photo[self._main_index] for photo in photos])

    def describe(
        self,
        photos: Collection[Pixels],
        centres: ClusterCentres | None,
        projection: PcaProjection | None = None,
    ) -> Rows:
        rows = [
            part.describe([photo[i] for photo in photos], self._centres_of(part, centres))
            for i, part in enumerate(self.parts)
        ]
        joined = join_rows(rows, self.config.weights)
        return joined if projection is None else projection.project(joined)

    def _centres_of(self, part: Extractor, centres: ClusterCentres | None) -> ClusterCentres | None:
        return centres if part is self._main else None
