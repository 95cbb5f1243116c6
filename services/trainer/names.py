"""Losses and miners are chosen by name."""

from __future__ import annotations

from collections.abc import Sequence

from shared.errors import Unprocessable


def match_name(name: str, known: Sequence[str], *, suffix: str, argument: str) -> str:
    """The one of `known` that `name` means, in capitals or not, with or without the suffix.

    Unprocessable: `unknown_loss` or `unknown_miner`, by the suffix; it lists the known ones.
    """
    wanted = name.strip().lower().removesuffix(suffix.lower())
    for candidate in known:
        if candidate.lower().removesuffix(suffix.lower()) == wanted:
            return candidate
    raise Unprocessable(
        f"unknown_{suffix.lower()}",
        f"There is no {suffix.lower()} {name!r}. Known: {', '.join(known)} ({argument}).",
    )
