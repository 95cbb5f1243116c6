"""Files that mean harm, or look like it: the same ones on every run.

Each says what may become of it: the codes it may be refused with, at once or as a failed job, and
"succeeded" where a photo in it is as good as any.
"""

from __future__ import annotations

from tests.support.hostile.archives import archives
from tests.support.hostile.file import Hostile
from tests.support.hostile.photos import cut_off, noise, of_another_kind, polyglots
from tests.support.hostile.said import exif, fields, names
from tests.support.hostile.sizes import bombs, huge


def corpus() -> list[Hostile]:
    """All of them."""
    return [
        *of_another_kind(),
        *cut_off(),
        *huge(),
        *bombs(),
        *polyglots(),
        *exif(),
        *noise(),
        *names(),
        *fields(),
        *archives(),
    ]
