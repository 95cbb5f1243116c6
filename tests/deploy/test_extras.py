"""Each service runs with its own extra alone: an image installs no more than that."""

from __future__ import annotations

import functools
import re
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path

import pytest

from tests.support.server import environment

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = {
    "embedded": ["services.standalone", "services.extractor.worker"],
    "extractor": ["services.extractor.service", "tools.make_shipped_vocabulary"],
    "flower": ["flower", "celery"],
    "gateway": ["services.gateway.app", "services.gateway.authentication", "services.http_server"],
    "search": ["services.search.service"],
    "steward": [
        "services.steward.scheduler",
        "services.steward.evaluation_worker",
        "services.steward.webhooks",
    ],
}
# What every image's command imports, whatever service it runs.
COMMAND = [
    "services.cli.main",
    "services.cli.operations.installation_checks",
    "services.cli.operations.maintenance",
    "shared.catalog.installation",
    "shared.telemetry.heartbeat",
    # Imported at their first use.
    "alembic.command",
    "shared.catalog.database.postgres",
    "shared.storage.s3",
]
HINTS = ["shared.jobs.celery_wakeups", "shared.jobs.celery_wakeups"]
NEEDED_BY_HINTS = {"extractor", "gateway", "steward"}

# Refuses what is installed here and would not be in the image.
IMPORT = """
import importlib, sys
refused, modules = set(sys.argv[1].split(",")), sys.argv[2].split(",")
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in refused:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
for module in modules:
    importlib.import_module(module)
if "services.cli.main" in modules:
    sys.modules["services.cli.main"].build_app()
"""


def name_of(requirement: str) -> str:
    """`Psycopg[binary]>=3 ; marker` -> psycopg."""
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert found, requirement
    return re.sub(r"[-_.]+", "-", found[0]).lower()


def requirements(extra: str) -> set[str]:
    """The distributions that an extra names, without what those need."""
    names: set[str] = set()
    for requirement in PROJECT["optional-dependencies"][extra]:
        own = re.match(r"placewise\[(.+)\]", requirement)
        if own is None:
            names.add(name_of(requirement))
            continue
        for other in own[1].split(","):
            names |= requirements(other)
    return names


@functools.cache
def installed_with(extra: str) -> set[str]:
    """Every distribution that would be in the image."""
    found: set[str] = set()
    expected = requirements(extra) | {name_of(line) for line in PROJECT["dependencies"]}
    while expected:
        name = expected.pop()
        if name in found:
            continue
        try:
            lines = requires(name) or []
        except PackageNotFoundError:  # for another platform, or an older Python
            continue
        found.add(name)
        # Optional requirements: none of them is needed to import anything.
        expected |= {name_of(line) for line in lines if "extra ==" not in line}
    return found


@functools.cache
def distributions_of_modules() -> dict[str, set[str]]:
    """The distributions that bring each top-level module; finding them takes seconds."""
    return {
        module: {name_of(name) for name in names}
        for module, names in packages_distributions().items()
    }


@pytest.mark.parametrize("extra", sorted(EXTRAS))
def test_a_service_imports_nothing_that_its_extra_does_not_bring(
    extra: str, tmp_path: Path
) -> None:
    there = installed_with(extra)
    refused = {
        module
        for module, distributions in distributions_of_modules().items()
        if not distributions & (there | {"placewise"})
    }
    assert refused & {"pytest", "moto"}, "the dev packages are in no image"
    modules = [*COMMAND, *EXTRAS[extra], *(HINTS if extra in NEEDED_BY_HINTS else [])]
    if extra == "flower":  # runs Celery's own command
        modules = EXTRAS[extra]
    done = subprocess.run(
        [sys.executable, "-c", IMPORT, ",".join(refused), ",".join(modules)],
        cwd=ROOT,
        env=environment(tmp_path),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-1500:]


def test_only_the_services_that_describe_photos_bring_torch() -> None:
    assert {extra for extra in EXTRAS if "torch" in installed_with(extra)} == {
        "embedded",
        "extractor",
    }


def test_no_service_brings_a_tool_of_the_developers() -> None:
    tools = requirements("dev") - {"pyyaml"}  # which huggingface-hub needs, too
    for extra in EXTRAS:
        assert not installed_with(extra) & tools, extra
