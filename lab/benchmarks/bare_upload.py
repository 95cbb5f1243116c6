"""Minimal FastAPI upload server, the baseline of `placewise bench pipeline`: stores a file in S3.

    python -m lab.benchmarks.bare_upload PORT    (with the S3_ settings in the environment)

It does not validate, count, hash or record anything.
"""

from __future__ import annotations

import io
import sys

import uvicorn
from fastapi import FastAPI, UploadFile
from starlette.concurrency import run_in_threadpool

from shared.config.settings import Settings
from shared.ids import new_id
from shared.storage.s3 import Bucket


def create_app(bucket: Bucket) -> FastAPI:
    app = FastAPI()

    @app.post("/upload")
    async def upload(file: UploadFile) -> dict[str, str]:
        data = await file.read()
        key = f"bare/{new_id()}"
        await run_in_threadpool(
            bucket.client.put_object, bucket.name, key, io.BytesIO(data), len(data)
        )
        return {"key": key}

    @app.get("/readyz")
    async def readyz() -> dict[str, str]:
        return {"status": "ready"}

    return app


if __name__ == "__main__":
    uvicorn.run(
        create_app(Bucket.from_settings(Settings())), port=int(sys.argv[1]), log_level="warning"
    )
