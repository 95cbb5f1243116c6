"""From flags and YAML files to checked arguments, and back to a file.

A key that is not known is an error that names the nearest known one.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from services.trainer.arguments import TrainingArguments
from shared.errors import InvalidRequest, NotFound

ALIASES = {"warmup_steps": "warmpup_steps"}
"""how one would spell it: how the predecessor does"""
ARGUMENT_NAMES = tuple(TrainingArguments.model_fields)


def resolve_name(name: str) -> str:
    """`batch-size`, `batch_size` -> `batch_size`; InvalidRequest (`unknown_argument`) otherwise."""
    wanted = name.replace("-", "_")
    wanted = ALIASES.get(wanted, wanted)
    if wanted in ARGUMENT_NAMES:
        return wanted
    raise InvalidRequest(
        "unknown_argument", f"There is no argument {name!r}.{suggest_name(wanted, ARGUMENT_NAMES)}"
    )


def suggest_name(name: str, known: Iterable[str]) -> str:
    """` Did you mean ...?` where something is near, else the list of what is known."""
    names = list(known)
    by_lower = {each.lower(): each for each in names}
    near = difflib.get_close_matches(name.lower(), by_lower, n=1)
    if near:
        return f" Did you mean {by_lower[near[0]]}?"
    return f" Known: {', '.join(names)}."


def load_yaml(path: Path) -> dict[str, Any]:
    """A YAML file's mapping of arguments.

    Raises NotFound (`config_not_found`), InvalidRequest (`bad_config` for what is no mapping,
    `unknown_argument` for a key).
    """
    values = load_mapping(path)
    return resolve_keys(values, str(path))


def load_mapping(path: Path) -> dict[str, Any]:
    """A YAML file's mapping, whatever its keys; the errors of `load_yaml` but the last."""
    import yaml  # of the extra `trainer`; the help is shown without it

    try:
        loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise NotFound("config_not_found", f"Can't read {path}: {error.strerror}.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InvalidRequest("bad_config", f"{path} is no YAML: {error}") from error
    if loaded is None:
        return {}
    if not isinstance(loaded, dict) or not all(isinstance(key, str) for key in loaded):
        raise InvalidRequest("bad_config", f"{path}: names with values are needed (`lr: 0.0002`).")
    return loaded


def resolve_keys(values: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The values under their arguments' names; InvalidRequest names the place for one unknown."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        try:
            found[resolve_name(key)] = value
        except InvalidRequest as error:
            raise InvalidRequest(error.code, f"{source}: {error.detail}") from error
    return found


def build_arguments(*layers: Mapping[str, Any]) -> TrainingArguments:
    """Checked arguments; a later layer overrides an earlier one.

    Raises InvalidRequest (`bad_argument`) that names each argument that can't be so.
    """
    merged: dict[str, Any] = {}
    for layer in layers:
        merged.update(layer)
    try:
        return TrainingArguments(**merged)
    except ValidationError as error:
        faults = [
            f"--{fault['loc'][0]}: {fault['msg'].removeprefix('Value error, ')} "
            f"(got {fault['input']!r})"
            for fault in error.errors()
        ]
        raise InvalidRequest("bad_argument", "; ".join(dict.fromkeys(faults))) from error


def to_plain_dict(arguments: TrainingArguments) -> dict[str, Any]:
    """Every argument as text, numbers, lists and dicts: what YAML and JSON hold."""
    plain: dict[str, Any] = arguments.model_dump(mode="json")
    return plain


def save_yaml(arguments: TrainingArguments, path: Path) -> None:
    """The file from which the same run can be made."""
    import yaml

    text = yaml.safe_dump(to_plain_dict(arguments), sort_keys=False, allow_unicode=True)
    path.write_text("# Every argument of this run: placewise train --config THIS\n" + text)
