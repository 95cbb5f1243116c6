"""Every statement that the services send finds its rows by an index."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared.catalog.database.session import Catalog, PoolConfig, TransactionTimeouts
from tests.integration.operations.query_plans.calls import KNOWN_FULL_SCANS, run_all_calls
from tests.integration.operations.query_plans.explain import Explainer
from tests.integration.operations.query_plans.fill import fill_catalog
from tests.support.servers import PostgresServer

# The first map has more rows than any statement may read: one that reads it all stands out.
PHOTOS = 30_000


@pytest.fixture
def catalog(postgres: PostgresServer, migrated_postgres: str) -> Iterator[Catalog]:
    url = postgres.new_database(migrated_postgres)
    with contextlib.closing(Catalog(url, PoolConfig(), TransactionTimeouts(250, 250))) as opened:
        yield opened


def test_no_statement_reads_a_whole_map_and_a_missing_index_is_noticed(
    catalog: Catalog, tmp_path: Path
) -> None:
    contents = fill_catalog(catalog, PHOTOS)
    explainer = Explainer(catalog)
    calls = list(run_all_calls(catalog, contents, explainer, tmp_path))
    assert {e.call for e in explainer.plans} >= set(calls) - {
        "steward: fit_due_vocabularies",
        "steward: evaluate_changed_maps",
        "steward: free_trash",  # looks at the disk
    }, "every call asks something"
    assert set(KNOWN_FULL_SCANS) <= set(calls), "an exception that is none any more"
    faulty = {
        f"{e.call}: {e.faults()} {e.scans} {e.sql}"
        for e in explainer.plans
        if e.faults() and e.call not in KNOWN_FULL_SCANS
    }
    assert not faulty, "\n".join(sorted(faulty))

    with catalog.engine.begin() as connection:
        connection.exec_driver_sql("DROP INDEX ix_photos_tags")
    explainer = Explainer(catalog)
    assert list(run_all_calls(catalog, contents, explainer, tmp_path, "GET /search?tags"))
    assert any(e.faults() for e in explainer.plans)
