"""Plain pycolmap with SIFT, with which `placewise bench pose` compares."""

from __future__ import annotations

import resource
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.extractor.geometry.pycolmap_models import RANDOM_SEED, require_pycolmap
from shared.geometry.cameras import Floats

FEATURES, LONGER_SIDE = 4096, 1600
MIN_INLIERS = 30


class PeerModel:
    """The largest model of photos in a folder, and the positions of queries in it.

    Args:
        names: Of the photos, relative to the folder.
        pairs: (m, 2) numbers of photos that are matched: those of Placewise.
        queries: For each query its name and the numbers of the photos that it is matched with.
    """

    def __init__(
        self,
        folder: Path,
        names: Sequence[str],
        pairs: NDArray[np.int32],
        queries: Sequence[tuple[str, Sequence[int]]],
    ) -> None:
        pycolmap = require_pycolmap()
        started = cpu_seconds()
        options = pycolmap.FeatureExtractionOptions(max_image_size=LONGER_SIDE)
        options.sift.max_num_features = FEATURES
        lines = [f"{names[i]} {names[j]}" for i, j in pairs.tolist()]
        lines += [f"{query} {names[i]}" for query, some in queries for i in some]
        with TemporaryDirectory(prefix="placewise-peer-") as scratch:
            path, listed = Path(scratch, "peer.db"), Path(scratch, "pairs.txt")
            listed.write_text("\n".join(lines))
            modes = pycolmap.CameraMode
            for some, mode in ((names, modes.SINGLE), ([q for q, _ in queries], modes.PER_IMAGE)):
                pycolmap.extract_features(path, folder, list(some), mode, {}, options)
            pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
            pycolmap.match_image_pairs(path, pairing_options=pairing)
            mapping = pycolmap.IncrementalPipelineOptions(random_seed=RANDOM_SEED)
            mapping.image_names = list(names)
            models = pycolmap.incremental_mapping(path, folder, scratch, mapping).values()
            model = max(models, key=lambda each: each.num_reg_images())
            images = {model.image(number).name: model.image(number) for number in model.images}
            self.rows = [row for row, name in enumerate(names) if name in images]
            found = [images[names[row]] for row in self.rows]
            self.centres = np.array([image.projection_center() for image in found])
            self.rotations = [image.cam_from_world().rotation.matrix() for image in found]
            with pycolmap.Database.open(path) as stored:
                self.positions = [
                    _localise(
                        stored, model, query, [images[names[i]] for i in some if i in self.rows]
                    )
                    for query, some in queries
                ]
        self.cpu_seconds = cpu_seconds() - started


def _localise(stored: Any, model: Any, query: str, images: Sequence[Any]) -> Floats | None:
    """Return the (3,) position of a query in the model."""
    pycolmap = require_pycolmap()
    image = stored.read_image_with_name(query)
    keypoints = np.asarray(stored.read_keypoints(image.image_id))[:, :2]
    pairs = [
        (keypoints[own], model.point3D(other.points2D[theirs].point3D_id).xyz)
        for other in images
        for own, theirs in stored.read_two_view_geometry(
            image.image_id, other.image_id
        ).inlier_matches.tolist()
        if other.points2D[theirs].has_point3D()
    ]
    if len(pairs) < MIN_INLIERS:
        return None
    found = pycolmap.estimate_and_refine_absolute_pose(
        *map(np.array, zip(*pairs, strict=True)),
        stored.read_camera(image.camera_id),
        pycolmap.AbsolutePoseEstimationOptions(estimate_focal_length=True),
        pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=True),
    )
    if found is None or found["num_inliers"] < MIN_INLIERS:
        return None
    position: Floats = found["cam_from_world"].inverse().translation
    return position


def cpu_seconds() -> float:
    """Return the CPU time of this process and of its children that have ended."""
    used = [resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)
