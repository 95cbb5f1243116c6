"""What `placewise bench scale` derives, and that docs/scale.md says the same."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lab.benchmarks.scale import PAGE, Sizing, format_amount, parse_assignments
from services.cli.main import build_app
from shared.errors import Misconfigured
from shared.ids import new_id
from shared.storage.chunks import write_chunk
from shared.storage.folder import FolderStore

runner = CliRunner()
app = build_app(["bench"])


def plan_of(photos: int, dimension: int, **inputs: float) -> dict[str, float]:
    return Sizing(inputs).evaluate(photos, dimension)[0]


def test_page_has_the_tables_that_the_program_makes() -> None:
    assert Sizing({}).updated_page() == PAGE.read_text(encoding="utf-8"), (
        "run: placewise bench scale --markdown docs/scale.md, and read the text around the tables"
    )


def test_page_with_another_price_is_another_page() -> None:
    assert Sizing({"price_gpu_hour": 7}).updated_page() != PAGE.read_text(encoding="utf-8")


def test_page_without_a_place_for_a_table_is_refused() -> None:
    page = PAGE.read_text(encoding="utf-8").replace("<!-- end of limits -->", "")
    with pytest.raises(Misconfigured, match="end of limits"):
        Sizing({}, page)


def test_a_plan_by_hand() -> None:
    plan = plan_of(
        1_000_000,
        98_304,
        scan_us=10,
        search_seconds=1,
        photo_columns_bytes=712,
        machine_ram_bytes=2e9,
        machine_disk_bytes=100e9,
        ram_used=0.5,
        replicas=3,
        queries_per_second=1,
        gpu_photos_per_second_98304=50,
    )
    assert plan["row_in_memory"] == 13_000
    assert plan["codes_in_memory"] == 26e9  # two generations
    assert plan["shards_for_memory"] == 26  # 26 GB in parts of 1 GB
    assert plan["shards_for_disk"] == 4  # 393 GB in parts of 100 GB
    assert plan["shards_for_time"] == 10  # 10 s in parts of one
    assert plan["shards"] == 26
    assert plan["search_workers"] == 78
    assert plan["worker_memory"] == pytest.approx(2e9)
    assert plan["gpu_time"] == 20_000
    assert plan["searches"] == 7_776_000
    costs = ("extractor_cost", "search_cost", "object_cost", "catalog_cost", "other_cost")
    assert plan["total_cost"] == pytest.approx(sum(plan[cost] for cost in costs))


def test_an_extractor_is_as_fast_as_the_slower_of_gpu_and_decoding() -> None:
    slow_cpu = {"extractor_vcpus": 2, "pipeline_cpu_seconds_98304": 0.1}
    assert plan_of(1000, 98_304, **slow_cpu)["extractor_rate"] == 20
    assert plan_of(1000, 98_304, gpu_photos_per_second_98304=3, **slow_cpu)["extractor_rate"] == 3


def test_chunk_bytes_are_those_that_are_written(tmp_path: Path) -> None:
    store = FolderStore(tmp_path)
    written = write_chunk(
        store,
        generation_id=new_id(),
        chunk_id=new_id(),
        rows=np.zeros((1000, 64), np.float16),
        photo_ids=[new_id() for _ in range(1000)],
        spec={},
    )
    assert written.rows == 1000
    on_disk = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    assert on_disk / 1000 == pytest.approx(
        2 * 64 + plan_of(1000, 14_336)["chunks"] / 1000 - 2 * 14_336, rel=0.01
    )


def test_limits_come_with_the_lowest_first_and_follow_the_inputs() -> None:
    found = Sizing({}).evaluate(1000, 98_304)[1]
    order = [row[0] for row in Sizing({}).tables()["limits"][1:]]
    assert [found[what] for what in order] == sorted(found.values())
    half = Sizing({"ram_used": 0.4}).evaluate(1000, 98_304)[1]
    what = "the codes exceed one machine's memory"
    assert half[what] == found[what] / 2


@pytest.mark.parametrize("given", ["price_gpu=2", "price_gpu_hour", "price_gpu_hour=no"])
def test_what_is_no_input_is_refused(given: str) -> None:
    ended = runner.invoke(app, ["bench", "scale", "--json", "--set", given])
    assert ended.exit_code == 1
    assert json.loads(ended.output)["code"] == "unknown_input"


def test_page_is_computed_from_its_own_inputs_only(tmp_path: Path) -> None:
    page = tmp_path / "scale.md"
    page.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    ended = runner.invoke(app, ["bench", "scale", "--set", "ram_used=0.5", "--markdown", str(page)])
    assert ended.exit_code == 2
    assert runner.invoke(app, ["bench", "scale", "--markdown", str(page)]).exit_code == 0
    assert page.read_text(encoding="utf-8") == PAGE.read_text(encoding="utf-8")


def test_each_number_has_its_name() -> None:
    ended = runner.invoke(app, ["bench", "scale", "--set", "photo_bytes=1000"])
    assert ended.exit_code == 0
    assert "originals\t10 MB\t1 GB\t100 GB\n" in ended.output
    assert "the codes exceed one machine's memory\t" in ended.output


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf"])
def test_an_input_is_a_positive_number(value: str) -> None:
    with pytest.raises(Misconfigured, match="above 0"):
        Sizing(parse_assignments([f"price_gpu_hour={value}"]))


def test_json_has_inputs_plans_and_limits() -> None:
    ended = runner.invoke(app, ["bench", "scale", "--json", "--set", "price_gpu_hour=7"])
    assert ended.exit_code == 0
    found = json.loads(ended.output)
    assert found["inputs"]["price_gpu_hour"] == 7
    assert {(plan["photos"], plan["dimensions"]) for plan in found["plans"]} == {
        (photos, dimensions)
        for photos in (10_000, 1_000_000, 100_000_000)
        for dimensions in (14_336, 98_304)
    }
    assert all(plan["limits"] for plan in found["plans"])


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [
        (393_216, "B", "393 kB"),
        (1.966e12, "B", "1.97 TB"),
        (0.000_002_4, "s", "2.4 us"),
        (90, "s", "1.5 min"),
        (8000, "s", "2.22 h"),
        (0, "B", "0 B"),
        (17.66, "/s", "17.7 /s"),
    ],
)
def test_amounts_have_three_digits_and_a_unit(value: float, unit: str, shown: str) -> None:
    assert format_amount(value, unit) == shown


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.0, "0"), (1000, "1,000"), (0.0116, "0.0116"), (45_678_901, "45,700,000")],
)
def test_amount_without_a_unit_has_three_digits(value: float, shown: str) -> None:
    assert format_amount(value) == shown
