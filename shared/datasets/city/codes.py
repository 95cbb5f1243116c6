"""What the fourth byte of a texture's pixel means: see-through, solid, or something that shines.

The three colours of a pixel are its paint by day; the code says which of them shine at night, and
which surfaces carry snow. One byte, so that it travels through every copy with the colours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CLEAR = 0
"""nothing is here: what is behind shows"""
PANE_0 = 1
PANES = 8
"""codes 1 to 8: the panes of a window; each session lights some of the eight"""
SHOP = 20
"""a shop's window: shines in the evening"""
SIGN = 21
LAMP = 22
"""lamps and headlights"""
FLAT = 30
"""lies open to the sky: snow stays on it"""
SOLID = 255


def light_table(lit_panes: tuple[int, ...], strength: float) -> NDArray[np.float32]:
    """(256,) float32: how strongly a pixel of each code shines by itself, 0 by day."""
    table = np.zeros(256, np.float32)
    for pane in lit_panes:
        table[PANE_0 + pane] = 0.9 * strength
    table[SHOP] = 1.0 * strength
    table[SIGN] = 0.8 * strength
    table[LAMP] = 1.6 * strength
    return table
