"""`docs/api-calls.md`, made of the API's own description: `make api-page`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, cast

from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from shared.config.settings import Settings

PAGE = Path(__file__).parents[1] / "docs" / "api-calls.md"
HEAD = """# Every call

Made of the description that a server gives on `/openapi.json`, by `make api-page`. What the calls
have in common stands on [the API in short](api.md).
"""


def openapi_description() -> dict[str, Any]:
    """The OpenAPI description. Its ports are never used: no call is made."""
    nothing = cast(Any, None)
    return create_app(
        GatewayContext(nothing, nothing, nothing, nothing, Settings(), LocalhostAuthenticator())
    ).openapi()


def render_page() -> str:
    """The page's text: a table for each tag, in the order of the calls."""
    tables: dict[str, list[str]] = {}
    for path, methods in openapi_description()["paths"].items():
        for method, call in methods.items():
            tables.setdefault(call.get("tags", ["server"])[0], []).append(
                _call_row(path, method, call)
            )
    parts = [HEAD]
    for tag, lines in tables.items():
        head = ["| call | parameters | answers | |", "|---|---|---|---|"]
        parts.append(f"## {tag.capitalize()}\n\n" + "\n".join([*head, *lines]) + "\n")
    return "\n".join(parts)


def _call_row(path: str, method: str, call: dict[str, Any]) -> str:
    said = [
        f"`{one['name']}`{'' if one.get('required') else '?'}"
        for one in call.get("parameters", [])
        if one["in"] == "query" and one["name"] != "map"
    ]
    if body := call.get("requestBody"):
        said.append(" or ".join(f"body: {kind}" for kind in body["content"]))
    answers = ", ".join(sorted(code for code in call["responses"] if code < "400"))
    what = re.split(r"(?<=[.;])\s", " ".join(call.get("description", "").split()))[0]
    cells = (f"`{method.upper()} {path}`", ", ".join(said), answers, what.rstrip(".;"))
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    PAGE.write_text(render_page())
