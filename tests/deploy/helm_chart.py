"""The Helm chart as Helm renders it: with each file of `deploy/helm/examples`, offline."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from tests.deploy.composition import ROOT

Json = dict[str, Any]
CHART = ROOT / "deploy" / "helm"
EXAMPLES = tuple(sorted(path.stem for path in (CHART / "examples").glob("*.yaml")))
RELEASE = "placewise"

# In a process of its own: Helm is a Go library, whose threads and signals are no part of the tests.
SCRIPT = """
import json, sys
from helm_python.chart import Chart, lint
from helm_python.errors import HelmError
chart, values, release, out = sys.argv[1], json.loads(sys.argv[2]), sys.argv[3], sys.argv[4]
try:
    files = Chart.load(chart).render(values, name=release, namespace="placewise")
    result = {"files": files, "lint": lint(chart, values, strict=True)}
except HelmError as error:
    result = {"error": str(error)}
with open(out, "w", encoding="utf-8") as file:
    json.dump(result, file)
"""


def run_helm(values: Json, release: str = RELEASE) -> Json:
    """Return `files` (path -> rendered text) and `lint` of the chart, or `error`."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "out.json"
        subprocess.run(
            [sys.executable, "-c", SCRIPT, CHART, json.dumps(values), release, out],
            check=True,
            capture_output=True,
        )
        result: Json = json.loads(out.read_text())
    return result


def example(name: str) -> Json:
    values: Json = yaml.safe_load((CHART / "examples" / f"{name}.yaml").read_text())
    return values


@cache
def helm_of_example(name: str) -> Json:
    return run_helm(example(name))


def parse_manifests(result: Json) -> tuple[Json, ...]:
    """The manifests of all rendered templates, without NOTES.txt.

    Raises:
        AssertionError: Helm refused the chart or its values.
    """
    assert "error" not in result, result["error"]
    texts = [text for path, text in result["files"].items() if path.endswith(".yaml")]
    return tuple(one for text in texts for one in yaml.safe_load_all(text) if one)
