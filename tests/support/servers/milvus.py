"""A real Milvus for tests: the standalone server from the wheel, which has an etcd in it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.request import urlopen

import milvus

from tests.support.servers.daemon import Daemon, free_ports, new_folder

ETCD = """\
name: default
listen-client-urls: http://localhost:{client}
advertise-client-urls: http://localhost:{client}
listen-peer-urls: http://localhost:{peer}
initial-advertise-peer-urls: http://localhost:{peer}
initial-cluster: default=http://localhost:{peer}
"""


@dataclass(frozen=True, slots=True)
class MilvusServer:
    """A server of its own, with all its data in `data`."""

    url: str
    process: Daemon
    data: Path

    def supervise(self) -> None:
        """Start it again if its health check fails: it stays so when its lease in etcd ran out."""
        if not self.process.answers():
            self.process.kill()
            self.process.start()

    def lose_everything(self) -> None:
        """Start it again without its data."""
        self.process.kill()
        shutil.rmtree(self.data)
        self.data.mkdir()
        self.process.start()


@contextmanager
def start_milvus() -> Iterator[MilvusServer]:
    folder = new_folder("milvus")
    config = milvus.MilvusServerConfig(data_dir=str(folder))
    names = [name for name in config.configurable_items if name.endswith("_port")]
    ports = free_ports(len(names) + 3)
    health, client, peer = ports[-3:]
    config.update(**dict(zip(names, ports, strict=False)) | {"etcd_port": client})
    config.resolve()
    milvus._initialize_data_files(str(folder))
    (folder / "configs" / "etcd.yaml").write_text(ETCD.format(client=client, peer=peer))
    variables = {
        "LD_LIBRARY_PATH": folder / "bin",
        "DEPLOY_MODE": "STANDALONE",
        "METRICS_PORT": health,
        "ETCD_CONFIG_PATH": folder / "configs" / "etcd.yaml",
    }
    command = ["env", *(f"{k}={v}" for k, v in variables.items()), str(folder / "bin" / "milvus")]

    def answers() -> bool:
        try:
            with urlopen(f"http://127.0.0.1:{health}/healthz", timeout=2) as answer:
                return b"OK" in answer.read()
        except OSError:
            return False

    process = Daemon("Milvus", [*command, "run", "standalone"], folder, answers)
    try:
        process.start()
        port = ports[names.index("proxy_port")]
        yield MilvusServer(f"http://127.0.0.1:{port}", process, folder / "data")
    finally:
        process.close()
