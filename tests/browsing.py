"""A page in a real browser: what its console says and what it asks for."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

SCREENS = ((1400, 900), (800, 1000))
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


def below_the_first_screen(browser: Any, path: Path, picture: str) -> list[str]:
    """Return which headlines and main pictures do not end on the first screen, at either size."""
    found = []
    for wide, high in SCREENS:
        opened = Page(browser, path)
        opened.page.set_viewport_size({"width": wide, "height": high})
        opened.page.wait_for_selector("html[data-printable]", state="attached")
        opened.page.wait_for_function(_ALL_IN_VIEW_ARE_DRAWN)
        ends = opened.page.evaluate(
            """(picture) => [".status", ".headline .value", picture].flatMap((which) => {
              const all = [...document.querySelectorAll(which)].filter((one) => one.checkVisibility());
              return all.length ? all.map((one) => [which, one.getBoundingClientRect().bottom]) : [[which, Infinity]];
            })""",
            picture,
        )
        found += [f"{which} at {wide} x {high}" for which, bottom in ends if bottom > high]
        opened.close()
    return found


def paper(browser: Any, path: Path, file: Path) -> dict[str, Any]:
    """Print a page and return what is wrong on paper.

    `missing`: figures without an image; `wide`: tables wider than the paper; `blank`: empty pages of the PDF file;
    `summary_mm`: height of the summary.
    """
    opened = Page(browser, path)
    opened.page.wait_for_selector("html[data-printable]", state="attached")
    opened.page.set_viewport_size({"width": 688, "height": 1000})  # A4 without margins, in CSS pixels
    opened.page.emulate_media(media="print")
    found: dict[str, Any] = opened.page.evaluate("""() => ({
      missing: [...document.querySelectorAll("figure[data-figure]")].filter((one) => !one.closest(".front")
        && !(one.querySelector("img.static")?.naturalHeight > 50 && one.querySelector("img.static").checkVisibility()))
        .map((one) => one.dataset.figure),
      broken: [...document.images].filter((one) => one.checkVisibility() && !one.naturalWidth).length,
      wide: [...document.querySelectorAll("table")].filter((one) => one.getBoundingClientRect().right > 689)
        .map((one) => one.caption.textContent),
      summary_mm: document.querySelector("#summary").getBoundingClientRect().height / 96 * 25.4,
    })""")
    opened.page.pdf(path=file, prefer_css_page_size=True)
    opened.close()
    return found | {"blank": [number for number, marks in enumerate(marks_of_pages(file), 1) if not marks]}


def marks_of_pages(file: Path) -> list[int]:
    """Return how many texts and images every page of a PDF file of the browser draws."""
    text = file.read_bytes()
    pages = re.findall(rb"<<\s*/Type /Page\n.*?/Contents (\d+) 0 R", text, re.DOTALL)
    counts = []
    for number in pages:
        _, _, rest = text.partition(b"\n%s 0 obj" % number)
        content = zlib.decompressobj().decompress(rest[rest.index(b"stream") + 6 :].lstrip(b"\r\n"))
        counts.append(len(re.findall(rb"\b(?:Tj|TJ|Do)\b", content)))
    return counts


@contextmanager
def viewer_pages(browser: Any, expected: str = "(?!)", timeout_ms: int = 8000) -> Iterator[Callable[..., Any]]:
    """Open pages of the viewer; at the end nothing but `expected` was complained of, and nobody else asked."""
    said: list[str] = []
    asked: list[str] = []
    contexts = []

    def open_page(client: Any, wait: str = "body[data-frame]", **settings: Any) -> Any:
        context = browser.new_context(viewport={"width": 1400, "height": 1000}, **settings)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(timeout_ms)
        page.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(client.server.address)
        page.wait_for_selector(wait)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert [text for text in said if not re.search(expected, text)] == []
    assert asked
    assert all(urlsplit(url).hostname == "127.0.0.1" or url.startswith(("data:", "blob:")) for url in asked)
