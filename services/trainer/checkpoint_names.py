"""Names of checkpoints and folders from templates with figures in them.

    {backbone_arch}_epoch({epoch:02d})_step({step:04d})_R1[{sfxs_val/R1:.4f}]

A field is an argument's name, `epoch`, `step` or a metric. `self.` and `model.` before it, which
the predecessor's commands write, mean the same. `R1` alone is the monitored set's.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from shared.errors import InvalidRequest

FIELD = r"\{(?P<name>[^{}:]+)(?P<format>:[^{}]*)?\}"
# With what belongs to it: `_R1[...]`, `-loss=...`.
LABELLED_FIELD = re.compile(
    rf"(?P<before>[_\-. ]?(?:[A-Za-z][A-Za-z0-9]*)?[\[(=]?)?{FIELD}(?P<after>[\])])?"
)
FIELD_ALIASES = {"encoder_arch": "backbone_arch"}


class CheckpointNameTemplate:
    """A template whose fields are known to be those that a run has.

    `dropped` are the fields that no run of these sets logs: they drop out, with the label and the
    brackets around them.
    """

    def __init__(
        self,
        template: str,
        fixed: Mapping[str, Any],
        metrics: Iterable[str],
        *,
        monitored_set: str = "",
        insert_names: bool = False,
    ) -> None:
        known = {"epoch", "step", *metrics}
        self.dropped_fields: list[str] = []
        self._insert_names = insert_names

        def settle(match: re.Match[str]) -> str:
            name = _strip_owner(match["name"])
            if f"{monitored_set}/{name}" in known:
                name = f"{monitored_set}/{name}"
            before, after = match["before"] or "", match["after"] or ""
            if name in known:
                return f"{before}{{{name}{match['format'] or ''}}}{after}"
            if name in fixed:
                return (
                    f"{before}{safe_filename(_format_value(fixed[name], match['format']))}{after}"
                )
            self.dropped_fields.append(match["name"])
            return ""

        self._template = LABELLED_FIELD.sub(settle, template)
        if not self._template.strip("_-. "):
            raise InvalidRequest(
                "bad_argument",
                f"--filename: nothing is left of {template!r}; known: {_join_names(known)}",
            )

    def format_name(self, figures: Mapping[str, Any]) -> str:
        """The name with these figures; `/` becomes `-`: a name is no path."""

        def fill(match: re.Match[str]) -> str:
            figure = _format_value(figures[match["name"]], match["format"])
            return f"{match['name']}={figure}" if self._insert_names else figure

        return safe_filename(re.sub(FIELD, fill, self._template))


def format_folder(template: str, fixed: Mapping[str, Any]) -> str:
    """A folder's path with arguments in it; InvalidRequest (`bad_argument`) for other fields."""

    def fill(match: re.Match[str]) -> str:
        name = _strip_owner(match["name"])
        if name not in fixed:
            raise InvalidRequest(
                "bad_argument", f"--default_root_dir: {name!r} is no argument of a run."
            )
        return safe_filename(_format_value(fixed[name], match["format"]))

    return re.sub(FIELD, fill, template)


def safe_filename(text: str) -> str:
    """The text as a part of a file's name on every system."""
    return re.sub(r'[/\\:*?"<>|\x00-\x1f]', "-", text)


def _strip_owner(name: str) -> str:
    name = name.strip()
    for owner in ("self.", "model."):
        name = name.removeprefix(owner)
    return FIELD_ALIASES.get(name, name)


def _format_value(value: Any, form: str | None) -> str:
    try:
        return format(value, (form or ":")[1:])
    except (ValueError, TypeError) as error:
        raise InvalidRequest(
            "bad_argument", f"--filename: {value!r} can't be written as {form!r}: {error}."
        ) from error


def _join_names(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))
