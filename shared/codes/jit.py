"""How the loops over codes and rows are compiled: by numba, on their first call.

What was compiled is kept beside the source, or in NUMBA_CACHE_DIR, for this kind of processor;
where neither can be written, each process compiles anew (some seconds).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

# What is added in which order stays as it is written.
ORDERED_FASTMATH = frozenset({"contract", "nsz"})
# Sums may run in vector lanes: for each length in one fixed order all the same.
REORDERED_FASTMATH = ORDERED_FASTMATH | {"reassoc"}


def numba_jit(arithmetic: frozenset[str]) -> Callable[[Function], Function]:
    """Compile a function of arrays and numbers. It holds no lock of the interpreter."""

    def wrap(function: Function) -> Function:
        options: dict[str, Any] = {"nogil": True, "fastmath": set(arithmetic)}
        try:
            made: Function = numba.njit(cache=True, **options)(function)
        except RuntimeError:  # there is no place to keep it
            made = numba.njit(**options)(function)
        return made

    return wrap
