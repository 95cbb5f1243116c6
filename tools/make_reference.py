"""Generates `docs/reference.md`, all settings, commands and error codes: `make pages`."""

from __future__ import annotations

import ast
import functools
import inspect
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import typer
from pydantic import SecretStr

from services.cli.main import build_app
from shared import errors
from shared.config.settings import Settings

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reference.md"
HEAD = """# Reference

Generated from the code by `make pages`. See also [every call](api-calls.md) of the API.

A setting is an environment variable, or a line of the file `.env`. Sizes may have a unit: `100MB`.
`placewise config` prints the values that are in effect. `placewise COMMAND --help` explains the
options of a command.
"""
CODE = re.compile(r"[a-z]+(_[a-z0-9]+)+")
MAX_OPTIONS = 12  # of a command; its help has the others
STATUSES = {
    name: kind.status
    for name, kind in vars(errors).items()
    if inspect.isclass(kind) and issubclass(kind, errors.PlacewiseError)
}


def render_page() -> str:
    """Render the page."""
    return "\n".join([HEAD, *_settings(), *_commands(), *_error_codes()])


@functools.cache
def error_codes() -> dict[str, tuple[int, str]]:
    """Return the HTTP status and the message of each error code that the code names, by code.

    Braces stand for what a message says about the case.
    """
    found: dict[str, tuple[int, str]] = {}
    trees = [
        ast.parse(path.read_bytes())
        for folder in ("shared", "services", "lab", "placewise")
        for path in sorted((ROOT / folder).rglob("*.py"))
    ]
    makers: dict[str, int] = {}  # functions and classes that are given a code
    for tree in trees:
        for call in _calls(tree, STATUSES):
            if not list(_constants(call.args[0], tree)):
                status = STATUSES[_name(call.func)]
                makers |= dict.fromkeys(_makers(tree, call), status)
    for tree in trees:
        for call in [*_calls(tree, STATUSES), *_calls(tree, makers)]:
            name = _name(call.func)
            codes = call.args[:1] if name in STATUSES else call.args
            message = _text(call.args[1]) if name in STATUSES and len(call.args) > 1 else ""
            for code in (code for each in codes for code in _constants(each, tree)):
                if CODE.fullmatch(code):
                    status, known = found.get(code, ((STATUSES | makers)[name], ""))
                    found[code] = (status, known or message)
    return dict(sorted(found.items()))


def _calls(tree: ast.AST, names: Collection[str]) -> Iterator[ast.Call]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and _name(node.func) in names and node.args:
            yield node


def _makers(tree: ast.Module, call: ast.Call) -> Iterator[str]:
    """Yield the functions around a call, or the classes with an attribute that it uses."""
    for node in ast.walk(tree):
        if isinstance(call.args[0], ast.Attribute):
            fields = ast.unparse(node) if isinstance(node, ast.ClassDef) else ""
            if re.search(rf"\b{call.args[0].attr.lstrip('_')}: str", fields):
                yield getattr(node, "name", "")
        elif isinstance(node, ast.FunctionDef) and call in ast.walk(node):
            yield node.name


def _settings() -> Iterator[str]:
    for group in Settings.__mro__[::-1]:
        fields = [
            (name, Settings.model_fields[name])
            for name in vars(group).get("__annotations__", {})
            if name in Settings.model_fields
        ]
        rows = [(f"`{n.upper()}`", _default(f.default), f.description or "") for n, f in fields]
        if rows:
            title = (inspect.getdoc(group) or "").split("\n")[0].rstrip(".")
            yield f"## Settings: {title[0].lower()}{title[1:]}\n"
            yield from _table(("setting", "default", ""), rows)


def _default(value: Any) -> str:
    if value is None or value == "" or isinstance(value, SecretStr):
        return ""
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _commands() -> Iterator[str]:
    yield "## Commands\n"
    rows = []
    for words, command in _walk(typer.main.get_command(build_app()), ()):
        options = [f"`{p.opts[0]}`" for p in command.params if p.opts[0].startswith("-")]
        sentence = _first_sentence(command.help or "")
        if len(options) > MAX_OPTIONS:
            options[MAX_OPTIONS:] = ["..."]
        rows.append((f"`placewise {' '.join(words)}`", sentence, " ".join(options)))
    yield from _table(("command", "", "options"), rows)


def _walk(command: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the commands below a command, each with its words."""
    if children := getattr(command, "commands", None):
        for name, child in children.items():
            yield from _walk(child, (*words, name))
    else:
        yield words, command


def _error_codes() -> Iterator[str]:
    yield "## Error codes\n"
    rows = [
        (f"`{code}`", str(status), _first_sentence(message))
        for code, (status, message) in error_codes().items()
    ]
    yield from _table(("code", "status", "message"), rows)


def _name(node: ast.expr) -> str:
    return node.id if isinstance(node, ast.Name) else getattr(node, "attr", "")


def _constants(node: ast.expr, tree: ast.Module) -> Iterator[str]:
    """Yield the strings that an expression may be; a name stands for all that is assigned to it."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.IfExp):
        yield from _constants(node.body, tree)
        yield from _constants(node.orelse, tree)
    elif isinstance(node, ast.Name):
        for other in ast.walk(tree):
            if isinstance(other, ast.Assign) and any(_name(t) == node.id for t in other.targets):
                yield from _constants(other.value, tree)


def _text(node: ast.expr) -> str:
    """Return a string expression as text, with `{}` for what is inserted."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part) for part in node.values)
    if isinstance(node, ast.BinOp):
        return _text(node.left) + _text(node.right)
    return "{}"


def _first_sentence(text: str) -> str:
    return re.split(r"(?<=\.)\s", " ".join(text.split()))[0].rstrip(".")


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    yield "| " + " | ".join(head) + " |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"
    yield ""


if __name__ == "__main__":
    PAGE.write_text(render_page())
