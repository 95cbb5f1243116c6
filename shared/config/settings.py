"""`Settings`: the configuration of every service, read from the environment and `.env`.

The fields are declared in groups, one base class a group, here and in the modules beside this one.
Each field is an environment variable of the same name in capitals. Names of durations end in
`_seconds`, names of sizes in `_bytes`, except where AnyLoc's name is kept (`MAX_FILE_SIZE`, in
bytes). Sizes may have a unit: `100MB`. `SECRET_SETTINGS` may also be read from files.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, SecretStr
from pydantic.fields import FieldInfo
from pydantic_settings import (
    BaseSettings,
    DotEnvSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)

from shared.config.extractor_settings import MAX_DECODE_PROCESSES, ExtractorSettings
from shared.config.gateway_settings import GatewaySettings
from shared.config.search_settings import SearchSettings
from shared.config.storage_settings import StorageSettings
from shared.errors import Misconfigured

# Each may be given as NAME_FILE, too: the path of a file with the value, such as a mounted secret.
SECRET_SETTINGS = (
    "ADMIN_KEY",
    "DATABASE_URL",
    "MILVUS_URI",
    "REDIS_URL",
    "S3_ACCESS_KEY",
    "S3_SECRET_KEY",
)

GPU_BATCH_PHOTOS = 64  # more at once are hardly faster: docs/how-to/throughput.md
CGROUP_MEMORY_LIMIT_FILE = Path("/sys/fs/cgroup/memory.max")
CGROUP_CPU_LIMIT_FILE = Path("/sys/fs/cgroup/cpu.max")  # microseconds in each period of so many


def memory_limit_bytes() -> int:
    """Return the memory that this process may use: the machine's, or the container's limit."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with contextlib.suppress(OSError, ValueError):  # no cgroups; "max" means no limit
        return min(machine, int(CGROUP_MEMORY_LIMIT_FILE.read_text()))
    return machine


def usable_processors() -> int:
    """Return how many processors this process may use: the machine's, or the container's limit."""
    has_affinity = hasattr(os, "sched_getaffinity")  # not macOS
    machine = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):
        limit, period = map(int, CGROUP_CPU_LIMIT_FILE.read_text().split())
        return max(1, min(machine, limit // period))
    return machine


class ServiceSettings(BaseSettings):
    """Listening address, message broker and observability."""

    host: str = Field("127.0.0.1", description="listening address")
    port: int = Field(8000, ge=0, le=65535, description="listening port; 0 picks a free port")
    debug: bool = Field(
        False,
        description="log every request and every rejected request; responses stay the same",
    )
    log_format: Literal["text", "json"] = Field(
        "text", description="log format; json writes one JSON object per line"
    )
    metrics_port: int | None = Field(
        None,
        ge=0,
        le=65535,
        description="port on HOST where a service answers GET /metrics for Prometheus, without a "
        "key; unset: no such port (the gateway and search also serve /metrics beside their API)",
    )
    redis_url: SecretStr | None = Field(
        None,
        description="URL of the Redis that carries job notifications between services; unset: all "
        "services run as one server",
    )
    heartbeat_file: Path | None = Field(
        None,
        description="heartbeat file for health checks, touched regularly by a separate extractor "
        "or steward process; unset: none",
    )


class JobSettings(BaseSettings):
    """Leases and retries of jobs, retention of finished ones, automatic evaluation."""

    lease_seconds: float = Field(
        60.0,
        gt=0,
        description="time without a renewal after which a job's lease expires, seconds",
    )
    search_history_days: float = Field(
        90.0, gt=0, description="retention of a search in the history, days"
    )
    auto_evaluate_photos: int = Field(
        20,
        ge=0,
        description="geotagged photos from which a changed map is evaluated automatically; "
        "0: never",
    )


class SecretFilesSource(PydanticBaseSettingsSource):
    """Reads `SECRET_SETTINGS` from the files that their NAME_FILE variables name."""

    def __init__(self, settings_cls: type[BaseSettings]) -> None:
        super().__init__(settings_cls)
        variables = {**DotEnvSettingsSource(settings_cls).env_vars, **os.environ}
        self._variables = {name.upper(): value for name, value in variables.items()}

    def get_field_value(self, field: FieldInfo, field_name: str) -> tuple[str | None, str, bool]:
        """Return the text of the file of one setting, or None, the variable's name, and False.

        Raises:
            Misconfigured: `bad_setting` if the file is empty or cannot be read, or the setting is
                given twice.
        """
        name = field_name.upper()
        variable = f"{name}_FILE"
        path = self._variables.get(variable)
        if not path:
            return None, variable, False
        if self._variables.get(name):
            raise Misconfigured("bad_setting", f"{name} and {variable} are both set. Unset one")
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "the file is not UTF-8 text"
            raise Misconfigured("bad_setting", f"{variable}={path}: {reason}") from None
        if not text.strip():
            # An empty ADMIN_KEY would leave a server without a key.
            raise Misconfigured("bad_setting", f"{variable}={path}: the file is empty")
        return text.strip(), variable, False

    def __call__(self) -> dict[str, Any]:
        """Return the settings that are in files, by field name."""
        names = [name.lower() for name in SECRET_SETTINGS]
        fields = self.settings_cls.model_fields
        found = {name: self.get_field_value(fields[name], name)[0] for name in names}
        return {name: value for name, value in found.items() if value}


# The fields of the last base come first: pydantic collects them against the order of resolution.
class Settings(
    SearchSettings,
    JobSettings,
    ExtractorSettings,
    StorageSettings,
    GatewaySettings,
    ServiceSettings,
):
    """The settings in force, validated and immutable."""

    model_config = SettingsConfigDict(
        env_file=".env",
        env_ignore_empty=True,  # compose files pass unset variables on as empty ones
        extra="ignore",
        frozen=True,
        validate_default=True,
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Add files with secrets to the sources: arguments, environment, `.env`, files."""
        return (init_settings, env_settings, dotenv_settings, SecretFilesSource(settings_cls))

    def for_device(self, device: str) -> Self:
        """Return the settings of an extractor on `cpu` or `cuda`, which decides what is unset."""
        processors = usable_processors()
        decoders = processors - 2 if device == "cuda" else processors // 4
        decoders = max(decoders, 2) * (1 if self.s3_endpoint is None else 2)
        chosen = {"decode_processes": min(decoders, MAX_DECODE_PROCESSES)}
        if device == "cuda":
            chosen["batch_photos"] = GPU_BATCH_PHOTOS
        unset = chosen.keys() - self.model_fields_set
        return self.model_copy(update={name: chosen[name] for name in unset})

    @property
    def search_cache_folder(self) -> Path:
        """The folder where search workers cache objects of a bucket."""
        return self.placewise_home / "search-cache"

    @property
    def search_memory_bytes(self) -> int:
        """The memory budget of search in bytes."""
        return (
            memory_limit_bytes() // 2
            if self.search_memory_budget is None
            else self.search_memory_budget
        )
