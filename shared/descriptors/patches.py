"""The local features that a vocabulary is learnt from: some patches of each photo, in an object
store, so that memory never depends on how many there are.

A vocabulary from photos at hand: their patches lie in a temporary folder meanwhile.
"""

from __future__ import annotations

import tempfile
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.extractor import Extractor
from shared.descriptors.vocabulary_file import VocabularyFile, fit_provenance
from shared.descriptors.vocabulary_fit import VocabularyFit
from shared.imaging.preprocessing import Pixels
from shared.storage import FolderStore, ObjectStore

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


PATCHES_FOLDER_PREFIX = "patches-"


def fit_vocabulary(
    extractor: Extractor,
    batches: Iterable[Sequence[Pixels]],
    photos: int,
    *,
    clusters: int,
    seed: int,
    on_progress: Callable[[str, int, int], None] = lambda what, done, most: None,
) -> VocabularyFile:
    """Learn `clusters` centres, or as many as the photos bear.

    `batches` are photos (height, width, 3) as the extractor's preprocessing leaves them, of any
    sizes, in a random order (`shared.descriptors.patches.sample_photos`); of `photos` at most.
    `on_progress` hears what is being done (`describing`, `clustering`), how far it is and where
    it ends.

    Raises Unprocessable (`no_photos`) when no photo comes.
    """
    with tempfile.TemporaryDirectory(prefix="placewise-fit-") as folder:
        store = PatchStore(
            FolderStore(Path(folder)), PATCHES_FOLDER_PREFIX, extractor.backbone.width
        )
        described = 0
        for batch in batches:
            store.add(extractor.local_features(batch), described, photos, seed)
            described += len(batch)
            on_progress("describing", described, photos)
        fit = VocabularyFit(store.open(), clusters, seed)
        while not fit.done:
            fit.step()
            on_progress("clustering", *fit.progress)
    centres = fit.centres()
    provenance = fit_provenance(
        extractor, centres, fit, requested_clusters=clusters, photos=described, seed=seed
    )
    return VocabularyFile(centres, provenance)
