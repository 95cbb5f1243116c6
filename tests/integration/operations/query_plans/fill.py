"""Fills a catalog by server-side SQL: photos, descriptors, jobs and searches of ten maps.

The first map has 70 % of the photos, the second 25 %, and the other eight share the rest. Ids
increase with time, as in production.
"""

from __future__ import annotations

from dataclasses import dataclass
from uuid import UUID

from sqlalchemy import text

from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, active_generation
from shared.catalog.maps import create_map
from shared.catalog.models import get_or_create_model
from shared.ids import new_id

MAPS = 10
LARGEST_MAP = "map-0"
CHUNK_ROWS = 1000
WAITING_JOB_SHARE = 0.01  # share of photos just uploaded and not described yet

# The n-th row of a kind, from 30 days ago until now.
CREATED_AT_SQL = "now() - interval '30 days' * (1 - n::float8 / :photos)"
UUID_SQL = (
    "(lpad(to_hex((extract(epoch FROM {moment}) * 1000)::bigint), 12, '0') || '700{kind}8'"
    " || lpad(to_hex(n), 15, '0'))::uuid"
)

FILL_STATEMENTS = {
    "numbers": """
        CREATE TEMPORARY TABLE numbers ON COMMIT DROP AS
        SELECT n, (:maps)::uuid[] AS maps, (:generations)::uuid[] AS generations, which,
               {photo} AS photo_id, {job} AS job_id, n >= :photos * (1 - :waiting) AS waits,
               row_number() OVER (PARTITION BY which ORDER BY n) - 1 AS place_in_map
        FROM (SELECT n, CASE WHEN n % 20 < 14 THEN 1 WHEN n % 20 < 19 THEN 2
                        ELSE 3 + (n / 20) % 8 END AS which
              FROM generate_series(1, :photos) AS n) AS all_numbers
    """,
    "photos": """
        INSERT INTO photos (id, map_id, job_id, role, sha256, object_key, filename, media_type,
            size_bytes, width, height, latitude, longitude, captured_at, place, tags, metadata,
            uploaded_at, deleted_at, changed_version)
        SELECT photo_id, maps[which], job_id,
            CASE WHEN n % 2000 = 7 THEN 'query' ELSE 'database' END,
            encode(sha256(n::text::bytea), 'hex'), 'originals/' || photo_id,
            CASE n % 3 WHEN 0 THEN 'IMG_' WHEN 1 THEN 'street-' ELSE 'DSC' END
                || md5(n::text) || '.jpg',
            'image/jpeg', 200000 + (n::bigint * 7919) % 3000000, 4032, 3024,
            CASE WHEN n % 10 > 0 THEN 45.0 + 0.2 * ((n::bigint * 7919) % 100003) / 100003.0 END,
            CASE WHEN n % 10 > 0 THEN 7.6 + 0.3 * ((n::bigint * 104729) % 100019) / 100019.0 END,
            {moment} - interval '1 hour',
            CASE WHEN n % 3 = 0 THEN 'place-' || n / 60 END,
            CASE n % 5 WHEN 0 THEN jsonb_build_array('night', 'tag-' || n / 100)
                WHEN 1 THEN jsonb_build_array('rain') ELSE '[]' END,
            '{{}}', {moment}, CASE WHEN n % 200 = 3 THEN now() - interval '1 minute' END, n
        FROM numbers
    """,
    "jobs": """
        INSERT INTO jobs (id, map_id, kind, state, priority, photo_id, params, progress_done,
            progress_total, progress_failed, attempts, alone, claimed_together, created_at,
            started_at, finished_at)
        SELECT job_id, maps[which], 'index', CASE WHEN waits THEN 'queued'
                WHEN n % 1000 = 11 THEN 'failed' ELSE 'succeeded' END,
            50, photo_id, '{{}}', 0, 1, 0, 0, false, 0, {moment},
            CASE WHEN NOT waits THEN {moment} END, CASE WHEN NOT waits THEN {moment} END
        FROM numbers
    """,
    "chunks": """
        INSERT INTO chunks (id, generation_id, object_key, rows, size_bytes, sha256, sealed,
            created_at)
        SELECT md5('chunk' || which || '/' || number)::uuid, generation,
            'chunks/' || md5('chunk' || which || '/' || number), count, count * 28672,
            md5('') || md5(''), true, now()
        FROM (SELECT which, generations[which] AS generation,
                     (place_in_map / :chunk_rows)::int AS number, count(*)::int AS count
              FROM numbers WHERE NOT waits GROUP BY 1, 2, 3) AS chunks
    """,
    "descriptors": """
        INSERT INTO descriptors (generation_id, photo_id, chunk_id, row)
        SELECT generations[which], photo_id,
            md5('chunk' || which || '/' || (place_in_map / :chunk_rows)::int)::uuid,
            (place_in_map % :chunk_rows)::int
        FROM numbers WHERE NOT waits
    """,
    "searches": """
        INSERT INTO searches (id, map_id, generation_id, query_photo_id, query_filename, top_k,
            results, processing_ms, best_score, in_map, searched_at)
        SELECT {search}, maps[which], generations[which], photo_id, 'query.jpg', 10, 10,
            5 + n % 50, 0.5, true, {moment}
        FROM numbers WHERE n % 5 = 0
    """,
}


@dataclass(frozen=True, slots=True)
class SyntheticCatalog:
    """Contents of the synthetic catalog."""

    photos: int
    big: UUID
    generation: UUID


def fill_catalog(catalog: Catalog, photos: int) -> SyntheticCatalog:
    """Fill an empty, migrated PostgreSQL catalog and run ANALYZE."""
    with catalog.write() as session:
        maps = [create_map(session, f"map-{n}", "test-tiny-avg").id for n in range(MAPS)]
        model = get_or_create_model(session, "synthetic", "0" * 64, "MIT", {})
        for map_id in maps:
            session.add(
                Generation(
                    id=new_id(),
                    map_id=map_id,
                    state=GenerationState.ACTIVE,
                    extractor="synthetic",
                    spec={"clusters": None},
                    spec_fingerprint="0" * 64,
                    dimension=7168,
                    model_id=model.id,
                )
            )
        session.flush()
        generations = [found.id for m in maps if (found := active_generation(session, m))]
        ids = {
            name: UUID_SQL.format(moment=CREATED_AT_SQL, kind=kind)
            for kind, name in enumerate(("photo", "job", "search"))
        }
        values = {
            "photos": photos,
            "maps": [str(map_id) for map_id in maps],
            "generations": [str(generation_id) for generation_id in generations],
            "chunk_rows": CHUNK_ROWS,
            "waiting": WAITING_JOB_SHARE,
        }
        for statement in FILL_STATEMENTS.values():
            session.execute(text(statement.format(moment=CREATED_AT_SQL, **ids)), values)
    with catalog.engine.connect() as connection:
        connection.execution_options(isolation_level="AUTOCOMMIT").exec_driver_sql(
            "VACUUM (ANALYZE)"
        )
    return SyntheticCatalog(photos, maps[0], generations[0])
