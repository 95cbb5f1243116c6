"""One Markdown table of the JSON results in a folder.

    python -m lab.benchmarks.results_table FOLDER

A measurement without a result has a file `.err` instead; its last line is shown.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path


def table_lines(folder: Path) -> Iterator[str]:
    """Yield the lines of the table, in the order of the file names."""
    yield "| measurement | what | value | target | load |"
    yield "|---|---|---|---|---|"
    for file in sorted([*folder.glob("*.json"), *folder.glob("*.err")]):
        if file.suffix == ".err":
            reason = (file.read_text().strip().splitlines() or ["no result"])[-1]
            yield f"| {file.stem} | **not measured**: {reason} | | | |"
            continue
        report = json.loads(file.read_text())
        for figure in report["figures"]:
            target = (figure["target"] or "") + (", missed" if figure["missed"] else "")
            yield (
                f"| {file.stem}: {report['title']} | {figure['what']} "
                f"| {figure['measured']:.4g} {figure['unit']} | {target} "
                f"| {figure['load_average']:.1f} |"
            )


if __name__ == "__main__":
    print("\n".join(table_lines(Path(sys.argv[1]))))
