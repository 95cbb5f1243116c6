"""`placewise models fetch` as a process of its own, killed in the middle of a download."""

from __future__ import annotations

import json
import time
from pathlib import Path

from shared.descriptors.backbones.dinov2 import SHAPES
from tests.support.files_server import files_server
from tests.support.processes import PLACEWISE, start
from tests.support.server import environment, run_command
from tests.support.vit import random_weights, save

FETCH = ("models", "fetch", "anyloc-vits14:layer=0", "--json")
FILE = "/timm/vit_small_patch14_dinov2.lvd142m/resolve/main/model.safetensors"
BEGUN_BYTES = 3_000_000
SECONDS = 60


def test_a_killed_fetch_goes_on_where_it_was(tmp_path: Path) -> None:
    weights = random_weights(SHAPES["vits14"], blocks=1)
    content = save(weights, tmp_path / "model.safetensors").read_bytes()
    with files_server() as server:
        server.files[FILE] = content
        server.stall_after = BEGUN_BYTES
        env = environment(
            tmp_path / "home",
            hf_endpoint=server.url,
            hf_home=tmp_path / "hf",
        )
        with (tmp_path / "fetch.log").open("wb") as log:
            fetching = start([PLACEWISE, *FETCH], env=env, cwd=tmp_path, stdout=log, stderr=log)
        deadline = time.monotonic() + SECONDS
        while sum(p.stat().st_size for p in tmp_path.glob("hf/hub/*/blobs/*.part")) < BEGUN_BYTES:
            assert fetching.poll() is None, "it ended before its time"
            assert time.monotonic() < deadline, "nothing came"
            time.sleep(0.05)
        fetching.kill()
        fetching.wait()

        server.stall_after = None
        server.requests.clear()
        result = run_command(*FETCH, env=env, cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        fetched = json.loads(result.stdout)
        assert Path(fetched["path"]).read_bytes() == content
        assert Path(fetched["path"]).is_relative_to(tmp_path / "hf" / "hub")
        # huggingface_hub asks for more than files.
        ranges = [part for path, part in server.requests if path == FILE]
        assert ranges == [f"bytes={BEGUN_BYTES}-"]
