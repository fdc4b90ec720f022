"""Every picture of the docs that shows a page or a figure of a command: `make docs-pictures`.

Simulated recordings are evaluated, their pages opened in the system's Chromium, and parts of them kept in docs/images.
Those of the published set-up come from benchmarks/published.py, that of the challenge, which wants its pictures, from
benchmarks/challenge.py.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

from fusion.cli import main

IMAGES = Path(__file__).resolve().parent / "images"
WIDTH, SCALE = 1200, 1.0
PICTURES = {
    "report": ("demo", "run MADE -o OUT", "Fz-0080/report.html", "#figure-sources", "#figure-components-load"),
    "campaign": ("matrix", "run MADE -o OUT", "report.html", "header", ".front"),
    "step": ("steps", "step MADE -o OUT", "step.html", "#figure-step-Fz", "#figure-bode-Fz"),
    "compensate": ("", "compensate STEP --frequency 3000 --damping 0.6 -o OUT", "compensate.html", "figure", "figure"),
    "decouple": ("steps", "decouple MADE -o OUT", "decouple.html", "figure", "figure"),
    "load": ("loads", "load MADE -o OUT", "load.html", "figure", "figure"),
    "identify": ("masses", "identify MADE -o OUT", "identify.html", "figure", "figure"),
    "elastomer": ("elastomer", "elastomer MADE/elastomer.toml -o OUT", "elastomer.html", "figure", "figure"),
    "cameras": (
        "targets",
        "cameras MADE/left MADE/right --target charuco --size 11x8 --spacing 9e-3 -o OUT/top.json",
        "top.html",
        "figure",
        "figure",
    ),
}
"""Preset, command, page in its results, and the first elements that a picture begins and ends with."""
EXAMPLES = ("motion_from_images", "compensated_release")
PLAN = "plan --frequencies 53.7:1020.3:12 --max-rate 82 --exposure 40e-6 --frames 211 --force --figure"


def make_pictures(chosen: list[str]) -> None:
    """Make the pictures of some names, or all."""
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        sys.exit("docs/pictures.py: expected Chromium, found none")
    with tempfile.TemporaryDirectory() as name, sync_playwright() as started:
        browser = started.chromium.launch(executable_path=program, args=["--no-sandbox"])
        for picture in chosen or PICTURES:
            if picture not in PICTURES:
                continue
            path = _evaluated(Path(name), picture)
            _keep(browser, path, IMAGES / f"{picture}.png", *PICTURES[picture][3:])
        browser.close()
    if not chosen or "plan" in chosen:
        main([*PLAN.split(), str(IMAGES / "plan.png"), "-q"])
    for example in EXAMPLES:
        if not chosen or example in chosen:
            script = IMAGES.parents[1] / "examples" / f"{example}.py"
            words = [sys.executable, str(script), str(IMAGES / f"{example}.png")]
            subprocess.run(words, cwd=IMAGES.parents[1], check=True)


def _evaluated(top: Path, picture: str) -> Path:
    """Simulate and evaluate what a picture shows, and return the path of its page."""
    preset, command, page, *_ = PICTURES[picture]
    made, out = top / (preset or "steps"), top / f"out-{picture}"
    out.mkdir()
    if not made.exists():
        main(["simulate", str(made), "--preset", made.name, "-q"])
    if "STEP" in command and not (top / "out-step").exists():
        _evaluated(top, "step")
    places = {"MADE": str(made), "OUT": str(out), "STEP": str(top / "out-step")}
    words = command.split()
    for name, place in places.items():
        words = [word.replace(name, place) for word in words]
    main([*words, "-q", "--force"])
    return out / page


def _keep(browser: Any, path: Path, picture: Path, first: str, last: str) -> None:
    """Write the part of a page from one element to another."""
    page = browser.new_page(viewport={"width": WIDTH, "height": 1000}, device_scale_factor=SCALE)
    page.goto(path.as_uri())
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
