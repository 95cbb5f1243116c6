"""Capacity planning: machines, storage and cost of a map of a given size.

`inputs` are the assumptions, each with its source; `plan` derives the numbers; `limits` gives the
size at which a part of the design fails; `replacements` lists alternatives; `this_machine` measures
inputs on this machine; `pages` formats the result.
"""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.report import Report
from benchmarks.scale.inputs import Inputs
from benchmarks.scale.pages import Sizing
from benchmarks.scale.this_machine import measure

__all__ = ["Inputs", "Sizing", "measure", "size_up"]


def size_up(given: Sequence[str], measured: Report | None = None) -> Sizing:
    """Compute the sizing from default inputs, measured values, and `NAME=VALUE` overrides.

    Raises:
        Misconfigured: `unknown_input`.
    """
    found = {figure.what: figure.measured for figure in measured.figures} if measured else {}
    return Sizing(Inputs().with_values(found).with_values(Inputs.parse(given)))
