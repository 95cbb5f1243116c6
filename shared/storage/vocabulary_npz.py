"""Vocabulary files: `.npz` with provenance, `.npy` without.

Encoding needs no torch; `shared.descriptors.vocabulary_file` reads and validates the files.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from typing import Any

import numpy as np

from shared.errors import Unavailable
from shared.storage.chunks import decode_rows

CENTRES, PROVENANCE = "centres", "provenance"
ZIP_TIMESTAMP = (1980, 1, 1, 0, 0, 0)  # fixed, so that equal vocabularies have equal bytes


def has_provenance(provenance: dict[str, Any]) -> bool:
    """Return whether the provenance names what the vocabulary was fitted on."""
    return "backbone_fingerprint" in provenance


def encode_vocabulary_npz(centres: bytes, provenance: dict[str, Any]) -> bytes:
    """Encode centres, given as the bytes of a `.npy` file, and provenance as an `.npz` file."""
    text = json.dumps(provenance, sort_keys=True, ensure_ascii=False)
    provenance_array = io.BytesIO()
    np.save(provenance_array, np.array(text), allow_pickle=False)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in (
            (CENTRES, centres),
            (PROVENANCE, provenance_array.getvalue()),
        ):
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", ZIP_TIMESTAMP), data)
    return buffer.getvalue()


def encode_vocabulary_file(
    centres: bytes, sha256: str, provenance: dict[str, Any]
) -> tuple[bytes, str]:
    """Encode a stored vocabulary as a file.

    Args:
        centres: bytes of the vocabulary's `.npy` object.
        sha256: expected hash of the array's numbers.

    Returns:
        The file's bytes, and its suffix (`.npz` or `.npy`).

    Raises:
        Unavailable: `vocabulary_corrupt` when the hash differs.
    """
    try:
        actual: str | None = hashlib.sha256(decode_rows(centres).tobytes()).hexdigest()
    except ValueError:
        actual = None
    if actual != sha256:
        raise Unavailable(
            "vocabulary_corrupt",
            "The vocabulary is damaged (its hash differs). Restore it from a backup, or fit a new "
            "one.",
        )
    if not has_provenance(provenance):
        return centres, ".npy"
    # The provenance of an imported file may lack the hash, which readers of the file compare.
    return encode_vocabulary_npz(centres, {**provenance, "sha256": sha256}), ".npz"
