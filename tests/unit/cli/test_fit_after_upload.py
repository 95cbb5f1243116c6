"""When `placewise index` fits a vocabulary after the upload."""

from __future__ import annotations

from typing import Any

import pytest
from rich.progress import Progress

from placewise.answers import Stats
from placewise.client import Client
from services.cli.ingest.upload import fit_vocabulary_if_needed
from shared.extractor_config.configs import MIN_PHOTOS_TO_FIT
from tests.support.api_responses import JOB, STARTED, STATS
from tests.unit.client.test_client import running_server


def fits(**stats: Any) -> bool:
    """Whether a vocabulary is fitted for a map with these statistics."""
    with running_server() as server, Client(server.url) as client:
        for answer in (STARTED, {**JOB, "state": "succeeded"}, STATS):
            server.will_answer(200, answer)
        fit_vocabulary_if_needed(client, Stats(**{**STATS, **stats}), Progress(disable=True))
        return any(path.endswith("/vocabularies") for _, path, _ in server.requests)


@pytest.mark.parametrize("vocabulary", ["foreign", "provisional", "pending", None])
def test_enough_photos_replace_a_vocabulary_that_is_not_their_own(vocabulary: str | None) -> None:
    assert fits(vocabulary=vocabulary, total_images=MIN_PHOTOS_TO_FIT)
    assert not fits(vocabulary=vocabulary, total_images=MIN_PHOTOS_TO_FIT - 1)


@pytest.mark.parametrize("vocabulary", ["own", "none"])
def test_a_map_with_a_vocabulary_of_its_own_or_without_any_keeps_it(vocabulary: str) -> None:
    assert not fits(vocabulary=vocabulary, total_images=10 * MIN_PHOTOS_TO_FIT)
