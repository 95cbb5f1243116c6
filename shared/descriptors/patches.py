"""Training samples for vocabularies: random patches of each photo, in a temporary file.

They are read in ranges, so memory does not depend on their number. `fit_vocabulary` fits a
vocabulary to photos.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Sequence
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.extractor import Extractor
from shared.descriptors.vocabulary_file import VocabularyFile, fit_provenance
from shared.descriptors.vocabulary_fit import fit_centres
from shared.imaging.preprocessing import Pixels

PATCHES_BYTES = 256_000_000  # of all photos together, in the file
FLOAT32 = np.dtype("<f4")


def max_photos_to_sample(width: int) -> int:
    """Return how many photos fit the file with one patch each, of `width` numbers."""
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


class PatchFile:
    """Keeps patches in a temporary file, which ends with the process; a `PointSource`."""

    def __init__(self, width: int) -> None:
        """`width`: the length of a local feature."""
        self._file = tempfile.TemporaryFile(prefix="placewise-fit-")  # noqa: SIM115  (see __exit__)
        self._patches = 0
        self.width = width

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, features: Iterable[torch.Tensor], first: int, photos: int, seed: int) -> None:
        """Append a random sample of the patches of a batch of photos.

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
        self._file.seek(0, os.SEEK_END)
        self._file.write(rows.astype(FLOAT32, copy=False).tobytes())
        self._patches += len(rows)

    def __len__(self) -> int:
        return self._patches

    def read(self, begin: int, end: int) -> torch.Tensor:
        """Return the patches [begin, end), float32 on the CPU."""
        row_bytes = FLOAT32.itemsize * self.width
        self._file.seek(begin * row_bytes)
        rows = np.frombuffer(self._file.read((end - begin) * row_bytes), FLOAT32)
        return torch.from_numpy(rows.reshape(-1, self.width).astype(np.float32))


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
        extractor: Computes the patch features.
        batches: Photos (height, width, 3) as the extractor's preprocessing returns them, of any
            sizes, in random order (`sample_photos`).
        photos: Upper bound of the number of photos.
        clusters: Requested number of centres; fewer if there are too few patches.
        seed: Seed of the sampling and of k-means.
        on_progress: Called with the stage (`sample`, `cluster`), the steps done and the
            total.

    Raises:
        Unprocessable: `no_photos` if `batches` is empty.
    """
    with PatchFile(extractor.backbone.width) as patches:
        described = 0
        for batch in batches:
            patches.add(extractor.patch_features(batch), described, photos, seed)
            described += len(batch)
            on_progress("sample", described, photos)
        fit = fit_centres(
            patches,
            clusters,
            seed,
            lambda done, total: on_progress("cluster", done, total),
            extractor.backbone.device,
        )
    provenance = fit_provenance(
        extractor, fit, requested_clusters=clusters, photos=described, seed=seed
    )
    return VocabularyFile(fit.centres, provenance)
