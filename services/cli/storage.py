"""`placewise storage create-bucket`."""

from __future__ import annotations

import typer

from services.cli.configuration import read_settings
from services.cli.output import JsonOption, answers, explained, print_json

app = typer.Typer(help="Where objects lie.", no_args_is_help=True)


@app.callback()
def _storage() -> None:
    """A group, so that each command has its own name."""


@app.command("create-bucket")
def create(as_json: JsonOption = False) -> None:
    """Make the bucket S3_BUCKET at S3_ENDPOINT, once; one that is there already is fine.

    S3_ACCESS_KEY has to be allowed to make buckets, which Placewise itself need not be.
    """
    with explained(as_json):
        from shared.objects.s3 import Bucket, create_bucket  # the minio client takes its time

        bucket = Bucket.of(read_settings())
        made = create_bucket(bucket)
    if as_json:
        print_json({"bucket": bucket.name, "endpoint": bucket.endpoint, "made": made})
        return
    state = "is made" if made else "was there already"
    answers.print(f"The bucket {bucket.name} at {bucket.endpoint} {state}.", soft_wrap=True)
