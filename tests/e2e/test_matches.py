"""Matches as a user asks for them: one call, one answer, and a drawing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.photos import encoded
from tests.support.server import ServerProcess, environment, run_command

WIDTH, HEIGHT = 480, 360
SHIFT = 36  # pixels that the query is taken farther to the right


def texture(seed: int, shift: int = 0) -> bytes:
    """A photo of an endless wall of random spots, farther to the right by `shift` pixels."""
    spots = np.random.default_rng(seed).integers(0, 256, (HEIGHT // 6, WIDTH // 4, 3), np.uint8)
    wall = Image.fromarray(spots).resize((WIDTH // 4 * 6, HEIGHT), Image.Resampling.BICUBIC)
    return encoded(wall.crop((shift, 0, shift + WIDTH, HEIGHT)), "JPEG", quality=92)


@pytest.fixture(scope="module")
def walls(server: ServerProcess) -> list[str]:
    return [server.indexed(texture(seed), f"wall-{seed}.jpg") for seed in range(4)]


def test_the_photo_of_the_same_wall_comes_first_with_its_points(
    server: ServerProcess, walls: list[str]
) -> None:
    answer = server.ask(texture(2, SHIFT), rerank=10, explain="true", top_k=4).json()
    best, *others = answer["similar_images"]
    assert best["image_id"] == walls[2]
    assert best["inliers"] == len(best["pairs"]) > 100
    shifts = [pair["photo"][0] - pair["query"][0] for pair in best["pairs"]]
    assert np.median(shifts) == pytest.approx(SHIFT, abs=1)
    inliers = [one["inliers"] for one in others if one["inliers"] is not None]
    assert len(inliers) >= 2
    assert max(inliers) < best["inliers"] / 5
    size = (answer["matches"]["query_width"], answer["matches"]["query_height"])
    assert size == (WIDTH, HEIGHT)
    stored = server.similar(walls[2], matches=3)
    assert stored.status_code == 200, stored.text
    assert stored.json()["matches"]["compared"] > 0


def test_the_command_counts_the_points_and_draws_them(
    server: ServerProcess, walls: list[str], tmp_path: Path
) -> None:
    photo = tmp_path / "again.jpg"
    photo.write_bytes(texture(1, SHIFT))
    options: list[str | Path] = ["--rerank", "10", "--top-k", "2", "--explain", "matches.png"]
    env = {**environment(server.home), "COLUMNS": "200"}
    shown = run_command("query", photo, *options, env=env, cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    first = next(line for line in shown.stdout.splitlines() if "wall-" in line)
    assert "wall-1.jpg" in first
    assert "photos were matched" in shown.stdout
    with Image.open(tmp_path / "matches.png") as drawn:
        assert drawn.width > 2 * WIDTH
