"""What every aggregator offers."""

from __future__ import annotations

from typing import Annotated, ClassVar, NamedTuple

import torch
from pydantic import Field
from torch import nn
from torch.nn.functional import normalize

# Arguments of aggregators come from files of others, too: these bounds keep sizes computable.
Size = Annotated[int, Field(ge=1, le=1 << 20)]
Layers = Annotated[int, Field(ge=1, le=64)]
Positive = Annotated[float, Field(gt=0, le=1000)]


class FeatureMapShape(NamedTuple):
    """The size of a backbone's map of one photo."""

    channels: int
    height: int
    width: int
    has_token: bool = False


class Aggregator(nn.Module):
    """(B, C, h, w) maps -> (B, dimension) float32 rows of length 1 (0 of a photo without any)."""

    inferred: ClassVar[dict[str, str]] = {}
    """Arguments that are read off the map: their name -> the field of MapShape."""
    takes_token: ClassVar[bool] = False
    """Whether `forward` has a second argument, (B, C) or None: a transformer's class token."""

    def __init__(self, dimension: int) -> None:
        super().__init__()
        self.dimension = dimension

    def refusal(self, height: int, width: int) -> str | None:
        """Why maps of h x w can't be aggregated; None where they can."""
        del height, width
        return None


def normalise_rows(values: torch.Tensor) -> torch.Tensor:
    """(B, ...) of any floating type -> (B, D) float32, each row divided by its length."""
    return normalize(values.flatten(1).float(), dim=-1)
