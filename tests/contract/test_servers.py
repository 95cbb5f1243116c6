"""The servers that tests run against do what `tests.support.servers` promises."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import psutil
import psycopg
import pytest
from redis import Redis
from redis.exceptions import RedisError
from sqlalchemy.engine import make_url

from shared.errors import Unavailable
from shared.objects.s3 import S3Store
from tests.support.servers import (
    PostgresServer,
    RedisServer,
    S3Server,
    containers,
    postgres,
    programs,
    redis,
    s3,
)
from tests.support.servers.handle import Handle

REPOSITORY = Path(__file__).parents[2]
