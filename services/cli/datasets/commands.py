"""The group `placewise datasets`."""

from __future__ import annotations

import typer

from services.cli.datasets.audit import audit
from services.cli.datasets.check import check
from services.cli.datasets.ground_truth import ground_truth
from services.cli.datasets.synth import synth

app = typer.Typer(help="Data sets: check one, complete one, or draw one.", no_args_is_help=True)
app.command("check")(check)
app.command("ground-truth")(ground_truth)
app.command("audit")(audit)
app.command("synth")(synth)
