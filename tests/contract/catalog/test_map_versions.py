"""Map versions, default map, model registry and deleted photos, on both databases."""

from __future__ import annotations

from collections.abc import Callable
from uuid import UUID

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from services.gateway.photo_search import MetadataSearchParams, search_photos
from shared.catalog.database.session import Catalog
from shared.catalog.maps import Map, get_or_create_default_map, increment_map_version
from shared.catalog.models import Model, get_or_create_model
from shared.catalog.photos import (
    count_live_photos,
    find_same_photo,
    get_live_photos,
    get_photo,
    list_photos_changed_since,
)
from shared.errors import NotFound
from tests.support.catalog_rows import add_map, add_photo, delete
from tests.support.threads import at_once


def test_versions_are_strictly_increasing_under_concurrent_bumps(
    catalog: Catalog, map_id: UUID
) -> None:
    threads, each = 6, 12

    def bump() -> list[int]:
        seen = []
        for _ in range(each):
            with catalog.write() as session:
                seen.append(increment_map_version(session, map_id))
        return seen

    by_thread = at_once(*[bump] * threads)
    assert all(seen == sorted(seen) for seen in by_thread)
    assert sorted(version for seen in by_thread for version in seen) == list(
        range(1, threads * each + 1)
    )
    with catalog.read() as session:
        assert session.get_one(Map, map_id).version == threads * each


@pytest.mark.parametrize(
    "get_or_create",
    [
        lambda session: get_or_create_default_map(session, "test-tiny-avg"),
        lambda session: get_or_create_model(session, "net", "f" * 64, "MIT", {"made": "here"}),
    ],
    ids=["default map", "model"],
)
def test_a_row_that_many_create_at_once_is_created_once(
    catalog: Catalog, get_or_create: Callable[[Session], Map | Model]
) -> None:
    def create() -> Map | Model:
        with catalog.write() as session:
            return get_or_create(session)

    created = at_once(*[create] * 4)
    with catalog.read() as session:
        assert session.scalars(select(type(created[0]).id)).one() == created[0].id
    assert len({row.id for row in created}) == 1


def test_a_deleted_photo_and_one_of_another_map_show_in_no_query(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        stays = add_photo(session, map_id).id
        goes = add_photo(session, map_id, sha256="b" * 64).id
        elsewhere = add_photo(session, add_map(session, "other").id).id
        version = session.get_one(Map, map_id).version
    delete(catalog, map_id, goes)
    with catalog.read() as session:
        for hidden in (goes, elsewhere):
            with pytest.raises(NotFound):
                get_photo(session, map_id, hidden)
        assert list(get_live_photos(session, [stays, goes])) == [stays]
        assert find_same_photo(session, map_id, "b" * 64, None) is None
        assert count_live_photos(session, map_id) == 1
        page, total = search_photos(session, map_id, MetadataSearchParams(), 10, None)
        assert ([photo.id for photo in page], total) == ([stays], 1)
        changed = list_photos_changed_since(session, map_id, version)
        assert [(facts.photo_id, facts.findable) for facts in changed] == [(goes, False)]
        assert list_photos_changed_since(session, map_id, version + 1) == []
