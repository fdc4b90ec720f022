"""The page of a calibration: well-formed, complete in itself, and saying what the numbers say."""

from __future__ import annotations

import dataclasses
import html
import re

import pytest
from calibration_factory import Session, make_calibration
from page_outline import outline

from fusion.cameras.figures import draw_pictures
from fusion.cameras.report import (
    camera_headlines,
    correlations_table,
    draw_coverage,
    draw_views,
    dropped_table,
    lengths_table,
    parameters_table,
    render_camera_report,
    verdict,
    views_table,
)
from fusion.report.provenance import Provenance
from photogram.arrays import Notice
from photogram.calibration.result import Calibration, Dropped
from photogram.camera import RIG_PARAMETERS

PROVENANCE = Provenance({"left-01.tif": "ab" * 32}, {"target": "dots"}, {"shakercal": "0.1.0"}, ("top.json",))


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return make_calibration()


@pytest.fixture(scope="module")
def page(calibration: Calibration) -> str:
    return render_camera_report(calibration, "top", PROVENANCE, 12.3)


def _text(page: str) -> str:
    return "".join(outline(page).text)


def test_page_is_well_formed_and_self_contained(page: str) -> None:
    found = outline(page)
    assert page.startswith("<!doctype html>")
    assert len(found.ids) == len(set(found.ids))
    anchors = {address[1:] for address in found.addresses if address.startswith("#")}
    assert anchors <= set(found.ids)
    others = [address for address in found.addresses if not address.startswith("#")]
    assert len(others) == 10
    assert all(address.startswith("data:image/svg+xml,%3Csvg") for address in others)
    assert not re.search(r"url\((?!%23)|@import", page)
    assert len(page.encode()) < 6_000_000


def test_page_says_what_was_found(page: str) -> None:
    text = _text(page)
    assert all(name in text for name in RIG_PARAMETERS)
    assert "One warning (coverage): the lower left corner" in text
    assert text.index("Warning · coverage") < text.index("Note · target")
    assert "(3.50000 ± 0.00020) mm, k = 2" in text
    assert "U (k = 2) = 0.0058 %" in text
    assert "a displacement of 1 mm is uncertain by 0.029 µm (k = 1)" in text
    assert "same point of the target / µm" in text
    assert "blurred: edges of 6.1 px" in text
    assert "ab" * 32 in text
    assert "top.json" in text
    assert "nan" not in text.lower()


def test_headlines_are_the_truth_within_their_uncertainty(calibration: Calibration) -> None:
    found = {headline.label: headline.value for headline in camera_headlines(calibration)}
    for label, truth in (
        ("Baseline", 171.8400),
        ("Angle between the optical axes", 24.0718),
        ("Focal length fx of the left camera", 3512.4),
        ("Focal length fx of the right camera", 3498.9),
    ):
        value, expanded = (float(number) for number in re.findall(r"[\d.]+", found[label])[:2])
        assert abs(value - truth) < 2 * expanded, label
    assert found["Views"] == "13 pairs in 14 views"


def test_every_parameter_has_its_row(calibration: Calibration) -> None:
    rows = parameters_table(calibration).rows
    turn = dict(zip(RIG_PARAMETERS[18:21], calibration.rig.right_from_left.pose[3:], strict=True))
    assert [row[0] for row in rows] == list(RIG_PARAMETERS)
    for row, item in zip(rows, calibration.parameters, strict=True):
        power = re.search(r"10<sup>(−?\d+)", row[5])
        scale = 10.0 ** int(power.group(1).replace("−", "-")) if power else 1.0
        scale *= 1e-3 if row[5].endswith("mm") else 1.0
        value, u, expanded = (scale * float(cell.replace("−", "-")) for cell in row[2:5])
        assert value == pytest.approx(turn.get(item.name, item.value), abs=0.06 * 2 * item.u)
        assert u == pytest.approx(item.u, rel=0.06)
        assert expanded == pytest.approx(2 * item.u, rel=0.06)


def test_states_in_plain_words(calibration: Calibration) -> None:
    changed = list(calibration.parameters)
    changed[8] = dataclasses.replace(changed[8], state="open", u=2.0)
    changed[7] = dataclasses.replace(changed[7], state="indistinct")
    changed[6] = dataclasses.replace(changed[6], u=0.0)
    other = dataclasses.replace(calibration, parameters=tuple(changed), notices=())
    assert [row[6] for row in parameters_table(other).rows[5:9]] == [
        "determined",
        "held",
        "not distinguishable from zero",
        "not determined by these views",
    ]
    assert verdict(other).startswith("Nothing in number")
    assert verdict(other).endswith("Not determined by these views: left.k3.")
    twice = dataclasses.replace(calibration, notices=(Notice("warning", "few views", ""),) * 2)
    assert verdict(twice).startswith("2 warnings, the first: few views.")


def test_correlations_are_sorted(calibration: Calibration) -> None:
    found = [abs(float(row[2].replace("−", "-"))) for row in correlations_table(calibration).rows]
    assert found == sorted(found, reverse=True)
    assert found[0] > 0.9


def test_lengths_hold_the_scale(calibration: Calibration) -> None:
    assert all(float(row[1]) > 200 * calibration.scale_u for row in lengths_table(calibration).rows)


def test_views_and_what_was_left_out(calibration: Calibration) -> None:
    rows = views_table(calibration).rows
    assert rows[5][1] == "left-06.tif<br>–"
    assert rows[5][3].endswith("<br>–")
    dropped = dropped_table(calibration)
    assert dropped is not None
    assert [row[1] for row in dropped.rows[:2]] == ["all", "all"]
    left_out = sum(int(row[1]) for row in dropped.rows[2:])
    every = [picture for view in calibration.views for picture in (view.left, view.right) if picture is not None]
    assert left_out == sum(int((~picture.used).sum()) for picture in every)
    assert dropped_table(dataclasses.replace(calibration, dropped=())) is None


def test_flat_target_missing_pictures_and_odd_names_still_have_a_page() -> None:
    names = ("<script>alert(1)</script>", "$x_1$ & \\co")
    made = make_calibration(Session(views=6, bow_m=0.0, scale_u=0.0, missing_right=(0, 2, 3), names=names))
    views = (*made.views[:4], dataclasses.replace(made.views[4], left=None), made.views[5])
    bare = dataclasses.replace(made, views=views, notices=(), dropped=())
    page = render_camera_report(bare, "<b>top</b>", PROVENANCE, 1.0)
    assert html.escape("<script>alert(1)</script>-01.tif") in page
    assert html.escape("$x_1$ & \\co-02.tif") in page
    assert "<h1>&lt;b&gt;top&lt;/b&gt;</h1>" in page
    text = _text(page)
    assert "Shape of the target" not in text
    assert "It was not stated" in text
    assert "2 pairs in 6 views" in text
    assert "Notices" not in text
    assert "nan" not in text.lower()


def test_figures_of_a_long_session_with_many_dropped_pictures_are_the_same_each_time() -> None:
    made = make_calibration(Session(views=24, missing_right=()))
    many = tuple(Dropped(f"picture-{n:03d}.tif", 0, "blurred") for n in range(12))
    changed = dataclasses.replace(made, dropped=many)
    draw_coverage(changed)
    for draw in (draw_views, draw_pictures):
        assert draw(changed).svg.startswith("<?xml")
        assert draw(changed) == draw(changed)
