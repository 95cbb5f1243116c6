"""`placewise config`, settings loading and checks for optional packages."""

from __future__ import annotations

from importlib.util import find_spec

from pydantic import ValidationError

from services.cli.output import JsonOption, Table, console, print_json, print_table, report_errors
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
        errors = [
            ": ".join(
                # `loc` is empty for an error of several settings: its message names them.
                [str(part).upper() for part in item["loc"]]
                + [item["msg"].removeprefix("Value error, ")]
            )
            for item in error.errors(include_input=False)  # a value may hold a password
        ]
        raise Misconfigured("bad_setting", "; ".join(errors)) from None


def config(as_json: JsonOption = False) -> None:
    """Print the effective settings. Secrets are masked."""
    with report_errors(as_json):
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
    console.print(f"New maps use the extractor {settings.new_map_extractor}.", soft_wrap=True)


def require_packages(*names: str) -> None:
    """Check that optional packages are installed.

    Args:
        names: Import names; by default those of evaluation, `faiss` and `torch`.

    Raises:
        Misconfigured: `trainer_missing` if one of them is not installed.
    """
    missing = [name for name in names or ("faiss", "torch") if find_spec(name) is None]
    if missing:
        raise Misconfigured(
            "trainer_missing",
            f"This command requires {', '.join(missing)}. "
            "Install it: pip install 'placewise[trainer]'.",
        )
