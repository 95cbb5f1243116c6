"""Complete response bodies of the API, for servers that tests script."""

from __future__ import annotations

from typing import Any

JOB_ID = "01a1fca4-c1a2-7356-bf32-75e2c2a0d083"
PHOTO_ID = "01a1fca4-c1a2-7356-bf32-75e1cb64beb1"
GENERATION_ID = "01a1fca4-c1a2-7356-bf32-75e1cb64beb2"
TIME = "2026-11-21T05:46:58Z"

JOB: dict[str, Any] = {
    "job_id": JOB_ID,
    "kind": "index",
    "state": "succeeded",
    "stage": None,
    "waiting_for": None,
    "awaited": None,
    "progress": {"done": 1, "total": 1, "failed": 0},
    "attempts": 1,
    "file_id": None,
    "result": None,
    "error": None,
    "created_at": TIME,
    "started_at": None,
    "finished_at": None,
    "status_url": f"/api/v1/jobs/{JOB_ID}",
    "result_url": None,
    "request_id": JOB_ID,
}
STARTED: dict[str, Any] = {
    "job_id": JOB_ID,
    "status": "queued",
    "status_url": "/",
    "result_url": None,
}
PHOTO: dict[str, Any] = {
    "image_id": PHOTO_ID,
    "image_path": "/image",
    "original_filename": "street.jpg",
    "relative_path": "Day 2/street.jpg",
    "upload_time": TIME,
    "file_size": 5,
    "width": 4,
    "height": 3,
    "metadata": {},
    "tags": ["a"],
    "latitude": 45.5,
    "longitude": None,
    "altitude": None,
    "heading": None,
    "focal_length": None,
    "captured_at": None,
    "place": None,
    "role": "database",
    "image_url": "/image",
    "thumbnail_url": "/thumbnail",
    "preview_url": "/preview",
}
UPLOADED: dict[str, Any] = {
    "file_id": PHOTO_ID,
    "job_id": JOB_ID,
    "filename": "street.jpg",
    "file_size": 5,
    "upload_time": TIME,
    "status": "queued",
    "status_url": "/",
    "already_there": False,
    "message": "",
}
SIMILAR: dict[str, Any] = {
    "query_file_id": None,
    "query_filename": "where.jpg",
    "processing_time_ms": 1.0,
    "total_similar": 0,
    "similar_images": [],
    "estimate": {"reason": "No match."},
    "vocabulary": "own",
    "word_weights": "none",
    "generation_id": GENERATION_ID,
    "certificate": "exhaustive",
    "rows_scanned": 0,
    "rows_reranked": 0,
    "snapshot_version": 1,
    "missing": [],
}
GENERATION: dict[str, Any] = {
    "generation_id": GENERATION_ID,
    "state": "active",
    "extractor": "efficientnet-lite0",
    "dimension": 2,
    "pca_from": None,
    "vocabulary_id": None,
    "photos": 3,
    "spec": {},
    "created_at": TIME,
    "activated_at": TIME,
    "ended_at": None,
}
STATS: dict[str, Any] = {
    "device": None,
    "map": "default",
    "map_version": 1,
    "total_images": 2,
    "searchable_images": 2,
    "labelled_queries": 0,
    "total_chunks": 1,
    "total_storage_bytes": 10,
    "feature_dimension": 2,
    "max_images_per_chunk": 1000,
    "extractor": "efficientnet-lite0",
    "vocabulary": "own",
    "total_searches": 0,
    "recent_uploads_24h": 0,
    "recent_searches_24h": 0,
    "avg_processing_time_ms": None,
    "max_processing_time_ms": None,
    "jobs": {},
    "counted_at": TIME,
}
MAP: dict[str, Any] = {
    "name": "tower",
    "extractor": "efficientnet-lite0-vlad128",
    "version": 0,
    "photos": 0,
    "searchable": 0,
    "labelled_queries": 0,
    "counted_at": TIME,
    "generation_id": None,
    "vocabulary": None,
    "dimension": None,
    "pca_from": None,
    "place_labels_are_paths": True,
    "rows": "float16",
    "created_at": TIME,
}
