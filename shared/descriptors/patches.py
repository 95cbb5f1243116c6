"""Training samples for vocabularies: random patches of each photo, in an object store.

The patches are stored as objects and read in ranges, so memory does not depend on their number.
`fit_vocabulary` fits a vocabulary to local photos, with the patches in a temporary folder.
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
    """Return how many photos fit the store with one patch each, of `width` numbers."""
    return max(1, PATCHES_BYTES // (FLOAT32.itemsize * width))


def sample_photos(available: int, sample: int, width: int, seed: int) -> list[int]:
    """Choose at most `sample` of `available` photos to fit on.

    Returns:
        Their indices in random order, so that each batch of patches represents all photos.
    """
    size = min(sample, available, max_photos_to_sample(width))
    chosen: list[int] = (
        np.random.default_rng(seed).choice(available, size=size, replace=False).tolist()
    )
    return chosen


class PatchStore:
    """Writes patches as objects `PREFIX<first photo>.f32`: float32 rows, little-endian, C order."""

    def __init__(self, store: ObjectStore, prefix: str, width: int) -> None:
        """`width`: the length of a local feature."""
        self._store = store
        self._prefix = prefix
        self.width = width

    def add(self, features: Iterable[torch.Tensor], first: int, photos: int, seed: int) -> None:
        """Store a random sample of the patches of a batch of photos.

        Args:
            features: (patches, width) features of each photo of the batch.
            first: Index of the batch's first photo among all photos.
            photos: Number of all photos; each gets an equal share of PATCHES_BYTES.
            seed: Selects the patches, together with the photo's index.
        """
        share = max(1, PATCHES_BYTES // (FLOAT32.itemsize * self.width * photos))
        sampled = [
            photo[np.random.default_rng([seed, index]).permutation(len(photo))[:share]]
            .cpu()
            .numpy()
            for index, photo in enumerate(features, first)
        ]
        rows: NDArray[np.float32] = np.concatenate(sampled)
        # A patch without any structure has a zero feature, which no centre can describe. Photos
        # with non-finite features are rejected when they are described.
        lengths = np.linalg.norm(rows, axis=1)
        rows = rows[np.isfinite(lengths) & (lengths > 0)]
        self._store.put(
            f"{self._prefix}{first:08d}.f32", rows.astype(FLOAT32, copy=False).tobytes()
        )

    def open(self) -> StoredPatches:
        """Open the patches stored so far, in the order of the photos."""
        objects = sorted((info.key, info.size_bytes) for info in self._store.list(self._prefix))
        return StoredPatches(self._store, objects, self.width)


class StoredPatches:
    """Reads row ranges of the stored patches as if they were one (n, width) array."""

    def __init__(self, store: ObjectStore, objects: list[tuple[str, int]], width: int) -> None:
        """`objects`: the key and the size in bytes of each."""
        self._store = store
        self._keys = [key for key, _ in objects]
        self._row_bytes = FLOAT32.itemsize * width
        rows = [size // self._row_bytes for _, size in objects]
        self._begins = [0, *accumulate(rows)]
        self.width = width

    def __len__(self) -> int:
        return self._begins[-1]

    def read(self, begin: int, end: int) -> torch.Tensor:
        """Return rows [begin, end), float32 on the CPU. Raises Unavailable as the store does."""
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
    on_progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> VocabularyFile:
    """Fit a VLAD vocabulary to photos.

    Args:
        extractor: Computes the local features.
        batches: Photos (height, width, 3) as the extractor's preprocessing returns them, of any
            sizes, in random order (`sample_photos`).
        photos: Upper bound of the number of photos.
        clusters: Requested number of centres; fewer if there are too few patches.
        seed: Seed of the sampling and of k-means.
        on_progress: Called with the stage (`describing`, `clustering`), the steps done and the
            total.

    Raises:
        Unprocessable: `no_photos` if `batches` is empty.
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
