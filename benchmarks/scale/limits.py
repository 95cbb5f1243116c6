"""Limits of the design: the number of photos at which a part fails, from the same inputs."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.scale.inputs import Inputs, Width
from benchmarks.scale.plan import SLOT_ROWS, chunk_row_bytes
from shared.config.settings import Settings
from shared.search_api.client import MAX_CONCURRENT_CALLS

LOADING_SECONDS = 600.0
STEWARD_SILENT_SECONDS = 900.0  # deploy/k8s: it is restarted after this time
CHANGE_SECONDS = 0.5  # services/steward/scheduler.py, "advance model changes"
STATEMENT_SECONDS = float(Settings.model_fields["database_work_seconds"].default)
FOLLOW_SECONDS = float(Settings.model_fields["search_follow_seconds"].default)


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit: `photos` is the number from which on the part fails, `formula` its derivation."""

    what: str
    photos: float
    formula: str


def limits(width: Width, i: Inputs) -> list[Limit]:
    """Return all limits, lowest first."""
    held = (4 * width.dimension + i.photo_columns_bytes) * i.generations_held
    per_machine = i.machine_ram_bytes * i.ram_used / held
    per_second = i.search_seconds / width.scan_seconds
    loading = 1 / i.store_read_bytes_per_second + 1 / i.hash_bytes_per_second
    merge = 2 * chunk_row_bytes(width.dimension) * loading
    found = [
        Limit(
            "the scan of one shard takes longer than `search_seconds`",
            per_second,
            "search_seconds / scan_us",
        ),
        Limit(
            "the rows outgrow one machine's memory",
            per_machine,
            "machine_ram_bytes x ram_used / (a row in memory x generations_held)",
        ),
        Limit(
            f"a query needs more shards than a gateway asks at once ({MAX_CONCURRENT_CALLS})",
            MAX_CONCURRENT_CALLS * min(per_second, per_machine),
            f"{MAX_CONCURRENT_CALLS} x the lesser of the limits of scan and memory",
        ),
        Limit(
            f"a lone search worker loads for more than {LOADING_SECONDS:.0f} s",
            LOADING_SECONDS / (4 * width.dimension * loading),
            f"{LOADING_SECONDS:.0f} s / (4 x dimensions x (1 / store_read_bytes_per_second"
            " + 1 / hash_bytes_per_second))",
        ),
        Limit(
            f"listing the chunks takes longer than `SEARCH_FOLLOW_SECONDS` ({FOLLOW_SECONDS:g} s)",
            FOLLOW_SECONDS / (i.chunk_list_us / 1e6) * SLOT_ROWS,
            f"SEARCH_FOLLOW_SECONDS / chunk_list_us x {SLOT_ROWS}",
        ),
        Limit(
            f"the walk over all objects takes longer than {STEWARD_SILENT_SECONDS:.0f} s",
            STEWARD_SILENT_SECONDS / i.list_page_seconds * 1000 / 2,
            f"{STEWARD_SILENT_SECONDS:.0f} s / list_page_seconds x 1,000 / 2 objects a photo",
        ),
        Limit(
            "while a model change is described, the steward holds the map's lock most of the time",
            CHANGE_SECONDS / (i.walked_row_us / 1e6),
            f"{CHANGE_SECONDS:g} s between two of its looks / walked_row_us",
        ),
        Limit(
            "the statement that finds photos for a model change takes longer than "
            f"`DATABASE_WORK_SECONDS` ({STATEMENT_SECONDS:g} s)",
            STATEMENT_SECONDS / (i.walked_row_us / 1e6),
            "DATABASE_WORK_SECONDS / walked_row_us",
        ),
        Limit(
            "the statement that removes a model change's jobs takes longer than "
            f"`DATABASE_WORK_SECONDS` ({STATEMENT_SECONDS:g} s)",
            STATEMENT_SECONDS / (i.deleted_row_us / 1e6),
            "DATABASE_WORK_SECONDS / deleted_row_us",
        ),
        Limit(
            "merging keeps one steward busy, while all is described in `fill_days`",
            i.fill_days * 86_400 / merge,
            "fill_days / (2 x 4 x dimensions x (1 / store_read_bytes_per_second"
            " + 1 / hash_bytes_per_second)): each row read and written once",
        ),
        Limit(
            "one gateway takes longer than `fill_days` for all uploads",
            i.fill_days * 86_400 * i.gateway_uploads_per_second,
            "fill_days x gateway_uploads_per_second",
        ),
    ]
    return sorted(found, key=lambda limit: limit.photos)
