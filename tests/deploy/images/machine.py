"""The services of docker-compose.yml as processes of this machine, on the ports that are free.

A service's command, environment and health check are taken from the file as they stand, and it runs
in the environment of its image. Only where things are is exchanged: a service's host and port, and
the folders that are its own in a container.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from tests.deploy.composition import Json, seconds
from tests.deploy.images.image import Image
from tests.support.servers.daemon import free_ports
from tests.support.servers.programs import find_redis, find_weed

START_SECONDS = 240.0  # seconds of work for each, of which a busy machine makes minutes
LOOK_SECONDS = 1.0  # each look is a process
WEED_PORTS = ("master.port", "volume.port", "filer.port")
# What the images of others bring along.
WGET = """#!{python}
import sys, urllib.request
target, url = sys.argv[-2:]
data = urllib.request.urlopen(url, timeout=5).read()
target == "-" and sys.stdout.buffer.write(data)
"""


class Machine:
    """`start` a service, ask for its health, `stop` it as an orchestrator would."""

    def __init__(
        self,
        root: Path,
        services: Mapping[str, Json],
        image: Callable[[str], Image],
        places: Mapping[str, str],
    ) -> None:
        """`places` says where servers of others are: {"postgres:5432": "127.0.0.1:18123"}."""
        self.root = root
        self._services = services
        self._image = image
        self._ports = dict(zip(services, free_ports(len(services)), strict=True))
        self._places = dict(places)
        for name in services:
            for inside in ("8000", "6379", "8333", "5555"):
                self._places.setdefault(f"{name}:{inside}", f"127.0.0.1:{self._ports[name]}")
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._programs = root / "bin"
        self._programs.mkdir(parents=True)
        self._install()

    def port(self, service: str) -> int:
        return self._ports[service]

    def url(self, service: str) -> str:
        return f"http://127.0.0.1:{self.port(service)}"

    def run_once(self, service: str, **changed: str) -> int:
        """The exit code of a service that ends by itself."""
        self.start(service, **changed)
        return self._running.pop(service).wait(timeout=START_SECONDS)

    def start(self, service: str, **changed: str) -> None:
        """`changed` are variables that are to be other than the file says."""
        of = self._services[service]
        command = [*(of.get("entrypoint") or []), *(of["command"] or [])]
        with self._log(service).open("ab") as log:
            self._running[service] = subprocess.Popen(
                [self._here(service, part) for part in command],
                env={**self._environment(service), **changed},
                cwd=self.folder(service),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def is_healthy(self, service: str) -> bool:
        """What the service's own check says; one that takes too long has failed."""
        check = self._services[service]["healthcheck"]
        kind, *test = check["test"]
        command = test if kind == "CMD" else ["sh", "-c", *test]
        try:
            done = subprocess.run(
                [self._here(service, part) for part in command],
                env=self._environment(service),
                cwd=self.folder(service),
                capture_output=True,
                timeout=seconds(check["timeout"]),
                check=False,
            )
        except subprocess.TimeoutExpired:
            return False
        return done.returncode == 0

    def wait_until_healthy(self, *services: str) -> None:
        deadline = time.monotonic() + START_SECONDS
        for service in services:
            while not self.is_healthy(service):
                self.check_running()
                assert time.monotonic() < deadline, f"{service}: {self.log(service)}"
                time.sleep(LOOK_SECONDS)

    def folder(self, service: str) -> Path:
        """Its /tmp and /data."""
        folder = self.root / service
        folder.mkdir(exist_ok=True)
        return folder

    def stop(self, service: str) -> int:
        """The stop signal; the exit code. What its threads do is in the log if it does not end."""
        of = self._services[service]
        process = self._running[service]
        process.send_signal(signal.Signals[of.get("stop_signal", "SIGTERM")])
        try:
            process.wait(timeout=seconds(of["stop_grace_period"]))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT)
            process.wait(timeout=LOOK_SECONDS * 10)
            pytest.fail(f"{service} does not end: {self.log(service)}")
        del self._running[service]
        return process.returncode

    def send_signal(self, service: str, sig: signal.Signals) -> None:
        self._running[service].send_signal(sig)

    def kill(self, service: str) -> None:
        """SIGKILL, to its children as well: so does the end of a container."""
        process = self._running.pop(service)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def check_running(self) -> None:
        """Fail if a service that was started has ended."""
        for service, process in self._running.items():
            assert process.poll() is None, f"{service} ended: {self.log(service)}"

    def log(self, service: str) -> str:
        return self._log(service).read_text(errors="replace")[-8000:]

    def close(self) -> None:
        for process in self._running.values():
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with its children
        for process in self._running.values():
            process.wait()

    def _here(self, service: str, text: str) -> str:
        """A command's part or a variable's value, with this machine's places in it."""
        for inside, here in self._places.items():
            text = re.sub(rf"(?<![\w.-]){re.escape(inside)}(?!\d)", here, text)
        own = self._ports[service]
        text = re.sub(r"127\.0\.0\.1:(8000|8333|5555)(?!\d)", f"127.0.0.1:{own}", text)
        text = text.replace("127.0.0.1:9333", f"127.0.0.1:{self._weed['master.port']}")
        return re.sub(r"(?<![\w.])/(tmp|data)\b", str(self.folder(service)), text)

    def _environment(self, service: str) -> dict[str, str]:
        folder, of = self.folder(service), self._services[service]
        if "build" in of:
            image = self._image(of["build"]["args"]["SERVICE"])
            base = image.environment(folder, self._programs)
            base["http_proxy"] = "http://127.0.0.1:1"  # Docker may give its proxies to containers
        else:
            base = {"PATH": f"{self._programs}:{os.environ['PATH']}", "HOME": str(folder)}
        reported = of.get("environment") or {}
        read = {name: self._here(service, value) for name, value in reported.items()}
        for port in ("PORT", "FLOWER_PORT"):
            if port in read:
                read[port] = str(self._ports[service])
        if "METRICS_PORT" in read:
            read["METRICS_PORT"] = "0"  # of all of them on one machine
        return {**base, **read, "PYTHONFAULTHANDLER": "1"}  # SIGABRT writes the stacks

    def _log(self, service: str) -> Path:
        return self.root / f"{service}.log"

    def _install(self) -> None:
        """The programs of the other images, which listen on their images' ports."""
        redis, weed = find_redis(), find_weed()
        assert redis is not None, "no redis-server: make setup"
        assert weed is not None, "no weed: make setup"
        flags = [flag for name in WEED_PORTS for flag in (name, f"{name}.grpc")]
        self._weed = dict(zip(flags, free_ports(len(flags)), strict=True))
        ports = " ".join(f"-{flag}={port}" for flag, port in self._weed.items())
        grpc = free_ports(1)[0]
        mine = f"-s3.port={self._ports['objects']} -s3.port.grpc={grpc}"
        small = "-master.volumeSizeLimitMB=64 -volume.max=100"
        port = self._ports["redis"]
        self._program("redis-server", f'exec {redis} "$@" --port {port} --bind 127.0.0.1')
        self._program("redis-cli", f'exec {redis.with_name("redis-cli")} -p {port} "$@"')
        self._program("weed", f'exec {weed} "$@" {ports} {mine} {small}')
        self._program("wget", WGET.format(python=sys.executable), interpreter="")

    def _program(self, name: str, text: str, interpreter: str = "#!/bin/sh\n") -> None:
        file = self._programs / name
        file.write_text(interpreter + text + "\n")
        file.chmod(0o755)
