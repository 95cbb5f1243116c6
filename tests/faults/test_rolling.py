"""A rolling restart under load: no request that a reasonable client makes fails, no job is lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.benchmarks.fleet import start_servers
from lab.benchmarks.rolling import restart_under_load

ONE_OF_EACH = ("gateway-0", "extractor-0", "search-0-0", "steward-0")


@pytest.mark.timeout(600)
def test_restarting_one_of_each_service_fails_no_request_and_loses_no_job(tmp_path: Path) -> None:
    with start_servers() as servers:
        report = restart_under_load(tmp_path, servers, ONE_OF_EACH, executed=False)
    assert not report.missed, report.as_json()
    requests = {
        figure.what: figure.measured
        for figure in report.figures
        if figure.what.startswith("requests: ")
    }
    for kind in ("upload", "query by new photo", "query by stored photo", "read"):
        assert requests[f"requests: {kind}"] >= len(ONE_OF_EACH), requests
