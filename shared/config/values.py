"""Values in environment variables: sizes (bytes, or a number with a unit) and lists."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator, ByteSize, TypeAdapter

_BYTE_SIZE = TypeAdapter(ByteSize)


def _parse_size(value: object) -> object:
    """Convert a text with a unit to bytes; anything else is left to the validation of integers."""
    if not isinstance(value, str) or value.strip().lstrip("+-").isdigit():
        return value
    try:
        return int(_BYTE_SIZE.validate_python(value))
    except ValueError:
        raise ValueError("expected a size such as 100MB, 2GiB or 1000000 (bytes)") from None


Size = Annotated[int, BeforeValidator(_parse_size)]
"""Bytes; written as a whole number, or with a unit such as 100MB (10^6 bytes) or 2GiB (2^30)."""


def format_megabytes(size_bytes: int) -> str:
    """Return a size in MB (10^6 bytes), as messages write it: 100 MB, 10.4858 MB."""
    return f"{size_bytes / 1e6:.6g} MB"


def split_list(value: str | None) -> list[str]:
    """Split a setting at commas and blanks; an unset one is an empty list."""
    return (value or "").replace(",", " ").split()
