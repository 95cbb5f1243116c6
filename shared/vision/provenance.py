"""Where a vocabulary comes from, and whether an extractor may use it.

Cosines between local features and centres mean something only where both come from the same
network, layer, facet and pixels: a vocabulary of the same width but other features would be
accepted by every shape check, and quietly spoil every descriptor.
"""

from __future__ import annotations

from typing import Any

from shared.errors import Unprocessable
from shared.recipes import ExtractorConfig
from shared.vision.extractors import Extractor
from shared.vision.fit import VocabularyFit
from shared.vision.vocabulary import ClusterCentres
from shared.vocabulary_npz import has_provenance

Provenance = dict[str, Any]
"""JSON: what `feature_provenance` says, and of a fit `fit_provenance`. Without the former the vocabulary is of
unknown origin, and `learnt_with` says `unknown`."""

UNKNOWN_PROVENANCE: Provenance = {"learnt_with": "unknown"}


def feature_provenance(extractor: Extractor) -> Provenance:
    """What makes the local features that centres are learnt from."""
    backbone = extractor.backbone
    return {
        "backbone": backbone.name,
        "backbone_fingerprint": backbone.fingerprint,
        "layer": backbone.layer,
        "facet": backbone.facet,
        "preprocessing": extractor.preprocessing.as_spec(),
    }


def fit_provenance(
    extractor: Extractor,
    centres: ClusterCentres,
    fit: VocabularyFit,
    *,
    requested_clusters: int,
    photos: int,
    seed: int,
) -> Provenance:
    """How `centres` were learnt; `photos` were looked at."""
    return {
        **feature_provenance(extractor),
        "clusters": centres.clusters,
        "clusters_asked": requested_clusters,
        "photos": photos,
        "patches": fit.patches,
        "seed": seed,
        "passes": fit.passes,
        "mean_cosine": fit.similarity,
        "sha256": centres.sha256,
    }


def check_vocabulary_fits(
    provenance: Provenance, centres: ClusterCentres, extractor: Extractor
) -> None:
    """Unprocessable (`vocabulary_unfit`) naming both specs unless the vocabulary was learnt from
    what the extractor makes. One of unknown origin only has to be as wide.
    """
    if not extractor.recipe.needs_vocabulary:
        raise Unprocessable(
            "vocabulary_unfit", f"The extractor {extractor.recipe.name} uses no vocabulary."
        )
    made = feature_provenance(extractor)
    if has_provenance(provenance):
        learnt = {key: provenance.get(key) for key in made}
        if learnt != made:
            raise Unprocessable(
                "vocabulary_unfit",
                f"The vocabulary was learnt from {_describe_features(learnt)}; the extractor "
                f"{extractor.recipe.name} makes {_describe_features(made)}. Fit one with this extractor.",
                learnt_with=learnt,
                extractor_makes=made,
            )
    check_vocabulary_width(centres, extractor.recipe, extractor.backbone.width)


def check_vocabulary_width(
    centres: ClusterCentres, recipe: ExtractorConfig, width: int | None
) -> None:
    """Unprocessable (`vocabulary_unfit`) unless the centres are as wide as the recipe's local
    features; None: only the loaded network tells."""
    if width is not None and centres.dimension != width:
        raise Unprocessable(
            "vocabulary_unfit",
            f"The vocabulary has {centres.dimension} dimensions, the local features of "
            f"{recipe.name} {width}.",
        )


def _describe_features(features: Provenance) -> str:
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
