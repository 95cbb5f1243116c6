"""Aggregator: the base class of the aggregators of VPR models."""

from __future__ import annotations

from typing import Annotated, ClassVar, NamedTuple

import torch
from pydantic import Field
from torch import nn
from torch.nn.functional import normalize

# Arguments may come from untrusted checkpoints; these bounds limit the sizes of tensors.
Size = Annotated[int, Field(ge=1, le=1 << 20)]
Layers = Annotated[int, Field(ge=1, le=64)]
Positive = Annotated[float, Field(gt=0, le=1000)]


class FeatureMapShape(NamedTuple):
    """Shape of a backbone's output for one photo."""

    channels: int
    height: int
    width: int


class Aggregator(nn.Module):
    """Aggregates (B, C, h, w) maps to (B, dimension) float32 unit rows.

    A photo without features gives a zero row.
    """

    inferred: ClassVar[dict[str, str]] = {}
    """Arguments inferred from the map: argument name -> field of FeatureMapShape."""
    takes_token: ClassVar[bool] = False
    """Whether `forward` takes a second argument: (B, C) class tokens or None."""

    def __init__(self, dimension: int) -> None:
        super().__init__()
        self.dimension = dimension

    def refusal(self, height: int, width: int) -> str | None:
        """Return why maps of `height` x `width` are not supported, or None if they are."""
        del height, width
        return None


def normalise_rows(values: torch.Tensor) -> torch.Tensor:
    """Flatten (B, ...) of any floating type to (B, D) float32 rows of length 1."""
    return normalize(values.flatten(1).float(), dim=-1)
