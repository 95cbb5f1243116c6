"""Vocabulary files for import and export, and the check that a vocabulary fits an extractor.

- `.npz`, as `placewise vocabulary export` writes it: an uncompressed NumPy archive of
  `centres`, (clusters, dimension) float32, and `provenance`, one string of JSON.
  `numpy.load` reads it without pickle.
- `.npy`: the centres alone.
- `.pt`: the centres alone, as one tensor: AnyLoc's `c_centers.pt`.

The provenance names the backbone, weights, layer, facet and preprocessing of the patch features
that a vocabulary was fitted on. Cosines between patch features and centres are meaningful only if
all of these agree; a shape check would accept a vocabulary of the same width but of other features,
and every descriptor would be wrong.
"""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared.descriptors.extractor import Extractor
from shared.descriptors.vocabulary import (
    ARRAY_READ_ERRORS,
    ClusterCentres,
    decode_array,
    decode_centres,
    encode_centres,
    parse_centres,
)
from shared.descriptors.vocabulary_fit import FittedCentres
from shared.errors import Unprocessable
from shared.extractor_config.configs import ExtractorConfig
from shared.storage.vocabulary_npz import CENTRES, PROVENANCE, encode_vocabulary_npz, has_provenance

Provenance = dict[str, Any]
"""JSON: the fields of `feature_provenance` and, after a fit, those of `fit_provenance`. For a
vocabulary of unknown origin it is UNKNOWN_PROVENANCE."""

UNKNOWN_PROVENANCE: Provenance = {"learnt_with": "unknown"}


def feature_provenance(extractor: Extractor) -> Provenance:
    """Return the provenance of the extractor's patch features."""
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
    fit: FittedCentres,
    *,
    requested_clusters: int,
    photos: int,
    seed: int,
) -> Provenance:
    """Return the provenance of a fit: the features', its arguments and its results.

    `photos` is the number of photos that the fit has read.
    """
    return {
        **feature_provenance(extractor),
        "clusters": fit.centres.clusters,
        "clusters_asked": requested_clusters,
        "photos": photos,
        "patches": fit.patches,
        "seed": seed,
        "passes": fit.passes,
        "mean_cosine": fit.similarity,
        "sha256": fit.centres.sha256,
    }


def check_vocabulary_fits(
    provenance: Provenance, centres: ClusterCentres, extractor: Extractor
) -> None:
    """Check that the vocabulary was fitted on the extractor's patch features.

    A vocabulary of unknown origin only needs the same width.

    Raises Unprocessable (`vocabulary_unusable`) naming both specs.
    """
    if not extractor.config.needs_vocabulary:
        raise Unprocessable(
            "vocabulary_unusable", f"The extractor {extractor.config.name} uses no vocabulary."
        )
    computed = feature_provenance(extractor)
    if has_provenance(provenance):
        fitted_on = {key: provenance.get(key) for key in computed}
        if fitted_on != computed:
            raise Unprocessable(
                "vocabulary_unusable",
                f"The vocabulary was fitted on {_describe_features(fitted_on)}; the extractor "
                f"{extractor.config.name} computes {_describe_features(computed)}. Fit a "
                "vocabulary with this extractor.",
                learnt_with=fitted_on,
                extractor_makes=computed,
            )
    check_vocabulary_width(centres, extractor.config, extractor.backbone.width)


def check_vocabulary_width(
    centres: ClusterCentres, config: ExtractorConfig, width: int | None
) -> None:
    """Check that the centres have the width of the extractor's patch features.

    `width` None skips the check: the width is known only after the network is loaded.

    Raises Unprocessable (`vocabulary_unusable`).
    """
    if width is not None and centres.dimension != width:
        raise Unprocessable(
            "vocabulary_unusable",
            f"The vocabulary has {centres.dimension} dimensions, the patch features of "
            f"{config.name} {width}.",
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


ARCHIVE_MEMBERS = {f"{CENTRES}.npy", f"{PROVENANCE}.npy"}
MAX_PROVENANCE_BYTES = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class VocabularyFile:
    """Cluster centres with their provenance."""

    centres: ClusterCentres
    provenance: Provenance

    @property
    def suffix(self) -> str:
        """The file's suffix: `.npz`, or `.npy` if the provenance is unknown."""
        return ".npz" if has_provenance(self.provenance) else ".npy"

    def encode(self) -> bytes:
        """Encode as a file with the suffix `suffix`."""
        centres = encode_centres(self.centres)
        return centres if self.suffix == ".npy" else encode_vocabulary_npz(centres, self.provenance)


def decode_vocabulary(data: bytes) -> VocabularyFile:
    """Decode and validate the bytes of a `.npz` or `.npy` file.

    Raises Unprocessable (`vocabulary_unusable`).
    """
    if not data.startswith(b"PK"):
        return VocabularyFile(decode_centres(data), UNKNOWN_PROVENANCE)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            infos = archive.infolist()
            # Checked before reading: many members may overlap in the same bytes.
            if sorted(info.filename for info in infos) != sorted(ARCHIVE_MEMBERS):
                first, more = ", ".join(sorted(info.filename for info in infos)[:3]), len(infos) - 3
                listed = f"{first} and {more} more" if more > 0 else first or "nothing"
                raise _vocabulary_unusable_error(f"it holds {listed}")
            members = {info.filename: _read(archive, info) for info in infos}
    except (*ARRAY_READ_ERRORS, NotImplementedError, RuntimeError) as error:
        raise _vocabulary_unusable_error(f"it can't be read ({error})") from error
    centres = decode_centres(members[f"{CENTRES}.npy"])
    provenance = _decode_provenance(members[f"{PROVENANCE}.npy"])
    if provenance.get("sha256") != centres.sha256:
        raise _vocabulary_unusable_error(
            "its provenance belongs to other centres (the hash differs)"
        )
    return VocabularyFile(centres, provenance)


def read_vocabulary(path: Path) -> VocabularyFile:
    """Read and validate a `.npz`, `.npy` or `.pt` file.

    Raises Unprocessable (`vocabulary_unusable`).
    """
    if path.suffix != ".pt":
        return decode_vocabulary(path.read_bytes())
    return VocabularyFile(_read_tensor(path), UNKNOWN_PROVENANCE)


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
        raise ValueError(f"{info.filename} is compressed")  # decompression has no size limit
    return archive.read(info)


def _decode_provenance(data: bytes) -> Provenance:
    if len(data) > MAX_PROVENANCE_BYTES:
        raise _vocabulary_unusable_error("its provenance is too long")
    try:
        array = decode_array(data)
        text = array.item() if array.dtype.kind == "U" and array.size == 1 else ""
        provenance: Any = json.loads(text)
    except (*ARRAY_READ_ERRORS, RecursionError) as error:
        raise _vocabulary_unusable_error(f"its provenance can't be read ({error})") from error
    if not isinstance(provenance, dict) or not has_provenance(provenance):
        raise _vocabulary_unusable_error(
            "its provenance does not name the features it was fitted on"
        )
    return provenance


def _vocabulary_unusable_error(reason: str) -> Unprocessable:
    return Unprocessable(
        "vocabulary_unusable",
        f"This is not a .npz file of `placewise vocabulary export`: {reason}. Import centres alone "
        "as a .npy file, or PyTorch's .pt with the command `placewise vocabulary import`.",
    )


def _read_tensor(path: Path) -> ClusterCentres:
    import torch

    from shared.descriptors.weight_files import (
        TENSOR_READ_ERRORS,
        check_declared_size,
        load_tensors,
    )

    try:
        tensor = load_tensors(path)
        if isinstance(tensor, torch.Tensor):
            check_declared_size([tensor], path)
    except TENSOR_READ_ERRORS as error:
        raise Unprocessable(
            "vocabulary_unusable", f"{path.name} is not a PyTorch tensor file: {error}"
        ) from error
    if not isinstance(tensor, torch.Tensor):
        raise Unprocessable(
            "vocabulary_unusable",
            f"{path.name} holds a {type(tensor).__name__}, expected one tensor.",
        )
    # Copied: it is mapped from the file, which may change.
    tensor = tensor.detach().to_dense().clone()
    if tensor.is_floating_point():
        tensor = tensor.to(torch.float32)  # NumPy has no bfloat16
    return parse_centres(tensor.numpy())
