"""The page of `shakercal view` in a browser: zoom, contrast, play, outlines, broken recordings, axes and colours."""

from __future__ import annotations

import re
import shutil
import socket
import struct
from base64 import b64decode
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import tifffile
from browsing import viewer_pages

from fusion.planning.planning_notices import RECORDING_CHANGED
from fusion.recording.load import load_manifest
from fusion.report.field_data import field_quantities, read_pair_fields
from fusion.report.figure import PURPLE, SOURCE_COLOUR
from fusion.report.report_notices import OTHER_STRUCTURE
from tests.fusion.test_view import served

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
    with viewer_pages(browser, EXPECTED, timeout_ms=20_000) as open_page:
        yield open_page


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


# The field of the results over the images.


def displacement_m(results: Path, frame: int) -> np.ndarray:
    """Return the displacement (N,) along z in a frame, by the stored phasors: Re{(t + r × x + rest) exp(jωt)}."""
    with h5py.File(results / "result.h5") as file:
        group = file["stereo/top"]
        line = int(np.argmin(np.abs(group["phasors/frequency_hz"][()] - 80.0)))
        rigid, at = group["phasors/value"][line], group["deflection/reference_m"][()]
        phasor = rigid[2] + np.cross(rigid[3:], at)[:, 2] + group["deflection/value"][line, :, 2]
        turn = np.exp(2j * np.pi * group["phasors/frequency_hz"][line] * group["time_s"][frame])
    return np.asarray((phasor * turn).real)


def choose_field(page: Any, key: str, frame: int) -> None:
    page.select_option("#field", key)
    page.locator("#frame").fill(str(frame))
    page.wait_for_selector(f"body[data-field='{key} {frame}']")


def probed(page: Any, x: float, y: float) -> re.Match[str]:
    """Point at a pixel of the left image and return what is shown of its subset: position, value, U."""
    box = page.locator("#left").bounding_box()
    factor = box["width"] / SIZE[0]
    page.mouse.move(box["x"] + (x + 0.5) * factor, box["y"] + (y + 0.5) * factor)
    found = re.match(r"Subset at \((\d+), (\d+)\) px: (\S+) ± (\S+) µm", page.inner_text("#field-probe"))
    assert found is not None
    return found


def test_the_probe_shows_the_motion_of_the_results_in_every_frame(demo_results, demo_recording, opened):
    """The value is that of the stored phasors; the poses tracked frame by frame, which no line describes, agree."""
    with h5py.File(demo_results / "result.h5") as file:
        points, poses = file["stereo/top/subsets_px"][()], file["stereo/top/motion/pose"][()]
        reference, origin = file["stereo/top/deflection/reference_m"][()], file["stereo/top/motion/origin_m"][()]
    point = int(np.argmin(np.linalg.norm(points - [150, 120], axis=1)))
    tracked = poses[:, 2] + np.cross(poses[:, 3:], reference[point] - origin)[:, 2]
    with served(demo_results, demo_recording) as client:
        page = opened(client)
        shown = []
        for frame in (0, 3, 7, 15):
            choose_field(page, "d-z", frame)
            x, y, value, expanded = probed(page, *points[point]).groups()
            assert np.hypot(float(x) - points[point, 0], float(y) - points[point, 1]) < 1.0
            shown.append(1e-6 * float(value.replace("\N{MINUS SIGN}", "-")))
            np.testing.assert_allclose(shown[-1], displacement_m(demo_results, frame)[point], atol=0.06e-6)
            assert 0.1 < float(expanded) < 5.0
        np.testing.assert_allclose(np.diff(shown), np.diff(tracked[[0, 3, 7, 15]]), atol=0.01 * np.ptp(tracked))
        page.select_option("#field-view", "size")
        until(page, "document.getElementById('field-probe').value.includes('phase')")
        assert float(page.inner_text("#field-probe").split(": ")[1].split(" ±")[0]) >= 1e6 * np.ptp(tracked) / 2 * 0.98
        page.locator("#left").focus()
        page.keyboard.press("Shift+ArrowRight")
        until(page, f"!document.getElementById('field-probe').value.includes('({x}, {y})')")
        assert page.evaluate("document.body.dataset.frame") == "15"


def test_the_viewer_offers_the_quantities_of_the_report_over_both_images(demo_results, demo_recording, opened):
    with h5py.File(demo_results / "result.h5") as file:
        (field,) = [one for one in read_pair_fields(file) if one.name == "top"]
    with served(demo_results, demo_recording) as client:
        page = opened(client)
        plain = [seen(page, side) for side in ("left", "right")]
        listed = page.evaluate(
            "[...document.querySelectorAll('#field option')].map((one) => [one.value, one.textContent])"
        )
        quantities = field_quantities(field, field.main_line)
        assert listed == [["", "none"], *([one.key, one.label] for one in quantities)]
        choose_field(page, "d-z", 0)
        low, high = page.inner_text("#field-low"), page.inner_text("#field-high")
        assert high.endswith(" µm")
        assert low == f"\N{MINUS SIGN}{high.removesuffix(' µm')}"
        largest = 1e6 * np.abs(field.displacement(field.main_line)[:, 2]).max()
        assert float(high.removesuffix(" µm")) == pytest.approx(largest, rel=0.02)
        for side, before in zip(("left", "right"), plain, strict=True):
            changed = np.abs(seen(page, side).astype(int) - before).mean(axis=0) > 5
            assert 0.5 < changed.mean() < 1.0
        # In the right image the points are where the subsets of the first frame are.
        answer, subsets = client.ask("field", pair=0, line=field.main_line), client.ask("subsets", pair=0, frame=0)
        points = np.frombuffer(b64decode(answer["cameras"][1]["points"]), "<f4").reshape(-1, 2)
        np.testing.assert_allclose(points, np.array(subsets["right"], dtype=float), atol=0.5)
        page.select_option("#field", "")
        until(page, "document.body.dataset.field === ''")
        assert page.is_hidden("#field-scale")


def test_without_results_no_field_is_offered(demo_recording, opened):
    with served(demo_recording) as client:
        page = opened(client)
        assert page.is_hidden("#field-tools")
        assert "error" in client.ask("field", pair=0, line=0)


def test_unreadable_fields_are_named_and_the_images_are_shown(demo_results, demo_recording, tmp_path, opened):
    broken = shutil.copytree(demo_results, tmp_path / "Fz-0080")
    with h5py.File(broken / "result.h5", "a") as file:
        del file["stereo/top/subset_zncc"]
        file.create_group("stereo/top/subset_zncc")
    with served(broken, demo_recording) as client:
        page = opened(client)
        assert OTHER_STRUCTURE.code in page.text_content("#problems-listed")
        assert page.is_hidden("#field-tools")
        assert seen(page).std() > 30


def test_the_next_frames_are_asked_for_in_the_direction_of_the_slider_and_once_each(demo_recording, opened):
    with served(demo_recording) as client:
        page = opened(client)
        asked: list[int] = []
        page.on(
            "request",
            lambda request: (
                asked.append(int(request.url.split("frame=")[1])) if "side=0&frame=" in request.url else None
            ),
        )
        for frame in (12, 11):
            page.locator("#frame").fill(str(frame))
            page.wait_for_selector(f"body[data-frame='{frame}']")
        page.wait_for_timeout(500)
        assert {10, 9, 8} <= set(asked)
        count = len(asked)
        for frame in (10, 9, 11, 12):
            page.locator("#frame").fill(str(frame))
            page.wait_for_selector(f"body[data-frame='{frame}']")
        page.wait_for_timeout(300)
        assert not {9, 10, 11, 12} & set(asked[count:])
        assert len(asked) == len(set(asked))


def test_a_page_that_is_closed_meanwhile_is_no_error(demo_recording, capfd):
    with served(demo_recording) as client:
        for sent in (b"", b"GET /"):
            with socket.create_connection(("127.0.0.1", client.server.server_port)) as connection:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # close: a reset
                connection.sendall(sent)
        assert client.ask("sources")["recordings"]
    assert capfd.readouterr().err == ""
