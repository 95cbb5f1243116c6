"""Mapillary Street-level Sequences in both of its protocols."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import utm

from lab.datasets.open_dataset import open_evaluation_set
from shared.errors import InvalidRequest, NotFound
from tests.lab.unit.data_sets import code_of, names, rows, write_csv, write_photos


def msls_city(folder: Path, photos: list[dict[str, Any]]) -> None:
    """The four tables as Mapillary writes them; `m` is metres east of the city's corner."""

    def write(name: str, header: tuple[str, ...], cells: Any) -> None:
        table = [(number, *cells(photo)) for number, photo in enumerate(photos)]
        write_csv(folder / name, ("", *header), table)

    def degrees(photo: dict[str, Any]) -> tuple[float, float]:
        latitude, longitude = utm.to_latlon(350_000 + photo["m"], 6_170_000, 33, "U")
        return float(longitude), float(latitude)

    write(
        "raw.csv",
        ("key", "lon", "lat", "ca", "captured_at", "pano"),
        lambda p: (p["key"], *degrees(p), 370.0, "2019-01-01", p.get("pano", False)),
    )
    # Metres as if the city lay 7 m further east: only the official protocol shall see them.
    write(
        "postprocessed.csv",
        ("key", "easting", "northing", "night", "view_direction"),
        lambda p: (p["key"], 350_007.0 + p.get("official", p["m"]), 6_170_000.0, False, "Forward"),
    )
    write("seq_info.csv", ("key", "sequence_key", "frame_number"), lambda p: (p["key"], "s1", 4))
    write("subtask_index.csv", ("all", "s2w"), lambda p: (p.get("all", True), False))
    write_photos(folder / "images", [f"{photo['key']}.jpg" for photo in photos])


def msls(base: Path) -> None:
    for city, queries in (
        (
            "cph",
            [
                {"key": "q0", "m": 0},
                {"key": "q1", "m": 30, "official": 20},
                {"key": "pano", "m": 0, "pano": True},
                {"key": "notask", "m": 0, "all": False},
                {"key": "far", "m": 900},
            ],
        ),
        ("sf", [{"key": "q5", "m": 5000}]),
    ):
        start = 0 if city == "cph" else 5000
        database = [
            {"key": f"{city}{number}", "m": start + metres}
            for number, metres in enumerate((0, 100))
        ]
        database.append({"key": f"{city}pano", "m": start, "pano": True})
        msls_city(base / "train_val" / city / "database", database)
        msls_city(base / "train_val" / city / "query", queries)


def test_msls_official_drops_panoramas_other_tasks_and_queries_without_positives(
    tmp_path: Path,
) -> None:
    msls(tmp_path)
    opened = open_evaluation_set(tmp_path)
    assert (opened.name, opened.protocol) == ("msls_val", "msls-official")
    stems = [[shot.path.stem for shot in shots] for shots in (opened.database, opened.queries)]
    assert stems == [["cph0", "cph1", "sf0", "sf1"], ["q0", "q1", "q5"]]
    assert rows(opened) == [[0], [0], [2]]
    query = opened.queries[0]
    assert (query.heading, query.sequence, query.frame) == (10.0, "s1", 4)
    assert query.path.is_file()
    assert names(opened)[1][0] == "train_val/cph/query/images/q0.jpg"


def test_msls_vme_keeps_all_queries_and_measures_by_latitude_and_longitude(
    tmp_path: Path,
) -> None:
    msls(tmp_path)
    opened = open_evaluation_set(tmp_path / "train_val", protocol="vme")
    assert [shot.path.stem for shot in opened.queries] == ["q0", "q1", "notask", "far", "q5"]
    assert rows(opened) == [[0], [], [0], [], [2]]
    official = open_evaluation_set(tmp_path / "train_val")
    assert official.fingerprint != opened.fingerprint


def test_msls_of_one_city_or_of_mixed_versions_is_refused(tmp_path: Path) -> None:
    msls(tmp_path)
    cut = tmp_path / "train_val" / "cph" / "query" / "subtask_index.csv"
    cut.write_text("\n".join(cut.read_text().splitlines()[:-1]))
    with pytest.raises(InvalidRequest, match="different versions") as caught:
        open_evaluation_set(tmp_path)
    assert code_of(caught) == "bad_table"
    (tmp_path / "train_val" / "sf").rename(tmp_path / "train_val" / "amman")
    with pytest.raises(NotFound, match=r"no city sf\. Available: amman, cph") as missing:
        open_evaluation_set(tmp_path)
    assert code_of(missing) == "city_missing"
