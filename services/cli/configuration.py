"""`placewise config`: what is in force."""

from __future__ import annotations

from rich.table import Table

from services.cli.output import JsonOption, answers, print_json
from shared.settings import Settings


def config(as_json: JsonOption = False) -> None:
    """Print every setting that is in force, secrets masked."""
    settings = Settings()
    values = settings.model_dump(mode="json")
    if as_json:
        print_json({name.upper(): value for name, value in values.items()})
        return
    table = Table("variable", "value", "default", "meaning")
    for name, field in Settings.model_fields.items():
        default = field.get_default(call_default_factory=True, validated_data={})
        table.add_row(name.upper(), str(values[name]), str(default), field.description or "")
    answers.print(table)
