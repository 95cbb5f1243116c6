"""`placewise config`, settings loading and checks for optional packages."""

from __future__ import annotations

from importlib.util import find_spec
from typing import get_args

from pydantic import SecretStr, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from services.cli.output import JsonOption, Table, print_json, print_message, print_table
from shared.config.settings import Settings
from shared.errors import Misconfigured


def read_settings() -> Settings:
    """Load the settings from the environment.

    Raises:
        Misconfigured: `bad_setting`, which lists every setting that is invalid.
    """
    try:
        return Settings()
    except ValidationError as error:
        errors = [_describe_setting_error(item) for item in error.errors()]
        raise Misconfigured("bad_setting", "; ".join(errors)) from None


EXPECTED = {
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_parsing": "a number",
    "bool_parsing": "true or false",
}


def _describe_setting_error(error: ErrorDetails) -> str:
    """Name the setting, its value and what is expected."""
    message = error["msg"].removeprefix("Value error, ")
    if not error["loc"]:  # an error of several settings: its message names them
        return message
    if error["type"] in EXPECTED:
        message = f"expected {EXPECTED[error['type']]}"
    elif message.startswith("Input should be "):
        a_value = "a value " if error["type"].startswith(("greater", "less")) else ""
        message = f"expected {a_value}{message.removeprefix('Input should be ')}"
    name = str(error["loc"][0])
    field = Settings.model_fields[name]
    # A value that holds a secret, or one that is not a single text, is not repeated.
    shown = isinstance(error["input"], str | int | float) and not is_secret(field)
    value = f"={error['input']}" if shown else ""
    return f"{name.upper()}{value}: {message} ({field.description})"


def is_secret(field: FieldInfo) -> bool:
    return SecretStr in (field.annotation, *get_args(field.annotation))


def config(as_json: JsonOption = False) -> None:
    """Print the effective settings. Secrets are masked."""
    settings = read_settings()
    values = settings.model_dump(mode="json")
    if as_json:
        print_json({name.upper(): value for name, value in values.items()})
        return
    table = Table("variable", "value", "default", "meaning")
    for name, field in Settings.model_fields.items():
        default = field.get_default(call_default_factory=True, validated_data={})
        table.add_row(name.upper(), str(values[name]), str(default), field.description or "")
    print_table(table)
    print_message(f"New maps use the extractor {settings.new_map_extractor}.")


def require_packages(*names: str) -> None:
    """Check that optional packages are installed.

    Args:
        names: Import names; by default those of evaluation, `faiss` and `torch`.

    Raises:
        Misconfigured: `lab_missing` if one of them is not installed.
    """
    missing = [name for name in names or ("faiss", "torch") if find_spec(name) is None]
    if missing:
        raise packages_missing(*missing)


def packages_missing(*names: str) -> Misconfigured:
    """Return the error `lab_missing` for packages that `make run` does not install."""
    return Misconfigured(
        "lab_missing",
        f"This command requires {', '.join(names)}. "
        "Run `make setup`, or in the repository: uv pip install '.[lab]'.",
    )


def lab_missing(what: str) -> Misconfigured:
    """Return the error `lab_missing` for a command or option of the lab, which is not installed."""
    return Misconfigured(
        "lab_missing",
        f"{what} is part of the lab, which this installation does not contain. Run it from a clone "
        "of the repository, after `make setup`, or after: uv pip install '.[lab]'.",
    )
