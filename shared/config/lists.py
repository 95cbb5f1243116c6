"""Lists in environment variables."""

from __future__ import annotations


def split_list(value: str | None) -> list[str]:
    """Split a setting at commas and blanks; an unset one is an empty list."""
    return (value or "").replace(",", " ").split()
