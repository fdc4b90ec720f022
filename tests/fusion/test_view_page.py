"""The page of `shakercal view` in a browser: zoom, contrast, play, outlines, broken recordings, axes and colours."""

from __future__ import annotations

import re
import shutil
from base64 import b64decode
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from fusion.planning.planning_notices import RECORDING_CHANGED
from fusion.recording.load import load_manifest
from fusion.report.figure import PURPLE, SOURCE_COLOUR
from tests.fusion.test_view import Client, served

SIZE = (304, 240)  # px of the demo's images
EXPECTED = "status of 400"
"""On the console, of a change that is refused."""


def until(page: Any, condition: str) -> None:
    """Wait for a condition, which the page's policy does not let the browser's driver evaluate."""
    for _ in range(400):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise AssertionError(condition)


@pytest.fixture
def opened(browser: Any) -> Iterator[Callable[..., Any]]:
    """Open a viewer's page; at the end nothing was complained of."""
    said: list[str] = []
    contexts = []

    def open_page(client: Client, wait: str = "body[data-frame]", **settings: Any) -> Any:
        context = browser.new_context(viewport={"width": 1400, "height": 1000}, **settings)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(20_000)
        page.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(client.server.address)
        page.wait_for_selector(wait)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert [text for text in said if not re.search(EXPECTED, text)] == []


@pytest.fixture
def campaign(tmp_path: Path, demo_recording: Path) -> Path:
    return Path(shutil.copytree(demo_recording, tmp_path / "demo"))


def seen(page: Any, side: str = "left") -> np.ndarray:
    """Return the shades (H, W) on a canvas."""
    text = page.locator(f"#{side}").evaluate("c => c.toDataURL('image/png')").partition(",")[2]
    return np.asarray(cv2.imdecode(np.frombuffer(b64decode(text), np.uint8), cv2.IMREAD_COLOR)[:, :, 2])


def port(page: Any, side: int = 0) -> dict[str, float]:
    found = page.evaluate(f"(({{ zoom, x, y }}) => ({{ zoom, x, y }}))(view.images.ports[{side}])")
    return dict(found)


def test_the_wheel_zooms_around_the_pixel_under_the_mouse(demo_recording, opened):
    with served(demo_recording) as client:
        page = opened(client)
        box = page.locator("#left").bounding_box()
        where = [round(box["x"] + 0.7 * box["width"]), round(box["y"] + 0.3 * box["height"])]
        at = f"view.where('left', {{ clientX: {where[0]}, clientY: {where[1]} }})"
        before = page.evaluate(at)
        page.mouse.move(*where)
        for _ in range(8):
            page.mouse.wheel(0, -100)
        until(page, "view.images.ports[0].zoom > 5")
        np.testing.assert_allclose(page.evaluate(at), before, atol=0.01)
        assert port(page, 1)["zoom"] == 1.0
        # The shown part is that of the file, magnified.
        part, shades = port(page), seen(page).astype(float)
        grey = tifffile.imread(demo_recording / "Fz-0080" / "top-left" / "0000.tif").astype(float)
        scale = SIZE[0] / part["zoom"] / shades.shape[1]
        rows = (part["y"] + scale * (np.arange(0, shades.shape[0], 7) + 0.5)).astype(int)
        columns = (part["x"] + scale * (np.arange(0, shades.shape[1], 7) + 0.5)).astype(int)
        assert np.corrcoef(grey[np.ix_(rows, columns)].ravel(), shades[::7, ::7].ravel())[0, 1] > 0.95
        page.mouse.down()
        page.mouse.move(where[0] - 60, where[1] + 30)
        page.mouse.up()
        np.testing.assert_allclose(
            [port(page)["x"] - part["x"], port(page)["y"] - part["y"]],
            [60 * SIZE[0] / part["zoom"] / box["width"], -30 * SIZE[0] / part["zoom"] / box["width"]],
            rtol=0.02,
        )
        assert page.evaluate("document.body.dataset.picked ?? ''") == ""
        page.mouse.dblclick(*where)
        until(page, "view.images.ports[0].zoom === 1")
        page.keyboard.press("+")
        assert port(page)["zoom"] > 1.0
        page.keyboard.press("0")
        assert port(page) == {"zoom": 1, "x": 0, "y": 0}


def test_contrast_is_that_of_the_sliders_and_auto_that_of_the_pixels(demo_recording, opened):
    with served(demo_recording) as client:
        page = opened(client)
        grey = tifffile.imread(demo_recording / "Fz-0080" / "top-left" / "0000.tif")
        levels = "[view.images.ports[0].black, view.images.ports[0].white]"
        black, white = page.evaluate(f"{levels}.map((one) => Number(one.value))")
        assert np.mean(grey < black) <= 0.01 <= np.mean(grey <= black)
        assert np.mean(grey < white) <= 0.99 <= np.mean(grey <= white)
        inputs = page.locator("#left-contrast input")
        inputs.nth(1).fill("1023")
        inputs.nth(0).fill("1000")
        dark = seen(page)
        assert dark.mean() < 3
        inputs.nth(0).fill("0")
        inputs.nth(1).fill("100")
        assert seen(page).mean() > 150
        page.locator("#left-contrast button").click()
        assert page.evaluate("Number(view.images.ports[0].white.value)") == white


def test_frames_play_in_the_chosen_order(demo_recording, opened):
    with served(demo_recording) as client:
        page = opened(client)
        page.select_option("#rate", "30")
        page.select_option("#order", "1")
        page.evaluate("""() => { view.shownFrames = [];
            new MutationObserver(() => view.shownFrames.push(Number(document.body.dataset.frame)))
              .observe(document.body, { attributeFilter: ["data-frame"] }); }""")
        page.click("#play")
        until(page, "view.shownFrames.length > 8")
        page.click("#play")
        assert page.get_attribute("#play", "aria-pressed") == "false"
        phases = np.array(client.ask("recording")["pairs"][0]["phases"][0])
        order = np.argsort(phases, kind="stable").tolist()
        shown = page.evaluate("view.shownFrames")[1:]
        places = [order.index(frame) for frame in shown]
        assert all((b - a) % len(order) == 1 for a, b in pairwise(places))
        page.wait_for_timeout(200)
        count = page.evaluate("view.shownFrames.length")
        page.wait_for_timeout(200)
        assert page.evaluate("view.shownFrames.length") == count


def draw_triangle(page: Any) -> None:
    page.select_option("#mouse", "mask-polygon")
    box = page.locator("#left").bounding_box()
    factor = box["width"] / SIZE[0]
    for x, y in ((100, 80), (150, 80), (120, 130), (100, 80)):
        page.mouse.click(box["x"] + (x + 0.5) * factor, box["y"] + (y + 0.5) * factor)


def test_a_polygon_is_written_after_a_confirmation(campaign, opened):
    file = campaign / "Fz-0080" / "recording.toml"
    before = file.read_bytes()
    with served(campaign) as client:
        page = opened(client)
        draw_triangle(page)
        assert page.input_value("#lines") == "mask = [[[100, 80], [150, 80], [120, 130]]]"
        page.click("#write")
        assert page.inner_text("#confirm-lines").strip() == "+ mask = [[[100, 80], [150, 80], [120, 130]]]"
        assert page.inner_text("#confirm-file") == str(file)
        page.click("#confirm-cancel")
        assert file.read_bytes() == before
        page.click("#write")
        page.click("#confirm-write")
        until(page, "document.getElementById('written').textContent === 'written'")
        assert load_manifest(file).images[0].mask == (((100, 80), (150, 80), (120, 130)),)
        assert page.is_disabled("#write")
        # Changed by hand meanwhile: refused in a sentence, and written after a reload.
        page.click("#clear")
        file.write_bytes(file.read_bytes() + b"# by hand\n")
        page.click("#write")
        page.click("#confirm-write")
        until(page, "document.getElementById('written').textContent !== ''")
        assert RECORDING_CHANGED.code in page.inner_text("#written")
        assert "mask" in file.read_text(encoding="utf-8")


def test_readable_images_of_a_broken_recording_are_shown_and_the_others_marked(campaign, opened):
    file = campaign / "Fz-0080" / "top-left" / "0003.tif"
    file.write_bytes(file.read_bytes()[:400])
    (campaign / "Fz-0080" / "top-right" / "0007.tif").unlink()
    bridge = campaign / "Fz-0080" / "bridge.h5"
    bridge.write_bytes(bridge.read_bytes()[:5000])
    with served(campaign) as client:
        page = opened(client, wait="body[data-examined]")
        listed = page.text_content("#problems-listed")
        assert all(part in listed for part in ("SC-124", "top-left/0003.tif", "bridge.h5"))
        for frame, marked in ((2, ("", "")), (3, ("SC-950", "")), (7, ("", "SC-950"))):
            page.locator("#frame").fill(str(frame))
            page.wait_for_selector(f"body[data-frame='{frame}']")
            codes = [page.get_attribute(f"#{side}-told", "data-refused") for side in ("left", "right")]
            assert tuple(codes) == marked
            for side, code in zip(("left", "right"), marked, strict=True):
                assert (seen(page, side).std() > 30) == (code == "")
        page.click("button[data-tab=signals]")
        names = [f"{one['daq']}.{one['name']}" for one in client.ask("recording")["channels"]]
        page.locator("#channels input").nth(names.index("bridge.Fz")).check()
        page.wait_for_selector("#signals-refused li")
        assert "bridge.h5" in page.inner_text("#signals-refused")
        assert page.get_attribute("#signals-drawn", "data-drawn") == "1"


def test_each_recorder_has_its_axis_and_each_source_its_colour(demo_recording, opened):
    with served(demo_recording) as client:
        page = opened(client)
        names = [f"{one['daq']}.{one['name']}" for one in client.ask("recording")["channels"]]
        page.click("button[data-tab=signals]")
        page.wait_for_selector("#signals-drawn[data-drawn='1'] canvas")
        for name in ("bridge.Fz", "vibrometer.base_acceleration"):
            page.locator("#channels input").nth(names.index(name)).check()
        page.wait_for_selector("#signals-drawn[data-drawn='3'] canvas")
        page.wait_for_timeout(300)
        page.evaluate("view.signals.groups[0].range.setv({ start: 0.2, end: 0.3 })")
        page.wait_for_selector("#signals[data-zoom='0.2 0.3']")
        ends = page.evaluate("view.signals.groups.map((group) => [group.daq, group.range.end])")
        assert [daq for daq, _ in ends] == ["vibrometer", "bridge"]
        assert ends[1][1] > 0.9
        colours = page.evaluate("""view.signals.groups.flatMap((group) => group.plots.map(({ number, plot }) =>
            [number, plot.renderers[0].glyph.line_color.value]))""")
        shown = {names[number]: colour for number, colour in colours}
        assert shown == {
            "vibrometer.velocity_1": SOURCE_COLOUR["vibrometer"],
            "vibrometer.base_acceleration": SOURCE_COLOUR["accelerometer"],
            "bridge.Fz": PURPLE,
        }


def test_the_logarithmic_axis_begins_at_zero(demo_recording, opened):
    with served(demo_recording) as client:
        page = opened(client)
        page.click("button[data-tab=spectra]")
        page.wait_for_selector("#spectrum-drawn[data-axis='0 linear']")
        assert page.evaluate("[view.spectrum.range.start, view.spectrum.source.data.x[0]]") == [0, 0]
        page.select_option("#frequency-axis", "log")
        page.wait_for_selector("#spectrum-drawn[data-axis='0 log']")
        start, first, second = page.evaluate("[view.spectrum.range.start, ...view.spectrum.source.data.x.slice(0, 2)]")
        step = 25_600 / 28_160
        np.testing.assert_allclose([start, first, second], [step / 2, step / 2, step], rtol=1e-9)
        # The highest bin is that of the line, at any zoom.
        page.evaluate("view.spectrum.range.setv({ start: 70, end: 90 })")
        until(page, "view.spectrum.source.data.x.length < 40")
        x, y = page.evaluate("[view.spectrum.source.data.x, view.spectrum.source.data.y]")
        assert abs(x[int(np.argmax(y))] - 80.0) < step
