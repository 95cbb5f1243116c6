"""Response models of the API, which the gateway sends and the Python client returns.

Times are UTC with an offset, ids are UUIDv7, sizes are bytes.
"""

from __future__ import annotations

from typing import Any, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    GetJsonSchemaHandler,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema


def _keep_newer(value: Any, validate: ValidatorFunctionWrapHandler) -> Any:
    try:
        return validate(value)
    except ValidationError:
        if isinstance(value, str):
            return value
        raise


OPEN = WrapValidator(_keep_newer)
"""Of an enumeration: a client keeps the values that a newer server adds, as strings."""


class ResponseModel(BaseModel):
    """Base class of all responses."""

    # A client keeps the fields that a newer server adds.
    model_config = ConfigDict(
        frozen=True, from_attributes=True, populate_by_name=True, extra="allow", defer_build=True
    )

    def as_json(self) -> dict[str, Any]:
        """Return the response as the server sent it, for `json.dumps`."""
        return self.model_dump(mode="json", exclude_unset=True, warnings=False)

    @classmethod
    def of_row(cls, row: object, **values: Any) -> Self:
        """Build the response from `values` and, for the other required fields, from a row.

        The row's attributes are named as the fields, or as their `validation_alias`.
        """
        assert values.keys() <= cls.model_fields.keys(), "they would be sent"
        for name, field in cls.model_fields.items():
            if name not in values and field.is_required():
                values[name] = getattr(row, str(field.validation_alias or name))
        return cls(**values)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        described = handler(schema)
        handler.resolve_ref_schema(described).pop("additionalProperties", None)  # it sends none
        return described
