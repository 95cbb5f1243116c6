"""Training runs that several modules examine."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.lab.training_runs import run_arguments, train, write_tiny_places

Json = dict[str, Any]


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_places(tmp_path_factory.mktemp("places"))


@pytest.fixture
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def whole(places: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Json]:
    """A run that nobody interrupted, its loggers and its test included."""
    out = tmp_path_factory.mktemp("whole")
    fields = run_arguments(places, out, experiment_phase="all", logger="csv,tensorboard")
    return out / "run", train(fields)
