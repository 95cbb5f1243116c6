"""The memory of a fit does not depend on how many photos it learns from."""

from __future__ import annotations

import json
from pathlib import Path

from tests.support.processes import INHERITED, REPOSITORY, start
from tests.unit.descriptors.vocabularies import fit_memory
from tests.unit.descriptors.vocabularies.fit_memory import CLUSTERS, PATCHES, WIDTH

ALL_FEATURES_BYTES = 600 * PATCHES * WIDTH * 4  # 236 MB


def test_a_fit_on_six_hundred_photos_takes_no_more_memory_than_one_on_150(tmp_path: Path) -> None:
    printed = tmp_path / "printed"
    with printed.open("w") as file:
        command = [str(fit_memory.__file__), "150", "600"]
        child = start(command, env=INHERITED, cwd=REPOSITORY, stdout=file, stderr=file)
        assert child.wait() == 0, printed.read_text()
    body = json.loads(printed.read_text())
    few, many = body["fits"]
    assert (few["photos"], many["photos"]) == (150, 600)
    assert few["clusters"] == many["clusters"] == CLUSTERS
    assert few["patches"] == 150 * PATCHES, "all of them"
    assert many["patches"] > 40_000, "a share of each photo's"
    # The features of 450 more photos are 177 MB. Two equal fits may differ by 40 MB.
    assert many["peak"] - few["peak"] < 80_000_000
    assert many["peak"] - body["before"] < 200_000_000 < ALL_FEATURES_BYTES
