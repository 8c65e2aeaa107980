"""Pages in a real browser: nothing may go wrong in them, and nothing may leave the host."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = shutil.which("chromium")
WIDE, PHONE = {"width": 1280, "height": 720}, {"width": 390, "height": 844}

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="there is no chromium here; apt-get install chromium"
)


@contextmanager
def started_browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        # Chromium refuses to run as root within its sandbox, which containers often are.
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        try:
            yield started
        finally:
            started.close()


@contextmanager
def opened(
    browser: Browser,
    address: str,
    patience_ms: float,
    *,
    size: dict[str, int] = WIDE,
    scheme: str = "light",
    script: str = "",
    may_be_away: bool = False,
) -> Iterator[Page]:
    """Open a page; afterwards nothing may have gone wrong, and nothing have left the host.

    Args:
        browser: the browser.
        address: of the page.
        patience_ms: how long it waits for what a test expects.
        size: of the window.
        scheme: `light` or `dark`.
        script: JavaScript that runs before that of the page.
        may_be_away: whether the server may end meanwhile, of which the console tells.
    """
    troubles: list[str] = []
    context = browser.new_context(viewport=size, color_scheme=scheme)  # type: ignore[arg-type]
    page = context.new_page()
    page.set_default_timeout(patience_ms)
    if not may_be_away:
        page.on(
            "console", lambda told: troubles.append(told.text) if told.type == "error" else None
        )
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("request", lambda asked: _check_host(asked.url, address, troubles))
    if script:
        page.add_init_script(script)
    page.goto(address)
    try:
        yield page
        assert troubles == []
    finally:
        context.close()


def _check_host(url: str, address: str, troubles: list[str]) -> None:
    if not url.startswith("data:") and urlsplit(url).netloc != urlsplit(address).netloc:
        troubles.append(f"asked {url}")


def fits(page: Page) -> bool:
    """Whether nothing is wider than the window."""
    return bool(page.evaluate("document.documentElement.scrollWidth <= innerWidth"))
