"""Still pictures of figures: marks stand where the data say, names are no markup, nothing is cut off."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html import unescape
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath
from matplotlib.ticker import MaxNLocator

from fusion.report.figure import BLUE, GREEN, ORANGE, RED, SHEET_IN, Mark, Scale, empty_figure
from fusion.report.figure_files import PNG_DPI, render_figure
from fusion.report.folder import data_uri
from fusion.report.static_figure import decade_ticks, limits, round_ticks, static_svg
from fusion.report.svg_marks import DRAWN, HEIGHTS, shade
from shakercal._common.digits import tick_texts

SVG = "{http://www.w3.org/2000/svg}"
NUMBER = re.compile(r"-?(?:\d+\.?\d*|\.\d+)(?:e-?\d+)?")
FONT = FontProperties(fname=str(Path(mpl.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"))


def one_panel(height_in=3.0):
    drawn = empty_figure("one", height_in)
    return drawn, drawn.panels[0]


def read(figure):
    return ElementTree.fromstring(static_svg(figure).encode())


def window(root, place=0):
    """Left, top, right and bottom of a panel."""
    box = root.findall(f".//{SVG}clipPath/{SVG}rect")[place].attrib
    x, y, wide, tall = (float(box[key]) for key in ("x", "y", "width", "height"))
    return x, y, x + wide, y + tall


def corners(path):
    """Numbers of an absolute path, (N, 2)."""
    return np.array([float(text) for text in NUMBER.findall(path)]).reshape(-1, 2)


def strokes_of(root, colour):
    return [e for e in root.iter(f"{SVG}path") if e.attrib.get("stroke") == colour]


def texts_of(root):
    """Every text of a picture with left and right end, base line and size in pt; those read upwards without places."""
    found = []
    for text in root.iter(f"{SVG}text"):
        size, content = float(text.attrib["font-size"]), "".join(text.itertext())
        x, y = float(text.attrib["x"]), float(text.attrib["y"])
        wide = TextPath((0, 0), content, size=size, prop=FONT).get_extents().width if content.strip() else 0.0
        left = x - {"start": 0.0, "middle": 0.5, "end": 1.0}[text.attrib["text-anchor"]] * wide
        found.append((content, None if "transform" in text.attrib else (left, left + wide, y), size))
    return found


@pytest.mark.parametrize("log", [False, True])
def test_marks_are_at_the_positions_of_the_data(log):
    drawn, panel = one_panel()
    x, y = np.array([1.0, 2.0, 5.0, 10.0]), np.array([3.0, 1.0, np.nan, 30.0])
    panel.x.limits, panel.y.limits, panel.y.log = (0.0, 10.0), (0.5, 50.0), log
    panel.line(x, y, colour=RED)
    panel.points(x, y, colour=BLUE, half_y=0.5)
    root = read(drawn)
    left, top, right, bottom = window(root)
    share = np.log(y / 0.5) / np.log(100.0) if log else (y - 0.5) / 49.5
    expected = np.column_stack([left + x / 10.0 * (right - left), bottom - share * (bottom - top)])
    (line,) = strokes_of(root, RED)
    np.testing.assert_allclose(corners(line.attrib["d"].replace("h0", "")), expected[[0, 1, 3]], atol=0.01)
    assert line.attrib["d"].count("M") == 2  # interrupted where nothing is known
    bars, dots = strokes_of(root, BLUE)
    middles = corners(bars.attrib["d"]).reshape(-1, 2, 2)
    np.testing.assert_allclose(middles[:, 0, 0], expected[[0, 1, 3], 0], atol=0.01)
    np.testing.assert_allclose(corners(dots.attrib["d"].replace("h0", "")), expected[[0, 1, 3]], atol=0.06)


def test_areas_boxes_and_rules_are_at_the_positions_of_the_data():
    drawn, panel = one_panel()
    panel.x.limits, panel.y.limits = (0.0, 10.0), (0.0, 10.0)
    panel.span(2.0, 3.0, colour=GREEN)
    panel.band([1.0, 2.0], [1.0, 1.0], [4.0, 5.0], colour=RED)
    panel.boxes((6.0, 7.0), (1.0, 8.0), colour=ORANGE)
    panel.rule(5.0, along="x", colour=BLUE)
    root = read(drawn)
    left, top, right, bottom = window(root)

    def back(path):
        places = corners(path.attrib["d"])
        return (places - [left, bottom]) / [right - left, top - bottom] * 10.0

    def filled(colour):
        return [back(e) for e in root.iter(f"{SVG}path") if e.attrib.get("fill") == colour]

    for colour, low, high in ((GREEN, (0, 2), (10, 3)), (RED, (1, 1), (2, 5)), (ORANGE, (6, 1), (7, 8))):
        (area,) = filled(colour)
        np.testing.assert_allclose([area.min(0), area.max(0)], [low, high], atol=1e-3)
    np.testing.assert_allclose(back(strokes_of(root, BLUE)[0]), [[5, 0], [5, 10]], atol=1e-3)


def test_names_of_users_are_letters_and_never_markup():
    drawn, panel = one_panel()
    name = '<script>alert("1")</script> & \N{MICRO SIGN}'
    panel.line([0.0, 1.0], [0.0, 1.0], name)
    panel.title, panel.x.label, panel.y.names = name, name, (name, "b")
    panel.text(0.5, 0.5, name)
    text = static_svg(drawn)
    assert "<script" not in text
    shown = {told for told, _, _ in texts_of(ElementTree.fromstring(text.encode()))}
    assert name in shown


def crowd():
    """A figure with long names and numbers, two columns, a legend of several rows, a second scale, a bar of colours."""
    drawn = empty_figure("crowd", 4.0, 2, 2, shared_x=False)
    rng = np.random.default_rng(1)
    for place, panel in enumerate(drawn.panels):
        panel.title = "a title that is rather long for the place that it has, a very long one"
        panel.x.label, panel.y.label = "time since the beginning of the record / s", "y / m"
        for k in range(5):
            panel.line(rng.normal(size=3), 1.234567e-9 * rng.normal(size=3), f"series number {k} of panel {place}")
    drawn.panels[1].y.second = ("from static / %", 1e-9, 1e13)
    drawn.panels[2].x.limits, drawn.panels[2].y.limits = (123456.7, 123456.9), (9.99991e5, 9.99992e5)
    values = np.array([0.1, np.nan])
    drawn.panels[3].points(
        [0.0, 1.0], [0.0, 1.0], values=values, scale=Scale("viridis", 0.01, 5.0, "size / m", log=True)
    )
    return drawn


def test_no_text_is_cut_off_and_numbers_do_not_overlap():
    drawn = crowd()
    told = [entry for entry in texts_of(read(drawn)) if entry[1] is not None]
    assert len(told) > 40
    for text, (left, right, base), size in told:
        assert left >= 0.0, text
        assert right <= 72.0 * 8.4, text
        assert size <= base + 0.5, text
        assert base <= 72.0 * drawn.height_in - 1.0, text
    for k, (text, (left, right, base), size) in enumerate(told):
        for other, (first, last, line), _ in told[:k]:
            apart = right <= first or last <= left or abs(line - base) >= 0.7 * size
            assert apart, (text, other)


def test_equal_figures_give_equal_text_and_the_file_is_that_text():
    assert static_svg(crowd()) == static_svg(crowd()) == render_figure(crowd()).decode()
    assert render_figure(crowd(), "png").startswith(b"\x89PNG")


def test_a_png_has_the_marks_where_the_svg_has_them():
    drawn, panel = one_panel()
    panel.x.limits, panel.y.limits = (0.0, 10.0), (0.0, 10.0)
    panel.points(5.0, 2.5, colour=RED, size=8.0)
    panel.boxes((7.0, 8.0), (6.0, 9.0), colour=BLUE)
    left, top, right, bottom = window(read(drawn))
    shown = cv2.imdecode(np.frombuffer(render_figure(drawn, "png"), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    for colour, x, y in ((RED, 5.0, 2.5), (BLUE, 7.5, 7.5)):
        parts = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        row, column = np.argwhere(np.abs(shown.astype(int) - parts).sum(axis=2) < 30).mean(axis=0)
        expected = left + 0.1 * x * (right - left), bottom - 0.1 * y * (bottom - top)
        np.testing.assert_allclose(np.array([column, row]) * 72.0 / PNG_DPI, expected, atol=0.5)


@pytest.mark.parametrize("stated", [False, True])
def test_equal_scales_are_equal(stated):
    drawn, panel = one_panel()
    panel.equal = True
    panel.line([0.0, 10.0], [0.0, 2.0], colour=RED)
    if stated:
        panel.x.limits, panel.y.limits = (0.0, 10.0), (-1.0, 3.0)
    root = read(drawn)
    (start, end) = corners(strokes_of(root, RED)[0].attrib["d"])
    assert abs(end[1] - start[1]) / abs(end[0] - start[0]) == pytest.approx(0.2, rel=2e-3)
    if stated:
        left, top, right, bottom = window(root)
        assert (bottom - top) / (right - left) == pytest.approx(0.4, rel=1e-3)


def test_shared_axes_have_one_pair_of_limits():
    drawn = empty_figure("shared", 4.0, 2)
    drawn.panels[0].line([0.0, 1.0], [0.0, 1.0], colour=RED)
    drawn.panels[1].line([2.0, 3.0], [0.0, 1.0], colour=RED)
    root = read(drawn)
    first, second = (corners(line.attrib["d"]) for line in strokes_of(root, RED))
    assert second[0, 0] - first[0, 0] == pytest.approx(2.0 * (first[1, 0] - first[0, 0]), rel=1e-3)
    assert limits(drawn.panels, "x") == pytest.approx((-0.15, 3.15))  # a twentieth of all on either side


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.7e-8, 2.2e-8), (99.3, 101.2), (-1e6, 5e6), (7.0, 7.0)])
def test_ticks_are_round_and_as_many_as_have_room(low, high):
    ticks = round_ticks(low, high, 6)
    assert np.all((ticks >= low - 1e-9 * abs(low)) & (ticks <= high + 1e-9 * abs(high)))
    if low < high:
        locator = MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
        step = np.diff(ticks)[0]
        assert 2 <= len(ticks) <= 7
        assert step <= 2.6 * np.diff(locator)[0]
        assert [float(text.replace("\N{MINUS SIGN}", "-")) for text in tick_texts(ticks)] == pytest.approx(
            ticks.tolist(), abs=1e-3 * step
        )


def test_ticks_of_a_logarithm_are_powers_or_few_round_numbers():
    assert decade_ticks(0.5, 2e3)[1] == ["1", "10", "100", "1000"]
    assert decade_ticks(0.5, 2e6)[1] == ["10⁰", "10¹", "10²", "10³", "10⁴", "10⁵", "10⁶"]
    assert decade_ticks(1e-12, 1e12)[0][1] / decade_ticks(1e-12, 1e12)[0][0] == pytest.approx(1e4)
    assert decade_ticks(0.15, 7.0)[1] == ["0.2", "0.5", "1", "2", "5"]


@pytest.mark.parametrize("name", ["viridis", "Blues", "RdBu"])
def test_colours_of_values_are_those_of_matplotlib(name):
    theirs = mpl.colormaps["RdBu_r" if name == "RdBu" else name]
    for share in np.linspace(0.0, 1.0, 33):
        own = np.array([int(shade(Scale(name, 0.0, 1.0), share)[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
        np.testing.assert_allclose(own, theirs(share)[:3], atol=0.02)


def test_a_figure_without_data_has_axes():
    drawn, panel = one_panel()
    panel.y.log = True
    panel.line([], [], "nothing")
    panel.points([np.nan], [np.nan])
    assert len(texts_of(read(drawn))) > 3
    assert texts_of(read(replace(drawn, height_in=1.0)))


def test_every_kind_of_mark_has_an_image():
    kinds = set(Mark.__subclasses__())
    assert kinds == set(DRAWN) == {kind for level in HEIGHTS for kind in level}


def test_an_ellipse_an_arrow_and_an_image_are_where_the_axes_say():
    drawn, panel = one_panel()
    panel.ellipse(2.0 + 1.0j, (1.0, 0.5), np.pi / 2.0, colour=RED)
    panel.arrows(np.array([[1.0, 0.0]]), np.array([[2.0, 1.0]]), colour=GREEN)
    panel.image(np.full((3, 4), 90, dtype=np.uint8), (0.0, 4.0), (2.0, 0.0))
    panel.x.limits, panel.y.limits = (0.0, 4.0), (0.0, 2.0)
    root = read(drawn)
    left, top, right, bottom = window(root)
    unit = (right - left) / 4.0, (bottom - top) / 2.0
    around = corners(strokes_of(root, RED)[0].attrib["d"])
    # Upright: half as wide as it is high.
    assert np.ptp(around[:, 0]) == pytest.approx(unit[0], abs=0.02)
    assert np.ptp(around[:, 1]) == pytest.approx(2.0 * unit[1], abs=0.02)
    assert around.mean(axis=0) == pytest.approx([left + 2.0 * unit[0], bottom - unit[1]], abs=0.02)
    arrow = corners(strokes_of(root, GREEN)[0].attrib["d"])
    assert arrow == pytest.approx(
        np.array([[left + unit[0], bottom], [left + 3.0 * unit[0], bottom - unit[1]]]), abs=0.02
    )
    (image,) = root.iter(f"{SVG}image")
    place = [float(image.attrib[key]) for key in ("x", "y", "width", "height")]
    assert place == pytest.approx([left, top, right - left, bottom - top], abs=0.02)
    data = np.frombuffer(base64.b64decode(image.attrib["href"].partition(",")[2]), dtype=np.uint8)
    assert cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) == pytest.approx(np.full((3, 4), 90), abs=2)


def test_a_text_with_a_sign_of_markup_survives_the_page():
    drawn, panel = one_panel()
    panel.text(1.0, 1.0, "< 0.60 & more")
    address = unescape(str(data_uri(static_svg(drawn))))
    root = ElementTree.fromstring(unquote(address.partition(",")[2]))
    assert "< 0.60 & more" in ["".join(text.itertext()) for text in root.iter(f"{SVG}text")]


def test_a_figure_higher_than_a_sheet_is_several_of_whole_rows():
    drawn = empty_figure("high", 28.0, 7, 2)
    parts = drawn.sheets()
    assert [len(part.heights) for part in parts] == [2, 2, 2, 1]
    assert [panel for part in parts for panel in part.panels] == list(drawn.panels)
    assert [part.height_in for part in parts] == pytest.approx([8.0, 8.0, 8.0, 4.0])
    assert all(part.height_in <= SHEET_IN for part in parts)
    (whole,) = empty_figure("low", 5.0, 3).sheets()
    assert (whole.height_in, len(whole.panels)) == (5.0, 3)
