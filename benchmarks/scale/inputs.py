"""Inputs of the capacity planning. Override one with `--set NAME=VALUE`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal, Self

from shared.errors import Misconfigured

HERE = "`placewise bench scale --measure`, two cores with other work on them, 2026-11-21"
CHANGE = "PostgreSQL, 69,000 photos of one map, all in memory, two cores, 2026-11-21"
CATALOG = "`placewise bench catalog`, a million photos, two cores, 2026-11-21"


def _measured(value: float, unit: str, where: str) -> Any:
    return field(default=value, metadata={"unit": unit, "kind": "measured", "source": where})


def _assumed(value: float, unit: str, why: str) -> Any:
    return field(default=value, metadata={"unit": unit, "kind": "assumed", "source": why})


def _built(value: float, unit: str, where: str) -> Any:
    return field(default=value, metadata={"unit": unit, "kind": "by design", "source": where})


@dataclass(frozen=True, slots=True)
class Input:
    """An input as it is displayed."""

    name: str
    value: float
    unit: str
    kind: Literal["measured", "assumed", "by design"]
    source: str


@dataclass(frozen=True, slots=True)
class Inputs:
    """All inputs. Byte units are decimal (1 GB is 10^9 bytes); names contain the unit."""

    # Photos.
    photo_bytes: float = _assumed(500_000, "B", "an original of about two megapixels")
    thumbnail_bytes: float = _measured(
        12_000, "B", "40 drawn photos as `shared/imaging/decode.py` shrinks them, 2026-11-21"
    )
    new_share_a_month: float = _assumed(0.02, "", "of the photos; they replace nothing")
    fill_days: float = _assumed(7, "days", "in which all photos are described at first")
    queries_per_second: float = _assumed(1, "/s", "all of them with a new photo")

    # Describing.
    pipeline_cpu_seconds: float = _measured(
        0.028, "s", "a photo, all services, without the model: `placewise bench pipeline`"
    )
    gpu_photos_per_second_7168: float = _assumed(
        1000, "/s", "not measured: EfficientNet-Lite0 on one GPU"
    )
    gpu_photos_per_second_98304: float = _assumed(
        60, "/s", "not measured: 0.5 TFLOP a photo (ViT-g/14 at 224), 30 TFLOP/s reached"
    )
    extractor_vcpus: float = _assumed(16, "", "beside each GPU, to decode")
    gateway_uploads_per_second: float = _measured(
        17.7, "/s", "benchmarks/RESULTS.md: embedded, describing beside it, two cores"
    )

    # Search, as services/search holds and scans rows.
    scan_us_7168: float = _measured(
        2.4, "us", f"a row, one thread, 2.1 to 2.9 in three runs: {HERE}"
    )
    scan_us_98304: float = _measured(30, "us", f"a row, one thread, 23 to 36 in three runs: {HERE}")
    photo_columns_bytes: float = _measured(400, "B", f"beside each row in memory: {HERE}")
    hash_bytes_per_second: float = _measured(1.2e9, "B/s", f"SHA-256 of a chunk: {HERE}")
    chunk_list_us: float = _measured(38, "us", f"a chunk's row read from SQLite: {HERE}")
    generations_held: float = _built(
        2, "", "services/search/catalog_sync.py: the active one, and one that is built beside it"
    )
    search_seconds: float = _assumed(1.0, "s", "longest scan of a shard")
    scans_at_once: float = _assumed(
        4, "", "by one search worker at full speed: memory's bandwidth is the limit"
    )
    replicas: float = _assumed(2, "", "of each shard at least, so that one may die")
    machine_ram_bytes: float = _assumed(256e9, "B", "of one search machine")
    ram_used: float = _assumed(0.8, "", "share of it that descriptors may take")
    store_read_bytes_per_second: float = _assumed(300e6, "B/s", "one connection to the store")
    list_page_seconds: float = _assumed(0.05, "s", "a page of 1,000 keys of the store's list")

    # The catalog.
    photos_row_bytes: float = _measured(1091, "B", f"a photo with its indexes: {CATALOG}")
    jobs_row_bytes: float = _measured(479, "B", f"a job with its indexes: {CATALOG}")
    descriptors_row_bytes: float = _measured(246, "B", f"a descriptor with its indexes: {CATALOG}")
    searches_row_bytes: float = _measured(
        320, "B", f"a search with its indexes (64 a photo, one of five was asked for): {CATALOG}"
    )
    search_history_days: float = _built(90, "days", "SEARCH_HISTORY_DAYS")
    walked_row_us: float = _measured(
        1.8, "us", f"a photo that a model change's statement walks past: {CHANGE}"
    )
    deleted_row_us: float = _measured(4.5, "us", f"a job that one deletes: {CHANGE}")
    catalog_copies: float = _assumed(2, "", "PostgreSQL and one standby")
    catalog_ram_share: float = _assumed(0.15, "", "of its bytes; at least 8 GB")
    catalog_vcpus: float = _assumed(8, "", "of each copy")
    services_vcpus: float = _assumed(8, "", "gateways, steward, Redis")

    # Prices, in any currency; each stands for a year's average, without discounts.
    price_gpu_hour: float = _assumed(3.0, "", "a GPU with the machine around it")
    price_vcpu_hour: float = _assumed(0.03, "", "without memory")
    price_ram_gb_month: float = _assumed(3.0, "", "a GB of a machine's memory")
    price_object_gb_month: float = _assumed(
        0.02, "", "a GB in the object store, its copies included"
    )
    price_disk_gb_month: float = _assumed(0.1, "", "a GB of PostgreSQL's disk")

    def __iter__(self) -> Iterator[Input]:
        values = asdict(self)
        for each in fields(self):
            about = each.metadata
            yield Input(each.name, values[each.name], about["unit"], about["kind"], about["source"])

    def with_values(self, values: Mapping[str, float]) -> Self:
        """Return a copy with other values.

        Raises:
            Misconfigured: `unknown_input`, for an unknown name or a value that is not a positive
                number.
        """
        names = {each.name for each in fields(self)}
        for name, value in values.items():
            if name not in names:
                raise Misconfigured(
                    "unknown_input",
                    f"{name!r} is no input. These are: {', '.join(sorted(names))}.",
                )
            if not (math.isfinite(value) and value > 0):
                raise Misconfigured("unknown_input", f"{name} has to be above 0, not {value:g}.")
        return replace(self, **values)

    @staticmethod
    def parse(given: Sequence[str]) -> dict[str, float]:
        """Parse `NAME=VALUE` texts.

        Raises:
            Misconfigured: `unknown_input`.
        """
        found = {}
        for text in given:
            name, _, value = text.partition("=")
            try:
                found[name.strip()] = float(value)
            except ValueError:
                raise Misconfigured(
                    "unknown_input",
                    f"{text!r} is not NAME=VALUE with a number, as price_gpu_hour=2",
                ) from None
        return found


@dataclass(frozen=True, slots=True)
class Width:
    """One of the two extractors that are sized, by its descriptor dimension."""

    dimension: int
    extractor: str
    gpu_photos_per_second: float
    scan_seconds: float
    """For one row, single thread."""

    @classmethod
    def both(cls, inputs: Inputs) -> tuple[Width, Width]:
        return (
            cls(
                7168,
                "efficientnet-lite0-vlad",
                inputs.gpu_photos_per_second_7168,
                inputs.scan_us_7168 / 1e6,
            ),
            cls(
                98_304,
                "anyloc-vitg14",
                inputs.gpu_photos_per_second_98304,
                inputs.scan_us_98304 / 1e6,
            ),
        )
