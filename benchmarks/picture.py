"""A picture of queries and what was found: each query above its best match."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from benchmarks.asked import QueryOutcome

COLUMNS = 6
CELL = (240, 180)
CAPTION = 22
EDGE = 4
GAP = 16
CORRECT_COLOUR, WRONG_COLOUR, OUT_OF_MAP_COLOUR = (46, 160, 67), (207, 60, 50), (150, 150, 150)


def draw_outcomes(outcomes: Sequence[QueryOutcome], database: Path, target: Path) -> None:
    """Write a JPEG: queries in the upper rows, under each its most similar photo, framed green
    where it shows the place, red where not, grey where the answer was "not in this map"."""
    chosen = _choose_outcomes(outcomes)
    width = COLUMNS * (CELL[0] + GAP) + GAP
    block = 2 * CELL[1] + 2 * CAPTION + 2 * GAP
    rows = -(-len(chosen) // COLUMNS)
    sheet = Image.new("RGB", (width, rows * block + GAP), "white")
    pen = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=14)
    for number, answer in enumerate(chosen):
        left = GAP + number % COLUMNS * (CELL[0] + GAP)
        top = GAP + number // COLUMNS * block
        frame = OUT_OF_MAP_COLOUR if answer.estimate["in_map"] is False else WRONG_COLOUR
        frame = CORRECT_COLOUR if answer.best_is_correct and frame == WRONG_COLOUR else frame
        _paste(sheet, answer.query, left, top)
        pen.text((left, top + CELL[1] + 2), "asked", fill="black", font=font)
        below = top + CELL[1] + CAPTION
        right, bottom = left + CELL[0], below + CELL[1]
        pen.rectangle((left - EDGE, below - EDGE, right + EDGE, bottom + EDGE), frame)
        _paste(sheet, database / answer.best, left, below)
        pen.text((left, below + CELL[1] + EDGE), _caption(answer), fill=frame, font=font)
    target.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(target, quality=85)


def _choose_outcomes(outcomes: Sequence[QueryOutcome]) -> list[QueryOutcome]:
    """Two rows: mostly what it was sure of and right, then where it was wrong, then strangers."""
    given = [a for a in outcomes if a.estimate["in_map"]]
    right = [a for a in given if a.best_is_correct]
    wrong = [a for a in given if not a.best_is_correct]
    refused = [a for a in outcomes if a.estimate["in_map"] is False]
    strangers = [a for a in refused if not a.in_map]
    missed = [a for a in refused if a.in_map]
    return [
        *_evenly_spaced(right, COLUMNS + 1),
        *_evenly_spaced(wrong, 1),
        *_evenly_spaced(missed, 1),
        *_evenly_spaced(strangers, 3),
    ][: 2 * COLUMNS]


def _evenly_spaced(found: Sequence[QueryOutcome], count: int) -> list[QueryOutcome]:
    step = max(1, len(found) // count) if count else 1
    return list(found[::step][:count])


def _caption(answer: QueryOutcome) -> str:
    if answer.estimate["in_map"] is False:
        return "not in this map" + (" (it is)" if answer.in_map else "")
    sure = answer.estimate["confidence"]
    error = f"{answer.error_m:.0f} m off" if answer.error_m is not None else "no place"
    return error if sure is None else f"{error}, {sure:.0%} sure"


def _paste(sheet: Image.Image, path: Path, left: int, top: int) -> None:
    with Image.open(path) as photo:
        sheet.paste(photo.convert("RGB").resize(CELL, Image.Resampling.BICUBIC), (left, top))
