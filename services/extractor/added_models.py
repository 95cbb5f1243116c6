"""Added models: import of trained checkpoints and exported networks, local file cache, loading.

`import_model` turns an uploaded checkpoint, TorchScript or ONNX file into a model of the catalog,
if it can be read and used safely. `AddedModelLoader` loads added models. `ModelFileCache` provides
their files with verified hashes: a file-based object store is read in place; from a bucket, files
are downloaded into a folder of at most MODEL_CACHE_BYTES, which the processes of this machine may
share.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from services.extractor.child_process import ChildKilled, run_in_child
from services.extractor.handlers import ExtractorContext, handles_model_change
from shared.catalog.database.base import db_now
from shared.catalog.database.session import Catalog
from shared.catalog.models import Model, get_model_for_loading, register_model
from shared.config.private_files import make_private_folder
from shared.config.settings import Settings
from shared.descriptors.backbones import Backbone
from shared.descriptors.backbones.exported import ExportedBackbone, exported_prefix
from shared.descriptors.backbones.trained import TrainedBackbone
from shared.descriptors.vpr_models.checkpoint import (
    Checkpoint,
    encode_model_file,
    load_checkpoint,
    read_model_file,
)
from shared.errors import NotFound, Unavailable, Unprocessable
from shared.extractor_config.configs import ExtractorConfig, get_extractor_config
from shared.extractor_config.names import TORCHSCRIPT_PREFIX, TRAINED_MODEL_PREFIX
from shared.ids import new_id
from shared.jobs import Job, JobKind
from shared.jobs.leases import lock_leased_job
from shared.jobs.runner import JobInterrupted
from shared.jobs.transitions import succeed_job
from shared.storage import ObjectStore
from shared.storage.copying import (
    PARTIAL_SUFFIX,
    download_object,
    hash_file,
    hash_object,
    remove_stale_partials,
)
from shared.storage.keys import new_model_key

log = logging.getLogger(__name__)

MODEL_CACHE_BYTES = 10_000_000_000
CHECK_SECONDS = 300.0  # of a TorchScript file, with the start of its process
MAX_CARD_CHARACTERS = 20_000  # of the model card as JSON


class ModelFileCache:
    """Least-recently-used cache of model files on this machine; processes may share its folder."""

    def __init__(self, store: ObjectStore, folder: Path, max_bytes: int) -> None:
        """`max_bytes` limits the cached files, not counting the one downloaded last."""
        self._store = store
        self._folder = folder
        self._max_bytes = max_bytes

    def local_path(self, key: str, sha256: str) -> Path:
        """Return the object as a local file, to be opened at once: a later call may delete it.

        Raises:
            Unavailable: `model_corrupt` if its hash differs; also as the store raises it.
            NotFound: As the store raises it.
        """
        stored_file = self._store.file(key)
        if stored_file is not None:
            _check_hash(hash_object(self._store, key)[1], key, sha256)
            return stored_file
        path = self._folder / f"{sha256}.safetensors"
        with contextlib.suppress(FileNotFoundError, Unavailable):
            with path.open("rb") as file:
                _check_hash(hash_file(file)[1], key, sha256)
            os.utime(path)  # marks it as recently used
            return path
        self._download(key, sha256, path)
        self._evict(path)
        return path

    def _download(self, key: str, sha256: str, path: Path) -> None:
        make_private_folder(self._folder)
        partial = self._folder / f"{new_id()}{PARTIAL_SUFFIX}"
        try:
            _check_hash(download_object(self._store, key, partial), key, sha256)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
        log.info("downloaded the model %s (%d bytes)", sha256[:12], path.stat().st_size)

    def _evict(self, fetched: Path) -> None:
        """Delete the least recently used files until all but `fetched` fit into the limit."""
        remove_stale_partials(self._folder)
        files: list[tuple[float, int, Path]] = []
        for path in self._folder.iterdir():
            with contextlib.suppress(FileNotFoundError):  # another process may evict files, too
                stat = path.stat()
                if path != fetched and path.suffix != PARTIAL_SUFFIX:
                    files.append((stat.st_mtime, stat.st_size, path))
        remaining = self._max_bytes
        for _, size_bytes, path in sorted(files, reverse=True):
            remaining -= size_bytes
            if remaining < 0:
                path.unlink(missing_ok=True)


def _check_hash(actual: str, key: str, sha256: str) -> None:
    if actual != sha256:
        raise Unavailable(
            "model_corrupt",
            f"The model {key} is corrupt: its hash differs. Restore it from a "
            "backup, or add the same file again under its name (POST /api/v1/models).",
        )


def model_cache_folder(settings: Settings) -> Path:
    """Folder for downloaded model files, used when the object store is not file-based."""
    return settings.placewise_home / "model-cache"


class AddedModelLoader:
    """Loads added models by name, as the catalog describes them."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        settings: Settings,
        is_stopping: Callable[[], bool] = lambda: False,
    ) -> None:
        """`is_stopping` is whether a pass of an ONNX file must end (`OnnxProcess`)."""
        self._is_stopping = is_stopping
        self._catalog = catalog
        self._settings = settings
        self._cache = ModelFileCache(store, model_cache_folder(settings), MODEL_CACHE_BYTES)

    def load(self, config: ExtractorConfig, device: torch.device) -> Backbone:
        """Load the added model of an extractor onto the device.

        Raises:
            Misconfigured: `model_missing`, `code_not_allowed`, `onnx_missing`.
            Unprocessable: `model_unusable`, of an exported network with other options than those
                that it was added with.
            Unavailable: `model_lost`, `model_corrupt`, `model_unreadable`, and as the store raises
                it.
        """
        name = config.added_model
        assert name is not None
        with self._catalog.read() as session:
            row = get_model_for_loading(session, name)
        assert row.object_key is not None
        assert row.sha256 is not None
        if name.prefix == TORCHSCRIPT_PREFIX:
            self._settings.check_torchscript_allowed(row.name, row.sha256)
        try:
            path = self._cache.local_path(row.object_key, row.sha256)
            if config.input is not None:
                data = path.read_bytes()
                return ExportedBackbone(
                    config,
                    data,
                    device,
                    licence=row.licence,
                    card=row.card,
                    is_stopping=self._is_stopping,
                )
            model = read_model_file(path)
        except NotFound as error:
            raise Unavailable(
                "model_lost",
                f"The weights of the model {row.name} are missing from the object store "
                f"({row.object_key}). Restore them from a backup, or add the same file again "
                "under its name.",
                model=row.added_name,
            ) from error
        return TrainedBackbone(
            row.name, model, row.fingerprint, device, licence=row.licence, card=row.card
        )


@handles_model_change(JobKind.ADD_MODEL)
def import_model(context: ExtractorContext, job: Job) -> None:
    """Validate the file at `object_key`, store its model file, and add its catalog row.

    A file without its row is deleted as an orphan.

    Raises:
        Unprocessable: As `load_checkpoint` raises it; `model_unusable`, `checkpoint_lost`.
        Misconfigured: `code_not_allowed`, `onnx_missing`.
        Conflict: `model_name_taken`.
    """
    filename, name = job.params["filename"], job.params["name"]
    with _local_file(context, job.params["object_key"]) as path:
        prefix = exported_prefix(path, filename)
        try:
            if prefix is None:
                new, data = _read_trained(load_checkpoint(path), filename, name)
            else:
                new, data = _read_exported(context, job, prefix, path)
        except Unprocessable as error:  # its message names the temporary file
            detail = error.detail.replace(path.name, filename)
            raise Unprocessable(error.code, detail, **error.extra) from error
    sha256 = hashlib.sha256(data).hexdigest()
    new.id, new.added_name, new.added_at = new_id(), name, db_now()
    new.object_key, new.sha256, new.size_bytes = new_model_key(sha256), sha256, len(data)
    new.licence, new.note = job.params["licence"], job.params["note"]
    context.store.put(new.object_key, data)
    with context.catalog.write() as session:
        if leased := lock_leased_job(session, job):
            model, added = register_model(session, new)
            assert model.config is not None
            succeed_job(
                leased,
                {
                    "name": model.added_name,
                    "extractor": model.config.get("extractor", model.name),
                    "fingerprint": model.fingerprint,
                    "dimension": model.dimension,
                    "size_bytes": model.size_bytes,
                    "already_there": not added,
                },
            )


def _read_trained(checkpoint: Checkpoint, filename: str, name: str) -> tuple[Model, bytes]:
    """Return the row of a checkpoint's model and its model file, after checking the model."""
    card = {"source": filename, **training_card(checkpoint)}
    TrainedBackbone(
        f"{TRAINED_MODEL_PREFIX}{name}",
        checkpoint.model,
        checkpoint.fingerprint,
        torch.device("cpu"),
        licence="",
        card=card,
    ).check()
    new = Model(
        name=f"{TRAINED_MODEL_PREFIX}{name}",
        fingerprint=checkpoint.fingerprint,
        dimension=checkpoint.model.dimension,
        config=checkpoint.config.model_dump(mode="json"),
        card=card,
    )
    return new, encode_model_file(checkpoint)


def _read_exported(
    context: ExtractorContext, job: Job, prefix: str, path: Path
) -> tuple[Model, bytes]:
    """Return the row of an exported network, and its file, after checking the network."""
    options = job.params["options"]
    name = f"{prefix}{job.params['name']}"
    config = get_extractor_config(
        f"{name}:{options}" if options else name, allow_test_extractors=False
    )
    card = {"source": job.params["filename"]}
    data = path.read_bytes()
    sha256 = hashlib.sha256(data).hexdigest()
    if prefix == TORCHSCRIPT_PREFIX:
        context.settings.check_torchscript_allowed(name, sha256)
    if prefix == TORCHSCRIPT_PREFIX:
        width = _check_torchscript(context, config, path)
    else:  # runs in a process of its own
        width = ExportedBackbone(
            config, data, torch.device("cpu"), is_stopping=context.is_stopping
        ).width
    assert config.input is not None
    size = config.input.height and [config.input.height, config.input.width]
    new = Model(
        name=name,
        fingerprint=sha256,
        dimension=width,
        config={"extractor": config.name, "image_size": size},
        card=card,
    )
    return new, data


def _check_torchscript(context: ExtractorContext, config: ExtractorConfig, path: Path) -> int:
    """Return the width of a network's output; a damaged file may end the process that loads it."""
    deadline = time.monotonic() + CHECK_SECONDS

    def check() -> None:
        if context.is_stopping():
            raise JobInterrupted
        if time.monotonic() > deadline:
            raise ChildKilled(f"it computes for more than {CHECK_SECONDS:g} s")

    try:
        return run_in_child(_load_width, config, path, on_progress=lambda: None, check=check)
    except ChildKilled as error:
        raise Unprocessable(
            "model_unusable", f"The extractor {config.name} can't be used: {error}."
        ) from error


def _load_width(config: ExtractorConfig, path: Path, _report: Callable[..., None]) -> int:
    return ExportedBackbone(config, path.read_bytes(), torch.device("cpu")).width


@contextlib.contextmanager
def _local_file(context: ExtractorContext, key: str) -> Iterator[Path]:
    """Yield the object as a local file, which is deleted afterwards if it was downloaded."""
    stored_file = context.store.file(key)
    if stored_file is not None:
        yield stored_file
        return
    folder = model_cache_folder(context.settings)  # whose left-over partial files are deleted
    make_private_folder(folder)
    path = folder / f"{new_id()}{PARTIAL_SUFFIX}"
    try:
        download_object(context.store, key, path)
        yield path
    except NotFound as error:
        raise Unprocessable(
            "checkpoint_lost",
            "The checkpoint is missing from the object store. Upload it again.",
        ) from error
    finally:
        path.unlink(missing_ok=True)


def training_card(checkpoint: Checkpoint) -> dict[str, Any]:
    """Return the checkpoint's training metadata as JSON that every supported database can store.

    Other values become text. If the JSON is longer than MAX_CARD_CHARACTERS, only the length of the
    training is kept.
    """
    try:
        card: dict[str, Any] = _JsonConverter().convert(checkpoint.about)
        if len(json.dumps(card)) <= MAX_CARD_CHARACTERS:
            return card
    except _CardTooLong:
        pass
    lengths = {name: checkpoint.about.get(name) for name in ("epoch", "global_step")}
    card = {name: value for name, value in lengths.items() if _is_short(value)}
    return {**card, "left_out": "the hyperparameters, which are too long"}


class _CardTooLong(Exception):
    pass


class _JsonConverter:
    """Converts values to JSON; raises _CardTooLong soon after MAX_CARD_CHARACTERS are exceeded.

    The limit bounds the work, too: a few bytes of a pickle can reference the same long value many
    times.
    """

    def __init__(self) -> None:
        self._remaining = MAX_CARD_CHARACTERS

    def convert(self, value: Any, depth: int = -1) -> Any:
        self._spend(1)
        if isinstance(value, bool) or value is None or _is_short(value):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else str(value)
        if depth < 4 and isinstance(value, dict):
            return {
                self._text(name): self.convert(member, depth + 1) for name, member in value.items()
            }
        if depth < 4 and isinstance(value, list | tuple):
            return [self.convert(member, depth + 1) for member in value]
        return self._text(value)

    def _text(self, value: Any) -> str:
        text = value if isinstance(value, str) else f"<{type(value).__name__}>"
        self._spend(len(text))
        # PostgreSQL can't store NUL characters or lone surrogates.
        return text.replace("\x00", "").encode("utf-8", "replace").decode("utf-8")

    def _spend(self, characters: int) -> None:
        self._remaining -= characters
        if self._remaining < 0:
            raise _CardTooLong


def _is_short(value: Any) -> bool:
    """Whether it is an integer that every supported database stores as a number."""
    return isinstance(value, int) and value.bit_length() < 64
