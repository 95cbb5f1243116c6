"""The notebooks run from their first cell to their last, on places drawn for the test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

from tests.lab.training_runs import write_tiny_places
from tests.support.processes import forked_program

REPOSITORY = Path(__file__).parents[2]
CELL_SECONDS = 850  # of a busy machine

SMALL = {
    "train": """
PLACES = 6
SIZE = "64x64"
IMAGE_SIZE = [64, 64]
EPOCHS = 1
MAX_STEPS = 1
ACCELERATOR = "cpu"
""",
    "pictures": """
PLACES = 4
SIZE = "64x64"
EXTRACTOR = "test-tiny-avg"
""",
}


@pytest.fixture(autouse=True)
def _environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    monkeypatch.setenv("DECODE_PROCESSES", "1")
    monkeypatch.setenv("DEVICE", "cpu")
    monkeypatch.setenv("MPLBACKEND", "agg")


def run_notebook(name: str, parameters: str, folder: Path) -> None:
    file = REPOSITORY / "docs" / "notebooks" / f"{name}.ipynb"
    notebook: Any = nbformat.read(file, as_version=4)  # type: ignore[no-untyped-call]
    assert all(not cell.get("outputs") for cell in notebook.cells), "commit it without outputs"
    (cell,) = (c for c in notebook.cells if "parameters" in c.metadata.get("tags", []))
    # The notebooks run `python -c "from services.cli import main; main()" ARGUMENTS`. A fork has
    # imported that.
    python = forked_program(folder / "python", prefix="shift 2")
    cell.source += f"\nimport sys\nsys.executable = {str(python)!r}\n{parameters}"
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, timeout=CELL_SECONDS, resources=resources).execute()


@pytest.mark.timeout(1800)
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client")
def test_the_notebooks_run_on_generated_places_one_after_the_other_in_one_folder(
    tmp_path: Path,
) -> None:
    for name, reports in (("pictures", 1), ("train", 3)):
        run_notebook(name, SMALL[name], tmp_path)
        assert len(list(tmp_path.glob("results/**/report.html"))) == reports


@pytest.mark.timeout(900)
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client")
def test_pictures_of_a_predictions_file_need_no_model(tmp_path: Path) -> None:
    write_tiny_places(tmp_path / "places", places=3)
    found = np.random.default_rng(0).permuted(np.tile(np.arange(6), (3, 1)), axis=1)
    np.save(tmp_path / "found.npy", found)
    parameters = 'DATA, PREDICTIONS = "places", "found.npy"\nSET = CHECKPOINT = EXTRACTOR = None'
    run_notebook("pictures", parameters, tmp_path)
    assert np.array_equal(np.load(tmp_path / "results" / "predictions_places.npy"), found)
