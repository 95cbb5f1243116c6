"""A vocabulary from photos at hand: their patches lie in a temporary folder meanwhile."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from shared.objects import FolderStore
from shared.vision.extractors import Extractor
from shared.vision.fit import Fit
from shared.vision.patches import PatchStore
from shared.vision.provenance import of_fit
from shared.vision.resample import Pixels
from shared.vision.vocabulary_file import VocabularyFile

PATCHES = "patches-"


def fit_photos(
    extractor: Extractor,
    batches: Iterable[Sequence[Pixels]],
    photos: int,
    *,
    clusters: int,
    seed: int,
    told: Callable[[str, int, int], None] = lambda what, done, most: None,
) -> VocabularyFile:
    """Learn `clusters` centres, or as many as the photos bear.

    `batches` are photos (height, width, 3) as the extractor's preprocessing leaves them, of any
    sizes, in a random order (`shared.vision.patches.choose_photos`); of `photos` at most.
    `told` hears what is being done (`describing`, `clustering`), how far it is and where it ends.

    Raises Unprocessable (`no_photos`) when no photo comes.
    """
    with tempfile.TemporaryDirectory(prefix="placewise-fit-") as folder:
        store = PatchStore(FolderStore(Path(folder)), PATCHES, extractor.backbone.width)
        described = 0
        for batch in batches:
            store.add(extractor.local_features(batch), described, photos, seed)
            described += len(batch)
            told("describing", described, photos)
        fit = Fit(store.open(), clusters, seed)
        while not fit.done:
            fit.step()
            told("clustering", *fit.progress)
    centres = fit.centres()
    provenance = of_fit(
        extractor, centres, fit, clusters_asked=clusters, photos=described, seed=seed
    )
    return VocabularyFile(centres, provenance)
