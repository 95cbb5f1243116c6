"""What a run tells whoever watches it; the command line shows it with bars."""

from __future__ import annotations

from typing import Protocol


class Display(Protocol):
    def info(self, text: str) -> None:
        """A line for the record."""

    def warn(self, text: str) -> None:
        """A line that asks for attention."""

    def progress(self, what: str, done: int, most: int, note: str = "") -> None:
        """How far `what` is; it begins when first heard of and ends at `most`."""


class NullDisplay:
    """Shows nothing; what was said stays, for whoever asks."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def info(self, text: str) -> None:
        self.said.append(text)

    def warn(self, text: str) -> None:
        self.said.append(text)

    def progress(self, what: str, done: int, most: int, note: str = "") -> None:
        return
