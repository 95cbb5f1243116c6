"""What goes wrong when files of tensors are read."""

from __future__ import annotations

import pickle

from safetensors import SafetensorError

UNREADABLE = (
    OSError,
    EOFError,
    RuntimeError,
    AssertionError,
    KeyError,
    ValueError,
    TypeError,
    SafetensorError,
    pickle.UnpicklingError,
)
"""What torch.load (with `weights_only`) and safetensors raise for damaged and for other files."""


def first_line(error: BaseException) -> str:
    """What an error says, in one line; its name where it says nothing."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
