"""Every picture of the docs that shows a part of a page or a figure of a command: `make docs-pictures`.

The pages are those of the gallery (gallery.py). Pictures of the published set-up come from benchmarks/published.py,
those of the DIC Challenge, which need its images, from `make dic-challenge`; drawings come from `python docs/drawings`.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from gallery import GALLERY, Entry, Laboratory, browser_and_laboratory, names_to_make
from PIL import Image
from walkthrough import follow

from fusion.cli import main
from fusion.planning.view.server import Server
from fusion.planning.view.view_requests import api_actions, api_handlers
from fusion.planning.view.view_sources import find_sources
from fusion.planning.view.viewed_recording import ViewSession
from fusion.sensor.certificate.certificate_form import METHOD, NEW_FORM

IMAGES = Path(__file__).resolve().parent / "images"
WIDTH = 1200
PICTURES = {
    "fields": ("demo", ".fields .controls", ".fields figure:last-of-type"),
    "campaign": ("matrix", "header", ".front"),
    "step": ("steps", "#figure-step-Fz", "#figure-bode-Fz"),
    "compensate": ("compensate", "#figure-step-0", "#figure-step-0"),
    "decouple": ("decouple", "#figure-decouple-crosstalk", "#figure-decouple-crosstalk"),
    "load": ("loads", "#figure-load-Fy", "#figure-load-Fy"),
    "identify": ("masses", "#figure-fit-z-0", "#figure-fit-z-0"),
    "elastomer": ("elastomer", "#figure-elastomer-shapes-frame", "#figure-elastomer-shapes-frame"),
    "cameras": ("targets", "#figure-coverage", "#figure-coverage"),
    "crosstalk": ("matrix", "#figure-crosstalk", "#figure-crosstalk"),
    "recordings": ("sweep", "#figure-recordings-Fz-Fz", "#figure-recordings-Fz-Fz"),
    "normalised": ("compare", "#figure-normalised", "#figure-normalised"),
    "rotation": ("rotation", "#figure-rotation-with-load-forces", "#figure-rotation-with-load-forces"),
    "transfer": ("chirp", "#figure-transfer-top-base", "#figure-transfer-top-base"),
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
CERTIFIED = {
    **{"number": "2026-0815", "issued": "2026-11-23", "received": "2026-11-15", "operator": "A. Operator"},
    **{"authoriser": "B. Leader", "city": "Example city", "country": "DE", "condition": "without visible damage"},
    **{"supply": "5 V, 4.8 kHz", "torque": "10 N·m", "axes": "z out of the flange of the load"},
    "description": "adapter plate, 8 screws M6",
}
"""Answers to the draft of a certificate; all others are "Example" with the name of the key."""
A4_PX = (794, 1123)
VIEWER_PX = 860
SPECIMEN = "certificate demo/Fz-0080 --results out/demo/Fz-0080 --form form.toml --specimen -o out/certificate"
TUTORIAL = {
    "tutorial-rig": "rig.html",
    "tutorial-recording": "lab/results/Fz_063Hz_1/report.html",
    "tutorial-campaign": "lab/results/report.html",
    "tutorial-certificate": "lab/certificate/certificate.html",
}
"""First screens of the pages that docs/tutorials/own-laboratory.md writes."""
FIRST_SCREEN, SHOWN_WIDTH = {"width": WIDTH, "height": 830}, 900
LOOK_PAGE = {"width": 1000, "height": 560}
PLAN = "plan --frequencies 53.7:1020.3:12 --max-rate 82 --exposure 40e-6 --frames 211 --force --figure"


def make_pictures(chosen: list[str]) -> None:
    """Make the pictures of some names."""
    with browser_and_laboratory() as (browser, laboratory):
        if set(chosen) & set(TUTORIAL):
            folder = laboratory.place / "tutorial"
            folder.mkdir()
            for step in follow(IMAGES.parent / "tutorials" / "own-laboratory.md", folder):
                print(step.command)
            keep_first_screens(browser, folder)
        for picture in [name for name in PICTURES if name in chosen]:
            entry, *ends = PICTURES[picture]
            _keep(browser, laboratory.page((GALLERY | FAULTY)[entry]), IMAGES / f"{picture}.png", *ends)
        for name in [name for name in DRAWN if name in chosen]:
            DRAWN[name](browser, laboratory)
    if "plan" in chosen:
        main([*PLAN.split(), str(IMAGES / "plan.png"), "-q"])
    for example in EXAMPLES:
        if example in chosen:
            script = IMAGES.parents[1] / "examples" / f"{example}.py"
            words = [sys.executable, str(script), str(IMAGES / f"{example}.png")]
            subprocess.run(words, cwd=IMAGES.parents[1], check=True)


def keep_first_screens(browser: Any, folder: Path) -> None:
    """Write the first screens of the tutorial's pages."""
    for name, path in TUTORIAL.items():
        screen = Image.open(io.BytesIO(_screen(browser, folder / path, FIRST_SCREEN, 1500))).convert("RGB")
        height = round(screen.height * SHOWN_WIDTH / screen.width)
        screen.resize((SHOWN_WIDTH, height), Image.Resampling.LANCZOS).save(IMAGES / f"{name}.webp", quality=80)


def _screen(browser: Any, path: Path, size: dict[str, int], wait_ms: int = 500) -> bytes:
    """Return the first screen of a page as a PNG file."""
    page = browser.new_page(viewport=size)
    page.goto(path.as_uri())
    page.wait_for_timeout(wait_ms)
    png: bytes = page.screenshot()
    page.close()
    return png


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
    clip = {**box, "height": end["y"] + end["height"] - begin["y"] + 24}
    _write(page.screenshot(full_page=True, clip=clip), picture)
    page.close()


def _write(png: bytes, picture: Path) -> None:
    """Write an image with 128 colours."""
    image = Image.open(io.BytesIO(png)).convert("RGB")
    image.quantize(128, dither=Image.Dither.NONE).save(picture, optimize=True)


def _certificate(browser: Any, laboratory: Laboratory) -> None:
    """Write the first sheet, and results with budget, of the certificate of the demo recording, a specimen."""
    laboratory.page(GALLERY["demo"])
    form, *_ = NEW_FORM.partition("[laboratory.cmc]")
    form += "[customer]" + NEW_FORM.partition("[customer]")[2]
    form = re.sub(
        r'^(\w+) = ""(?!")',
        lambda found: f'{found[1]} = "{CERTIFIED.get(found[1], "Example " + found[1].replace("_", " "))}"',
        form,
        flags=re.MULTILINE,
    )
    for key, day in (("begun", "2026-11-19"), ("ended", "2026-11-20")):
        form = form.replace(f'# {key} = ""', f'{key} = "{day}"')
    form = re.sub(r"^# (?=\[conditions|temperature|humidity)", "", form, flags=re.MULTILINE)
    (laboratory.place / "form.toml").write_text(form.replace("METHOD", METHOD), encoding="utf-8")
    laboratory.run(SPECIMEN)
    page = browser.new_page(viewport=dict(zip(("width", "height"), A4_PX, strict=True)))
    page.goto((laboratory.place / "out" / "certificate" / "certificate.html").as_uri())
    page.wait_for_timeout(500)
    calibration, begin, end = (
        page.locator("main section", has=page.get_by_role("heading", name=name, exact=True)).bounding_box()
        for name in ("Calibration", "Results", "Uncertainty budgets")
    )
    for name, top, low in (("certificate", 0.0, calibration), ("certificate_results", begin["y"] - 8.0, end)):
        clip = {"x": 0, "y": top, "width": A4_PX[0], "height": low["y"] + low["height"] - top + 8.0}
        _write(page.screenshot(full_page=True, clip=clip), IMAGES / f"{name}.png")
    page.close()


def _light(browser: Any, laboratory: Laboratory) -> None:
    """Write the page of `look` for the demo recording with ten times the scale of its laser."""
    laboratory.page(GALLERY["demo"])
    manifest = laboratory.place / "demo" / "Fz-0080" / "recording.toml"
    stated = manifest.read_text(encoding="utf-8")
    manifest.write_text(re.sub(r"^scale = 0.1$", "scale = 1.0", stated, flags=re.MULTILINE), encoding="utf-8")
    page_file = laboratory.place / "light.html"
    main(["look", str(manifest.parent), "--page", str(page_file), "-q"])
    manifest.write_text(stated, encoding="utf-8")
    _write(_screen(browser, page_file, LOOK_PAGE), IMAGES / "light.png")


def _live(browser: Any, laboratory: Laboratory) -> None:
    """Write the page of `look --live` for the demo recording, whose aim is reached."""
    laboratory.page(GALLERY["demo"])
    page_file, recording = laboratory.place / "live.html", laboratory.place / "demo" / "Fz-0080"
    main(["look", "--live", str(recording), "--rate", "38.345", "--until", "0.25", "--page", str(page_file), "-q"])
    _write(_screen(browser, page_file, LOOK_PAGE), IMAGES / "live.png")


def _viewer(browser: Any, laboratory: Laboratory) -> None:
    """Write the viewer with a field over the images of the demo recording."""
    laboratory.page(GALLERY["demo"])
    viewed = ViewSession(find_sources(laboratory.place / "out" / "demo" / "Fz-0080", None))
    server = Server(api_handlers(viewed), 0, api_actions(viewed))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page = browser.new_page(viewport={"width": WIDTH, "height": 900})
    page.goto(server.address)
    page.wait_for_selector("body[data-frame]")
    page.locator("#field").select_option(index=1)
    page.wait_for_timeout(1500)
    image = Image.open(io.BytesIO(page.screenshot(clip={"x": 0, "y": 0, "width": WIDTH, "height": VIEWER_PX})))
    image.convert("RGB").resize((1000, 1000 * VIEWER_PX // WIDTH)).save(IMAGES / "viewer.webp", quality=50, method=6)
    page.close()
    server.shutdown()
    server.server_close()


def _next(browser: Any, laboratory: Laboratory) -> None:
    """Write the figure of the next recordings of the matrix campaign."""
    results = laboratory.page(GALLERY["matrix"]).parent
    main(["plan", "--next", str(results), "--force", "--figure", str(IMAGES / "next.png"), "-q"])


DRAWN = {"next": _next, "certificate": _certificate, "viewer": _viewer, "light": _light, "live": _live}


if __name__ == "__main__":
    make_pictures(names_to_make((*TUTORIAL, *PICTURES, *DRAWN, "plan", *EXAMPLES), __doc__))
