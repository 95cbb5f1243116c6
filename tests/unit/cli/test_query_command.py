"""`placewise query`: the levels of an estimate as a table that fits into 80 columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from typer.testing import CliRunner

from services.cli.option_groups import CommandGroup
from services.cli.query import query as query_command
from tests.support.api_responses import PHOTO, POSE, SIMILAR
from tests.support.fake_server import FakeServer, running_server

PLACES = [
    {"place": "tower/floor 7 [east]/elevator", "probability": 0.614},
    {"place": "tower/floor 7 [east]", "probability": 0.972},
    {"place": "tower", "probability": 0.98, "whole_map": True},
]
CIRCLES = [
    {"latitude": 45.0, "longitude": 7.0, "radius_m": radius_m, "probability": probability}
    for radius_m, probability in ((25, 0.5), (100, 0.75), (500, 0.9), (2000, 0.96))
]

app = CommandGroup()
app.command()(query_command)


def estimate(levels: list[dict[str, Any]], **fields: Any) -> dict[str, Any]:
    return {
        "headline": "In tower, floor 7 [east]: 97 %",
        "reason": "Not known yet.",
        "levels": levels,
        "answer_level": None,
        "certainty": 0.95,
        "not_in_map_probability": 0.02,
        "has_place": True,
        "calibration_source": "own_photos",
        **fields,
    }


def query(
    folder: Path,
    answer: dict[str, Any],
    *options: str,
    pose: dict[str, Any] | None = None,
    in_terminal: bool = True,
    **photo: Any,
) -> tuple[str, str]:
    """The output of the command for an answer of the server, and the path of its request.

    `pose` are the fields of the answer about the pose.
    """
    (folder / "where.jpg").write_bytes(b"photo")
    match = {**PHOTO, "similarity_score": 0.8, **photo}
    server: FakeServer
    with running_server() as server:
        found = {"similar_images": [match], "estimate": answer, **(pose or {})}
        server.will_answer(200, {**SIMILAR, **found})
        shown = CliRunner().invoke(
            app,
            [str(folder / "where.jpg"), "--server", server.url, *options],
            env={"TTY_COMPATIBLE": str(int(in_terminal)), "COLUMNS": "80"},
        )
    assert shown.exit_code == 0, shown.output
    return shown.stdout, server.requests[0][1]


def bars(output: str) -> list[int]:
    """Lengths of the bars, in characters."""
    return [line.count("━") + line.count("╸") for line in output.splitlines() if " % " in line]


def test_each_level_has_its_probability_and_a_bar_within_80_columns(tmp_path: Path) -> None:
    shown, _ = query(
        tmp_path,
        estimate(PLACES, answer_level=1),
        match_probability=0.614,
        relative_path="Day 2/a[/b].jpg",
    )
    lines = shown.splitlines()
    assert "In tower, floor 7 [east]: 97 %" in lines
    for name, probability in (
        *((level["place"], level["probability"]) for level in PLACES[:2]),
        ("in this map", 0.98),
        ("not in this map", 0.02),
    ):
        assert any(
            row.startswith(f"{name} ") and f" {probability:.1%}"[:-1] in row for row in lines
        )
    assert "fitted on photos of this map" in " ".join(shown.split())
    assert bars(shown)[-4:] == [12, 19, 20, 0]
    match = next(row for row in lines if "Day 2/a[/b].jpg" in row)
    assert "0.8000" in match
    assert "61.4 %" in match
    tables = [row for row in lines if not row.endswith(".")]
    assert max(map(len, tables)) <= 80


def test_circles_are_named_by_their_radius_with_the_radii_of_68_and_95_percent(
    tmp_path: Path,
) -> None:
    shown, _ = query(
        tmp_path,
        estimate(CIRCLES, answer_level=3, radius_68_m=79.4, radius_95_m=1750.2),
    )
    text = " ".join(shown.split())
    assert "Position: 68 % within 79 m, 95 % within 1.8 km." in text
    for name in ("within 25 m", "within 100 m", "within 500 m", "within 2 km"):
        assert f"\n{name} " in shown


def test_the_headline_and_the_reason_are_those_of_the_server(tmp_path: Path) -> None:
    answer = estimate(CIRCLES, latitude=45.0, longitude=7.0)
    answer |= {"headline": "Here, within 25 m: 97 %", "reason": "So it is."}
    lines = query(tmp_path, answer)[0].splitlines()
    at = lines.index("Here, within 25 m: 97 %. 45.000000, 7.000000")
    assert lines[at + 1] == "So it is."
    nowhere = query(tmp_path, {"headline": "No place.", "reason": "No place."})[0]
    assert nowhere.count("No place.") == 1


def test_options_of_the_search_are_sent_to_the_server(tmp_path: Path) -> None:
    options = {"certainty": "0.8", "elsewhere": "0.1", "rerank": "10", "top_k": "2"}
    given = [f"--{name.replace('_', '-')}={value}" for name, value in options.items()]
    _, path = query(tmp_path, estimate(PLACES), *given)
    sent = parse_qs(urlsplit(path).query)
    assert {name: sent[name] for name in options} == {name: [v] for name, v in options.items()}


def test_a_pose_is_a_table_of_80_columns_and_tab_separated_values_in_a_pipe(
    tmp_path: Path,
) -> None:
    options = ("--pose", "--focal-length", "0.8")
    place: dict[str, Any] = {"headline": "No place.", "reason": "No place is known."}
    shown, path = query(tmp_path, place, *options, pose={"pose": POSE, "no_pose": None})
    sent = parse_qs(urlsplit(path).query)
    assert (sent["pose"], sent["focal_length"]) == (["true"], ["0.8"])
    rows = [" ".join(row.split()) for row in shown.splitlines()]
    for row in (
        "latitude 45.0692801",
        "altitude 241.50 m",
        "68 % within 0.42 m",
        "heading 338.0°",
        "heading, 68 % within 1.2°",
        "x, y, z 0.4100, 0.6000, -0.1000",
        "points 148 of 312 agree",
        "focal length 1044 of 1280 px, exif",
    ):
        assert row in rows
    assert max(len(row) for row in shown.splitlines() if not row.endswith(".")) <= 80
    piped, _ = query(tmp_path, place, pose={"pose": POSE, "no_pose": None}, in_terminal=False)
    assert "pose\tvalue\nlatitude\t45.0692801\nlongitude\t7.6853000\n" in piped


def test_missing_coordinates_and_poses_are_explained(tmp_path: Path) -> None:
    place: dict[str, Any] = {"headline": "No place.", "reason": "No place is known."}
    fields = dict.fromkeys(name for name in POSE if name.endswith(("_m", "itude", "_degrees")))
    pose = {**POSE, **fields, "heading": None, "reason": "All photos are on a line."}
    shown, path = query(tmp_path, place, pose={"pose": pose, "no_pose": None})
    assert "All photos are on a line." in " ".join(shown.split())
    assert "latitude 45" not in " ".join(shown.split())
    assert "within" not in shown
    assert "pose" not in path
    reason = "The map has no reconstruction yet. Make one: `placewise reconstruct`."
    shown, _ = query(tmp_path, place, "--pose", pose={"pose": None, "no_pose": reason})
    assert f"No pose: {reason}" in shown.splitlines()


def test_an_answer_without_levels_has_neither_bars_nor_match_probabilities(tmp_path: Path) -> None:
    shown, path = query(tmp_path, {"headline": "No place.", "reason": "No place is known."})
    assert "No place is known." in shown.splitlines()
    guess = {"latitude": 45.0, "longitude": 7.0, "headline": "Best guess", "reason": "Not yet."}
    assert "Best guess. 45.000000, 7.000000\nNot yet." in query(tmp_path, guess)[0]
    assert "probability" not in shown
    assert "match" not in shown
    assert "certainty" not in path


def test_matched_photos_have_their_points_and_the_others_a_reason(tmp_path: Path) -> None:
    place: dict[str, Any] = {"headline": "No place.", "reason": "No place is known."}
    counts: dict[str, Any] = {
        "compared": 2,
        "missing": 1,
        "reason": None,
        "query_width": 4,
        "query_height": 3,
    }
    shown, _ = query(tmp_path, place, pose={"matches": counts}, inliers=57)
    assert "2 photos were matched; 1 have no local features." in shown.splitlines()
    header, row = (line.split() for line in shown.splitlines()[:3:2])
    assert row[header.index("points")] == "57"
    counts |= {"compared": 0, "reason": "It has no texture."}
    shown, _ = query(tmp_path, place, pose={"matches": counts}, inliers=None)
    assert "No matching points: It has no texture." in shown.splitlines()
