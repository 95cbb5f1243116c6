"""The local features that a vocabulary is learnt from: some patches of each photo, in an object
store, so that memory never depends on how many there are.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from itertools import accumulate

import numpy as np
import torch
from numpy.typing import NDArray

from shared.objects import ObjectStore

PATCHES_BYTES = 256_000_000  # of all photos together, in the store
FLOAT32 = np.dtype("<f4")


def max_photos_to_sample(width: int) -> int:
    """How many photos can give one patch each; `width` is the length of a local feature."""
    return max(1, PATCHES_BYTES // (FLOAT32.itemsize * width))


def sample_photos(available: int, sample: int, width: int, seed: int) -> list[int]:
    """Which of so many photos to learn from, at most `sample`: their numbers, in a random order.

    The order lets each batch of patches stand for all photos.
    """
    size = min(sample, available, max_photos_to_sample(width))
    chosen: list[int] = (
        np.random.default_rng(seed).choice(available, size=size, replace=False).tolist()
    )
    return chosen


class PatchStore:
    """Patches as objects `PREFIX<photo's place>.f32`: float32 rows, little-endian, C order."""

    def __init__(self, store: ObjectStore, prefix: str, width: int) -> None:
        """`width`: the length of a local feature."""
        self._store = store
        self._prefix = prefix
        self.width = width

    def add(self, features: Iterable[torch.Tensor], first: int, photos: int, seed: int) -> None:
        """Keep (patches, width) features of each of a few photos, which are the `first` and
        following of all `photos`. Each gives an equal share of PATCHES_BYTES, chosen by `seed` and
        its place.
        """
        share = max(1, PATCHES_BYTES // (FLOAT32.itemsize * self.width * photos))
        kept = [
            one[np.random.default_rng([seed, place]).permutation(len(one))[:share]].cpu().numpy()
            for place, one in enumerate(features, first)
        ]
        rows: NDArray[np.float32] = np.concatenate(kept)
        # A patch without any structure has a zero feature, which no centre can describe. What is
        # not finite is refused when the photo is described.
        lengths = np.linalg.norm(rows, axis=1)
        rows = rows[np.isfinite(lengths) & (lengths > 0)]
        self._store.put(
            f"{self._prefix}{first:08d}.f32", rows.astype(FLOAT32, copy=False).tobytes()
        )

    def open(self) -> StoredPatches:
        """What is there now, in the order of the photos."""
        found = sorted((info.key, info.size_bytes) for info in self._store.list(self._prefix))
        return StoredPatches(self._store, found, self.width)


class StoredPatches:
    """The rows of all objects as one (n, width) array that is read piece by piece."""

    def __init__(self, store: ObjectStore, objects: list[tuple[str, int]], width: int) -> None:
        """`objects`: key and size in bytes of each."""
        self._store = store
        self._keys = [key for key, _ in objects]
        self._row_bytes = FLOAT32.itemsize * width
        rows = [size // self._row_bytes for _, size in objects]
        self._begins = [0, *accumulate(rows)]
        self.width = width

    def __len__(self) -> int:
        return self._begins[-1]

    def read(self, begin: int, end: int) -> torch.Tensor:
        """(end - begin, width) float32 on the CPU; Unavailable as the store raises it."""
        parts = []
        at = bisect_right(self._begins, begin) - 1
        while begin < end:
            until = min(end, self._begins[at + 1])
            if until > begin:
                start = (begin - self._begins[at]) * self._row_bytes
                data = self._store.read_range(
                    self._keys[at], start, (until - begin) * self._row_bytes
                )
                parts.append(np.frombuffer(data, FLOAT32).reshape(-1, self.width))
            begin, at = until, at + 1
        return torch.from_numpy(np.concatenate(parts).astype(np.float32, copy=False))
