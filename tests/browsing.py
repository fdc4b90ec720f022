"""A page in a real browser: what its console says and what it asks for."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import urlsplit

SCREENS = ((1400, 900), (800, 1000))
_ALL_IN_VIEW_ARE_DRAWN = """() => [...document.querySelectorAll("figure[data-figure]")].every((one) => {
  const { top, bottom } = one.getBoundingClientRect();
  return "drawn" in one.dataset || bottom < 0 || top > innerHeight || !one.checkVisibility();
})"""


WINDOW = (1400, 1000)


class Tab:
    """A page of a browser. It is used again after `leave`: a new one takes a second of the processor."""

    free: ClassVar[list[Tab]] = []

    def __init__(self, browser: Any) -> None:
        self.page = browser.new_context().new_page()
        self.said: list[tuple[str, str]] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append((message.type, message.text)))
        self.page.on("pageerror", lambda error: self.said.append(("error", str(error))))
        self.page.on("request", lambda request: self.asked.append(request.url))

    @classmethod
    def open(cls, browser: Any, address: str, size: tuple[int, int], timeout_ms: int, **media: str) -> Tab:
        """Show an address in a window of this size; `media` is what `emulate_media` takes."""
        tab = cls.free.pop() if cls.free else cls(browser)
        tab.page.set_default_timeout(timeout_ms)
        tab.page.set_viewport_size({"width": size[0], "height": size[1]})
        tab.page.emulate_media(**({"media": "null", "color_scheme": "light", "reduced_motion": "null"} | media))
        tab.page.goto(address)
        return tab

    def leave(self) -> tuple[list[tuple[str, str]], list[str]]:
        """Return what the console said, with the kind of each text, and what was asked for."""
        found = [*self.said], [*self.asked]
        self.page.goto("about:blank")
        self.page.mouse.move(0, 0)
        self.said.clear()
        self.asked.clear()
        self.free.append(self)
        return found


class Page:
    """A page that is open."""

    def __init__(self, browser: Any, path: Path, size: tuple[int, int] = WINDOW, **media: str) -> None:
        self.tab = Tab.open(browser, path.as_uri(), size, 8000, **media)
        self.page = self.tab.page

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
        said, asked = self.tab.leave()
        assert [text for kind, text in said if kind != "info"] == []
        assert all(address.startswith(("file:", "data:", "blob:")) for address in asked)


def below_the_first_screen(browser: Any, path: Path, picture: str) -> list[str]:
    """Return which headlines and main pictures do not end on the first screen, at either size."""
    found = []
    for wide, high in SCREENS:
        opened = Page(browser, path, (wide, high))
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
    tabs: list[Tab] = []

    def open_page(client: Any, wait: str = "body[data-frame]", **media: str) -> Any:
        tabs.append(Tab.open(browser, client.server.address, WINDOW, timeout_ms, **media))
        tabs[-1].page.wait_for_selector(wait)
        return tabs[-1].page

    yield open_page
    left = [tab.leave() for tab in tabs]
    said = [text for told, _ in left for kind, text in told if kind in ("error", "warning")]
    assert [text for text in said if not re.search(expected, text)] == []
    asked = [url for _, asked in left for url in asked]
    assert asked
    assert all(urlsplit(url).hostname == "127.0.0.1" or url.startswith(("data:", "blob:")) for url in asked)
