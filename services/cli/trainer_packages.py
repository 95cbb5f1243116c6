"""The packages that training and data sets need, and serving does not."""

from __future__ import annotations

from importlib.util import find_spec

from shared.errors import Misconfigured


def require_packages(*names: str) -> None:
    """Misconfigured (`trainer_missing`) unless all are installed; left out: those of evaluation."""
    missing = [name for name in names or ("faiss", "torch") if find_spec(name) is None]
    if missing:
        raise Misconfigured(
            "trainer_missing",
            f"This needs {', '.join(missing)}, which is not installed: "
            "pip install 'placewise[trainer]'.",
        )
