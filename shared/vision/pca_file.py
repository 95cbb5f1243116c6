"""Files of PCA whitenings: safetensors, checked before they spoil a descriptor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared.errors import Unprocessable
from shared.vision.pca import Whitening

NAMES = ("mean", "directions", "variances", "explained", "rows")


def encode_whitening(whitening: Whitening) -> bytes:
    """The whitening as the bytes of a `.safetensors` file."""
    from safetensors.numpy import save

    return save(
        {
            "mean": np.ascontiguousarray(whitening.mean),
            "directions": np.ascontiguousarray(whitening.directions),
            "variances": np.ascontiguousarray(whitening.variances),
            "explained": np.array([whitening.explained], dtype=np.float64),
            "rows": np.array([whitening.rows], dtype=np.int64),
        }
    )


def decode_whitening(data: bytes, *, dimension: int | None = None) -> Whitening:
    """The whitening in such bytes, for descriptors of `dimension` if that is known.

    Unprocessable (`pca_unfit`) says what is wrong with it.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        stored = load(data)
    except SafetensorError as error:
        raise _unfit(f"it is no safetensors file, or not a whole one ({error})") from error
    missing = [name for name in NAMES if name not in stored]
    if missing:
        raise _unfit(f"it has no {', '.join(missing)}")
    mean, directions, variances = (_floats(stored, name) for name in NAMES[:3])
    shapes = (mean.shape, variances.shape)
    if directions.ndim != 2 or shapes != (directions.shape[1:], directions.shape[:1]):
        raise _unfit(
            f"its mean {mean.shape}, directions {directions.shape} and variances "
            f"{variances.shape} do not belong together: (D,), (d, D) and (d,) are expected"
        )
    kept, made_for = directions.shape
    if not 0 < kept <= made_for:
        raise _unfit(f"it makes {kept} dimensions of {made_for}")
    if dimension is not None and made_for != dimension:
        raise _unfit(f"it is for descriptors of {made_for} dimensions, and these have {dimension}")
    if not (variances > 0).all():
        raise _unfit("a variance is not positive")
    # A unit direction divided by its standard deviation, as far as float32 goes.
    lengths = np.linalg.norm(directions, axis=1) * np.sqrt(variances)
    if not np.allclose(lengths, 1.0, rtol=0.01):
        raise _unfit("its directions are not those of its variances")
    try:
        return Whitening(
            mean,
            directions,
            variances,
            explained=float(stored["explained"].item()),
            rows=int(stored["rows"].item()),
        )
    except ValueError as error:
        raise _unfit(f"explained and rows are one number each ({error})") from error


def _floats(stored: dict[str, NDArray[np.generic]], name: str) -> NDArray[np.float32]:
    array = stored[name]
    if array.dtype != np.float32:
        raise _unfit(f"its {name} is {array.dtype}, not float32")
    floats = array.astype(np.float32, copy=False)
    if not np.isfinite(floats).all():
        raise _unfit(f"its {name} holds NaN or infinite numbers")
    return floats


def _unfit(reason: str) -> Unprocessable:
    return Unprocessable(
        "pca_unfit", f"The PCA file can't be used: {reason}. Fit a new one on the map's rows."
    )
