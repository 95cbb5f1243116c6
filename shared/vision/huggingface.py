"""Files of the Hugging Face hub, in its own cache: downloads that go on, checked by their hash.

huggingface_hub's own download begins anew in each process and compares sizes only. Here the file is
brought as a blob of the cache, whose name is the hash that the hub promises; huggingface_hub finds
it there and gives it its place in the snapshot.
"""

from __future__ import annotations

import re
from pathlib import Path

from shared.vision.download import OnProgress, download_file


def download_hub_file(repository: str, filename: str, on_progress: OnProgress) -> Path:
    """The file in the cache of this machine, the newest that the hub has.

    Misconfigured (`download_corrupt`) when it has another hash; OSError, RuntimeError or
    httpx2.HTTPError when it can't be had. HF_ENDPOINT, HF_TOKEN and HF_HOME are honoured.
    """
    import huggingface_hub
    from huggingface_hub import constants
    from huggingface_hub.file_download import repo_folder_name
    from huggingface_hub.utils import build_hf_headers  # type: ignore[attr-defined]

    url = huggingface_hub.hf_hub_url(repository, filename)
    metadata = huggingface_hub.get_hf_file_metadata(url)
    if metadata.etag is None:
        raise OSError(f"{url} has no ETag")
    folder = repo_folder_name(repo_id=repository, repo_type="model")
    # Small files have git's hash, which is of more than their content.
    sha256 = metadata.etag if re.fullmatch(r"[0-9a-f]{64}", metadata.etag) else None
    download_file(
        url,
        Path(constants.HF_HUB_CACHE, folder, "blobs", metadata.etag),
        sha256=sha256,
        headers=build_hf_headers(),
        on_progress=on_progress,
    )
    return Path(huggingface_hub.hf_hub_download(repository, filename))
