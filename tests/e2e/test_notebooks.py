"""The notebooks run from their first cell to their last, on places drawn for the test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

REPOSITORY = Path(__file__).parents[2]
CELL_SECONDS = 850  # of a busy machine

SMALL = {
    "train": """
DATA = "city"
PLACES = 6
SIZE = "64x64"
IMAGE_SIZE = [64, 64]
EPOCHS = 1
MAX_STEPS = 1
ACCELERATOR = "cpu"
""",
    "pictures": """
DATA = SET = PREDICTIONS = CHECKPOINT = None
PLACES = 4
SIZE = "64x64"
EXTRACTOR = "test-tiny-avg"
""",
}


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", sorted(SMALL))
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client")
def test_notebook_runs_on_generated_places(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    monkeypatch.setenv("DECODE_PROCESSES", "1")
    monkeypatch.setenv("DEVICE", "cpu")
    monkeypatch.setenv("MPLBACKEND", "agg")
    file = REPOSITORY / "docs" / "notebooks" / f"{name}.ipynb"
    notebook: Any = nbformat.read(file, as_version=4)  # type: ignore[no-untyped-call]
    assert all(not cell.get("outputs") for cell in notebook.cells), "commit it without outputs"
    (parameters,) = (c for c in notebook.cells if "parameters" in c.metadata.get("tags", []))
    parameters.source = SMALL[name]
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=CELL_SECONDS, resources=resources).execute()
    reports = list(tmp_path.glob("results/**/report.html"))
    assert len(reports) == {"train": 2, "pictures": 1}[name]
