"""Where a vocabulary comes from, and whether an extractor may use it.

Cosines between local features and centres mean something only where both come from the same
network, layer, facet and pixels: a vocabulary of the same width but other features would be
accepted by every shape check, and quietly spoil every descriptor.
"""

from __future__ import annotations

from typing import Any

from shared.errors import Unprocessable
from shared.recipes import Recipe
from shared.vision.extractors import Extractor
from shared.vision.fit import Fit
from shared.vision.vocabulary import Centres
from shared.vocabulary_npz import is_known

Provenance = dict[str, Any]
"""JSON: what `of_features` says, and of a fit `of_fit`. Without the former the vocabulary is of
unknown origin, and `learnt_with` says `unknown`."""

UNKNOWN: Provenance = {"learnt_with": "unknown"}


def of_features(extractor: Extractor) -> Provenance:
    """What makes the local features that centres are learnt from."""
    backbone = extractor.backbone
    return {
        "backbone": backbone.name,
        "backbone_fingerprint": backbone.fingerprint,
        "layer": backbone.layer,
        "facet": backbone.facet,
        "preprocessing": extractor.preprocessing.as_spec(),
    }


def of_fit(
    extractor: Extractor, centres: Centres, fit: Fit, *, clusters_asked: int, photos: int, seed: int
) -> Provenance:
    """How `centres` were learnt; `photos` were looked at."""
    return {
        **of_features(extractor),
        "clusters": centres.clusters,
        "clusters_asked": clusters_asked,
        "photos": photos,
        "patches": fit.patches,
        "seed": seed,
        "passes": fit.passes,
        "mean_cosine": fit.similarity,
        "sha256": centres.sha256,
    }


def check_fits(provenance: Provenance, centres: Centres, extractor: Extractor) -> None:
    """Unprocessable (`vocabulary_unfit`) naming both specs unless the vocabulary was learnt from
    what the extractor makes. One of unknown origin only has to be as wide.
    """
    if not extractor.recipe.needs_vocabulary:
        raise Unprocessable(
            "vocabulary_unfit", f"The extractor {extractor.recipe.name} uses no vocabulary."
        )
    made = of_features(extractor)
    if is_known(provenance):
        learnt = {key: provenance.get(key) for key in made}
        if learnt != made:
            raise Unprocessable(
                "vocabulary_unfit",
                f"The vocabulary was learnt from {_in_words(learnt)}; the extractor "
                f"{extractor.recipe.name} makes {_in_words(made)}. Fit one with this extractor.",
                learnt_with=learnt,
                extractor_makes=made,
            )
    check_width(centres, extractor.recipe, extractor.backbone.width)


def check_width(centres: Centres, recipe: Recipe, width: int | None) -> None:
    """Unprocessable (`vocabulary_unfit`) unless the centres are as wide as the recipe's local
    features; None: only the loaded network tells."""
    if width is not None and centres.dimension != width:
        raise Unprocessable(
            "vocabulary_unfit",
            f"The vocabulary has {centres.dimension} dimensions, the local features of "
            f"{recipe.name} {width}.",
        )


def _in_words(features: Provenance) -> str:
    pixels = features["preprocessing"]
    if isinstance(pixels, dict):
        pixels = " ".join(f"{key} {value}" for key, value in pixels.items())
    parts = [
        f"{features['backbone']} (weights {str(features['backbone_fingerprint'])[:12]})",
        f"layer {features['layer']}",
        f"facet {features['facet']}",
        f"preprocessing {pixels}",
    ]
    return ", ".join(parts)
