"""A program that fits vocabularies to patches as ViT-S makes them, and prints its memory."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors import patches
from shared.descriptors.extractor import Extractor
from shared.extractor_config.configs import get_extractor_config
from tests.support.memory import memory_bytes
from tests.unit.descriptors.vocabularies.points import clustered_points

WIDTH = 384
PATCHES = 256
BATCH_PHOTOS = 16
CLUSTERS = 4


class ManyPatches:
    """A backbone without a network: as many and as wide features as ViT-S/14's at 224 pixels."""

    name = "test-patches"
    fingerprint = "0" * 64
    licence = "MIT"
    width = WIDTH
    layer = "none"
    facet: str | None = None
    device = torch.device("cpu")

    def __init__(self) -> None:
        self.card: dict[str, Any] = {}
        self._some = clustered_points(0, BATCH_PHOTOS * PATCHES, WIDTH, 40)
        self._turned = 0

    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        self._turned += 1  # every batch has other features
        turned = self._some.roll(self._turned, dims=1)
        return turned[: len(pixels) * PATCHES].reshape(len(pixels), PATCHES, WIDTH)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return 1, PATCHES


def main(counts: list[int]) -> None:
    torch.set_num_threads(1)
    patches.PATCHES_BYTES //= 4
    before = memory_bytes("VmRSS")
    print(json.dumps({"before": before, "fits": [fit(photos) for photos in counts]}))


def fit(photos: int) -> dict[str, int]:
    config = get_extractor_config("anyloc-vits14", allow_test_extractors=False)
    backbone: Any = ManyPatches()
    extractor = Extractor(config, torch.device("cpu"), backbone=backbone)
    fitted = patches.fit_vocabulary(extractor, batches(photos), photos, clusters=CLUSTERS, seed=0)
    return {
        "peak": memory_bytes("VmHWM"),  # of all fits so far
        "photos": fitted.provenance["photos"],
        "patches": fitted.provenance["patches"],
        "clusters": fitted.centres.clusters,
    }


def batches(photos: int) -> Iterator[list[NDArray[np.uint8]]]:
    blank = np.zeros((8, 8, 3), np.uint8)
    for begin in range(0, photos, BATCH_PHOTOS):
        yield [blank] * min(BATCH_PHOTOS, photos - begin)


if __name__ == "__main__":
    main(list(map(int, sys.argv[1:])))
