"""The object store: bytes under keys. A folder when embedded; S3 for many machines.

`shared.storage.open_store` chooses between the two by the settings.

| keys | what lies there |
|---|---|
| `originals/<uuid>` | an uploaded photo |
| `incoming/<upload>` | what a caller sent straight to the bucket, until the upload is completed |
| `archives/<uuid>` | an uploaded archive, until its photos are in |
| `checkpoints/<uuid>` | a checkpoint that was sent, until it is a model or refused |
| `models/<sha256>/<uuid>.safetensors` | a model that was added: its configuration and weights |
| `thumbnails/<photo>` | its thumbnail, JPEG |
| `chunks/<generation>/<chunk>.npy`, `.json`, `.codes` | descriptor rows, what they are, codes |
| `journal/<first>-<last>-<uuid>.jsonl.gz` | rows of the catalog (`shared.journal`) |
| `vocabularies/<uuid>.npy` | VLAD centres |
| `whitenings/<uuid>.safetensors` | PCA whitenings |
| `queries/<job>`, `queries/<job>.npy` | a query photo that is not stored, and its descriptor |
| `queries/<job>.json` | what a comparison has come to |
| `features/<generation>/<photo>.npy` | a photo's local features, with LOCAL_FEATURES=keep |
| `work/<job>/...` | what a sliced job keeps between its slices |
| `trash/<day>/<key>` | an orphan that was moved there on that day, until TRASH_DAYS are over |
| `imports/...` (IMPORT_PREFIX) | what others have put there; it is only read |

Notes of the store itself are no objects: `.placewise` (whose store it is, `store_owner`) and
`.placewise-hold` (orphans are not collected until someone decides, `collection_hold`).
"""

from shared.storage.folder import FolderStore
from shared.storage.protocol import (
    ObjectInfo,
    ObjectStore,
    ObjectWriter,
    OwnedStore,
    PresignedPut,
    PresigningStore,
)

__all__ = [
    "FolderStore",
    "ObjectInfo",
    "ObjectStore",
    "ObjectWriter",
    "OwnedStore",
    "PresignedPut",
    "PresigningStore",
]
