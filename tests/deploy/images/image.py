"""An image's environment, built by the lines of deploy/Dockerfile in a folder of its own.

No container engine is needed: the instructions of the build stage are executed as they stand, on
the files that .dockerignore lets through, with the image's root in the folder. Only how packages
are installed differs: from uv's cache and as hard links, without compiling them.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from docker.utils.build import exclude_paths

from tests.deploy.composition import ROOT
from tests.support.processes import INHERITED

INSTALLED_OTHERWISE = ("UV_COMPILE_BYTECODE", "UV_LINK_MODE", "UV_NO_CACHE")
BUILD_SECONDS = 600.0


@dataclass(frozen=True, slots=True)
class Image:
    """What a build leaves: a root folder, and what ENV says in the final stage."""

    root: Path
    variables: Mapping[str, str]

    @property
    def python(self) -> Path:
        return self.root / "opt/placewise/bin/python"

    def environment(self, data: Path, programs: Path = Path("/usr/bin")) -> dict[str, str]:
        """The variables of a process of the image: /data is `data`, the system's programs too.

        Bytecode is cached beside the image, because the build has not compiled the packages.
        """
        values = dict(self.variables)
        for inside, here in (
            ("/data", data),
            ("/opt/placewise", self.root / "opt/placewise"),
            ("$PATH", f"{programs}:/usr/local/bin:/usr/bin:/bin"),
        ):
            values = {name: text.replace(inside, str(here)) for name, text in values.items()}
        del values["PYTHONDONTWRITEBYTECODE"]
        return {**values, "HOME": str(data), "PYTHONPYCACHEPREFIX": f"{self.root}/bytecode"}

    def packages(self) -> set[str]:
        """The names of the installed distributions, normalised."""
        code = (
            "from importlib.metadata import distributions; "
            "print(*(d.metadata['Name'] for d in distributions()))"
        )
        found = subprocess.run(
            [self.python, "-I", "-c", code], check=True, capture_output=True, text=True
        )
        return {re.sub(r"[-_.]+", "-", name).lower() for name in found.stdout.split()}


class Builder:
    """Builds images below a folder, on one build context and one Python of the base image."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._context = folder / "context"
        copy_build_context(self._context)
        self._build, self._final = stages(self._context / "deploy/Dockerfile")
        self._python = base_python(self._build[0][1])
        # In place of the base image's programs, among which is pip.
        subprocess.run([self._python, "-m", "venv", folder / "base"], check=True)

    def build(self, service: str) -> Image:
        """Execute the build stage with SERVICE; TORCH_INDEX is empty, as by default."""
        root = folder = self._folder / service
        root.mkdir()
        given = {"SERVICE": service, "TORCH_INDEX": ""}
        variables = {
            **{name: value for name, value in INHERITED.items() if not name.startswith("PYTHON")},
            # uv makes its environment from the first Python that is none itself.
            "PATH": f"{self._folder}/base/bin:{self._python.parent}:/usr/local/bin:/usr/bin:/bin",
        }
        for name, value in self._build[1:]:
            match name:
                case "ENV":
                    variables |= _in_root(root, value)
                    for other in INSTALLED_OTHERWISE:
                        variables.pop(other, None)
                case "ARG":
                    argument, _, default = value.partition("=")
                    variables[argument] = given.get(argument, default.strip('"'))
                case "WORKDIR":
                    folder = root / value.lstrip("/")
                    folder.mkdir(parents=True)
                case "COPY":
                    _copy(self._context, folder, value)
                case "RUN":
                    done = subprocess.run(
                        ["sh", "-c", value],
                        cwd=folder,
                        env=variables,
                        capture_output=True,
                        text=True,
                        timeout=BUILD_SECONDS,
                        check=False,
                    )
                    assert done.returncode == 0, f"{service}: {value}\n{done.stderr[-3000:]}"
                case _:
                    raise AssertionError(f"deploy/Dockerfile has {name}, which this does not know")
        said = " ".join(value for name, value in self._final if name == "ENV")
        return Image(root, dict(_settings(said)))


def copy_build_context(target: Path) -> None:
    """Copy the files that .dockerignore lets through, as `docker build` sends them."""
    patterns = (ROOT / ".dockerignore").read_text().split()
    for name in exclude_paths(ROOT, patterns, dockerfile="deploy/Dockerfile"):
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, target / name)


def stages(dockerfile: Path) -> list[list[tuple[str, str]]]:
    """The instructions of each stage, each as its name and the rest of its line."""
    text = re.sub(r"(?m)^#.*\n", "", dockerfile.read_text()).replace("\\\n", "")
    found: list[list[tuple[str, str]]] = []
    for line in filter(None, map(str.strip, text.splitlines())):
        name, _, value = line.partition(" ")
        if name == "FROM":
            found.append([])
        found[-1].append((name, value.strip()))
    return found


def base_python(base: str) -> Path:
    """The Python of the base image's minor release if this machine has one, else the tests' own."""
    release = re.match(r"python:(\d+\.\d+)", base)
    assert release, f"deploy/Dockerfile is not FROM a Python: {base}"
    code = "import sys; print(sys._base_executable)"
    for name in (f"python{release[1]}", sys.executable):
        program = shutil.which(name, path=INHERITED["PATH"])
        if program is not None:
            done = subprocess.run(
                [program, "-c", code], capture_output=True, text=True, check=False
            )
            if done.returncode == 0:  # pyenv has programs for releases that are not installed
                return Path(done.stdout.strip())
    raise AssertionError(f"{sys.executable} does not run")


def _copy(context: Path, folder: Path, value: str) -> None:
    *sources, target = value.split()
    for source in sources:
        if (context / source).is_dir():  # COPY copies what is in a folder, not the folder
            shutil.copytree(context / source, folder / target, dirs_exist_ok=True)
        else:
            shutil.copy(context / source, folder / target)


def _in_root(root: Path, value: str) -> dict[str, str]:
    return {name: re.sub("^/", f"{root}/", text) for name, text in _settings(value)}


def _settings(value: str) -> Iterator[tuple[str, str]]:
    for word in shlex.split(value):
        name, _, text = word.partition("=")
        yield name, text
