"""Models that were added, loaded by whoever describes photos with them.

Files of added models on this machine, with their hash checked.

Where objects are files already they are read where they lie. From a bucket they are fetched into a
folder that the processes of this machine may share, up to MODEL_CACHE_BYTES.

ADD_MODEL: a checkpoint that was sent becomes a model, if it can be read and used safely.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import torch

from shared.catalog.models import ModelRegistration, get_model_for_loading, register_model
from shared.catalog.session import Catalog
from shared.config.private_files import create_private_file, make_private_folder
from shared.config.settings import Settings
from shared.descriptors.backbones.trained import TrainedBackbone
from shared.descriptors.vpr_models.checkpoint import (
    Checkpoint,
    encode_model_file,
    load_checkpoint,
    read_model_file,
)
from shared.errors import NotFound, Unavailable, Unprocessable
from shared.extractor_config.names import TRAINED_MODEL_PREFIX
from shared.ids import new_id
from shared.jobs import Job
from shared.jobs.leases import lock_leased_jobs
from shared.jobs.transitions import succeed_job
from shared.storage import ObjectStore
from shared.storage.keys import new_model_key

log = logging.getLogger(__name__)

COPY_BYTES = 1 << 20
STALE_PARTIAL_SECONDS = 3600.0  # a file that is still being fetched then: its process was killed


class ModelFileCache:
    def __init__(self, store: ObjectStore, folder: Path, max_bytes: int) -> None:
        """`folder` is made when something is fetched. `max_bytes` of models that are not in use."""
        self._store = store
        self._folder = folder
        self._max_bytes = max_bytes

    def local_path(self, key: str, sha256: str) -> Path:
        """The object as a file of this machine, to be opened soon: a later call may remove it.

        Unavailable (`model_corrupt`) when it is not what was stored; NotFound and Unavailable of
        the store.
        """
        there = self._store.file(key)
        if there is not None:
            with self._store.open(key) as opened:
                _verify_hash(opened, key, sha256)
            return there
        path = self._folder / f"{sha256}.safetensors"
        with contextlib.suppress(FileNotFoundError, Unavailable):
            with path.open("rb") as opened:
                _verify_hash(opened, key, sha256)
            os.utime(path)  # used just now
            return path
        self._download(key, sha256, path)
        self._evict(path)
        return path

    def _download(self, key: str, sha256: str, path: Path) -> None:
        make_private_folder(self._folder)
        partial = self._folder / f"{new_id()}.partial"
        try:
            with self._store.open(key) as source, create_private_file(partial) as file:
                _verify_hash(source, key, sha256, file)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
        log.info("the model %s was fetched (%d bytes)", sha256[:12], path.stat().st_size)

    def _evict(self, fetched: Path) -> None:
        """Remove what was used least lately, until the rest beside `fetched` fits."""
        long_ago = time.time() - STALE_PARTIAL_SECONDS
        found: list[tuple[float, int, Path]] = []
        for path in self._folder.iterdir():
            with contextlib.suppress(FileNotFoundError):  # another process makes room, too
                about = path.stat()
                if path.suffix == ".partial":
                    if about.st_mtime < long_ago:
                        path.unlink()
                elif path != fetched:
                    found.append((about.st_mtime, about.st_size, path))
        room = self._max_bytes
        for _, size_bytes, path in sorted(found, reverse=True):
            room -= size_bytes
            if room < 0:
                path.unlink(missing_ok=True)


def _verify_hash(source: BinaryIO, key: str, sha256: str, copy: BinaryIO | None = None) -> None:
    """Read it whole, into `copy` if there is one; Unavailable when its hash is another."""
    digest = hashlib.sha256()
    while piece := source.read(COPY_BYTES):
        digest.update(piece)
        if copy is not None:
            copy.write(piece)
    if digest.hexdigest() != sha256:
        raise Unavailable(
            "model_corrupt",
            f"The model {key} is not what was stored (its hash differs). Restore it from a "
            "backup, or add the same checkpoint again under its name (POST /api/v1/models).",
        )


def model_cache_folder(settings: Settings) -> Path:
    """Where files of models lie for a while, when objects are no files of this machine."""
    return settings.placewise_home / "model-cache"


class AddedModelLoader:
    """By their names; the catalog says where each lies and what it is."""

    def __init__(self, catalog: Catalog, store: ObjectStore, settings: Settings) -> None:
        self._catalog = catalog
        self._cache = ModelFileCache(
            store, model_cache_folder(settings), settings.model_cache_bytes
        )

    def load(self, name: str, device: torch.device) -> TrainedBackbone:
        """The model `name`, its weights on the device.

        Misconfigured (`model_missing`); Unavailable: `model_lost`, `model_corrupt`,
        `model_unreadable`, and those of the store.
        """
        with self._catalog.read() as session:
            row = get_model_for_loading(session, name)
        assert row.object_key is not None
        assert row.sha256 is not None
        try:
            found = read_model_file(self._cache.local_path(row.object_key, row.sha256))
        except NotFound as error:
            raise Unavailable(
                "model_lost",
                f"The weights of the model {name!r} are gone from the object store "
                f"({row.object_key}). Restore them from a backup, or add the same checkpoint again "
                "under its name.",
                model=name,
            ) from error
        return TrainedBackbone(
            row.name, found.model, row.fingerprint, device, licence=row.licence, card=row.card
        )


MAX_CARD_CHARACTERS = 20_000  # of JSON: what the training said of itself


class ModelImporter:
    """One piece of work, on the CPU: nothing is described with the model yet."""

    def __init__(self, catalog: Catalog, store: ObjectStore, folder: Path) -> None:
        """`folder`: that of ModelCache, which has room for large files and removes what is left
        over.
        """
        self._catalog = catalog
        self._store = store
        self._folder = folder

    def import_checkpoint(self, job: Job) -> None:
        """Check the checkpoint under `object_key`, store what describes photos, add its row.

        Unprocessable: those of `load_checkpoint`, `model_unfit`, `checkpoint_lost`; Conflict
        (`model_name_taken`).
        """
        filename = job.params["filename"]
        with self._local_file(job.params["object_key"]) as path:
            try:
                checkpoint = load_checkpoint(path)
            except Unprocessable as error:  # it speaks of the file as it is called here
                said = error.detail.replace(path.name, filename)
                raise Unprocessable(error.code, said, **error.extra) from error
        card = {"source": filename, **training_card(checkpoint)}
        name = job.params["name"]
        TrainedBackbone(
            f"{TRAINED_MODEL_PREFIX}{name}",
            checkpoint.model,
            checkpoint.fingerprint,
            torch.device("cpu"),
            licence="",
            card=card,
        ).check()
        data = encode_model_file(checkpoint)
        sha256 = hashlib.sha256(data).hexdigest()
        new = ModelRegistration(
            name=name,
            fingerprint=checkpoint.fingerprint,
            object_key=new_model_key(sha256),
            sha256=sha256,
            size_bytes=len(data),
            dimension=checkpoint.model.dimension,
            config=checkpoint.config.model_dump(mode="json"),
            licence=job.params["licence"],
            note=job.params["note"],
            card=card,
        )
        self._store.put(new.object_key, data)
        self._commit(job, new)

    def _commit(self, job: Job, new: ModelRegistration) -> None:
        """The row and the job's end. A file that stays without row is an orphan, and collected."""
        token = job.lease_token
        assert token is not None, "a claimed job carries a token"
        with self._catalog.write() as session:
            for mine in lock_leased_jobs(session, token, [job]):
                model, added = register_model(session, new)
                succeed_job(
                    mine,
                    {
                        "name": new.name,
                        "extractor": model.name,
                        "fingerprint": model.fingerprint,
                        "dimension": model.dimension,
                        "size_bytes": model.size_bytes,
                        "already_there": not added,
                    },
                )

    @contextlib.contextmanager
    def _local_file(self, key: str) -> Iterator[Path]:
        """The object as a file of this machine."""
        there = self._store.file(key)
        if there is not None:
            yield there
            return
        make_private_folder(self._folder)
        path = self._folder / f"{new_id()}.partial"
        try:
            with self._store.open(key) as source, create_private_file(path) as file:
                while piece := source.read(COPY_BYTES):
                    file.write(piece)
            yield path
        except NotFound as error:
            raise _checkpoint_lost_error() from error
        finally:
            path.unlink(missing_ok=True)


def training_card(checkpoint: Checkpoint) -> dict[str, Any]:
    """What the checkpoint says of its training, as JSON that every database keeps.

    What is no JSON becomes text; of more than MOST_ABOUT_CHARACTERS only how long it was trained
    is left.
    """
    try:
        said: dict[str, Any] = _Plain().of(checkpoint.about)
        if len(json.dumps(said)) <= MAX_CARD_CHARACTERS:
            return said
    except _TooLong:
        pass
    lengths = {name: checkpoint.about.get(name) for name in ("epoch", "global_step")}
    said = {name: value for name, value in lengths.items() if _is_short(value)}
    return {**said, "left_out": "the hyperparameters, which are too long"}


class _TooLong(Exception):
    pass


class _Plain:
    """Makes values JSON. Raises _TooLong before it has made much more than MOST_ABOUT_CHARACTERS:
    a few bytes of a pickle can name the same long value any number of times."""

    def __init__(self) -> None:
        self._left = MAX_CARD_CHARACTERS

    def of(self, value: Any, depth: int = -1) -> Any:
        self._take(1)
        if isinstance(value, bool) or value is None or _is_short(value):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else str(value)
        if depth < 4 and isinstance(value, dict):
            return {self._text(name): self.of(one, depth + 1) for name, one in value.items()}
        if depth < 4 and isinstance(value, list | tuple):
            return [self.of(member, depth + 1) for member in value]
        return self._text(value)

    def _text(self, value: Any) -> str:
        if isinstance(value, str):
            self._take(len(value))
        return _to_json_text(value)

    def _take(self, characters: int) -> None:
        self._left -= characters
        if self._left < 0:
            raise _TooLong


def _is_short(value: Any) -> bool:
    """Is it a number that every database keeps as one?"""
    return isinstance(value, int) and value.bit_length() < 64


def _to_json_text(value: Any) -> str:
    # PostgreSQL keeps no NUL, and no half of a character.
    text = value if isinstance(value, str) else f"<{type(value).__name__}>"
    return text.replace("\x00", "").encode("utf-8", "replace").decode("utf-8")


def _checkpoint_lost_error() -> Unprocessable:
    return Unprocessable(
        "checkpoint_lost", "The checkpoint is gone from the object store. Send it again."
    )
