"""Just-in-time compilation of loops over codes and rows by numba, on their first call.

Compiled code is cached beside the source, or in NUMBA_CACHE_DIR, for the current CPU type. If
neither is writable, each process compiles again, which takes some seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

# Floating-point additions keep the order in which they are written.
ORDERED_FASTMATH = frozenset({"contract", "nsz"})
# Sums may be vectorized: the order may change, but is the same for each array length.
REORDERED_FASTMATH = ORDERED_FASTMATH | {"reassoc"}


def numba_jit(arithmetic: frozenset[str]) -> Callable[[Function], Function]:
    """Decorator that compiles a function of arrays and numbers; it runs without the GIL."""

    def decorate(function: Function) -> Function:
        options: dict[str, Any] = {"nogil": True, "fastmath": set(arithmetic)}
        try:
            compiled: Function = numba.njit(cache=True, **options)(function)
        except RuntimeError:  # no writable cache folder
            compiled = numba.njit(**options)(function)
        return compiled

    return decorate
