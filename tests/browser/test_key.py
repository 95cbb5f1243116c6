"""The page asks for the key of a server that needs one."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess

KEY = "a-key-of-ones-own-0123456789"


@pytest.fixture(scope="module")
def locked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    with ServerProcess(tmp_path_factory.mktemp("locked") / "home", admin_key=KEY) as server:
        server.indexed(photo_bytes(1), "first.jpg")
        yield server


@pytest.fixture
def page(browser: Browser, locked: ServerProcess) -> Iterator[Page]:
    context = browser.new_context()
    opened = context.new_page()
    opened.goto(f"{locked.client.base_url}")
    yield opened
    context.close()


def give(page: Page, key: str) -> None:
    page.get_by_label("Key", exact=True).fill(key)
    page.get_by_role("button", name="Go on").click()


def test_the_key_is_requested_once_and_stored_for_the_tab_alone(page: Page) -> None:
    expect(page.get_by_role("dialog")).to_contain_text("needs a key")
    give(page, "x" * 20)
    expect(page.get_by_role("dialog")).to_contain_text("does not know this key")
    give(page, KEY)
    expect(page.get_by_role("heading", name="Where was this taken?")).to_be_visible()
    # Pictures are fetched with the key, too.
    expect(page.locator(".mosaic img")).to_have_attribute("src", re.compile("^blob:"))
    assert page.evaluate("sessionStorage.getItem('placewise-key')") == KEY
    assert KEY not in page.evaluate("JSON.stringify(localStorage) + document.cookie")
    page.reload()
    expect(page.get_by_role("heading", name="Where was this taken?")).to_be_visible()
    expect(page.get_by_role("dialog")).to_have_count(0)


def test_the_key_is_remembered_on_this_device_until_it_is_forgotten(page: Page) -> None:
    page.get_by_label("Remember the key on this device").check()
    give(page, KEY)
    expect(page.get_by_role("heading", name="Where was this taken?")).to_be_visible()
    another_tab = page.context.new_page()
    another_tab.goto(page.url + "#/status")
    another_tab.get_by_role("button", name="Forget the key").click()
    expect(another_tab.get_by_role("dialog")).to_contain_text("needs a key")
    assert KEY not in another_tab.evaluate("JSON.stringify([localStorage, sessionStorage])")


def test_a_read_only_key_gets_a_message_that_names_the_missing_scope(
    page: Page, locked: ServerProcess
) -> None:
    made = locked.client.post("/api/v1/keys", json={"name": "reader", "scopes": ["read"]})
    assert made.status_code == 201, made.text
    give(page, made.json()["key"])
    page.get_by_role("link", name="Photos").click()
    page.locator(".photo-card input").check()
    for _ in range(2):
        page.get_by_role("button", name="Remove").click()
        expect(page.locator(".note")).to_have_count(1)
        expect(page.locator(".note")).to_contain_text("requires the scope “write”")
        page.locator(".photo-card input").check()
