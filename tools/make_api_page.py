"""Generates `docs/api-calls.md` from the OpenAPI description: `make pages`."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any, cast

from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from shared.config.settings import Settings

PAGE = Path(__file__).parents[1] / "docs" / "api-calls.md"
HEAD = """# Every call

Generated from the server's OpenAPI description (`/openapi.json`) by `make pages`. For what all
calls have in common, see [the API](api.md).
"""


@functools.cache
def openapi_description() -> dict[str, Any]:
    """Build the OpenAPI description; the dependencies are None because no route is called."""
    unused = cast(Any, None)
    return create_app(
        GatewayContext(unused, unused, unused, unused, Settings(), LocalhostAuthenticator())
    ).openapi()


def render_page() -> str:
    """Render the page: a table per tag, in the order of the calls."""
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
    inputs = [
        f"`{parameter['name']}`{'' if parameter.get('required') else '?'}"
        for parameter in call.get("parameters", [])
        if parameter["in"] == "query" and parameter["name"] != "map"
    ]
    if body := call.get("requestBody"):
        inputs.append(" or ".join(f"body: {kind}" for kind in body["content"]))
    statuses = ", ".join(sorted(code for code in call["responses"] if code < "400"))
    summary = re.split(r"(?<=[.;])\s", " ".join(call.get("description", "").split()))[0]
    cells = (f"`{method.upper()} {path}`", ", ".join(inputs), statuses, summary.rstrip(".;"))
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    PAGE.write_text(render_page())
