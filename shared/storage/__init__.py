"""Object store: immutable bytes under string keys, in a local folder or an S3 bucket.

`shared.storage.open_store.open_store` selects the implementation by the settings.

| keys | contents |
|---|---|
| `originals/<uuid>` | an uploaded photo |
| `checkpoints/<uuid>` | an uploaded checkpoint or COLMAP model, until its job has ended |
| `models/<sha256>/<uuid>.safetensors` | an added model: its configuration and weights |
| `thumbnails/<photo>` | a photo's thumbnail, JPEG |
| `previews/<photo>` | a preview for browsers, JPEG, of a photo that needs one |
| `chunks/<generation>/<chunk>.npy`, `.json` | descriptor rows, manifest |
| `chunks/<generation>/<chunk>.codes`, `.features` | sign codes and local features of the rows |
| `journal/<first>-<last>-<uuid>.jsonl.gz` | rows of the catalog (`shared.journal`) |
| `vocabularies/<uuid>.npy` | VLAD centres |
| `whitenings/<uuid>.safetensors` | PCA whitenings |
| `reconstructions/<uuid>/matches.npz` | verified matches of a reconstruction |
| `reconstructions/<uuid>/<n>/*.bin`, `<n>.npz` | a component: COLMAP model, and what queries read |
| `queries/<job>`, `queries/<job>.npy` | a query photo that is not stored, and its descriptor |
| `queries/<job>.features` | its local features |
| `queries/<job>.jpg` | a preview of a query photo in a format that not all browsers show |
| `trash/<day>/<key>` | an orphan moved to the trash on that day, deleted after TRASH_DAYS |
| `imports/...` | the operator's files, which Placewise only reads |

Notes are small files of the store itself and not objects: `.placewise` (the catalog that owns the
store, `shared.storage.ownership`) and `.placewise-hold` (garbage collection is suspended,
`shared.storage.trash`).
"""

from shared.storage.folder import FolderStore
from shared.storage.protocol import ObjectInfo, ObjectStore, ObjectWriter, OwnedStore

__all__ = ["FolderStore", "ObjectInfo", "ObjectStore", "ObjectWriter", "OwnedStore"]
