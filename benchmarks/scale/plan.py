"""Derives machines, storage and cost from the number of photos and the inputs, with formulas."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from benchmarks.scale.inputs import Inputs, Width
from shared.config.settings import Settings
from shared.storage.chunks import encode_rows

MONTH_HOURS = 730.0
DAY_SECONDS = 86_400.0
MONTH_SECONDS = MONTH_HOURS * 3600
MANIFEST_ROW_BYTES = 40  # a photo's id in the chunk's `.json` manifest
SLOT_ROWS = int(Settings.model_fields["slot_rows"].default)
LEAST_CATALOG_RAM_BYTES = 8e9


@dataclass(frozen=True, slots=True)
class Number:
    """A derived number. `formula` names inputs and earlier numbers."""

    group: str
    what: str
    value: float
    unit: str
    formula: str


@dataclass(slots=True)
class Plan:
    """All numbers for `photos` photos of one descriptor width, in the order of derivation."""

    photos: int
    width: Width
    numbers: list[Number] = field(default_factory=list)

    def __getitem__(self, what: str) -> float:
        return next(number.value for number in self.numbers if number.what == what)

    def _add(self, group: str, what: str, value: float, unit: str, formula: str) -> float:
        self.numbers.append(Number(group, what, value, unit, formula))
        return value

    @classmethod
    def of(cls, photos: int, width: Width, inputs: Inputs) -> Plan:
        plan = cls(photos, width)
        plan._describe(inputs)
        plan._search(inputs)
        plan._store(inputs)
        plan._catalog(inputs)
        plan._money(inputs)
        return plan

    def _describe(self, i: Inputs) -> None:
        group = "describing"
        speed = self._add(
            group,
            "one extractor",
            min(self.width.gpu_photos_per_second, i.extractor_vcpus / i.pipeline_cpu_seconds),
            "photos/s",
            "min(gpu_photos_per_second, extractor_vcpus / pipeline_cpu_seconds)",
        )
        self._add(group, "GPU time, once", self.photos / speed, "s", "photos / one extractor")
        self._add(
            group,
            "CPU time around the model, once",
            self.photos * i.pipeline_cpu_seconds,
            "s",
            "photos x pipeline_cpu_seconds",
        )
        rate = self.photos / (i.fill_days * DAY_SECONDS)
        self._add(group, "uploads at first", rate, "/s", "photos / fill_days")
        self._add(
            group,
            "extractors at first",
            math.ceil(rate / speed),
            "",
            "ceil(uploads at first / one extractor)",
        )
        self._add(
            group,
            "gateways at first",
            math.ceil(rate / i.gateway_uploads_per_second),
            "",
            "ceil(uploads at first / gateway_uploads_per_second)",
        )
        later = self.photos * i.new_share_a_month / MONTH_SECONDS + i.queries_per_second
        self._add(
            group,
            "extractors later",
            math.ceil(later / speed),
            "",
            "ceil((photos x new_share_a_month / month + queries_per_second) / one extractor)",
        )

    def _search(self, i: Inputs) -> None:
        group = "search"
        row = self._add(
            group,
            "a row in memory",
            4 * self.width.dimension + i.photo_columns_bytes,
            "B",
            "4 x dimensions + photo_columns_bytes",
        )
        memory = self._add(
            group,
            "rows in memory",
            self.photos * row * i.generations_held,
            "B",
            "photos x a row in memory x generations_held",
        )
        whole = self.photos * self.width.scan_seconds
        self._add(group, "one query on one shard of 1", whole, "s", "photos x scan_us")
        by_memory = self._add(
            group,
            "shards for memory",
            math.ceil(memory / (i.machine_ram_bytes * i.ram_used)),
            "",
            "ceil(rows in memory / (machine_ram_bytes x ram_used))",
        )
        by_time = self._add(
            group,
            "shards for time",
            math.ceil(whole / i.search_seconds),
            "",
            "ceil(one query on one shard of 1 / search_seconds)",
        )
        shards = self._add(
            group, "shards", max(by_memory, by_time), "", "max(for memory, for time)"
        )
        scan = whole / shards
        replicas = self._add(
            group,
            "replicas",
            max(i.replicas, math.ceil(i.queries_per_second * scan / i.scans_at_once)),
            "",
            "max(replicas, ceil(queries_per_second x scan of a shard / scans_at_once))",
        )
        self._add(group, "search workers", shards * replicas, "", "shards x replicas")
        part = self._add(
            group,
            "memory of one worker",
            memory / shards / i.ram_used,
            "B",
            "rows in memory / shards / ram_used",
        )
        loaded = part * i.ram_used / i.generations_held
        self._add(
            group,
            "loading one worker",
            loaded * (1 / i.store_read_bytes_per_second + 1 / i.hash_bytes_per_second),
            "s",
            "one generation's rows / store_read_bytes_per_second, and / hash_bytes_per_second: "
            "one chunk after the other",
        )

    def _store(self, i: Inputs) -> None:
        group = "object store"
        originals = self._add(
            group, "originals", self.photos * i.photo_bytes, "B", "photos x photo_bytes"
        )
        thumbnails = self._add(
            group, "thumbnails", self.photos * i.thumbnail_bytes, "B", "photos x thumbnail_bytes"
        )
        chunks = self._add(
            group,
            "chunks",
            self.photos * chunk_row_bytes(self.width.dimension),
            "B",
            f"photos x (4 x dimensions + {MANIFEST_ROW_BYTES} + header / {SLOT_ROWS})",
        )
        self._add(
            group,
            "all objects",
            originals + thumbnails + chunks,
            "B",
            "originals + thumbnails + chunks; a model change adds the chunks again",
        )
        self._add(
            group,
            "objects",
            2 * self.photos + 2 * math.ceil(self.photos / SLOT_ROWS),
            "",
            f"2 x photos + 2 x photos / {SLOT_ROWS}",
        )

    def _catalog(self, i: Inputs) -> None:
        group = "PostgreSQL"
        found = i.queries_per_second * DAY_SECONDS * i.search_history_days
        self._add(group, "searches", found, "", "queries_per_second x search_history_days")
        steady = self._add(
            group,
            "bytes later",
            self.photos * (i.photos_row_bytes + i.descriptors_row_bytes)
            + self.photos * i.new_share_a_month * i.jobs_row_bytes
            + found * i.searches_row_bytes,
            "B",
            "photos x (photos_row_bytes + descriptors_row_bytes) + new photos x jobs_row_bytes"
            " + searches x searches_row_bytes",
        )
        self._add(
            group,
            "bytes in a model change",
            steady + self.photos * (i.descriptors_row_bytes + i.jobs_row_bytes),
            "B",
            "bytes later + photos x (descriptors_row_bytes + jobs_row_bytes)",
        )
        self._add(
            group,
            "rows in a model change",
            4 * self.photos + found,
            "",
            "photos x (1 photo + 2 descriptors + 1 job) + searches",
        )

    def _money(self, i: Inputs) -> None:
        group = "money a month"
        gpu = self._add(
            group,
            "extractors",
            self["extractors later"] * MONTH_HOURS * i.price_gpu_hour,
            "",
            "extractors later x 730 h x price_gpu_hour",
        )
        workers = self["search workers"]
        search = self._add(
            group,
            "search",
            workers * self["memory of one worker"] / 1e9 * i.price_ram_gb_month
            + workers * i.scans_at_once * MONTH_HOURS * i.price_vcpu_hour,
            "",
            "search workers x (memory of one worker x price_ram_gb_month"
            " + scans_at_once x 730 h x price_vcpu_hour)",
        )
        store = self._add(
            group,
            "objects kept",
            self["all objects"] / 1e9 * i.price_object_gb_month,
            "",
            "all objects x price_object_gb_month",
        )
        most = self["bytes in a model change"]
        memory = max(LEAST_CATALOG_RAM_BYTES, most * i.catalog_ram_share)
        catalog = self._add(
            group,
            "catalog",
            i.catalog_copies
            * (
                most / 1e9 * i.price_disk_gb_month
                + memory / 1e9 * i.price_ram_gb_month
                + i.catalog_vcpus * MONTH_HOURS * i.price_vcpu_hour
            ),
            "",
            "catalog_copies x (bytes in a model change x price_disk_gb_month + memory x"
            " price_ram_gb_month + catalog_vcpus x 730 h x price_vcpu_hour)",
        )
        others = self._add(
            group,
            "gateways, steward, Redis",
            i.services_vcpus * MONTH_HOURS * i.price_vcpu_hour,
            "",
            "services_vcpus x 730 h x price_vcpu_hour",
        )
        self._add(group, "together", gpu + search + store + catalog + others, "", "the sum")
        self._add(
            group,
            "and once, to describe all",
            self["GPU time, once"] / 3600 * i.price_gpu_hour,
            "",
            "GPU time, once x price_gpu_hour",
        )


def chunk_row_bytes(dimension: int) -> float:
    """Object store bytes per photo, as `shared/storage/chunks.py` writes them for a full slot."""
    rows = np.zeros((2, dimension), np.float32)
    data = encode_rows(rows)
    header = len(data) - rows.nbytes
    return rows.nbytes / len(rows) + MANIFEST_ROW_BYTES + header / SLOT_ROWS
