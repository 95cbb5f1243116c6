"""The file that a vocabulary travels in, written without torch: `.npz` with its provenance, `.npy`
without. `shared.descriptors.vocabulary_file` reads and checks it.
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
ZIP_TIMESTAMP = (1980, 1, 1, 0, 0, 0)  # no clock in the file: equal vocabularies are equal bytes


def has_provenance(provenance: dict[str, Any]) -> bool:
    """Does it say what the vocabulary was learnt from?"""
    return "backbone_fingerprint" in provenance


def encode_vocabulary_npz(centres: bytes, provenance: dict[str, Any]) -> bytes:
    """The `.npz` of centres, which are the bytes of a `.npy` file."""
    text = json.dumps(provenance, sort_keys=True, ensure_ascii=False)
    said = io.BytesIO()
    np.save(said, np.array(text), allow_pickle=False)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in ((CENTRES, centres), (PROVENANCE, said.getvalue())):
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", ZIP_TIMESTAMP), data)
    return buffer.getvalue()


def encode_vocabulary_file(
    centres: bytes, sha256: str, provenance: dict[str, Any]
) -> tuple[bytes, str]:
    """A stored vocabulary as a file's bytes and suffix. `centres` are the bytes of its `.npy`
    object, `sha256` that of its numbers: Unavailable (`vocabulary_corrupt`) where they differ.
    """
    try:
        found = hashlib.sha256(decode_rows(centres).tobytes()).hexdigest()
    except ValueError:
        found = "of no array"
    if found != sha256:
        raise Unavailable(
            "vocabulary_corrupt",
            "The vocabulary is not what was stored (its hash differs). Restore it from a backup, "
            "or fit a new one.",
        )
    if not has_provenance(provenance):
        return centres, ".npy"
    # An imported file may have said less: what reads it compares the hash.
    return encode_vocabulary_npz(centres, {**provenance, "sha256": sha256}), ".npz"
