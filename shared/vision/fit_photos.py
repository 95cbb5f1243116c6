"""A vocabulary from photos at hand: their patches lie in a temporary folder meanwhile."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from shared.objects import FolderStore
from shared.vision.extractors import Extractor
from shared.vision.fit import VocabularyFit
from shared.vision.patches import PatchStore
from shared.vision.provenance import fit_provenance
from shared.vision.resample import Pixels
from shared.vision.vocabulary_file import VocabularyFile

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
    sizes, in a random order (`shared.vision.patches.sample_photos`); of `photos` at most.
    `on_progress` hears what is being done (`describing`, `clustering`), how far it is and where it ends.

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
