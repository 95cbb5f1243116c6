"""Real servers for tests: PostgreSQL, Redis, S3. Each is the first of these that can be had:

1. the one that the environment names: `PLACEWISE_TEST_POSTGRES`, `_REDIS`, `_S3`;
2. a container, where a Docker engine answers (`containers`);
3. a program of this machine: `postgres` with `initdb`, `redis-server`, `weed` (`programs`);
4. a program from a package that the dev extra installs.

Where none of them is there, the test fails and says how to get one.
Milvus is always that of the package.

Each server is started when a test first asks for it, and ends with the tests, also when those are
killed. Those of 2 to 4 may be killed, stopped, started again and paused (`Handle`).
"""

from tests.support.servers.milvus import MilvusServer, start_milvus
from tests.support.servers.postgres import PostgresServer, start_postgres
from tests.support.servers.redis import RedisServer, start_redis
from tests.support.servers.s3 import S3Server, start_moto, start_s3

__all__ = [
    "MilvusServer",
    "PostgresServer",
    "RedisServer",
    "S3Server",
    "start_milvus",
    "start_moto",
    "start_postgres",
    "start_redis",
    "start_s3",
]
