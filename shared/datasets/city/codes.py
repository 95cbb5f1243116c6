"""What the fourth byte of a texture's pixel means: see-through, solid, or something that shines.

The three colours of a pixel are its paint by day; the code says which of them shine at night, and
which surfaces carry snow. One byte, so that it travels through every copy with the colours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CODE_TRANSPARENT = 0
"""nothing is here: what is behind shows"""
CODE_FIRST_PANE = 1
PANE_CODES = 8
"""codes 1 to 8: the panes of a window; each session lights some of the eight"""
CODE_SHOP = 20
"""a shop's window: shines in the evening"""
CODE_SIGN = 21
CODE_LAMP = 22
"""lamps and headlights"""
CODE_FLAT = 30
"""lies open to the sky: snow stays on it"""
CODE_SOLID = 255


def emission_table(lit_panes: tuple[int, ...], strength: float) -> NDArray[np.float32]:
    """(256,) float32: how strongly a pixel of each code shines by itself, 0 by day."""
    table = np.zeros(256, np.float32)
    for pane in lit_panes:
        table[CODE_FIRST_PANE + pane] = 0.9 * strength
    table[CODE_SHOP] = 1.0 * strength
    table[CODE_SIGN] = 0.8 * strength
    table[CODE_LAMP] = 1.6 * strength
    return table
