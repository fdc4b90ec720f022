"""A page in a real browser: what its console says and what it asks for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

_ALL_IN_VIEW_ARE_DRAWN = """() => [...document.querySelectorAll("figure[data-figure]")].every((one) => {
  const { top, bottom } = one.getBoundingClientRect();
  return "drawn" in one.dataset || bottom < 0 || top > innerHeight || !one.checkVisibility();
})"""


class Page:
    """A page that is open, what its console said and what it asked for."""

    def __init__(self, browser: Any, path: Path, **settings: Any) -> None:
        self.context = browser.new_context(viewport={"width": 1400, "height": 1000}, **settings)
        self.page = self.context.new_page()
        self.page.set_default_timeout(8000)
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text) if message.type != "info" else None)
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())

    def draw(self, name: str) -> Any:
        """Bring a figure into view and wait for it."""
        figure = self.page.locator(f"figure[data-figure='{name}']")
        figure.evaluate("one => one.closest('details')?.setAttribute('open', '')")
        for _ in range(2):  # others that come into view with it move it
            figure.evaluate("one => one.scrollIntoView({ block: 'center', behavior: 'instant' })")
            self.page.wait_for_function(_ALL_IN_VIEW_ARE_DRAWN)
        return figure

    def close(self) -> None:
        """Close the page, which has had nothing to complain of and asked for nothing."""
        self.context.close()
        assert self.said == []
        assert all(address.startswith(("file:", "data:", "blob:")) for address in self.asked)
