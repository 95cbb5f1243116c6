"""`lab/benchmarks/gpu.sh`, with a tiny network on the CPU."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.support.processes import forked_program

ROOT = Path(__file__).parents[3]
TINY = {
    "DEVICE": "cpu",
    "EXTRACTORS": "test-tiny-vlad",
    "PRECISIONS": "float32",
    "BATCHES": "1,2",
    "PHOTOS": "2",
    "SEARCH": "--photos 0",  # refused: its row says why
    "PYTHON": sys.executable,
    "ALLOW_TEST_EXTRACTORS": "1",
}


def run_script(folder: Path, **variables: str) -> str:
    placewise = forked_program(folder / "placewise")
    done = subprocess.run(
        [str(ROOT / "lab" / "benchmarks" / "gpu.sh"), str(folder)],
        cwd=ROOT,
        env={**os.environ, **TINY, "PLACEWISE": str(placewise), **variables},
        capture_output=True,
        text=True,
        check=True,
        timeout=600,
    )
    table = (folder / "gpu.md").read_text()
    assert table == done.stdout
    return table


def test_script_writes_one_table_and_names_what_it_could_not_measure(tmp_path: Path) -> None:
    table = run_script(tmp_path)
    assert "extraction, batches of 1 |" in table
    assert "extraction, batches of 2 |" in table
    assert "90-search | **not measured**" in table
    assert len({line.count("|") for line in table.splitlines()}) == 1

    assert run_script(tmp_path, SECONDS_IN_ALL="0").count("**not measured**: no time was left") == 2
