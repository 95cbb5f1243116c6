"""For tests of loaded extractors in which no model was added."""

from __future__ import annotations

from typing import NoReturn

import torch


def none_added(name: str, device: torch.device) -> NoReturn:
    raise AssertionError(f"nothing in this test names the model {name!r}")
