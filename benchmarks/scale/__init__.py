"""What a map of a given size takes: photos, machines, bytes, money.

`inputs` are the numbers that everything is derived from, each with its source; `plan` derives;
`limits` says at which size a part of the design breaks; `replacements` what would take its place;
`this_machine` measures what a machine can be asked in seconds; `pages` writes it down.
"""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.report import Report
from benchmarks.scale.inputs import Inputs
from benchmarks.scale.pages import Sizing
from benchmarks.scale.this_machine import measure

__all__ = ["Inputs", "Sizing", "measure", "size_up"]


def size_up(given: Sequence[str], measured: Report | None = None) -> Sizing:
    """Everything that the inputs come to: the defaults, in their place what was measured here, in
    its place the `NAME=VALUE` texts of `given`. Misconfigured (`unknown_input`) for what is none.
    """
    found = {figure.what: figure.measured for figure in measured.figures} if measured else {}
    return Sizing(Inputs().with_values(found).with_values(Inputs.parse(given)))
