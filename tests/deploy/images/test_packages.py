"""What is installed in each image: all that its service imports, and no more than that."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.deploy.composition import ROOT
from tests.deploy.images.conftest import BuildImage
from tests.deploy.images.image import Image

# kombu imports it when it first connects.
BROKER = "kombu.transport.redis"
MODULES = {
    "embedded": ["services.standalone", "services.extractor.worker"],
    "extractor": ["services.extractor.service", BROKER],
    "flower": ["flower.command", BROKER],
    "gateway": ["services.gateway.service", BROKER],
    "search": ["services.search.service"],
    "steward": ["services.steward.service", BROKER],
}
# What the command imports, whatever service it runs; some of it at its first use.
COMMAND = [
    "services.cli.main",
    "services.cli.operations.installation_checks",
    "services.cli.operations.storage",
    "shared.catalog.installation",
    "shared.telemetry.heartbeat",
    "alembic.command",
    "opentelemetry.exporter.otlp.proto.http.trace_exporter",
    "shared.catalog.database.postgres",
    "shared.storage.s3",
]
LAB_COMMAND = "import sys; sys.argv = ['placewise', 'train', '--help']; main()"
LOAD_XFEAT = """
import torch
from shared.matching.xfeat import load_detector
print(load_detector(torch.device("cpu")).model)
"""
IMPORT = """
import importlib, sys
for module in sys.argv[1:]:
    importlib.import_module(module)
if "services.cli.main" in sys.argv:
    sys.modules["services.cli.main"].build_app()
"""
pytestmark = pytest.mark.timeout(1200)  # with the builds, on a busy machine


@pytest.mark.parametrize("service", MODULES)
def test_an_image_holds_what_its_service_and_the_command_import(
    service: str, image: BuildImage, tmp_path: Path
) -> None:
    command = [] if service == "flower" else COMMAND  # it runs Celery's
    run_python(image(service), tmp_path, IMPORT, *MODULES[service], *command)


@pytest.mark.parametrize("package", ["torch", "pillow-heif"])
def test_only_the_images_that_describe_photos_hold_what_decodes_and_describes(
    package: str, image: BuildImage
) -> None:
    holding = {service for service in MODULES if package in image(service).packages()}
    assert holding == {"embedded", "extractor"}


@pytest.mark.parametrize("service", ["embedded", "extractor"])
def test_images_that_describe_photos_load_xfeat_and_nothing_that_its_package_requires(
    service: str, image: BuildImage, tmp_path: Path
) -> None:
    required = {"gdown", "matplotlib", "opencv-python", "opencv-python-headless"}
    assert not image(service).packages() & required
    assert run_python(image(service), tmp_path, LOAD_XFEAT).startswith("xfeat@")


def run_python(image: Image, home: Path, *code: str, exits: int = 0) -> str:
    """What the program writes, run with these arguments in the environment of an image."""
    done = subprocess.run(
        [image.python, "-c", *code],
        cwd=home,
        env=image.environment(home),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == exits, done.stderr[-1500:]
    return done.stdout + done.stderr


def test_no_image_holds_a_tool_of_the_developers(image: BuildImage) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = [re.split(r"[^\w.-]", line)[0] for line in project["optional-dependencies"]["dev"]]
    tools = set(names) - {"placewise", "pyyaml"}  # which huggingface-hub needs, too
    assert {"pytest", "moto"} <= tools
    for service in MODULES:
        assert not image(service).packages() & tools, service


def test_an_image_holds_no_lab_and_its_commands_say_so(image: BuildImage, tmp_path: Path) -> None:
    """Of one image: the context of all builds has no lab."""
    code = f"from services.cli import main; {LAB_COMMAND}"
    said = run_python(image("gateway"), tmp_path, code, exits=1)
    assert "lab_missing: `placewise train` is part of the lab" in " ".join(said.split())


@pytest.mark.parametrize("python", ["3.12", "3.13", "3.14"])
def test_a_later_python_finds_all_packages(python: str, tmp_path: Path) -> None:
    """As `make setup` installs them, on Linux with an x86-64 processor."""
    uv = str(Path(sys.executable).with_name("uv"))
    where = ("--python-platform", "x86_64-manylinux_2_34", "--python-version", python)
    packages = ("--constraint", "requirements.lock", "--requirement", "pyproject.toml")
    install = ("pip", "install", "--dry-run", "--all-extras", "--target", tmp_path)
    done = subprocess.run(
        [uv, *install, *where, *packages], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-1500:]
