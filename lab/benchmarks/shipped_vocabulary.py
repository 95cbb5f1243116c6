"""Generates the vocabularies that are shipped with the extractors of EfficientNet-Lite0:

    python -m lab.benchmarks.shipped_vocabulary

They are fitted on photographs contained in installed packages (scikit-learn, scikit-image), cut
into overlapping views at several scales. Since they are not fitted on a map's own photos, searches
with them report `vocabulary: foreign`, and a map should fit its own.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from shared.descriptors.extractor import SHIPPED_VOCABULARIES, Extractor, choose_device
from shared.descriptors.kmeans import KMeansPass, choose_seeds
from shared.descriptors.vocabulary import encode_centres, parse_centres
from shared.descriptors.vocabulary_fit import TOLERANCE
from shared.extractor_config.configs import EXTRACTOR_CONFIGS, ExtractorConfig

# Photographs only: no drawings, scans, microscope images, depth maps or generated images.
PHOTOGRAPHS = {
    "sklearn": ("datasets/images", ("china.jpg", "flower.jpg")),
    "skimage": (
        "data",
        (
            "astronaut.png",
            "brick.png",
            "camera.png",
            "chelsea.png",
            "coffee.png",
            "grass.png",
            "gravel.png",
            "motorcycle_left.png",
            "motorcycle_right.png",
            "rocket.jpg",
        ),
    ),
}
PACKAGES = {"sklearn": "scikit-learn", "skimage": "scikit-image"}
VIEW_SCALES = (1.0, 0.6, 0.35)  # of the photograph's shorter side
VIEWS_PER_SIDE = 4  # views along each side, at every scale below 1
SEED = 0
MAX_KMEANS_PASSES = 100


def main() -> None:
    """Fit and write the vocabulary of each extractor that has one."""
    for config in EXTRACTOR_CONFIGS.values():
        if config.shipped_vocabulary is not None:
            _write_vocabulary(config)


def _write_vocabulary(config: ExtractorConfig) -> None:
    """Fit the centres of one extractor and write them with their provenance."""
    extractor = Extractor(config, choose_device("cpu"))
    views = [
        view for path in _list_photographs() for view in _cut_views(Image.open(path).convert("RGB"))
    ]
    points = torch.cat(
        [
            extractor.features(
                np.stack([extractor.preprocessing.apply(v) for v in views[i : i + 16]])
            ).flatten(0, 1)
            for i in range(0, len(views), 16)
        ]
    )
    centres, iterations = _find_centres(points, config.clusters)
    vocabulary = parse_centres(centres.numpy())
    provenance = {
        "backbone": extractor.backbone.name,
        "backbone_fingerprint": extractor.backbone.fingerprint,
        "layer": extractor.backbone.layer,
        "facet": extractor.backbone.facet,
        "preprocessing": extractor.preprocessing.as_spec(),
        "clusters": vocabulary.clusters,
        "sha256": vocabulary.sha256,
        "seed": SEED,
        "iterations": iterations,
        "views": len(views),
        "patches": len(points),
        "made_by": "python -m lab.benchmarks.shipped_vocabulary",
        "photographs": {
            PACKAGES[package]: {
                "version": version(PACKAGES[package]),
                "files": list(names),
            }
            for package, (_, names) in PHOTOGRAPHS.items()
        },
        "photographs_sha256": {
            path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in _list_photographs()
        },
    }
    target = SHIPPED_VOCABULARIES / str(config.shipped_vocabulary)
    target.write_bytes(encode_centres(vocabulary))
    target.with_suffix(".json").write_text(json.dumps(provenance, indent=2) + "\n")
    print(
        f"{vocabulary.clusters} centres from {len(points)} patches of {len(views)} views: {target}"
    )


def _find_centres(points: torch.Tensor, clusters: int) -> tuple[torch.Tensor, int]:
    """Fit centres with full-batch Lloyd iterations; all points fit into memory.

    Args:
        points: (n, D) patch features.

    Returns:
        (clusters, D) centres and the number of iterations.
    """
    centres = choose_seeds(points, clusters, SEED)
    passes, movement = 0, float("inf")
    while passes < MAX_KMEANS_PASSES and movement > TOLERANCE:
        kmeans_pass = KMeansPass.begin(centres)
        kmeans_pass.accumulate(points, centres)
        new_centres = kmeans_pass.end(centres)
        movement = float(((new_centres - centres) ** 2).sum())
        centres = new_centres
        passes += 1
    return centres, passes


def _list_photographs() -> list[Path]:
    """List the photograph files of the installed packages."""
    paths = []
    for package, (folder, names) in PHOTOGRAPHS.items():
        spec = importlib.util.find_spec(package)
        if spec is None or spec.origin is None:
            raise SystemExit(f"{PACKAGES[package]} is not installed. Run make setup.")
        root = Path(spec.origin).parent / folder
        paths += [root / name for name in names]
    return paths


def _cut_views(photograph: Image.Image) -> list[Image.Image]:
    """Cut square views: one at full scale, and a grid of overlapping ones at smaller scales."""
    width, height = photograph.size
    views = []
    for scale in VIEW_SCALES:
        side = int(min(width, height) * scale)
        lefts = np.linspace(0, width - side, VIEWS_PER_SIDE) if side < width else np.zeros(1)
        tops = np.linspace(0, height - side, VIEWS_PER_SIDE) if side < height else np.zeros(1)
        views += [
            photograph.crop((int(left), int(top), int(left) + side, int(top) + side))
            for top in tops
            for left in lefts
        ]
    return views


if __name__ == "__main__":
    main()
