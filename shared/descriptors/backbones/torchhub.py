"""torch.hub backbones: entries of third-party repositories that compute one global descriptor.

MegaLoc, BoQ, CosPlace, EigenPlaces and others publish such entries: (B, 3, H, W) normalised pixels
-> (B, D). If an entry returns a tuple, its first element is used: BoQ adds its attention maps.

A repository is downloaded at a fixed commit to the folder that torch.hub uses
(`$TORCH_HOME/hub/OWNER_NAME_COMMIT`), fingerprinted and executed. `Settings.config` decides whether
its code may run at all; once it runs, it can do whatever this process can do.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import re
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import URLError

import httpx2
import torch

from shared.descriptors.backbones import NetworkBackbone, StoredWeights, find_descriptor_fault
from shared.descriptors.weight_files import (
    OnProgress,
    download_file,
    first_error_line,
    ignore_progress,
)
from shared.errors import Misconfigured, PlacewiseError
from shared.extractor_config.configs import ExtractorConfig
from shared.extractor_config.names import TORCHHUB_PREFIX, TorchHubEntry
from shared.imaging.preprocessing import get_preprocessing

GITHUB = "https://github.com"
HUBCONF = "hubconf.py"
LICENCE_FILES = re.compile(r"(licen[cs]e|copying)([.-].*)?", re.IGNORECASE)
NETWORK_ERRORS = (URLError, httpx2.HTTPError, ConnectionError, TimeoutError)


def _cached_code_folder(hub: TorchHubEntry) -> Path:
    """Return the folder of the entry's code, whether or not it exists."""
    if hub.folder is not None:
        return Path(hub.folder)
    assert hub.repository is not None
    return Path(torch.hub.get_dir(), f"{hub.repository.replace('/', '_')}_{hub.commit}")


def _find_or_download_code(hub: TorchHubEntry, on_progress: OnProgress = ignore_progress) -> Path:
    """Return the folder of the code; a repository is downloaded from GitHub if it is missing.

    Raises Misconfigured: `weights_missing` with the three ways to get it, `download_corrupt`.
    """
    folder = _cached_code_folder(hub)
    if hub.folder is None and not folder.exists():
        try:
            _download_repository(hub, folder, on_progress)
        except (*NETWORK_ERRORS, OSError) as error:
            raise _code_missing_error(
                hub, f"its code can't be downloaded: {first_error_line(error)}"
            ) from error
    return _find_local_code(hub)


def _find_local_code(hub: TorchHubEntry) -> Path:
    """As `_find_or_download_code`, without downloading: raises `weights_missing` instead."""
    folder = _cached_code_folder(hub)
    if not (folder / HUBCONF).is_file():
        reason = f"there is no {folder / HUBCONF}" if hub.folder else "its code is not downloaded"
        raise _code_missing_error(hub, reason)
    return folder


def _load_module(
    hub: TorchHubEntry, folder: Path, on_progress: OnProgress = ignore_progress
) -> torch.nn.Module:
    """Execute the entry of the folder's `hubconf.py` with its arguments.

    Weights that the entry downloads through torch.hub are downloaded by `download_file` instead.

    Raises Misconfigured: `weights_missing`, `torchhub_unusable`, `download_corrupt`.
    """
    try:
        with _import_guard(folder, on_progress):
            # The code is a local folder also for repositories, so torch.hub neither asks whether to
            # trust it nor compares it with the repository's branches.
            load: Any = torch.hub.load  # untyped
            module = load(str(folder), hub.entry, source="local", **dict(hub.arguments))
    except PlacewiseError:
        raise
    except (Exception, SystemExit) as error:  # third-party code may raise anything
        message = f"{type(error).__name__}: {first_error_line(error)}"
        if isinstance(error, EOFError) and "reading a line" in message:
            message += ". It asks a question (as torch.hub does about a further repository), but "
            message += "there is no interactive input"
        if any(isinstance(cause, NETWORK_ERRORS) for cause in _exception_chain(error)):
            raise _code_missing_error(
                hub, f"a file that it needs can't be downloaded: {message}"
            ) from error
        raise _torchhub_unusable_error(hub, f"loading it failed with {message}") from error
    if not isinstance(module, torch.nn.Module):
        raise _torchhub_unusable_error(
            hub, f"{hub.entry} returns a {type(module).__name__}, not a torch.nn.Module"
        )
    return module


def code_fingerprint(folder: Path) -> str:
    """Return the sha256 of every file's path and content, except hidden files and bytecode."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        skipped = any(part.startswith(".") or part == "__pycache__" for part in relative.parts)
        if skipped or not path.is_file():
            continue
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").hexdigest()
        digest.update(f"{relative.as_posix()}\0{content}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _find_licence(folder: Path) -> str:
    """Return the title and the name of the folder's licence file, or `none found`."""
    for path in sorted(folder.iterdir()):
        if not LICENCE_FILES.fullmatch(path.name) or not path.is_file():
            continue
        text = path.read_text(errors="replace")
        lines = [line.strip() for line in text.splitlines() if line.strip()][:2]
        title = ", ".join(lines if lines[1:] and lines[1].startswith("Version") else lines[:1])
        return f"{title[:100]} ({path.name})"
    return "none found"


def _code_missing_error(hub: TorchHubEntry, reason: str) -> Misconfigured:
    """Return the error for code or weights that are missing.

    API clients see the message: it names no local folder that is not in the extractor's name.
    """
    cache = "$TORCH_HOME/hub (~/.cache/torch/hub where TORCH_HOME is not set)"
    fetch = f"with internet access, `placewise models fetch {hub.name}`"
    if hub.folder is not None:
        ways = (
            "(1) copy the folder to that path, on every machine that describes photos; (2) for "
            f"weights that its code downloads, {fetch}; (3) copy them from a machine that has "
            f"them: {cache}, the folder checkpoints."
        )
    else:
        ways = (
            f"(1) {fetch}; (2) copy {cache} with its checkpoints from a machine that has them; "
            "(3) clone the repository at its commit and use the folder: "
            f"{TORCHHUB_PREFIX}/FOLDER:{hub.entry}."
        )
    return Misconfigured(
        "weights_missing",
        f"The extractor {hub.name} can't be loaded: {reason}. Three ways to get its code and "
        f"weights: {ways}",
    )


def _torchhub_unusable_error(hub: TorchHubEntry, reason: str) -> Misconfigured:
    """Return the error for an entry that can't be used."""
    return Misconfigured(
        "torchhub_unusable",
        f"The extractor {hub.name} can't be used: {reason}. Three ways to fix it: (1) in the name, "
        "set other arguments of the entry, or the input that its network expects "
        "(input.size=HEIGHTxWIDTH,input.mean=R/G/B,input.std=R/G/B); (2) use another commit, and "
        "install the packages that it needs; (3) use a changed copy of the folder: "
        f"{TORCHHUB_PREFIX}/FOLDER:{hub.entry}.",
    )


@contextlib.contextmanager
def _import_guard(folder: Path, on_progress: OnProgress) -> Iterator[None]:
    """Isolate the loading of third-party code.

    Within the context stdin is empty, stdout goes to stderr and no bytecode is written. Afterwards
    the imported modules are removed, so that the next repository does not import them.
    """
    original_download = torch.hub.download_url_to_file

    def download_url_to_file(
        url: str, dst: str, hash_prefix: str | None = None, progress: bool = True
    ) -> None:
        # torch.hub's own download does not resume, and has no read timeout.
        if not url.startswith(("http://", "https://")):
            original_download(url, dst, hash_prefix, progress)
            return
        target = Path(dst).expanduser()
        download_file(url, target, sha256=hash_prefix, on_progress=on_progress)

    with (
        _patched(sys, "stdin", io.StringIO()),
        _patched(sys, "dont_write_bytecode", True),
        _patched(torch.hub, "download_url_to_file", download_url_to_file),
        contextlib.redirect_stdout(sys.stderr),
    ):
        try:
            yield
        finally:
            _forget_modules(folder, Path(torch.hub.get_dir()))


@contextlib.contextmanager
def _patched(owner: Any, name: str, value: object) -> Iterator[None]:
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


def _forget_modules(*folders: Path) -> None:
    """Unload modules: repositories may share module names, and a folder may change."""
    prefixes = tuple(f"{folder.resolve()}{os.sep}" for folder in folders)
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if isinstance(file, str) and os.path.realpath(file).startswith(prefixes):
            del sys.modules[name]


def _download_repository(hub: TorchHubEntry, folder: Path, on_progress: OnProgress) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    packed = folder.with_name(f"{folder.name}.zip")
    url = f"{GITHUB}/{hub.repository}/zipball/{hub.commit}"
    download_file(url, packed, on_progress=on_progress)
    with tempfile.TemporaryDirectory(dir=folder.parent) as unpacked:
        try:
            with zipfile.ZipFile(packed) as archive:
                # GitHub writes the commit to the comment; there is no other checksum.
                if archive.comment not in (b"", str(hub.commit).encode()):
                    raise zipfile.BadZipFile(f"its commit is {archive.comment.decode()}")
                archive.extractall(unpacked)  # stays in the folder: zipfile strips roots and ..
        except zipfile.BadZipFile as error:
            raise Misconfigured(
                "download_corrupt",
                f"{url} is not the archive of that commit: {error}. The download was deleted. "
                "Try again, or clone the repository and use its folder: "
                f"{TORCHHUB_PREFIX}/FOLDER:{hub.entry}.",
            ) from error
        finally:
            packed.unlink()
        entries = list(Path(unpacked).iterdir())
        root = entries[0] if len(entries) == 1 else Path(unpacked)
        with contextlib.suppress(FileExistsError):  # another process has downloaded it
            shutil.move(root, folder)


def _exception_chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


class TorchHubBackbone(NetworkBackbone):
    """Backbone that runs a torch.hub entry; one feature per photo."""

    licence = "unknown"

    def __init__(
        self,
        hub: TorchHubEntry,
        device: torch.device,
        *,
        on_progress: OnProgress = ignore_progress,
    ) -> None:
        """Load the entry, which executes its code, and check it on two images of noise.

        Raises Misconfigured: `weights_missing`, `torchhub_unusable`, `download_corrupt`.
        """
        self._hub = hub
        folder = _find_or_download_code(hub, on_progress)
        # Before anything is executed: the code may change its own folder.
        self.code_fingerprint = code_fingerprint(folder)
        self.name = hub.module
        self.layer = hub.entry
        self.licence = _find_licence(folder)
        self.device = device
        module = _load_module(hub, folder, on_progress)
        self.network = module = module.eval().requires_grad_(False).to(device)
        self.expected = hub.input
        self.fingerprint, size_bytes = module_fingerprint(module)
        self.card: dict[str, Any] = {
            "source": hub.source,
            "entry": hub.entry,
            "arguments": dict(hub.arguments),
            "size_bytes": size_bytes,
        }
        self.width = self._check()

    def own_spec(self) -> dict[str, Any]:
        return {"code_fingerprint": self.code_fingerprint}

    @classmethod
    def load(
        cls, config: ExtractorConfig, device: torch.device, weights: Path | None
    ) -> TorchHubBackbone:
        assert config.hub is not None
        return cls(config.hub, device)

    @classmethod
    def weights_source(cls, config: ExtractorConfig, weights: Path | None) -> str:
        hub = config.hub
        assert hub is not None
        return f"the folder {hub.folder}" if hub.folder else f"github.com/{hub.source}"

    @classmethod
    def find_weights(cls, config: ExtractorConfig, weights: Path | None) -> StoredWeights:
        """Find the code, which alone knows where its weights are."""
        assert config.hub is not None
        folder = _find_local_code(config.hub)
        return StoredWeights(folder, _find_licence(folder))

    @classmethod
    def fetch(
        cls, config: ExtractorConfig, weights: Path | None, on_progress: OnProgress
    ) -> TorchHubBackbone:
        assert config.hub is not None
        return cls(config.hub, torch.device("cpu"), on_progress=on_progress)

    def _check(self) -> int:
        """Return the descriptor's dimension; raise `torchhub_unusable` for invalid descriptors."""
        size = get_preprocessing(self._hub.input.preprocessing).typical_size
        try:
            both, alone = self.probe(*size)
        except ValueError as error:
            raise _torchhub_unusable_error(self._hub, str(error)) from error
        fault = find_descriptor_fault(both, alone)
        if fault is not None:
            raise _torchhub_unusable_error(self._hub, fault)
        return int(both.shape[1])


def module_fingerprint(module: torch.nn.Module) -> tuple[str, int]:
    """Return the sha256 of a module's tensors, and their size in bytes.

    Each tensor counts with name, dtype and shape; sorted by name.
    """
    digest, size_bytes = hashlib.sha256(), 0
    state: dict[str, Any] = module.state_dict()
    for name in sorted(state):
        tensor = state[name]
        if not isinstance(tensor, torch.Tensor):
            continue  # extra state that is not a tensor
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        flat = tensor.detach().cpu().contiguous().reshape(-1)
        digest.update(flat.view(torch.uint8).numpy().data)
        size_bytes += tensor.nbytes
    return digest.hexdigest(), size_bytes
