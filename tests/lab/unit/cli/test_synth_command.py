"""What `placewise datasets synth` tells people; the drawing itself is tested from outside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from lab.city.write import NOT_COMPARABLE
from lab.cli.datasets.commands import app
from lab.cli.datasets.synth import parse_size


@pytest.mark.parametrize("text", ["", "320", "63x240", "320x1921"])
def test_size_is_width_times_height_from_64_to_1920(text: str) -> None:
    assert (parse_size("64x64"), parse_size("1920x1080")) == ((64, 64), (1920, 1080))
    with pytest.raises(typer.BadParameter, match="320x240"):
        parse_size(text)


def test_ladder_is_shown_with_the_line_that_it_is_not_comparable(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def climbed(*_: Any) -> list[dict[str, Any]]:
        shares = {"1": 0.25, "5": 0.5, "10": 0.75}
        return [
            {
                "rung": "average colour",
                "recall": shares,
                "recall_in_map": shares,
                "recall_other_way": None,
            }
        ]

    monkeypatch.setattr("lab.cli.datasets.synth.evaluate_baselines", climbed)
    arguments = ["synth", str(tmp_path / "out"), "--places", "1", "--queries", "2"]
    result = CliRunner().invoke(app, [*arguments, "--size", "64x64"])
    assert result.exit_code == 0, result.output
    for part in ("average colour", "25.0 %", "75.0 %", "25 m", NOT_COMPARABLE):
        assert part in result.output
