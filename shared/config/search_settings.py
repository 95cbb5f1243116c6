"""Settings of search: catalog sync, memory budget, engine, ranking, location estimates."""

from __future__ import annotations

import math
import re
from typing import Literal

from pydantic import Field, SecretStr, field_validator
from pydantic_settings import BaseSettings

from shared.config.values import Size, split_list
from shared.errors import Conflict

MAX_MILVUS_DIMENSION = 32_768


class SearchSettings(BaseSettings):
    """What search workers find rows with, and how they rank results."""

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

    search_engine: Literal["placewise", "milvus"] = Field(
        "placewise",
        description="what search workers find rows with: their own memory, or Milvus, for maps "
        "larger than one machine (needs the extra milvus)",
    )
    milvus_uri: SecretStr | None = Field(
        None,
        description="URL of Milvus, with a user or a token if it needs one: "
        "https://user:password@milvus:19530, https://token@milvus:19530; a file name that ends "
        "in .db is opened with milvus-lite",
    )
    milvus_index: Literal["FLAT", "HNSW"] = Field(
        "FLAT",
        description="index of new collections in Milvus: FLAT compares all rows, HNSW only some",
    )

    # Search workers on several machines (`placewise search`, which listens on HOST and PORT).
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

    @field_validator("milvus_uri")
    @classmethod
    def _check_milvus(cls, value: SecretStr | None) -> SecretStr | None:
        uri = value.get_secret_value() if value else "x.db"
        if not uri.endswith(".db") and not re.fullmatch(r"https?://[^\s/?#]+/?", uri):
            raise ValueError("MILVUS_URI is not a URL such as http://milvus:19530")
        return value

    def check_row_length(self, dimension: int | None) -> None:
        """Raise Conflict (`rows_too_long`) for rows that the search engine can't hold."""
        if self.search_engine == "milvus" and (dimension or 0) > MAX_MILVUS_DIMENSION:
            raise Conflict(
                "rows_too_long",
                f"Milvus holds rows of at most {MAX_MILVUS_DIMENSION} numbers, and these have "
                f"{dimension}. Reduce the descriptors by PCA: placewise maps switch NAME --pca "
                "8192, which is possible before Milvus has them.",
                dimension=dimension,
            )

    @property
    def level_radii_m(self) -> tuple[float, ...]:
        """The radii of the levels of an estimate in metres, ascending."""
        return tuple(sorted({float(radius) for radius in split_list(self.estimate_radii_m)}))

    @property
    def estimate_radius_m(self) -> float:
        """Distance to the true position within which an estimate counts as correct, in metres."""
        return self.level_radii_m[0]

    @property
    def search_worker_urls(self) -> tuple[str, ...]:
        """The search workers' URLs without duplicates; () when search runs in this process."""
        return tuple(dict.fromkeys(url.rstrip("/") for url in split_list(self.search_urls)))
