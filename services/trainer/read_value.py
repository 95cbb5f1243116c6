"""Text of a flag or of a YAML file -> what an argument means by it.

Lists and dicts are JSON. The predecessor's published commands write some of them as Python does,
`(320, 320)` and `['sfxs_val']`, so both are read.
"""

from __future__ import annotations

import ast
import json
import re
from typing import Any

TRUE_WORDS = frozenset(("true", "yes", "on", "1"))
FALSE_WORDS = frozenset(("false", "no", "off", "0"))


def parse_bool(value: Any) -> Any:
    """`True`, `false`, `yes`, `0` ... -> bool; what is no text stays for pydantic to judge.

    Raises ValueError for any other text: a non-empty text is not simply true.
    """
    if not isinstance(value, str):
        return value
    word = value.strip().lower()
    if word in TRUE_WORDS:
        return True
    if word in FALSE_WORDS:
        return False
    raise ValueError(f"{value!r} is neither true nor false")


def parse_literal(value: Any) -> Any:
    """JSON or Python notation -> list, tuple, dict or number; ValueError for what is neither."""
    if not isinstance(value, str):
        return value
    text = value.strip()
    for read in (json.loads, ast.literal_eval):
        try:
            return read(text)
        except (ValueError, SyntaxError):
            continue
    raise ValueError(f"{value!r} is neither JSON nor Python notation")


def parse_names(value: Any) -> Any:
    """As `parse_literal`; a bare word, or several with commas between, is a list of names."""
    if isinstance(value, str) and re.fullmatch(r"[\w.\- ]+(,[\w.\- ]+)*", value.strip()):
        return [name.strip() for name in value.split(",")]
    return parse_literal(value)


def parse_image_size(value: Any) -> Any:
    """`(320, 320)`, `[320, 320]`, `320 320`, `320x320` (H W) and `320` (both) -> (H, W)."""
    if isinstance(value, str):
        numbers = re.fullmatch(r"\s*(\d+)(?:\s*[x, ]\s*(\d+))?\s*", value)
        if numbers:
            return (int(numbers[1]), int(numbers[2] or numbers[1]))
        value = parse_literal(value) if value.strip()[:1] in ("(", "[") else value.strip()
    if isinstance(value, int):
        return (value, value)
    return value


def parse_number_or_text(value: Any) -> Any:
    """`32` -> 32, `[0]` -> [0], `16-mixed` -> "16-mixed"."""
    if not isinstance(value, str):
        return value
    try:
        return parse_literal(value)
    except ValueError:
        return value.strip()
