"""Named, versioned ways of bringing a photo to the size that a backbone sees.

The name and the version are part of the extractor spec: two ways never mix in one generation.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from PIL import Image

from shared.errors import Misconfigured


@dataclass(frozen=True, slots=True)
class Preprocessing:
    name: str
    version: int
    height: int
    """pixels"""
    width: int
    """pixels"""

    def apply(self, image: Image.Image) -> Image.Image:
        """An RGB image resized, aspect not kept: bilinear, antialiased when it shrinks."""
        return image.resize((self.width, self.height), Image.Resampling.BILINEAR)

    def as_spec(self) -> dict[str, str | int]:
        return {"name": self.name, "version": self.version}


PREPROCESSINGS = {
    "square224": Preprocessing("square224", version=1, height=224, width=224),
    "square32": Preprocessing("square32", version=1, height=32, width=32),
}


def get_preprocessing(name: str) -> Preprocessing:
    """The preprocessing of that name; `resizeHEIGHTxWIDTH` is one for each size.

    Misconfigured: `unknown_preprocessing`.
    """
    if name in PREPROCESSINGS:
        return PREPROCESSINGS[name]
    size = re.fullmatch(r"resize([0-9]+)x([0-9]+)", name)
    if size is None:
        raise Misconfigured(
            "unknown_preprocessing",
            f"There is no preprocessing {name!r}. Known: {', '.join(sorted(PREPROCESSINGS))}, "
            "resizeHEIGHTxWIDTH.",
        )
    return Preprocessing(name, version=1, height=int(size[1]), width=int(size[2]))
