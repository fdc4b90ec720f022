"""Every picture of the docs that shows a part of a page or a figure of a command: `make docs-pictures`.

The pages are those of the gallery (gallery.py). Pictures of the published set-up come from benchmarks/published.py,
that of the challenge, which needs its images, from benchmarks/challenge.py; drawings come from `python docs/drawings`.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from gallery import GALLERY, Entry, browser_and_laboratory

from fusion.cli import main

IMAGES = Path(__file__).resolve().parent / "images"
WIDTH = 1200
PICTURES = {
    "fields": ("demo", ".fields .controls", ".fields figure:last-of-type"),
    "campaign": ("matrix", "header", ".front"),
    "step": ("steps", "#figure-step-Fz", "#figure-bode-Fz"),
    "compensate": ("compensate", "figure", "figure"),
    "decouple": ("decouple", "figure", "figure"),
    "load": ("loads", "figure", "figure"),
    "identify": ("masses", "figure", "figure"),
    "elastomer": ("elastomer", "figure", "figure"),
    "cameras": ("targets", "figure", "figure"),
    "acceptance": ("acceptance", "header", ".headlines"),
    "acceptance-noise": ("shaken rig", "#figure-noise-spectrum", "#figure-noise-spectrum"),
    "acceptance-fields": ("rig without distortion", "#figure-fields-translation-x", "#figure-fields-translation-x"),
}
"""Entry of the gallery or of `FAULTY`, and the first elements that a picture begins and ends with."""


def _faulty(name: str, fault: str) -> Entry:
    """Return the page of an acceptance test that fails."""
    simulated = f"simulate {name} --preset acceptance --violate {fault}"
    return Entry((simulated, f"accept {name} -o out/{name}"), f"out/{name}/acceptance.html", "", 1)


FAULTY = {"shaken rig": _faulty("shaken", "vibration"), "rig without distortion": _faulty("flat", "no-distortion")}
EXAMPLES = ("motion_from_images", "compensated_release")
PLAN = "plan --frequencies 53.7:1020.3:12 --max-rate 82 --exposure 40e-6 --frames 211 --force --figure"


def make_pictures(chosen: list[str]) -> None:
    """Make the pictures of some names, or all."""
    with browser_and_laboratory() as (browser, laboratory):
        for picture in [name for name in PICTURES if not chosen or name in chosen]:
            entry, *ends = PICTURES[picture]
            _keep(browser, laboratory.page((GALLERY | FAULTY)[entry]), IMAGES / f"{picture}.png", *ends)
    if not chosen or "plan" in chosen:
        main([*PLAN.split(), str(IMAGES / "plan.png"), "-q"])
    for example in EXAMPLES:
        if not chosen or example in chosen:
            script = IMAGES.parents[1] / "examples" / f"{example}.py"
            words = [sys.executable, str(script), str(IMAGES / f"{example}.png")]
            subprocess.run(words, cwd=IMAGES.parents[1], check=True)


def _keep(browser: Any, path: Path, picture: Path, first: str, last: str) -> None:
    """Write the part of a page from one element to another."""
    page = browser.new_page(viewport={"width": WIDTH, "height": 1000})
    page.goto(path.as_uri())
    page.evaluate("document.querySelectorAll('details').forEach(part => { part.open = true })")
    for figure in page.query_selector_all("figure[data-figure]"):
        if figure.is_visible():
            figure.scroll_into_view_if_needed()
            page.wait_for_timeout(300)
    page.evaluate("scrollTo(0, 0)")
    begin, end = (page.locator(f"main >> {part}").first.bounding_box() for part in (first, last))
    box = {"x": begin["x"] - 12, "y": begin["y"] - 12, "width": begin["width"] + 24}
    page.screenshot(path=picture, full_page=True, clip={**box, "height": end["y"] + end["height"] - begin["y"] + 24})
    page.close()


if __name__ == "__main__":
    make_pictures(sys.argv[1:])
