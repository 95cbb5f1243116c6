"""Names of models that were trained and added: `gsv:N`, or `gsv:/folder/best.ckpt` for a file.

A registered model `N` is fetched from the object store by whoever describes photos with it. A file
of this machine is for the commands alone: no other machine has it.

Imports no torch, and looks at no file.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from shared.errors import Misconfigured

TRAINED_MODEL_PREFIX = "gsv:"
MODEL_NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
MODEL_NAME_RULE = (
    "a model's name has up to 100 letters, digits, `.`, `_` and `-`, and begins with a letter or "
    "digit"
)
MAX_PATH_CHARACTERS = 190  # columns of the catalog hold names of 200


@dataclass(frozen=True, slots=True)
class TrainedModelName:
    """Exactly one of the two is set."""

    registered: str | None
    """The name that it was added under."""
    file: str | None
    """Absolute path of a checkpoint."""

    @property
    def extractor(self) -> str:
        """The extractor's canonical name."""
        return f"{TRAINED_MODEL_PREFIX}{self.registered or self.file}"


def parse_trained_model_name(extractor: str) -> TrainedModelName:
    """What an extractor's name that begins with `gsv:` means.

    Misconfigured: `bad_model_name`.
    """
    rest = extractor.removeprefix(TRAINED_MODEL_PREFIX)
    if rest.startswith("/"):
        if len(rest) > MAX_PATH_CHARACTERS or "\x00" in rest:
            raise Misconfigured(
                "bad_model_name",
                f"The path in {extractor!r} has more than {MAX_PATH_CHARACTERS} characters, or "
                "one that no path has.",
            )
        return TrainedModelName(None, rest)
    if not re.fullmatch(MODEL_NAME_PATTERN, rest):
        raise Misconfigured(
            "bad_model_name",
            f"The extractor {extractor!r} can't be read: {MODEL_NAME_RULE}. It is written "
            f"{TRAINED_MODEL_PREFIX}NAME for a model that was added, or {TRAINED_MODEL_PREFIX}/FOLDER/FILE for a checkpoint.",
        )
    return TrainedModelName(rest, None)
