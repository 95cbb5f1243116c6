"""Rows of two extractors side by side: what their cosine is, and which vocabulary they use."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from shared.descriptors.extractor import Extractor
from shared.descriptors.side_by_side import SideBySideExtractor, join_rows
from shared.descriptors.vocabulary import parse_centres
from shared.descriptors.vocabulary_file import check_vocabulary_fits, feature_provenance
from shared.extractor_config.configs import get_extractor_config
from shared.imaging.decode import decode_photo
from tests.support.photos import photo_bytes

pytestmark = pytest.mark.numerics

NAME = "patchnorm@0.3+test-tiny-vlad@0.7"
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def extractor() -> SideBySideExtractor:
    config = get_extractor_config(NAME, allow_test_extractors=True)
    return SideBySideExtractor(config, [Extractor(part, CPU) for part in config.parts])


def test_the_cosine_of_rows_is_the_weighted_mean_of_the_cosines_of_their_parts(
    extractor: SideBySideExtractor,
) -> None:
    centres = parse_centres(np.random.default_rng(0).standard_normal((4, 16)).astype(np.float32))
    photos = [decode_photo(photo_bytes(n), extractor.preprocessing, 10**9).pixels for n in range(3)]
    rows = extractor.describe(photos, centres)
    assert rows.shape == (3, extractor.dimension(centres)) == (3, 2048 + 64)
    parts = []
    for part, own in zip(extractor.parts, (None, centres), strict=True):
        alone = [decode_photo(photo_bytes(n), part.preprocessing, 10**9).pixels for n in range(3)]
        parts.append(part.describe(alone, own))
    expected = 0.3 * parts[0] @ parts[0].T + 0.7 * parts[1] @ parts[1].T
    np.testing.assert_allclose(rows @ rows.T, expected, atol=1e-5)
    np.testing.assert_allclose(np.diag(expected), 1, atol=1e-5)
    projected = extractor.with_precision("bfloat16")
    assert projected.precision == "bfloat16"


def test_a_part_without_structure_leaves_the_row_to_the_other() -> None:
    one, nothing = np.eye(3, dtype=np.float32), np.zeros((3, 2), np.float32)
    rows = join_rows([one, nothing], [0.2, 0.8])
    np.testing.assert_allclose(rows[:, :3], one, atol=1e-6)
    assert not join_rows([nothing, nothing], [0.5, 0.5]).any()
    damaged = one.copy()
    damaged[1, 0] = np.nan
    assert np.isnan(join_rows([nothing, damaged], [0.5, 0.5])).all(axis=1).tolist() == [
        False,
        True,
        False,
    ]


def test_the_vocabulary_is_that_of_the_part_that_needs_one(
    extractor: SideBySideExtractor,
) -> None:
    alone = Extractor(get_extractor_config("test-tiny-vlad", allow_test_extractors=True), CPU)
    centres = parse_centres(np.eye(16, dtype=np.float32)[:4])
    check_vocabulary_fits(feature_provenance(alone), centres, extractor)
    image = Image.new("RGB", (64, 64), (90, 20, 200))
    (found,) = extractor.patch_features([extractor.preprocessing.apply(image)])
    (expected,) = alone.patch_features([alone.preprocessing.apply(image)])
    torch.testing.assert_close(found, expected)


def test_the_spec_names_both_parts_and_their_weights(extractor: SideBySideExtractor) -> None:
    centres = parse_centres(np.eye(16, dtype=np.float32)[:4])
    spec = extractor.spec(centres)
    assert spec["extractor"] == NAME
    assert spec["weights"] == [0.3, 0.7]
    assert spec["vocabulary_sha256"] == centres.sha256
    assert spec["beside"] == extractor.parts[0].spec(None)
    assert spec["dimension"] == 2048 + 64
