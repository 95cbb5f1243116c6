"""Vocabulary files: with their provenance, without it, and those that are refused."""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from shared.descriptors.vocabulary import parse_centres
from shared.descriptors.vocabulary_file import (
    UNKNOWN_PROVENANCE,
    Provenance,
    VocabularyFile,
    decode_vocabulary,
    read_vocabulary,
)
from shared.errors import Unprocessable
from tests.unit.descriptors.vocabularies.test_vocabulary import Untrustworthy, good_centres, npy


def learnt(**others: Any) -> Provenance:
    """A provenance of the good centres."""
    return {
        "backbone": "test-tiny",
        "backbone_fingerprint": "ab" * 32,
        "layer": "projection",
        "facet": None,
        "preprocessing": {"name": "square32", "version": 1},
        "photos": 17,
        "seed": 3,
        "sha256": parse_centres(good_centres()).sha256,
        **others,
    }


def good_file() -> VocabularyFile:
    return VocabularyFile(parse_centres(good_centres()), learnt())


def npz(compression: int = zipfile.ZIP_STORED, **members: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return buffer.getvalue()


def text(value: Any) -> bytes:
    return npy(np.array(json.dumps(value)))


def test_centres_and_their_provenance_survive_in_a_file_that_numpy_reads_too(
    tmp_path: Path,
) -> None:
    path = tmp_path / "city.npz"
    data = good_file().encode()
    assert data == good_file().encode(), "it holds no clock"
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["centres"], good_centres())
        assert json.loads(archive["provenance"].item()) == learnt()
    path.write_bytes(data)
    found = read_vocabulary(path)
    np.testing.assert_array_equal(found.centres.array, good_centres())
    assert found.provenance == learnt()
    assert found.suffix == ".npz"


def test_centres_of_unknown_origin_are_written_alone() -> None:
    found = VocabularyFile(parse_centres(good_centres()), UNKNOWN_PROVENANCE)
    assert found.suffix == ".npy"
    again = decode_vocabulary(found.encode())
    assert again.provenance == UNKNOWN_PROVENANCE
    np.testing.assert_array_equal(again.centres.array, good_centres())


def broken_archives() -> dict[str, bytes]:
    centres, provenance = npy(good_centres()), text(learnt())
    whole = good_file().encode()
    at = whole.index(good_centres().tobytes())
    flipped = whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]
    pickled = npy(np.array([[Untrustworthy()]], dtype=object))
    zero = npy(np.diag([1.0, 0.0, 1.0, 1.0]) @ good_centres())
    compressed = npz(zipfile.ZIP_DEFLATED, centres=centres, provenance=provenance)
    return {
        "belongs to other centres": npz(centres=npy(good_centres()[:3]), provenance=provenance),
        "does not name the features it was fitted on": npz(centres=centres, provenance=text({})),
        "does not name the features": npz(centres=centres, provenance=text(["a list"])),
        "it holds centres.npy. Import centres alone as a .npy file, or": npz(centres=centres),
        "vocabulary export`: it holds a.npy, b.npy, c.npy and 1 more.": npz(
            a=b"", b=b"", c=b"", d=b""
        ),
        "it holds nothing": npz(),
        "it holds centres.npy, code.npy": npz(centres=centres, provenance=provenance, code=b"x"),
        "centres.npy is compressed": compressed,
        "its provenance can't be read": npz(centres=centres, provenance=npy(np.array("no JSON"))),
        "its provenance is too long": npz(
            centres=centres, provenance=text(learnt(note="x" * 100_000))
        ),
        "Bad CRC-32": flipped,
        "it can't be read": whole[:-30],
        "pickled objects": npz(centres=pickled, provenance=provenance),
        "pickled": npz(centres=centres, provenance=pickled),
        "centre 1 is zero": npz(centres=zero, provenance=provenance),
    }


@pytest.mark.parametrize("reason", broken_archives())
def test_an_archive_that_is_no_whole_vocabulary_is_refused_with_the_reason(reason: str) -> None:
    with pytest.raises(Unprocessable) as caught:
        decode_vocabulary(broken_archives()[reason])
    assert caught.value.code == "vocabulary_unusable"
    assert reason in caught.value.detail
    assert not Untrustworthy.unpickled


def test_arrays_parameters_and_half_precision_tensors_are_read(tmp_path: Path) -> None:
    (tmp_path / "centres.npy").write_bytes(npy(good_centres()))
    read = read_vocabulary(tmp_path / "centres.npy").centres
    np.testing.assert_array_equal(read.array, good_centres())
    path = tmp_path / "c_centers.pt"
    torch.save(torch.nn.Parameter(torch.from_numpy(good_centres())), path)
    np.testing.assert_array_equal(read_vocabulary(path).centres.array, good_centres())
    torch.save(torch.from_numpy(good_centres()).bfloat16(), path)
    np.testing.assert_allclose(read_vocabulary(path).centres.array, good_centres(), atol=0.02)


def broken_tensor_files() -> dict[str, bytes]:
    whole, dictionary = io.BytesIO(), io.BytesIO()
    torch.save(torch.from_numpy(good_centres()), whole)
    torch.save({"centres": torch.ones(2, 3)}, dictionary)
    empty = io.BytesIO()
    with zipfile.ZipFile(empty, "w"):
        pass
    return {
        "a dictionary": dictionary.getvalue(),
        "nothing": b"",
        "text": b"hello",
        "truncated": whole.getvalue()[:-200],
        "an empty archive": empty.getvalue(),
        "a pickle that runs code": pickle.dumps(Untrustworthy(), protocol=2),
    }


@pytest.mark.parametrize("name", broken_tensor_files())
def test_damaged_tensor_files_are_refused_without_executing_code(name: str, tmp_path: Path) -> None:
    path = tmp_path / "c_centers.pt"
    path.write_bytes(broken_tensor_files()[name])
    with pytest.raises(Unprocessable) as caught:
        read_vocabulary(path)
    assert caught.value.code == "vocabulary_unusable"
    assert not Untrustworthy.unpickled


@pytest.mark.real_photos
def test_published_anyloc_vocabularies_load(real_photos: Path) -> None:
    files = sorted((real_photos / "anyloc-vocabularies").glob("*.pt"))
    assert len(files) == 3
    for file in files:
        read = read_vocabulary(file)
        found = read.centres
        assert read.provenance == UNKNOWN_PROVENANCE
        assert (found.clusters, found.dimension) == (32, 1536), file.name
        lengths = np.linalg.norm(found.array, axis=1)
        assert lengths.min() < 0.7, "AnyLoc's centres are means of unit vectors, not unit vectors"
