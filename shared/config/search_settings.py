"""Settings of search: catalog sync, memory budget, shards, ranking, location estimates."""

from __future__ import annotations

import math
import re

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings

from shared.config.shards import Shard
from shared.config.values import Size, split_list


class SearchSettings(BaseSettings):
    """How search workers follow the catalog, share the rows among them and rank results."""

    estimate_radii_m: str = Field(
        "25,100,500,2000",
        description="radii of the levels of an estimate by coordinates, metres, separated by "
        "commas; photos within the first one show the same place",
    )
    certainty: float = Field(
        0.95,
        gt=0,
        le=1,
        description="share of the answers that must be right, unless a search has `certainty`",
    )
    search_memory_budget: Size | None = Field(
        None,
        ge=0,
        description="bytes of codes and rows that search keeps in memory; unset: half of the "
        "machine's memory, or of the container's memory limit",
    )

    # Search workers on several machines (`placewise search`, which listens on HOST and PORT).
    search_shard: str = Field(
        "0/1", description="shard of this search worker: 1/3 is the second of three shards"
    )
    search_urls: str | None = Field(
        None,
        description="URLs of all search workers, separated by commas; unset: search runs in this "
        "process",
    )

    @field_validator("estimate_radii_m")
    @classmethod
    def _check_radii(cls, value: str) -> str:
        try:
            radii = [float(radius) for radius in split_list(value)]
        except ValueError:
            radii = []
        if not radii or not all(0 < radius < math.inf for radius in radii):
            raise ValueError(f"{value!r} is not a list of radii in metres, such as 25,100,500")
        return value

    @field_validator("search_shard")
    @classmethod
    def _check_shard(cls, value: str) -> str:
        return str(Shard.parse(value))

    @field_validator("search_urls")
    @classmethod
    def _check_urls(cls, value: str | None) -> str | None:
        for url in split_list(value):
            if not re.fullmatch(r"https?://[^\s/?#]+/?", url):
                raise ValueError(
                    f"{url!r} is not a URL such as http://search-0:8000; separate several URLs by "
                    "commas"
                )
        return value

    @property
    def level_radii_m(self) -> tuple[float, ...]:
        """The radii of the levels of an estimate in metres, ascending."""
        return tuple(sorted({float(radius) for radius in split_list(self.estimate_radii_m)}))

    @property
    def estimate_radius_m(self) -> float:
        """Distance to the true position within which an estimate counts as correct, in metres."""
        return self.level_radii_m[0]

    @property
    def shard(self) -> Shard:
        """The shard that this process's search worker holds."""
        return Shard.parse(self.search_shard)

    @property
    def search_worker_urls(self) -> tuple[str, ...]:
        """The search workers' URLs without duplicates; () when search runs in this process."""
        return tuple(dict.fromkeys(url.rstrip("/") for url in split_list(self.search_urls)))
