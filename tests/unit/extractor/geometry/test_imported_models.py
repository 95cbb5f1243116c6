"""Names of an imported model and the photos of a map."""

from __future__ import annotations

from uuid import UUID

import pytest

from services.extractor.geometry.imported_models import match_names

PATHS = ["walk/day 1/a.jpg", "walk/day 2/a.jpg", "b.jpg", "c.jpg", "x/d.jpg", "d.jpg"]
IDS = {UUID(int=number + 1): path for number, path in enumerate(PATHS)}


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["walk/day 1/a.jpg", "b.jpg"], ["walk/day 1/a.jpg", "b.jpg"]),
        (["day 1/a.jpg", "images/b.jpg"], ["walk/day 1/a.jpg", "b.jpg"]),
        (["day 1\\a.jpg"], ["walk/day 1/a.jpg"]),
        (["a.jpg"], [None]),
        (["day 3/a.jpg", "e.jpg"], [None, None]),
        (["d.jpg"], ["d.jpg"]),
        (["x/d.jpg"], ["x/d.jpg"]),
        (["one/b.jpg", "other/b.jpg", "c.jpg"], [None, None, "c.jpg"]),
    ],
)
def test_name_is_that_of_the_one_photo_whose_path_ends_alike(
    names: list[str], expected: list[str | None]
) -> None:
    found = match_names(names, IDS)
    assert [IDS[found[name]] if name in found else None for name in names] == expected
