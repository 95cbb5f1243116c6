"""Place labels that are paths, such as `tower/floor 7/elevator`, and their levels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

PATH_SEPARATOR = "/"


def label_levels(label: str | None, is_path: bool) -> tuple[str, ...]:
    """Return the levels of a place label, finest first.

    Args:
        is_path: Whether `/` separates levels. Otherwise the whole label is the only level.

    Returns:
        The prefixes of the path that end in a level with a name: those of `a//b` are `a//b` and
        `a`. Empty for None and for a path without any name.
    """
    if label is None or not is_path:
        return () if label is None else (label,)
    parts = label.split(PATH_SEPARATOR)
    return tuple(
        PATH_SEPARATOR.join(parts[:depth])
        for depth in range(len(parts), 0, -1)
        if parts[depth - 1].strip()
    )


def look_like_paths(labels: Collection[str]) -> bool:
    """Return whether distinct labels are paths by their look.

    They are if most of them have two or more levels, and two of these begin with the same name.
    """
    paths = [levels for label in labels if len(levels := label_levels(label, is_path=True)) > 1]
    first_names = Counter(levels[-1] for levels in paths)
    return 2 * len(paths) > len(labels) and max(first_names.values()) > 1


def is_within_level(label: str | None, level: str) -> bool:
    """Return whether a label path is the level or lies below it."""
    return label is not None and (label == level or label.startswith(level + PATH_SEPARATOR))
