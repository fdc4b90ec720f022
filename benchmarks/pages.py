"""Pages: their size, the CPU time that makes them, and how soon they answer in the system's Chromium.

`python benchmarks/pages.py [--docs docs]`; with --docs the table goes to performance.md there. The demo is
evaluated, and a simulated campaign of 48 recordings, which takes two minutes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from marked import existing_folder, markdown_table, write_marked
from playwright.sync_api import sync_playwright

from fusion.campaign import joint_report
from fusion.cli import main
from fusion.report import recording_report
from fusion.report.summary_pdf import find_browser

PRESETS = {
    "demo": ("Fz-0080/report.html", recording_report, "render_report"),
    "sweep": ("report.html", joint_report, "render_campaign"),
}
NAMES = {"demo": "recording of the demo, 21 figures", "sweep": "campaign of 48 recordings"}


def measure(folder: Path, browser: Any) -> list[str]:
    rows = []
    for preset, (page, module, function) in PRESETS.items():
        seconds: list[float] = []
        timed(module, function, seconds)
        main(["simulate", str(folder / preset), "--preset", preset, "-q"])
        main(["run", str(folder / preset), "-o", str(folder / "out" / preset), "-q"])
        path = folder / "out" / preset / page
        size, answer = path.stat().st_size / 1e6, min(answers(browser, path) for _ in range(5))
        rows.append(f"| {NAMES[preset]} | {size:.2f} | {seconds[-1]:.2f} | {answer:.2f} |")
    return rows


def timed(module: Any, function: str, seconds: list[float]) -> None:
    """Have a function note the CPU time of its calls."""
    inner: Callable[..., Any] = getattr(module, function)

    def outer(*arguments: Any) -> Any:
        start = time.process_time()
        made = inner(*arguments)
        seconds.append(time.process_time() - start)
        return made

    setattr(module, function, outer)


def answers(browser: Any, path: Path) -> float:
    """Time in s from the start of a page's program until its first figure can be used."""
    page = browser.new_page(viewport={"width": 1280, "height": 1024})
    page.goto(path.as_uri())
    page.locator("figure[data-figure]").first.scroll_into_view_if_needed()
    page.wait_for_selector("figure[data-drawn]")
    found = float(page.evaluate("document.documentElement.dataset.interactive")) / 1e3
    page.close()
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--docs", type=existing_folder)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, sync_playwright() as started:
        browser = started.chromium.launch(executable_path=find_browser(), args=["--no-sandbox"])
        rows = measure(Path(name), browser)
        browser.close()
    table = markdown_table("| page | size / MB | CPU time / s | usable after / s |", rows)
    print(table)
    if options.docs:
        write_marked(options.docs / "performance.md", {"pages": table})
