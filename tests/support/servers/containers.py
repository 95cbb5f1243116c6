"""A server in a container, where a Docker engine answers."""

from __future__ import annotations

import functools
import gc
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tests.support.servers.handle import wait_until

if TYPE_CHECKING:
    from docker.models.containers import Container as Started

START_SECONDS = 180.0  # the first time, its image is fetched
STOP_SECONDS = 60
ASK_SECONDS = 3
OLDEST_API = "1.44"  # explicit, so that creating a client sends no request


@functools.cache
def engine_answers() -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import docker
        from docker.errors import DockerException

        client = docker.DockerClient.from_env(timeout=ASK_SECONDS, version=OLDEST_API)
        try:
            return bool(client.ping())
        except (DockerException, OSError):
            return False
        finally:
            client.close()
            del client
            gc.collect()  # it forgets sockets, and their warnings must not become some test's


@dataclass
class Container:
    """One server. testcontainers removes it when the tests end, however they end."""

    name: str
    image: str
    port: tuple[int, int]
    """Inside, and on this machine: a fixed one, which stays when it is started again."""
    command: Sequence[str]
    answers: Callable[[], bool]
    environment: Mapping[str, str] = field(default_factory=dict)
    _started: Started | None = field(default=None, init=False)
    _close: Callable[[], None] = field(default=lambda: None, init=False)

    def start(self) -> None:
        if self._started is None:
            self._create()
        else:
            self._started.start()
        wait_until(self.answers, START_SECONDS, self._reason_to_give_up, self.name)

    def stop(self) -> None:
        self._container.stop(timeout=STOP_SECONDS)

    def kill(self) -> None:
        self._container.kill()
        self._container.wait()

    def pause(self) -> None:
        self._container.pause()

    def resume(self) -> None:
        self._container.unpause()

    def cpu_seconds(self) -> float:
        used: int = self._container.stats(stream=False)["cpu_stats"]["cpu_usage"]["total_usage"]
        return used / 1e9

    def close(self) -> None:
        self._close()

    @property
    def _container(self) -> Started:
        assert self._started is not None, f"{self.name} does not run"
        return self._started

    def _create(self) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from testcontainers.core.container import DockerContainer

            made = (
                DockerContainer(self.image)
                .with_bind_ports(*self.port)
                .with_command(list(self.command))
                .with_envs(**self.environment)
            )
            made.start()
        self._close = made.stop
        self._started = made.get_wrapped_container()

    def _reason_to_give_up(self) -> str | None:
        self._container.reload()
        if self._container.status in ("created", "running"):
            return None
        reported: bytes = self._container.logs(tail=50)
        return reported.decode(errors="replace")
