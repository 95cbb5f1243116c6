"""`make demo`: index, fit, ask, on photographs that installed packages bring.

Each photograph of scikit-learn and scikit-image is cut into overlapping views, which stand for
places; a query is the same place seen from a little aside, nearer, darker, and saved again. What
is printed shows that the parts work together. It is no benchmark: the shipped vocabulary was
learnt on these very photographs.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageEnhance

from shared.client import Client

GRID = 3  # places along each side of a photograph
PLACE = 0.34  # side of a place's view, as a share of the photograph's shorter side
ASIDE = 0.12  # how far a query stands beside its place, as a share of the view


def main() -> None:
    from services.cli.connect import connect
    from services.cli.output import progress_bar
    from services.cli.vocabulary import fit_and_wait
    from shared.vision.shipped_vocabulary import photographs

    with tempfile.TemporaryDirectory() as folder:
        os.environ["PLACEWISE_HOME"] = str(Path(folder, "home"))
        pairs = make_places(photographs(), Path(folder))
        with connect(None, None) as client, progress_bar() as progress:
            for place, _ in progress.track(pairs, description="indexing"):
                uploaded = client.upload(place, place=place.stem)
            client.wait_for(uploaded["job_id"])
            print(f"{len(pairs)} places; found at once (R@1):")
            print(f"  with the shipped vocabulary   {found_at_once(client, pairs)} of {len(pairs)}")
            fit_and_wait(client, {}, progress)
            print(f"  with one fitted on the map    {found_at_once(client, pairs)} of {len(pairs)}")


def found_at_once(client: Client, pairs: list[tuple[Path, Path]]) -> int:
    """How many queries have their own place first."""
    return sum(
        client.similar_to_file(query, top_k=1)["similar_images"][0]["place"] == place.stem
        for place, query in pairs
    )


def make_places(photographs: list[Path], folder: Path) -> list[tuple[Path, Path]]:
    """(place, query) photos, written into the folder."""
    rng = np.random.default_rng(0)
    pairs = []
    for photograph in photographs:
        image = Image.open(photograph).convert("RGB")
        side = int(min(image.size) * PLACE)
        steps = [np.linspace(0.15 * side, length - 1.15 * side, GRID) for length in image.size]
        for x, left in enumerate(steps[0]):
            for y, top in enumerate(steps[1]):
                name = f"{photograph.stem}-{x}{y}"
                place, query = folder / f"{name}.jpg", folder / f"{name}-asked.jpg"
                _view(image, left, top, side).save(place, quality=92)
                aside = rng.uniform(-ASIDE, ASIDE, 2) * side
                seen = _view(image, left + aside[0], top + aside[1], side * rng.uniform(0.85, 1))
                dimmed = ImageEnhance.Brightness(seen).enhance(rng.uniform(0.6, 0.9))
                dimmed.save(query, quality=70)
                pairs.append((place, query))
    return pairs


def _view(image: Image.Image, left: float, top: float, side: float) -> Image.Image:
    box = (int(left), int(top), int(left + side), int(top + side))
    return image.crop(box).resize((320, 320), Image.Resampling.BICUBIC)


if __name__ == "__main__":
    main()
