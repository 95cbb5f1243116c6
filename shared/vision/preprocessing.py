"""Named, versioned ways of bringing a photo to the size that a backbone sees.

The name and the version are part of the extractor spec: two ways never mix in one generation.
"""

from __future__ import annotations

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
    try:
        return PREPROCESSINGS[name]
    except KeyError:
        raise Misconfigured(
            "unknown_preprocessing",
            f"There is no preprocessing {name!r}. Known: {', '.join(sorted(PREPROCESSINGS))}.",
        ) from None
