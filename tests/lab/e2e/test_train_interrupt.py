"""Ctrl-C in a real training process."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest
import torch

from lab.training import run
from lab.training.run_control import NullDisplay, StopRequest
from tests.lab.training_runs import assert_same_weights, run_arguments, train, write_tiny_places
from tests.support.processes import INHERITED, PLACEWISE, start

LIMIT_SECONDS = 240


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_process_leaves_a_run_that_goes_on_exactly(
    number: signal.Signals, tmp_path: Path
) -> None:
    places = write_tiny_places(tmp_path / "places")
    arguments = run_arguments(places, tmp_path, max_epochs=10_000, check_val_every_n_epoch=10_000)
    words = [f"--{name}={value}" for name, value in arguments.items()]
    last = tmp_path / "run" / "checkpoints" / "last.ckpt"
    with (tmp_path / "output").open("w+") as output:
        process = start(
            [PLACEWISE, "train", *words],
            env={**INHERITED, "OMP_NUM_THREADS": "1"},
            cwd=tmp_path,
            stdout=output,
            stderr=output,
        )
        deadline = time.monotonic() + LIMIT_SECONDS
        while not last.exists():
            assert process.poll() is None, (tmp_path / "output").read_text()
            assert time.monotonic() < deadline, (tmp_path / "output").read_text()
            time.sleep(0.05)
        process.send_signal(number)
        assert process.wait(LIMIT_SECONDS) == 130
    text = (tmp_path / "output").read_text()
    assert f"placewise train --resume {tmp_path / 'run'}" in text.replace("\n", "")
    assert "Traceback" not in text
    stopped = torch.load(last, weights_only=True)["global_step"]
    # Two steps more, and all of them without an interruption.
    torch.set_num_threads(1)
    most = stopped + 2
    resumed = run.resume(tmp_path / "run", {"max_steps": most}, NullDisplay(), StopRequest())
    whole = train({**arguments, "run_name": "whole", "max_steps": most})
    assert [epoch["step"] for epoch in resumed["epochs"]] == [most]
    assert_same_weights(Path(whole["last"]), Path(resumed["last"]))
