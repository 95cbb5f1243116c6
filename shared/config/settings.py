"""`Settings`: the configuration of every service, read from the environment and `.env`.

The fields are declared in groups, one base class a group, in the modules beside this one. Each
field is an environment variable of the same name in capitals. Names of durations end in
`_seconds`, names of sizes in `_bytes`, except where AnyLoc's name is kept (`MAX_FILE_SIZE`, in
bytes). Sizes may have a unit: `100MB`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Self

from pydantic import model_validator
from pydantic_settings import SettingsConfigDict

from shared.config.extractor_settings import ExtractorSettings
from shared.config.gateway_settings import GatewaySettings
from shared.config.job_settings import JobSettings
from shared.config.search_settings import SearchSettings
from shared.config.service_settings import ServiceSettings
from shared.config.shards import Shard
from shared.config.storage_settings import StorageSettings

CGROUP_MEMORY_LIMIT_FILE = Path("/sys/fs/cgroup/memory.max")


def memory_limit_bytes() -> int:
    """Return the memory that this process may use: the machine's, or the container's limit."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = CGROUP_MEMORY_LIMIT_FILE.read_text().strip()
    except OSError:
        return machine
    return min(machine, int(limit)) if limit.isdigit() else machine  # "max" means no limit


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

    @model_validator(mode="after")
    def _check_batch_fits_slot(self) -> Self:
        if self.batch_photos > self.slot_rows:
            raise ValueError(
                f"BATCH_PHOTOS ({self.batch_photos}) may not exceed SLOT_ROWS ({self.slot_rows}): "
                "a batch becomes one chunk, and a chunk must fit into a slot"
            )
        return self

    def search_cache_folder(self, shard: Shard) -> Path:
        """The folder where the search worker of a shard caches objects of a bucket."""
        return self.placewise_home / "search-cache" / str(shard).replace("/", "-of-")

    @property
    def search_memory_bytes(self) -> int:
        """The memory budget of search in bytes."""
        return (
            memory_limit_bytes() // 2
            if self.search_memory_budget is None
            else self.search_memory_budget
        )
