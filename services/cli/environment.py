"""`placewise config`: what is in force.

The packages that training and data sets need, and serving does not.
"""

from __future__ import annotations

from importlib.util import find_spec

from pydantic import ValidationError
from rich.table import Table

from services.cli.output import JsonOption, console, print_json, report_errors
from shared.config.settings import Settings
from shared.errors import Misconfigured


def read_settings() -> Settings:
    """The settings in force; Misconfigured (`bad_setting`) names what can't be read."""
    try:
        return Settings()
    except ValidationError as error:
        faults = [
            ": ".join(
                # A fault of several settings together has no place of its own: it names them.
                [str(part).upper() for part in fault["loc"]]
                + [fault["msg"].removeprefix("Value error, ")]
            )
            for fault in error.errors(include_input=False)  # a value may hold a password
        ]
        raise Misconfigured("bad_setting", "; ".join(faults)) from None


def config(as_json: JsonOption = False) -> None:
    """Print every setting that is in force, secrets masked."""
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
    console.print(table)
    console.print(f"New maps are described by {settings.new_map_extractor}.", soft_wrap=True)


def require_packages(*names: str) -> None:
    """Misconfigured (`trainer_missing`) unless all are installed; left out: those of evaluation."""
    missing = [name for name in names or ("faiss", "torch") if find_spec(name) is None]
    if missing:
        raise Misconfigured(
            "trainer_missing",
            f"This needs {', '.join(missing)}, which is not installed: "
            "pip install 'placewise[trainer]'.",
        )
