"""Folders as the predecessor, the AnyLoc similarity service, left them."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

SCHEMA = """
CREATE TABLE images (
    image_id TEXT PRIMARY KEY,
    image_path TEXT NOT NULL,
    original_filename TEXT,
    upload_time TIMESTAMP DEFAULT CURRENT_TIMESTAMP,
    file_size INTEGER,
    width INTEGER,
    height INTEGER,
    feature_chunk_id INTEGER,
    feature_index_in_chunk INTEGER,
    similarity_searches INTEGER DEFAULT 0,
    last_accessed TIMESTAMP,
    metadata_json TEXT,
    tags TEXT
);
CREATE TABLE feature_chunks (
    chunk_id INTEGER PRIMARY KEY,
    chunk_file TEXT NOT NULL,
    image_count INTEGER DEFAULT 0,
    created_time TIMESTAMP DEFAULT CURRENT_TIMESTAMP,
    last_modified TIMESTAMP DEFAULT CURRENT_TIMESTAMP
);
CREATE TABLE search_history (
    search_id INTEGER PRIMARY KEY AUTOINCREMENT,
    query_image_id TEXT,
    search_time TIMESTAMP DEFAULT CURRENT_TIMESTAMP,
    top_k INTEGER,
    processing_time_ms REAL,
    results_count INTEGER
);
CREATE INDEX idx_images_upload_time ON images(upload_time);
CREATE INDEX idx_images_filename ON images(original_filename);
CREATE INDEX idx_images_chunk ON images(feature_chunk_id);
CREATE INDEX idx_chunks_modified ON feature_chunks(last_modified);
CREATE INDEX idx_search_time ON search_history(search_time);
"""


class AnylocInstallation:
    """One that grows: `backend/app/` with its database in WAL mode, its uploads and the rest."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.models = root / "backend" / "app" / "models"
        self.uploads = root / "backend" / "app" / "uploads"
        self.uploads.mkdir(parents=True)
        (self.models / "features").mkdir(parents=True)
        (self.models / "features" / "chunk_0.npy").write_bytes(b"375 MiB of zeros, mostly")
        (self.models / "vocabulary").mkdir()
        (self.models / "vocabulary" / "c_centers.pt").write_bytes(b"random numbers, perhaps")
        (self.uploads / ".gitkeep").touch()
        self.database = self.models / "similarity.db"
        self.connection = sqlite3.connect(self.database, isolation_level=None)
        self.connection.execute("PRAGMA journal_mode=WAL")
        self.connection.executescript(SCHEMA)

    def add(self, file: str, data: bytes | None, **columns: Any) -> None:
        """A row whose photo is called `file`; without data, only the row."""
        if data is not None:
            (self.uploads / file).write_bytes(data)
        row = {
            "image_id": f"id-of-{file}",
            "image_path": f"/app/app/uploads/{file}",
            "original_filename": f"original-{file}",
            "upload_time": "2026-05-01 10:20:30",
            **columns,
        }
        self.connection.execute(
            f"INSERT INTO images ({', '.join(row)}) VALUES ({', '.join('?' * len(row))})",
            list(row.values()),
        )

    def close(self) -> None:
        """Stop it in good order: SQLite folds the write-ahead log into the database."""
        self.connection.close()
