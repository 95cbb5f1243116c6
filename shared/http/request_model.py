"""Base class of JSON bodies, whose errors are bounded whatever the body contains."""

from __future__ import annotations

from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, FailFast, model_validator

Item = TypeVar("Item")
FailFastList = Annotated[list[Item], FailFast()]
"""A list of which only the first invalid item is reported, for lists of thousands of items."""
MAX_FIELDS = 100


class RequestModel(BaseModel):
    """A JSON body, or an object in one; unknown fields are refused."""

    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _limit_fields(cls, values: object) -> object:
        if isinstance(values, dict) and len(values) > MAX_FIELDS:  # each unknown one is an error
            raise ValueError(f"has {len(values)} fields, at most {MAX_FIELDS} are allowed")
        return values
