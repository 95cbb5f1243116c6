"""One settings object for every service, read from the environment and `.env`.

Durations end in `_seconds`, sizes in `_bytes` unless the predecessor's name is kept
(`MAX_FILE_SIZE`, in bytes).

What this machine, or this container, gives to a process.
"""

from __future__ import annotations

import os
import re
from ipaddress import ip_network
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from shared.config.shards import Shard
from shared.errors import Misconfigured
from shared.extractor_config.anyloc_compat import extractor_from_dino_settings
from shared.extractor_config.configs import ExtractorConfig, get_extractor_config
from shared.extractor_config.names import TORCHHUB_PREFIX, parse_torchhub_name

CGROUP_MEMORY_LIMIT_FILE = Path("/sys/fs/cgroup/memory.max")


def memory_limit_bytes() -> int:
    """The memory that this process may have: the machine's, or less in a container."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = CGROUP_MEMORY_LIMIT_FILE.read_text().strip()
    except OSError:
        return machine
    return min(machine, int(limit)) if limit.isdigit() else machine  # "max" is no limit


MIN_ADMIN_KEY_CHARACTERS = 16


class Settings(BaseSettings):
    """What is in force. Each field is an environment variable of the same name in capitals."""

    model_config = SettingsConfigDict(
        env_file=".env",
        env_ignore_empty=True,  # compose files pass on what is unset as empty
        extra="ignore",
        frozen=True,
        validate_default=True,
    )

    # Where it listens and where it keeps things.
    host: str = Field("127.0.0.1", description="address to listen on")
    port: int = Field(8000, ge=0, le=65535, description="0 takes a free one")
    admin_key: SecretStr | None = Field(
        None,
        description="a key that may do everything, beside those of `placewise keys`; unset: the "
        "embedded Placewise needs none on loopback, and makes one at its first start beyond",
    )
    cors_origins: str | None = Field(
        None,
        description="pages of elsewhere whose scripts may call, by their origins, separated by "
        "commas: https://maps.example.com; unset: none",
    )
    hsts_seconds: int = Field(
        0,
        ge=0,
        description="how long browsers shall use HTTPS alone (Strict-Transport-Security); 0: not "
        "said. For servers that are reached over HTTPS only",
    )

    # Limits for slow and for many clients. Every HTTP server has those for connections.
    max_connections: int = Field(
        2000,
        ge=1,
        description="open connections of one server; fewer where the process may open few files",
    )
    max_connections_per_address: int = Field(
        200,
        ge=0,
        description="open connections from one address (IPv6: from one /64); 0: no limit",
    )
    trusted_proxies: str | None = Field(
        None,
        description="addresses or networks of reverse proxies, separated by commas: 10.0.0.5, "
        "192.168.0.0/16. Their `X-Forwarded-For` is believed, and their connections are not "
        "limited per address; unset: none",
    )
    request_head_seconds: float = Field(
        20.0, gt=0, description="longest time in which a client sends the head of a request"
    )
    min_body_bytes_per_second: int = Field(
        1000,
        ge=0,
        description="slowest rate at which a client sends the body of a request, over 10 seconds; "
        "0: no limit",
    )
    max_event_streams: int = Field(
        500, ge=0, description="event streams (GET /jobs/ID/events) that one gateway sends at once"
    )
    max_event_streams_per_caller: int = Field(
        100, ge=0, description="the same for one key, and for one address"
    )

    # What a key may do, unless it has limits of its own; ADMIN_KEY has none.
    key_requests_per_minute: int | None = Field(
        None, ge=1, description="calls of one key; unset: any number"
    )
    key_upload_bytes_per_day: int | None = Field(
        None,
        ge=1,
        description="bytes of request bodies that one key may send in 24 hours, whether or not "
        "they are stored; unset: any number",
    )
    key_max_photos: int | None = Field(
        None, ge=1, description="photos that are stored through one key; unset: any number"
    )

    webhook_private_addresses: bool = Field(
        False,
        description="lets webhooks lead to private addresses and over plain HTTP: whoever makes "
        "one then reaches what the steward reaches",
    )
    placewise_home: Path = Field(
        Path("./var"), description="folder of the embedded catalog and object store"
    )
    upload_dir: Path | None = Field(
        None, description="folder of the original photos; unset: PLACEWISE_HOME/objects/originals"
    )
    database_url: SecretStr | None = Field(
        None,
        description="SQLAlchemy URL of the catalog; unset: SQLite under PLACEWISE_HOME",
    )

    # How a process talks to PostgreSQL. SQLite, when embedded, has none of this.
    database_pool_size: int = Field(
        10, ge=1, le=1000, description="connections that a process keeps open"
    )
    database_pool_overflow: int = Field(
        20, ge=0, le=1000, description="further connections while they are needed"
    )
    database_pool_wait_seconds: float = Field(
        3.0, gt=0, description="longest wait for a free connection of these"
    )
    database_connect_seconds: float = Field(
        3.0, ge=2, description="longest wait for a new connection, for each address of its host"
    )
    database_statement_seconds: float = Field(
        5.0, gt=0, description="longest statement of a request"
    )
    database_lock_seconds: float = Field(
        3.0, gt=0, description="longest wait of a request for a lock"
    )
    database_work_seconds: float = Field(
        60.0, gt=0, description="longest statement of extractors, search and the steward"
    )
    schema_wait_seconds: float = Field(
        60.0,
        ge=0,
        description="how long a service that starts waits for the catalog and `placewise migrate`",
    )

    # Where objects lie when not in PLACEWISE_HOME: a bucket of any S3 server.
    s3_endpoint: str | None = Field(
        None, description="host:port of an S3 server for all objects; unset: PLACEWISE_HOME/objects"
    )
    s3_access_key: str | None = Field(None, description="who asks S3_ENDPOINT")
    s3_secret_key: SecretStr | None = Field(None, description="the secret of S3_ACCESS_KEY")
    s3_public_endpoint: str | None = Field(
        None,
        description="address of S3_ENDPOINT as callers reach it, who send photos straight there: "
        "https://photos.example.com; unset: S3_ENDPOINT itself",
    )
    s3_bucket: str = Field("placewise", description="a bucket that belongs to this Placewise alone")
    s3_secure: bool = Field(True, description="speak HTTPS with S3_ENDPOINT")
    s3_region: str = Field("us-east-1", description="the region of S3_BUCKET")
    s3_timeout_seconds: float = Field(
        10.0, gt=0, description="longest silence of S3_ENDPOINT, and longest time to send it 5 MiB"
    )

    debug: bool = Field(
        False, description="log every call and every refusal; answers stay the same"
    )

    # What a running service tells of itself.
    log_format: Literal["text", "json"] = Field(
        "text", description="of every line of a service's log; json: one object a line"
    )
    metrics_port: int | None = Field(
        None,
        ge=0,
        le=65535,
        description="where, on HOST, a service answers GET /metrics without a key, for Prometheus; "
        "unset: nowhere (the gateway and search have theirs beside the API as well)",
    )
    otel_exporter_otlp_endpoint: str | None = Field(
        None,
        description="where traces are sent by OTLP/HTTP: http://collector:4318; needs the extra "
        "otel; unset: nothing is traced",
    )

    redis_url: SecretStr | None = Field(
        None, description="Redis that carries hints between services; unset: one process"
    )

    map_tiles: str | None = Field(
        None,
        description="address of the page's map tiles: "
        "https://tile.openstreetmap.org/{z}/{x}/{y}.png; unset: a plain graticule, and the page "
        "loads nothing from elsewhere",
    )
    map_attribution: str | None = Field(
        None, description="whose MAP_TILES are, as their licence wants it shown"
    )

    heartbeat_file: Path | None = Field(
        None,
        description="file that an extractor or steward of its own touches while it works, for "
        "health checks; unset: none",
    )

    # What is accepted.
    max_file_size: int = Field(10_485_760, gt=0, description="bytes of one photo")
    max_image_pixels: int = Field(50_000_000, gt=0, description="width x height of one photo")
    max_archive_size: int = Field(
        10_737_418_240,
        gt=0,
        description="bytes of one batch: of its archive, packed and unpacked, or of all its files",
    )
    max_batch_photos: int = Field(
        100_000, gt=0, description="photos in one batch; all members of an archive count"
    )
    import_prefix: str = Field(
        "imports/",
        description="where the objects lie that a batch may name by their keys",
    )
    max_vocabulary_bytes: int = Field(64_000_000, gt=0, description="bytes of an imported one")
    max_model_bytes: int = Field(
        2_000_000_000, gt=0, description="bytes of a checkpoint that is added as a model"
    )
    presign_seconds: int = Field(
        900, ge=1, le=604_800, description="time to send and complete a direct upload"
    )
    max_wait_seconds: int = Field(60, ge=0, description="longest `Prefer: wait` and `?wait=`")

    # What is refused before anything fills up.
    max_queued_jobs: int = Field(
        200_000, ge=1, description="waiting jobs from which calls that make more are refused"
    )
    max_queued_jobs_per_map: int = Field(
        100_000, ge=1, description="the same for the jobs of one map"
    )
    max_queued_queries: int = Field(
        1000, ge=1, description="waiting query photos; uploads do not count"
    )
    max_concurrent_uploads: int = Field(
        32, ge=1, description="files that one gateway receives at once, and as many query photos"
    )
    max_concurrent_uploads_per_caller: int = Field(
        16, ge=1, description="the same for one key, and for one address"
    )
    min_free_bytes: int = Field(
        500_000_000,
        ge=0,
        description="of the disks of PLACEWISE_HOME and UPLOAD_DIR; with less free, uploads are "
        "rejected and batches wait; query photos are rejected below a tenth of it",
    )

    # How photos are described.
    extractor: str = Field(
        "efficientnet-lite0-vlad",
        description="extractor of new maps, with options: "
        "anyloc-vitb14:layer=9,preprocessing=demo1024",
    )
    dino_model: str | None = Field(
        None, description="extractor of new maps by its DINOv2: dinov2_vits14|vitb14|vitl14|vitg14"
    )
    desc_layer: int | None = Field(
        None, description="DINO_MODEL's block, from 0; unset: 10, 10, 20 or 31 by its size"
    )
    desc_facet: str | None = Field(
        None, description="query, key, value or token of that block; unset: value"
    )
    vlad_clusters: int | None = Field(
        None, description="centres that fits make with DINO_MODEL; unset: 64"
    )
    vlad_desc_dim: int | None = Field(
        None, description="width of DINO_MODEL's features, checked against the model"
    )
    allow_test_extractors: bool = Field(
        False, description="lets a map use the tiny extractors that exist for tests"
    )
    torchhub_allowed: str | None = Field(
        None,
        description="torch.hub extractors that maps may use, whose code is executed: exact names, "
        "separated by blanks: torchhub:OWNER/NAME@COMMIT:ENTRY; unset: none but EXTRACTOR",
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="where photos are described; auto takes CUDA where it is"
    )
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto",
        description="what new generations are computed in; auto takes bfloat16 for DINOv2 on CUDA, "
        "and float32 for all else",
    )
    dino_weights: Path | None = Field(
        None,
        description="DINOv2's weights: a .pth, .pt or .safetensors file; unset: timm's on the hub",
    )
    model_cache_bytes: int = Field(
        10_000_000_000,
        ge=0,
        description="of fetched models that an extractor keeps under PLACEWISE_HOME when objects "
        "lie in a bucket; what was used least lately goes first",
    )
    batch_photos: int = Field(16, ge=1, le=1024, description="most photos in one batch")
    decode_processes: int = Field(2, ge=1, le=64, description="photos decoded at once")
    decode_memory_bytes: int = Field(
        2_000_000_000, ge=500_000_000, description="memory of one decoding process"
    )
    decode_timeout_seconds: float = Field(30.0, gt=0, description="for one photo")
    batch_ahead_photos: int = Field(
        500, ge=1, description="queued photos at which batches wait for the extractors"
    )
    descriptor_cache_bytes: int = Field(
        20_000_000_000,
        ge=0,
        description="of PLACEWISE_HOME/descriptors, where evaluate and compare keep their rows",
    )
    auto_fit_photos: int = Field(
        200, ge=1, description="photos at which a map without a vocabulary fits its own"
    )

    # How the first photos of an answer are looked at closely (`rerank`, `explain`).
    compare_wait_seconds: float = Field(
        10.0,
        ge=0,
        description="longest wait for a comparison inside a call; then 202 and a job to poll",
    )
    local_features: Literal["recompute", "keep"] = Field(
        "recompute",
        description="those of compared photos: made again each time, or kept as float16 in the "
        "object store once made (44 kB a photo with the default extractor)",
    )

    # How jobs are kept alive.
    lease_seconds: float = Field(60.0, gt=0, description="silence after which a worker is given up")
    drain_seconds: float = Field(
        10.0, gt=0, description="how long a worker goes on for one hint before it looks up"
    )
    visibility_seconds: int = Field(
        900, ge=60, description="after which Redis delivers a silent worker's hint again"
    )
    max_attempts: int = Field(3, ge=1, description="lone crashes before a job is failed")
    query_ttl_seconds: float = Field(3600.0, gt=0, description="life of an unstored query")
    idempotency_key_seconds: float = Field(
        86_400.0, gt=0, description="how long a call repeated under its Idempotency-Key is known"
    )

    # How the store is kept healthy.
    slot_rows: int = Field(1000, ge=2, description="rows of a sealed chunk")
    compact_chunks: int = Field(
        8, ge=2, description="chunks of an open slot that are worth merging"
    )
    superseded_grace_seconds: float = Field(
        600.0, ge=0, description="life of a chunk after it was merged into another"
    )
    retired_grace_seconds: float = Field(
        3600.0, ge=0, description="life of a generation after it was replaced"
    )
    orphan_age_seconds: float = Field(
        86_400.0,
        ge=0,
        description="age at which an object that no row knows is moved to the trash",
    )
    trash_days: float = Field(
        7.0,
        ge=0,
        description="days for which such objects stay in the trash; emptied sooner when the disk "
        "is nearly full",
    )
    collect_max_share: float = Field(
        0.1,
        ge=0,
        le=1,
        description="share of all objects; with more orphans than this (and than 100), none is "
        "moved before `placewise storage collect --confirm`",
    )

    job_retention_days: float = Field(
        30.0, gt=0, description="life of a finished job; photos that were not described keep theirs"
    )
    search_history_days: float = Field(90.0, gt=0, description="life of a search in the history")

    # How answers become places.
    estimate_radius_m: float = Field(
        25.0, gt=0, description="an estimate this near to the truth counts as right"
    )
    auto_evaluate_photos: int = Field(
        20,
        ge=0,
        description="located photos from which a changed map is evaluated by itself; 0: never",
    )

    word_weights: bool = Field(
        True,
        description="rank by word weights where a map has them, and learn them for maps with a "
        "vocabulary of their own",
    )

    # How search follows the catalog.
    search_follow_seconds: float = Field(
        1.0, gt=0, description="how often search looks for what is new"
    )
    search_wait_seconds: float = Field(5.0, gt=0, description="longest wait for `min_version`")

    search_memory_budget: int | None = Field(
        None,
        ge=0,
        description="bytes of codes and rows that search holds in memory; unset: half of the "
        "machine's, or of what its container may use",
    )
    search_device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="where search compares rows; auto: on a CUDA GPU if there is one"
    )

    # How search is spread over machines (`placewise search`, which listens on HOST and PORT, too).
    search_shard: str = Field(
        "0/1", description="what this search worker holds: 1/3 is the second of three shards"
    )
    search_urls: str | None = Field(
        None,
        description="every search worker's address, separated by commas; unset: in this process",
    )
    search_timeout_seconds: float = Field(
        10.0, gt=0, description="longest wait for the shards' answers; who is late is left out"
    )

    @field_validator("admin_key")
    @classmethod
    def _check_admin_key(cls, value: SecretStr | None) -> SecretStr | None:
        if value is None:
            return None
        key = value.get_secret_value()
        if len(key) < MIN_ADMIN_KEY_CHARACTERS or not re.fullmatch(r"[!-~]+", key):
            raise ValueError(
                f"a key has at least {MIN_ADMIN_KEY_CHARACTERS} printable ASCII characters and no "
                "blanks; this makes one: openssl rand -hex 24"
            )
        return value

    @field_validator("cors_origins")
    @classmethod
    def _check_origins(cls, value: str | None) -> str | None:
        for origin in _split(value):
            if not re.fullmatch(r"https?://([a-z0-9.-]+|\[[0-9a-f:]+\])(:\d+)?", origin):
                raise ValueError(
                    f"{origin!r} is no origin: scheme, name and port in small letters, without a "
                    "path: https://maps.example.com"
                )
        return value

    @field_validator("trusted_proxies")
    @classmethod
    def _are_networks(cls, value: str | None) -> str | None:
        for address in _split(value):
            try:
                ip_network(address)
            except ValueError as error:
                raise ValueError(f"{error}; expected is one like 10.0.0.5 or 10.0.0.0/8") from None
        return value

    @field_validator("search_shard")
    @classmethod
    def _check_shard(cls, value: str) -> str:
        return str(Shard.parse(value))

    @field_validator("search_urls")
    @classmethod
    def _check_urls(cls, value: str | None) -> str | None:
        for url in _split(value):
            if not re.fullmatch(r"https?://[^\s/?#]+/?", url):
                raise ValueError(
                    f"{url!r} is no address like http://search-0:8000; several are separated by "
                    "commas"
                )
        return value

    @field_validator("torchhub_allowed")
    @classmethod
    def _check_torchhub_entries(cls, value: str | None) -> str | None:
        for name in (value or "").split():
            if not name.startswith(TORCHHUB_PREFIX):
                raise ValueError(f"{name!r} is no torch.hub extractor: {TORCHHUB_PREFIX}...")
            try:
                parse_torchhub_name(name)
            except Misconfigured as error:
                raise ValueError(error.detail) from error
        return value

    @field_validator("placewise_home", "upload_dir")
    @classmethod
    def _resolve_path(cls, value: Path | None) -> Path | None:
        return value and value.expanduser().resolve()

    @field_validator("dino_weights")
    @classmethod
    def _resolve_weights_path(cls, value: Path | None) -> Path | None:
        # Not resolved: a link in a Hugging Face cache has a better name than what it points to.
        return None if value is None else value.expanduser().absolute()

    @field_validator("s3_endpoint")
    @classmethod
    def _check_host_and_port(cls, value: str | None) -> str | None:
        if value is not None and not re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[\w.-]+)(:\d+)?", value):
            raise ValueError(
                "is a host and a port without a scheme, such as s3.example.com or 10.0.0.5:8333; "
                "S3_SECURE says whether it is HTTPS"
            )
        return value

    @field_validator("map_tiles")
    @classmethod
    def _check_tile_url(cls, value: str | None) -> str | None:
        # Its host goes into the page's Content-Security-Policy: nothing else may follow it there.
        if value is not None and not (
            re.fullmatch(r"https?://[A-Za-z0-9.-]+(:\d+)?/[^\s]+", value)
            and all(part in value for part in ("{z}", "{x}", "{y}"))
        ):
            raise ValueError(
                f"{value!r} is no address of tiles with {{z}}, {{x}} and {{y}}, such as "
                "https://tile.openstreetmap.org/{z}/{x}/{y}.png"
            )
        return value

    @field_validator("s3_public_endpoint")
    @classmethod
    def _check_base_url(cls, value: str | None) -> str | None:
        if value is not None and not re.fullmatch(r"https?://[^\s/?#@]+/?", value):
            raise ValueError("is an address without a path, such as https://photos.example.com")
        return value and value.rstrip("/")

    @field_validator("s3_bucket")
    @classmethod
    def _check_bucket_name(cls, value: str) -> str:
        if not re.fullmatch(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]", value):
            raise ValueError(
                "a bucket's name has 3 to 63 small letters, digits, hyphens and dots, and begins "
                "and ends with a letter or digit"
            )
        return value

    @model_validator(mode="after")
    def _check_s3_settings(self) -> Self:
        if self.s3_endpoint is None:
            return self
        if not (self.s3_access_key and self.s3_secret_key):
            raise ValueError("S3_ENDPOINT needs S3_ACCESS_KEY and S3_SECRET_KEY")
        if self.upload_dir is not None:
            raise ValueError(
                "With S3_ENDPOINT the photos lie in S3_BUCKET, and UPLOAD_DIR names a folder for "
                "them. Unset one of the two"
            )
        return self

    @model_validator(mode="after")
    def _check_map_attribution(self) -> Self:
        if self.map_tiles is not None and self.map_attribution is None:
            raise ValueError(
                "MAP_TILES needs MAP_ATTRIBUTION, which stands in the corner of the map: "
                "© OpenStreetMap contributors"
            )
        return self

    @model_validator(mode="after")
    def _check_batch_fits_slot(self) -> Self:
        if self.batch_photos > self.slot_rows:
            raise ValueError(
                f"BATCH_PHOTOS ({self.batch_photos}) may not exceed SLOT_ROWS ({self.slot_rows}): "
                "a batch becomes one chunk, and a chunk has to fit into a slot"
            )
        return self

    @model_validator(mode="after")
    def _check_dino_model(self) -> Self:
        for name in ("desc_layer", "desc_facet", "vlad_clusters", "vlad_desc_dim"):
            value = getattr(self, name)
            if value is not None and self.dino_model is None:
                raise ValueError(
                    f"{name.upper()}={value} says how DINO_MODEL is used, which is not set. "
                    "Set DINO_MODEL, or use the options of EXTRACTOR instead: "
                    "anyloc-vitb14:layer=9,facet=key,clusters=32"
                )
        return self

    @model_validator(mode="after")
    def _check_one_extractor(self) -> Self:
        try:
            recipe = get_extractor_config(
                self.extractor, allow_test_extractors=self.allow_test_extractors
            )
            check_extractor_is_shared(recipe)
        except Misconfigured as error:
            raise ValueError(f"EXTRACTOR={self.extractor}: {error.detail}") from error
        named = recipe.name
        chosen = self.new_map_extractor
        if "extractor" in self.model_fields_set and named != chosen:
            raise ValueError(
                f"EXTRACTOR={self.extractor} contradicts DINO_MODEL={self.dino_model}, which "
                f"means {chosen}. Unset one of them"
            )
        return self

    @property
    def new_map_extractor(self) -> str:
        """The canonical name of the extractor that EXTRACTOR or DINO_MODEL chooses."""
        if self.dino_model is None:
            return get_extractor_config(
                self.extractor, allow_test_extractors=self.allow_test_extractors
            ).name
        return extractor_from_dino_settings(
            self.dino_model,
            desc_layer=self.desc_layer,
            desc_facet=self.desc_facet,
            vlad_clusters=self.vlad_clusters,
            vlad_desc_dim=self.vlad_desc_dim,
        )

    def recipe(self, name: str) -> ExtractorConfig:
        """The recipe of an extractor that this installation may load.

        Misconfigured as `get_extractor_config`, `torchhub_not_allowed` for code that nobody
        allowed, and
        `model_not_added` for a checkpoint that is only a file.
        """
        recipe = get_extractor_config(name, allow_test_extractors=self.allow_test_extractors)
        check_extractor_is_shared(recipe)
        if recipe.hub is not None and recipe.name not in self.allowed_hub_extractors:
            raise Misconfigured(
                "torchhub_not_allowed",
                f"The extractor {recipe.name} executes code of {recipe.hub.source}, which is not "
                "allowed here. Whoever runs this Placewise allows it by that exact name in "
                "TORCHHUB_ALLOWED, for the gateway and the extractors, and starts them anew.",
            )
        return recipe

    @property
    def allowed_hub_extractors(self) -> tuple[str, ...]:
        """Canonical names of the torch.hub extractors that may be loaded."""
        allowed = [parse_torchhub_name(name).name for name in (self.torchhub_allowed or "").split()]
        configured = self.new_map_extractor
        if configured.startswith(TORCHHUB_PREFIX):
            allowed.append(configured)
        return tuple(dict.fromkeys(allowed))

    @property
    def shard(self) -> Shard:
        """The part of every generation that this process's search worker holds."""
        return Shard.parse(self.search_shard)

    def search_cache_folder(self, shard: Shard) -> Path:
        """Where the search worker of a shard keeps what it fetches from a bucket."""
        return self.placewise_home / "search-cache" / str(shard).replace("/", "-of-")

    @property
    def search_memory_bytes(self) -> int:
        return (
            memory_limit_bytes() // 2
            if self.search_memory_budget is None
            else self.search_memory_budget
        )

    @property
    def search_worker_urls(self) -> tuple[str, ...]:
        """The search workers' addresses, each once; () when search is in this process."""
        return tuple(dict.fromkeys(url.rstrip("/") for url in _split(self.search_urls)))

    @property
    def allowed_origins(self) -> tuple[str, ...]:
        """Whose pages may call; () for our own alone."""
        return tuple(dict.fromkeys(_split(self.cors_origins)))

    @property
    def proxy_addresses(self) -> list[str]:
        """Addresses and networks of trusted reverse proxies."""
        return _split(self.trusted_proxies)

    def catalog_url(self) -> str:
        """The SQLAlchemy URL of the catalog."""
        if self.database_url is not None:
            return self.database_url.get_secret_value()
        return f"sqlite:///{self.placewise_home / 'catalog.sqlite'}"


def check_extractor_is_shared(recipe: ExtractorConfig) -> None:
    """Misconfigured (`model_not_added`) for a checkpoint that other machines would not find."""
    if recipe.trained is not None and recipe.trained.file is not None:
        raise Misconfigured(
            "model_not_added",
            f"{recipe.trained.file} is a file of one machine, and a map's photos are described "
            f"wherever there is room. Add it: `placewise models add {recipe.trained.file} --name "
            "NAME`, and use gsv:NAME.",
        )


def _split(value: str | None) -> list[str]:
    """What is separated by commas or blanks."""
    return (value or "").replace(",", " ").split()
