"""Pages of all presets with thumbnails, for the site: `make gallery`.

Every preset is simulated and evaluated. The pages go to build/gallery/pages, from where `make docs` takes them into the
site, their first screens as thumbnails to docs/images/gallery, and the list to docs/gallery.md. The first screen of the
demo recording, in motion, is the picture of the README: docs/images/first-screen.webp.
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
import sys
import tempfile
from collections.abc import Collection, Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image
from playwright.sync_api import sync_playwright

from fusion.cli import main
from fusion.report.summary_pdf import find_browser

DOCS = Path(__file__).resolve().parent
BUILT = DOCS.parent / "build" / "gallery" / "pages"
SCREEN, THUMBNAIL, ANIMATED = (1400, 900), (560, 360), (900, 579)
"""Width and height of the browser's window, of a thumbnail, and of the moving picture, in px."""
IMAGES_OF_A_PERIOD, TIME_OF_AN_IMAGE_MS = 16, 90


class Entry(NamedTuple):
    """One page: commands after `shakercal` in one common folder, the page that they write, and a caption.

    `status`: exit status of the last command.
    """

    commands: tuple[str, ...]
    page: str
    caption: str
    status: int = 0


def _made(preset: str, command: str, page: str, caption: str) -> Entry:
    """Return the entry of a preset with the command that evaluates it, where * stands for the preset's name."""
    made = f"simulate {preset} --preset {preset}"
    return Entry((made, command.replace("*", preset)), f"out/{preset}/{page}", caption)


_RUN = "run * -o out/*", "report.html"
_SWEEP = "simulate sweep --preset sweep", "run sweep -o out/sweep"
_STEPS = "simulate steps --preset steps"
_COMPARED = "simulate other --preset sweep --seed 2", "run other -o out/other"
_TARGET = "--target charuco --size 11x8 --spacing 9e-3"
GALLERY = {
    "demo": _made("demo", *_RUN, "One recording at 80 Hz: two stereo pairs, laser, accelerometer"),
    "single": _made("single", *_RUN, "One camera and three laser points"),
    "bending": _made("bending", *_RUN, "A load mass that bends at 1020 Hz, with its mode"),
    "room": _made("room", *_RUN, "Cameras and lasers on a floor that shakes, with patches at rest"),
    "laboratory": _made("laboratory", *_RUN, "A load mass that bends, with patches at rest next to it"),
    "nitsche2018": _made("nitsche2018", *_RUN, "The published set-up at 106.25 Hz"),
    "sweep": _made("sweep", *_RUN, "A curve over twelve frequencies: two mountings, two recordings each"),
    "matrix": _made("matrix", *_RUN, "The 6 × 6 matrix of sensitivities, with its cross-talk"),
    "compare": Entry(
        (*_SWEEP, *_COMPARED, "compare first=out/sweep second=out/other -o out/compare"),
        "out/compare/comparison.html",
        "Two campaigns with two sensors of one type compared: degrees of equivalence",
    ),
    "targets": _made(
        "targets",
        f"cameras targets/left targets/right {_TARGET} -o out/targets/top.json",
        "top.html",
        "Calibration of a stereo pair from images of a target",
    ),
    "acceptance": _made(
        "acceptance", "accept * -o out/*", "acceptance.html", "Acceptance test of a stereo rig, which passes"
    ),
    "chirp": _made("chirp", "transfer * -o out/*", "transfer.html", "Transfer functions and a resonance from a chirp"),
    "masses": _made("masses", "identify * -o out/*", "identify.html", "Stiffness, damping, internal mass of a sensor"),
    "pitching": _made("pitching", "identify * -o out/*", "identify.html", "A horizontal set-up whose load pitches"),
    "rotation": _made("rotation", "rotate * -o out/*", "rotation.html", "Masses from rotation about a horizontal axis"),
    "orientations": _made("orientations", "rotate * -o out/*", "rotation.html", "Masses from the poses of a robot"),
    "steps": _made("steps", "step * -o out/*", "step.html", "Modes, bands and settling from ropes that are cut"),
    "decouple": Entry(
        (_STEPS, "decouple steps -o out/decouple"),
        "out/decouple/decouple.html",
        "A filter that removes dynamic cross-talk between six outputs",
    ),
    "compensate": Entry(
        (_STEPS, "step steps -o out/steps", "compensate out/steps --frequency 3000 --damping 0.6 -o out/compensate"),
        "out/compensate/compensate.html",
        "A filter that makes the sensor faster",
    ),
    "loads": _made("loads", "load * -o out/*", "load.html", "The resonance over the load mass, and the load limit"),
    "elastomer": _made(
        "elastomer", "elastomer elastomer/elastomer.toml -o out/*", "elastomer.html", "Modes of a cross-beam element"
    ),
}

SECTIONS = {
    "One recording": ("demo", "single", "bending", "room", "laboratory", "nitsche2018"),
    "Campaigns": ("sweep", "matrix", "compare"),
    "Cameras": ("targets", "acceptance"),
    "Models of the sensor": ("rotation", "orientations", "chirp", "masses", "pitching"),
    "Releases and filters": ("steps", "loads", "compensate", "decouple", "elastomer"),
}
CONTENTS = {
    "demo": "the sensitivity with U, the agreement of cameras and laser, the moving rig, and fields over the images",
    "single": "the six components that one camera and three laser points determine together",
    "bending": "the bending of the load mass as a deflection shape, and its effect on the sensitivity",
    "room": "the motion of the floor, by patches at rest in the images, and the corrected result",
    "laboratory": "the bending of the load mass, and the motion of the room by the patches at rest",
    "nitsche2018": "the sensitivity at the frequency and amplitude of a published measurement",
    "acceptance": "verdicts for noise, scale, straightness and epipolar distances of a rig, and the most likely fault",
    "sweep": "magnitude and phase over frequency, and the scatter of repeats and mountings",
    "matrix": "the main elements with U, the map of cross-talk, and the poses and scales of all recordings together",
    "compare": "the degrees of equivalence with U, and the values that U does not cover",
    "targets": "the parameters of the pair with U, the coverage of the images, and the residuals",
    "rotation": "internal mass, load mass and centres of mass, with readings over the angle and their residuals",
    "orientations": "the same masses from poses in space, and the offsets of all channels",
    "chirp": "magnitude and phase with the fitted oscillator, U of every line, and the budget of the resonance",
    "masses": "stiffness, damping and internal mass from two load masses, with curves and residuals",
    "pitching": "the parameters of translation and rotation that are coupled by the height of the load",
    "steps": "modes, bands and settling times of every component, for three kinds of rope",
    "loads": "the resonance over the load mass, and the load limit",
    "compensate": "the response before and after the filter, the noise, and the usable band",
    "decouple": "the dynamic cross-talk before and after the filter",
    "elastomer": "natural frequencies and mode shapes by several models, next to measured values",
}
"""Contents of each page, as the end of a sentence."""


class Laboratory:
    """A folder where commands of entries run, each once.

    Parameters
    ----------
    place : Path
        An empty folder.
    """

    def __init__(self, place: Path) -> None:
        self.place = place
        self._done: set[str] = set()

    def page(self, entry: Entry) -> Path:
        """Return the path of the page of an entry."""
        (self.place / entry.page).parent.mkdir(parents=True, exist_ok=True)
        for command in entry.commands:
            self.run(command, entry.status if command == entry.commands[-1] else 0)
        return self.place / entry.page

    def run(self, command: str, expected: int = 0) -> None:
        """Run a command in the folder, unless it has been run."""
        if command not in self._done:
            with chdir(self.place):
                status = main([*command.split(), "-q", "--force"])
            if status != expected:
                sys.exit(f"docs/gallery.py: {command}: expected exit status {expected}, found {status}")
            self._done.add(command)


@contextmanager
def browser_and_laboratory() -> Iterator[tuple[Any, Laboratory]]:
    """Open the system's Chromium, and a folder for commands."""
    with tempfile.TemporaryDirectory() as name, sync_playwright() as started:
        browser = started.chromium.launch(executable_path=find_browser(), args=["--no-sandbox"])
        yield browser, Laboratory(Path(name))
        browser.close()


def first_screens(browser: Any, path: Path, phases: int = 1) -> list[Image.Image]:
    """Return images of the first screen of a page, at equal steps of the motion's phase."""
    page = browser.new_page(viewport=dict(zip(("width", "height"), SCREEN, strict=True)))
    page.goto(path.as_uri())
    page.wait_for_timeout(1500)
    taken = []
    for index in range(phases):
        if phases > 1:
            page.locator("input[data-part=phase]").first.evaluate(
                "(slider, at) => { slider.value = at; slider.dispatchEvent(new Event('input', { bubbles: true })) }",
                round(360 * index / phases),
            )
            page.wait_for_timeout(100)
        taken.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    page.close()
    return taken


def names_to_make(every: Collection[str], purpose: str | None) -> list[str]:
    """Return the names of the command line, all without one; exit status 2 for one that is not among `every`."""
    parser = argparse.ArgumentParser(description=purpose, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    names: list[str] = parser.parse_args().names
    if unknown := [name for name in names if name not in every]:
        parser.error(f"NAME: expected some of {', '.join(every)}, found {', '.join(unknown)}")
    return names or list(every)


def make_gallery(chosen: list[str]) -> None:
    """Make the pages of some entries, their thumbnails, and the list of docs/gallery.md."""
    thumbnails = DOCS / "images" / "gallery"
    for folder in (BUILT, thumbnails):
        folder.mkdir(parents=True, exist_ok=True)
    with browser_and_laboratory() as (browser, laboratory):
        for name in chosen:
            path = laboratory.page(GALLERY[name])
            shutil.copyfile(path, BUILT / f"{name}.html")
            first, *more = first_screens(browser, path, IMAGES_OF_A_PERIOD if name == "demo" else 1)
            _smaller(first, THUMBNAIL).save(thumbnails / f"{name}.webp", quality=70, method=6)
            if more:
                _save_animated([_smaller(image, ANIMATED) for image in (first, *more)])
            print(f"{name}: {os.path.getsize(path) / 1e6:.2f} MB", flush=True)
    from marked import write_marked

    write_marked(DOCS / "gallery.md", {"gallery": listing()})


def _smaller(image: Image.Image, size: tuple[int, int]) -> Image.Image:
    return image.resize(size, Image.Resampling.LANCZOS)


def _save_animated(images: list[Image.Image]) -> None:
    options: dict[str, Any] = {"duration": TIME_OF_AN_IMAGE_MS, "loop": 0, "quality": 55, "method": 6}
    images[0].save(DOCS / "images" / "first-screen.webp", save_all=True, append_images=images[1:], **options)


def listing() -> str:
    """Return the thumbnails of all pages, by section, with their captions, contents and commands."""
    parts = []
    for section, names in SECTIONS.items():
        parts.append(f"## {section}")
        for name in names:
            entry = GALLERY[name]
            commands = "\n".join(f"shakercal {command}" for command in entry.commands)
            image = f"![First screen of this page.](images/gallery/{name}.webp)"
            parts.append(f"### {entry.caption}\n\nThe page shows {CONTENTS[name]}.\n\n{image}\n\n```\n{commands}\n```")
    return "\n\n".join(parts)


if __name__ == "__main__":
    sys.path.insert(0, str(DOCS.parent / "benchmarks"))
    make_gallery(names_to_make(GALLERY, __doc__))
