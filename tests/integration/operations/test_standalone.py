"""The embedded server on a catalog that other services use."""

from __future__ import annotations

from services.standalone import run_standalone
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.jobs import JobState
from tests.support.catalog_rows import add_job, add_map, read_job, take


def test_leases_in_a_shared_catalog_are_not_released_at_the_start(
    catalog: Catalog, settings: Settings
) -> None:
    with catalog.write() as session:
        add_job(session, add_map(session).id)
    (job,) = take(catalog, lease_seconds=600)
    url = catalog.url.render_as_string(hide_password=False)
    shared = Settings(**settings.model_dump() | {"database_url": url, "port": 0})
    with run_standalone(shared, lazy_extractor=True):
        found = read_job(catalog, job.id)
    assert (found.state, found.lease_token) == (JobState.RUNNING, job.lease_token)
