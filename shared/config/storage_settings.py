"""Settings of the catalog (SQLite or PostgreSQL) and of the object store (folder or S3)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Self

from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings

# How the URL of a database may begin -> dialect and driver of SQLAlchemy.
DATABASE_SCHEMES = {
    "postgres": "postgresql+psycopg",
    "postgresql": "postgresql+psycopg",
    "postgresql+psycopg": "postgresql+psycopg",
    "sqlite": "sqlite",
}


class StorageSettings(BaseSettings):
    """Where the catalog and the objects are, and how they are maintained."""

    placewise_home: Path = Field(
        Path("./var"), description="folder of the embedded catalog and object store"
    )
    upload_dir: Path | None = Field(
        None, description="folder of the original photos; unset: PLACEWISE_HOME/objects/originals"
    )
    database_url: SecretStr | None = Field(
        None,
        description="URL of the catalog: postgresql://USER:PASSWORD@HOST:PORT/DATABASE; unset: "
        "SQLite under PLACEWISE_HOME",
    )

    # Object store in a bucket of an S3 server instead of PLACEWISE_HOME.
    s3_endpoint: str | None = Field(
        None,
        description="host:port of an S3 server that stores all objects; unset: "
        "PLACEWISE_HOME/objects",
    )
    s3_access_key: str | None = Field(None, description="S3 access key ID")
    s3_secret_key: SecretStr | None = Field(None, description="S3 secret access key")
    s3_bucket: str = Field("placewise", description="S3 bucket, which no other application may use")
    s3_secure: bool = Field(True, description="use HTTPS for S3_ENDPOINT")
    s3_region: str = Field("us-east-1", description="region of S3_BUCKET")
    s3_timeout_seconds: float = Field(
        10.0, gt=0, description="S3 read timeout, and timeout for sending a part of 5 MiB, seconds"
    )

    # Compaction and garbage collection.
    chunk_rows: int = Field(1000, ge=2, description="most rows of a merged chunk")
    orphan_age_seconds: float = Field(
        86_400.0,
        ge=0,
        description="age at which an orphan (an object that no row references) is moved to the "
        "trash, seconds",
    )
    trash_days: float = Field(
        7.0,
        ge=0,
        description="days after which an orphan in the trash is deleted; earlier when the disk is "
        "nearly full",
    )

    removed_photo_days: float = Field(
        30.0,
        ge=0,
        description="days in which a photo that was deleted can be restored; its bytes are kept",
    )

    @field_validator("placewise_home", "upload_dir")
    @classmethod
    def _resolve_path(cls, value: Path | None) -> Path | None:
        return value and value.expanduser().resolve()

    @field_validator("database_url")
    @classmethod
    def _check_database_url(cls, value: SecretStr | None) -> SecretStr | None:
        if value is None:
            return None
        scheme, separator, rest = value.get_secret_value().partition("://")
        if separator and scheme in DATABASE_SCHEMES:
            return SecretStr(f"{DATABASE_SCHEMES[scheme]}://{rest}")
        # Without a separator, all of the value may be a password.
        named = f"the scheme {scheme!r} is not known" if separator else "it has no scheme"
        raise ValueError(
            f"{named}; expected postgresql://USER:PASSWORD@HOST:PORT/DATABASE or sqlite:///FILE"
        )

    @field_validator("s3_endpoint")
    @classmethod
    def _check_host_and_port(cls, value: str | None) -> str | None:
        if value is not None and not re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[\w.-]+)(:\d+)?", value):
            raise ValueError(
                "expected a host and a port without a scheme, such as s3.example.com or "
                "10.0.0.5:8333; S3_SECURE selects HTTPS"
            )
        return value

    @field_validator("s3_bucket")
    @classmethod
    def _check_bucket_name(cls, value: str) -> str:
        if not re.fullmatch(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]", value):
            raise ValueError(
                "a bucket name has 3 to 63 lower-case letters, digits, hyphens and dots, and "
                "begins and ends with a letter or digit"
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
                "S3_ENDPOINT stores the photos in S3_BUCKET, and UPLOAD_DIR stores them in a "
                "folder. Unset one of the two"
            )
        return self

    def catalog_url(self) -> str:
        """The SQLAlchemy URL of the catalog."""
        if self.database_url is not None:
            return self.database_url.get_secret_value()
        return f"sqlite:///{self.placewise_home / 'catalog.sqlite'}"
