"""Every statement that the services send finds its rows by an index."""

from __future__ import annotations

from pathlib import Path

from benchmarks.catalog.command import KNOWN_FULL_SCANS, run_all_calls
from benchmarks.catalog.explain import Explainer
from benchmarks.catalog.fill import fill_catalog
from shared.catalog.database.session import Catalog, PoolConfig, TransactionTimeouts
from tests.support.servers import PostgresServer

# The first map has more rows than any statement may read: one that reads it all stands out.
PHOTOS = 60_000


def test_no_statement_reads_a_whole_map(
    postgres: PostgresServer, migrated_postgres: str, tmp_path: Path
) -> None:
    catalog = Catalog(
        postgres.new_database(migrated_postgres), PoolConfig(), TransactionTimeouts(250, 250)
    )
    try:
        filled = fill_catalog(catalog, PHOTOS)
        explainer = Explainer(catalog, small=True)
        calls = list(run_all_calls(catalog, filled, explainer, tmp_path))
    finally:
        catalog.close()
    assert {e.call for e in explainer.plans} >= set(calls) - {
        "steward: fit maps that wait",
        "steward: evaluate changed maps",
        "steward: free trash",  # looks at the disk
    }, "every call asks something"
    assert set(KNOWN_FULL_SCANS) <= set(calls), "an exception that is none any more"
    faulty = {
        f"{e.call}: {e.faults()} {e.scans} {e.sql}"
        for e in explainer.plans
        if e.faults() and e.call not in KNOWN_FULL_SCANS
    }
    assert not faulty, "\n".join(sorted(faulty))


def test_missing_index_is_noticed(
    postgres: PostgresServer, migrated_postgres: str, tmp_path: Path
) -> None:
    catalog = Catalog(
        postgres.new_database(migrated_postgres), PoolConfig(), TransactionTimeouts(250, 250)
    )
    try:
        filled = fill_catalog(catalog, PHOTOS)
        with catalog.engine.begin() as connection:
            connection.exec_driver_sql("DROP INDEX ix_photos_tags")
        explainer = Explainer(catalog, small=True)
        for _ in run_all_calls(catalog, filled, explainer, tmp_path):
            pass
    finally:
        catalog.close()
    assert any("tags" in e.call and e.faults() for e in explainer.plans)
