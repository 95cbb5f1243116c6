"""A real `placewise serve` in a process of its own, which tests may kill."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import httpx2
import psutil

from shared.config.embedded_home import server_address_file
from tests.support.processes import INHERITED, PLACEWISE, Process, start

SERVICES_KEY = "the-admin-key-of-the-tests"  # separate services want one, on loopback too
START_SECONDS = 150.0  # seconds of work, of which a busy machine makes minutes
COMMAND_SECONDS = 120.0


def environment(home: Path, **settings: Any) -> dict[str, str]:
    """For a process on `home`: the tiny extractor, and none of the developer's own settings."""
    return {
        **INHERITED,
        "PLACEWISE_HOME": str(home),
        "HOST": "127.0.0.1",
        "PORT": "0",
        "EXTRACTOR": "test-tiny-avg",
        "ALLOW_TEST_EXTRACTORS": "true",
        "DECODE_PROCESSES": "1",
        **{name.upper(): str(value) for name, value in settings.items()},
    }


def run_command(
    *arguments: str | Path,
    env: Mapping[str, str],
    cwd: Path,
    executed: bool = False,
    seconds: float = COMMAND_SECONDS,
) -> subprocess.CompletedProcess[str]:
    """`placewise ARGUMENTS` to its end. `cwd` should have no `.env`; `executed` as for `start`."""
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        process = start(
            [PLACEWISE, *arguments], env=env, cwd=cwd, stdout=out, stderr=err, executed=executed
        )
        try:
            code = process.wait(seconds)
        finally:
            process.kill()
            process.wait()
        out.seek(0)
        err.seek(0)
        return subprocess.CompletedProcess(arguments, code, out.read(), err.read())


@dataclass(slots=True)
class Run:
    """A finished command."""

    process: subprocess.CompletedProcess[str]

    @property
    def code(self) -> int:
        return self.process.returncode

    @property
    def stdout(self) -> str:
        return self.process.stdout

    @property
    def stderr(self) -> str:
        return self.process.stderr

    def json(self, code: int = 0) -> Any:
        """The answer of a command run with --json: all of stdout."""
        assert self.code == code, self.stderr + self.stdout
        assert "Traceback" not in self.stderr
        return json.loads(self.stdout)

    def refusal(self, code: str) -> str:
        """The `detail` of a problem printed with --json."""
        body = self.json(1)
        assert body["code"] == code, body
        assert body["type"] == f"urn:placewise:problem:{code}"
        assert set(body) >= {"title", "status", "detail"}
        detail: str = body["detail"]
        return detail


class CommandLine:
    """Runs `placewise` in a folder, with the PLACEWISE_HOME of a server or of none."""

    def __init__(self, folder: Path, home: Path, **settings: Any) -> None:
        self.folder = folder
        self.environment = environment(home, **settings)
        self.seconds = COMMAND_SECONDS

    def __call__(self, *arguments: str | Path) -> Run:
        return Run(
            run_command(*arguments, env=self.environment, cwd=self.folder, seconds=self.seconds)
        )


class ServerProcess:
    """Starts on a free port; `client` speaks to it. Settings come from keyword arguments.

    Where the server wants a key, `client` sends the one that it leaves for its own user.
    """

    def __init__(self, home: Path, **settings: Any) -> None:
        self.home = home
        self._environment = environment(home, **settings)
        self.log_path = home.with_name(home.name + ".log")
        self._process: Process | None = None
        self.client = httpx2.Client(timeout=60)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()
        self.kill()

    @property
    def process(self) -> Process:
        assert self._process is not None, "the server was not started"
        return self._process

    def start(self, *options: str) -> None:
        """Start and wait until it answers; `options` are those of `placewise serve`."""
        server_address_file(self.home).unlink(missing_ok=True)
        with self.log_path.open("ab") as log:
            self._process = start(
                [PLACEWISE, "serve", *options],
                env=self._environment,
                cwd=self.home.parent,  # the repository may hold a developer's .env
                stdout=log,
                stderr=log,
            )
        deadline = time.monotonic() + START_SECONDS
        while time.monotonic() < deadline:
            if self._process.poll() is not None:
                raise AssertionError(f"the server ended: {self.log()}")
            reported = self._announced()
            if reported is not None:
                self.client.close()
                self.client = httpx2.Client(
                    base_url=reported["url"],
                    headers={"Authorization": f"Bearer {reported['key']}"}
                    if "key" in reported
                    else None,
                    timeout=90,
                    event_hooks={"response": [self._check_discreet]},
                )
                try:
                    if self.client.get("/livez").is_success:
                        return
                except httpx2.TransportError:
                    pass
            time.sleep(0.05)
        raise AssertionError(f"the server did not answer in {START_SECONDS} s: {self.log()}")

    def _check_discreet(self, answer: httpx2.Response) -> None:
        """No answer says where the server keeps its files, or how its code looks."""
        answer.read()
        for secret in (str(self.home).encode(), b"Traceback"):
            assert secret not in answer.content, f"{answer.request.url} tells of {secret!r}"

    def _announced(self) -> dict[str, str] | None:
        try:
            body: dict[str, str] = json.loads(server_address_file(self.home).read_text())
        except (FileNotFoundError, ValueError):
            return None
        return body

    def kill(self) -> None:
        """SIGKILL: nothing can be tidied up."""
        if self._process is not None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()

    def stop(self) -> int:
        """SIGTERM; the exit code."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=30)

    @contextlib.contextmanager
    def no_decoding(self) -> Iterator[None]:
        """While the block runs no photo is decoded, so that what needs one stays under way."""
        (extractor,) = psutil.Process(self.process.pid).children()
        decoders = extractor.children()
        assert decoders, "they start with the first photo: index one before"
        for decoder in decoders:
            decoder.suspend()
        try:
            yield
        finally:
            for decoder in decoders:
                decoder.resume()

    def log(self) -> str:
        return self.log_path.read_text(errors="replace")[-5000:]

    # What most tests do over HTTP.

    def upload(
        self, data: bytes, name: str = "photo.jpg", map_name: str = "default", **fields: Any
    ) -> httpx2.Response:
        form = {key: str(value) for key, value in fields.items()}
        params, files = {"map": map_name}, {"file": (name, data)}
        return self.client.post("/api/v1/upload", params=params, files=files, data=form)

    def indexed(
        self, data: bytes, name: str = "photo.jpg", map_name: str = "default", **fields: Any
    ) -> str:
        """Upload and wait until it is searchable; the photo's id."""
        answer = self.upload(data, name, map_name, **fields)
        assert answer.status_code in (200, 202), answer.text
        job = self.finished(answer.json()["job_id"], map=map_name)
        assert job["state"] == "succeeded", job
        file_id: str = answer.json()["file_id"]
        return file_id

    def finished(self, job_id: str, seconds: float = 60, **params: Any) -> dict[str, Any]:
        """The job once it has ended; `params` may name its map."""
        deadline = time.monotonic() + seconds
        while True:
            job: dict[str, Any] = self.client.get(
                f"/api/v1/jobs/{job_id}", params={"wait": 5, **params}
            ).json()
            if job["state"] in ("succeeded", "failed", "cancelled"):
                return job
            if time.monotonic() > deadline:
                raise AssertionError(f"the job did not end in {seconds} s: {job}\n{self.log()}")

    def similar(self, file_id: str, **params: Any) -> httpx2.Response:
        return self.client.post(f"/api/v1/similarity/{file_id}", params=params)

    def ask(self, data: bytes, wait: int = 30, **params: Any) -> httpx2.Response:
        return self.client.post(
            "/api/v1/similarity",
            files={"file": ("query.jpg", data)},
            params=params,
            headers={"Prefer": f"wait={wait}"},
        )
