"""A real browser for tests of the page: Debian's chromium, driven by playwright."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from processes import LIMIT

AXE = Path(__file__).parent / "gateway" / "node_modules" / "axe-core" / "axe.min.js"
_REFUSED = "ERR_CONNECTION_REFUSED"  # the browser's own line: no page can prevent it
_NAMES = ("chromium", "chromium-browser", "google-chrome")
# No sandbox: its namespaces are not available to root, nor in containers. The page is ours.
_ARGUMENTS = ["--no-sandbox", "--disable-dev-shm-usage", "--disable-background-networking"]


@contextmanager
def chromium() -> Iterator[Any]:
    """Give a browser of playwright. Skip the test if playwright or the browser is missing."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        pytest.skip("chromium is not installed: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


def in_both_schemes(page: Any) -> Iterator[str]:
    """Show a page in light, then in dark: styles alone depend on the scheme, so it need not be loaded twice."""
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        assert page.evaluate(f"matchMedia('(prefers-color-scheme: {scheme})').matches")
        yield scheme


class Visit:
    """A page in a browser, with what it complained about and which other hosts it asked."""

    def __init__(self, browser: Any, address: str, **options: Any) -> None:
        self.complaints: list[str] = []
        self.loses_gateway = False  # whether the test ends the gateway
        self.strange_requests: list[str] = []
        self._origin = address.split("/")[2]
        self._context = browser.new_context(**options)
        self._context.set_default_timeout(1000 * LIMIT)
        self.page = self._context.new_page()
        self.page.on("console", self._on_console)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self._on_request(request.url))
        self.page.on("websocket", lambda socket: self._on_request(socket.url))
        self.page.goto(address)

    def _on_console(self, message: Any) -> None:
        if message.type in ("error", "warning") and not (self.loses_gateway and _REFUSED in message.text):
            self.complaints.append(message.text)

    def _on_request(self, address: str) -> None:
        if address.split("/")[2] != self._origin:
            self.strange_requests.append(address)

    def violations(self) -> list[str]:
        """Return what axe-core finds, such as texts of too little contrast. Skip the test if it is not installed."""
        if not AXE.exists():
            pytest.skip("axe-core is not installed: run `make examples`")
        self.page.evaluate(AXE.read_text("utf-8"))
        found = self.page.evaluate("async () => (await axe.run()).violations")
        return [f"{each['id']}: {node['html'][:150]}" for each in found for node in each["nodes"]]

    def close(self) -> None:
        self._context.close()
