"""What a tag builds and publishes: workflows, versions and the client package."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CLIENT = tomllib.loads((ROOT / "deploy" / "client" / "pyproject.toml").read_text())
HOST = re.compile(r"\b[a-z0-9-]+(\.[a-z0-9-]+)*\.(io|com|org|net|dev)\b")


def jobs(workflow: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(workflow.read_text())["jobs"]
    return found


def steps(workflow: Path) -> list[dict[str, Any]]:
    return [step for job in jobs(workflow).values() for step in job["steps"]]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_a_workflow_is_what_its_schema_allows(workflow: Path) -> None:
    subprocess.run(
        [
            *(sys.executable, "-m", "check_jsonschema"),
            *("--builtin-schema", "vendor.github-workflows", workflow),
        ],
        check=True,
        cwd=ROOT,
    )


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_a_workflow_names_no_registry_and_only_files_that_exist(workflow: Path) -> None:
    assert HOST.search(workflow.read_text()) is None
    for step in steps(workflow):
        if "uses" in step:
            assert re.fullmatch(r"[\w-]+/[\w-]+@v\d+", step["uses"]), step
        named = [
            step.get("with", {}).get("file", ""),
            *re.findall(r"\.ci/\w+", step.get("run", "")),
        ]
        named += re.findall(r"deploy/\w+", step.get("run", ""))
        for path in filter(None, named):
            assert (ROOT / path).exists(), path


def test_every_image_is_built_tested_and_signed_before_it_can_be_used() -> None:
    release = jobs(ROOT / ".github" / "workflows" / "release.yml")
    images = release["images"]
    assert images["needs"] == "test"
    services = {entry["service"] for entry in images["strategy"]["matrix"]["include"]}
    assert services == {"embedded", "extractor", "flower", "gateway", "search", "steward"}
    assert services <= PROJECT["optional-dependencies"].keys()
    [push] = [i for i, step in enumerate(images["steps"]) if step.get("with", {}).get("push")]
    assert any("placewise --version" in step.get("run", "") for step in images["steps"][:push])
    assert "cosign sign" in images["steps"][-1]["run"]
    assert release["client"]["needs"] == "test"


def test_the_chart_is_published_signed_and_names_published_images() -> None:
    chart = jobs(ROOT / ".github" / "workflows" / "release.yml")["chart"]
    assert chart["needs"] == "images"
    commands = " ".join(step.get("run", "") for step in chart["steps"])
    order = [commands.index(f"helm {verb}") for verb in ("package", "lint", "push")]
    assert sorted(order) == order
    assert "cosign sign" in chart["steps"][-1]["run"]


def test_all_files_name_one_version_and_the_changelog_has_it() -> None:
    version = PROJECT["version"]
    assert CLIENT["project"]["version"] == version
    assert f"\n## {version}" in (ROOT / "CHANGELOG.md").read_text()
    chart = yaml.safe_load((ROOT / "deploy" / "helm" / "Chart.yaml").read_text())
    assert (chart["version"], chart["appVersion"]) == (version, version)
    compose = (ROOT / "docker-compose.yml").read_text()
    assert set(re.findall(r"PLACEWISE_VERSION:-([\d.]+)", compose)) == {version}


def test_the_client_package_holds_what_the_client_imports_and_needs() -> None:
    assert set(CLIENT["project"]["dependencies"]) <= set(PROJECT["dependencies"])
    included = CLIENT["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    for source in included:
        assert (ROOT / "deploy" / "client" / source).exists(), source
    script = (
        "import sys, placewise\n"
        "print(*sorted({m for m in sys.modules if m.partition('.')[0] in ('services', 'shared')}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    modules = {target.removesuffix(".py").removesuffix("/__init__") for target in included.values()}
    assert {name.replace(".", "/") for name in done.stdout.split()} <= modules
