"""Settings that every long-running service reads: listening address, logs, metrics, traces."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, SecretStr
from pydantic_settings import BaseSettings


class ServiceSettings(BaseSettings):
    """Listening address, message broker and observability."""

    host: str = Field("127.0.0.1", description="listening address")
    port: int = Field(8000, ge=0, le=65535, description="listening port; 0 picks a free port")
    debug: bool = Field(
        False,
        description="log every request and every rejected request; responses stay the same",
    )
    log_format: Literal["text", "json"] = Field(
        "text", description="log format; json writes one JSON object per line"
    )
    metrics_port: int | None = Field(
        None,
        ge=0,
        le=65535,
        description="port on HOST where a service answers GET /metrics for Prometheus, without a "
        "key; unset: no such port (the gateway and search also serve /metrics beside their API)",
    )
    otel_exporter_otlp_endpoint: str | None = Field(
        None,
        description="OTLP/HTTP endpoint for traces: http://collector:4318; needs the extra otel; "
        "unset: tracing is off",
    )
    redis_url: SecretStr | None = Field(
        None,
        description="URL of the Redis that carries job notifications between services; unset: all "
        "services run in one process",
    )
    heartbeat_file: Path | None = Field(
        None,
        description="heartbeat file for health checks, touched regularly by a separate extractor "
        "or steward process; unset: none",
    )
