"""The documentation: generated pages are up to date, and every link leads somewhere."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any

import pytest

from tools import make_api_page, make_reference
from tools.make_api_page import openapi_description

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md"), ROOT / "lab/benchmarks/RESULTS.md"])


@functools.cache
def anchors(page: Path) -> set[str]:
    """Of a page's headings, as GitHub makes them."""
    found = set()
    for heading in re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()
        found.add(re.sub(r"[^\w\- ]", "", plain).replace(" ", "-"))
    return found


@pytest.mark.parametrize("tool", [make_api_page, make_reference], ids=["calls", "reference"])
def test_generated_pages_are_up_to_date(tool: Any) -> None:
    assert tool.PAGE.read_text() == tool.render_page(), "run `make pages`"


@pytest.mark.parametrize("name", ["api.md", "troubleshooting.md"])
def test_codes_that_a_page_names_with_their_status_exist(name: str) -> None:
    text = (ROOT / "docs" / name).read_text()
    named = set(re.findall(r"\b[45]\d\d `([a-z_0-9]+)`", text))
    assert named
    assert named - make_reference.error_codes().keys() == set()


def test_every_call_is_described_once_with_its_errors() -> None:
    calls = {
        f"{method} {path}": call
        for path, methods in openapi_description()["paths"].items()
        for method, call in methods.items()
    }
    assert len({call["operationId"] for call in calls.values()}) == len(calls)
    for name, call in calls.items():
        assert call["description"], name
        assert "application/problem+json" in call["responses"]["4XX"]["content"], name


def test_links_between_pages_resolve() -> None:
    links = [
        (page, link)
        for page in PAGES
        for link in re.findall(
            r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
        )
        if "://" not in link and not link.startswith("mailto:")
    ]
    broken = []
    for page, link in links:
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        whole = target.exists() and target.is_relative_to(ROOT)
        if not whole or (anchor and anchor not in anchors(target)):
            broken.append((str(page.relative_to(ROOT)), link))
    assert broken == []


def test_no_text_names_placewise_as_a_package_of_an_index() -> None:
    sources = [
        path for name in ("services", "shared", "placewise") for path in (ROOT / name).rglob("*.py")
    ]
    wrong = [path for path in [*PAGES, *sources] if "install 'placewise[" in path.read_text()]
    assert wrong == []
