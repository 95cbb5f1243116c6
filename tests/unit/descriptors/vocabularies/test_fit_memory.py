"""The memory of a fit does not depend on how many photos it learns from."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.unit.descriptors.vocabularies.fit_memory import CLUSTERS, PATCHES, WIDTH

REPOSITORY = Path(__file__).parents[4]
ALL_FEATURES_BYTES = 2000 * PATCHES * WIDTH * 4  # 786 MB


def test_a_fit_on_two_thousand_photos_takes_no_more_memory_than_one_on_five_hundred() -> None:
    child = subprocess.run(
        [sys.executable, "-m", "tests.unit.descriptors.vocabularies.fit_memory", "500", "2000"],
        cwd=REPOSITORY,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert child.returncode == 0, child.stderr
    body = json.loads(child.stdout)
    few, many = body["fits"]
    assert (few["photos"], many["photos"]) == (500, 2000)
    assert few["clusters"] == many["clusters"] == CLUSTERS
    assert few["patches"] == 500 * PATCHES, "all of them"
    assert many["patches"] > 150_000, "a share of each photo's"
    assert many["peak"] < 2_000_000_000
    # The features of 1,500 more photos are 590 MB. Two equal fits may differ by 40 MB.
    assert many["peak"] - few["peak"] < 100_000_000
    assert many["peak"] - body["before"] < 200_000_000 < ALL_FEATURES_BYTES / 3
