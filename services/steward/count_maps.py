"""Counting large maps, so that no caller has to."""

from __future__ import annotations

from shared.catalog.figures import are_statistics_stale, cache_map_statistics, is_large_map
from shared.catalog.maps import list_maps
from shared.catalog.session import Catalog


def update_statistics_of_large_maps(catalog: Catalog) -> None:
    """Count each live map that is too large to be counted when someone asks, and is due."""
    with catalog.read() as session:
        maps = [map_.id for map_ in list_maps(session)]
        due = [
            map_id
            for map_id in maps
            if is_large_map(session, map_id) and are_statistics_stale(session, map_id)
        ]
    for map_id in due:
        with catalog.write() as session:
            cache_map_statistics(session, map_id)
