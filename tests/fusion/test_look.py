"""`shakercal look`: recordings with one fault each, which the look has to name."""

from __future__ import annotations

import base64
import json
import re
import shutil
import time
import tomllib
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from support import edit, refusals

from fusion import check, load_manifest, look
from fusion.cli import main
from fusion.errors import ComputeError, InputError
from fusion.phasors.phasor_notices import NO_INSTRUMENT
from fusion.planning.look.data_checks import _sigma_px
from fusion.planning.look.finding import refusal_findings
from fusion.planning.look.look import MISSED, WATCHED_S, WatchedPage, look_page
from fusion.planning.look.look_notices import (
    AIM_MISSED,
    ALIASED_LINES,
    CALIBRATION_CONTRADICTED,
    CAMERA_OUT_OF_FOCUS,
    CAMERAS_EXCHANGED,
    DARK_FRAMES,
    DARK_IMAGES,
    DRIVEN_LINE_MISSING,
    EPIPOLAR_OFFSET,
    EXPLAINED_CONTRADICTION,
    FILE_PROBLEM,
    FIRST_EDGE_UNSTATED,
    INCOMPLETE_RECORDING,
    IRREGULAR_EDGES,
    LOOK_CONSTANT_CHANNEL,
    MAINS_PICKUP,
    OTHER_DIRECTION_DRIVEN,
    OVEREXPOSED,
    REPEATING_PATTERN,
    SIGNAL_DEFECT,
    SIGNAL_DRIFT,
    SPECKLE_SIZE,
)
from fusion.planning.look.problem_pictures import mark_image
from fusion.recording.recording_notices import RESPONSE_RANGE_TOO_SMALL
from fusion.recording.toml import to_toml
from fusion.sensitivity.sensitivity_notices import POSITION_UNSTATED
from fusion.simulate import simulate
from photogram.subsets.texture import textured_area
from shakercal._common.notices import DeclaredNotice, Notice


@pytest.fixture
def campaign(tmp_path, demo_recording):
    """A copy of the demo that a test may damage."""
    ignore = shutil.ignore_patterns("results", "truth.json")
    return Path(shutil.copytree(demo_recording, tmp_path / "demo", ignore=ignore))


def change(folder: Path, file: str, name: str, how: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change the samples of a channel."""
    with h5py.File(folder / "Fz-0080" / file, "a") as stream:
        attributes = dict(stream[name].attrs)
        samples = how(np.array(stream[name]))
        del stream[name]
        stream[name] = samples
        stream[name].attrs.update(attributes)


def repaint(folder: Path, camera: str, how: Callable[[np.ndarray, int], np.ndarray]) -> None:
    """Change the pictures of a camera."""
    for i, path in enumerate(sorted((folder / "Fz-0080" / camera).glob("*.tif"))):
        cv2.imwrite(str(path), how(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), i).astype(np.uint16))


def blur(folder: Path, camera: str, sigma_px: float) -> None:
    repaint(folder, camera, lambda image, i: cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px))


def turn(folder: Path, name: str, angle_rad: float) -> None:
    """Turn the cameras of a calibration against each other."""
    path = folder / "calibration" / f"{name}.json"
    content = json.loads(path.read_text())
    turned, _ = cv2.Rodrigues(np.array([angle_rad, 0.0, 0.0]))
    content["rotation"] = (turned @ np.array(content["rotation"])).tolist()
    path.write_text(json.dumps(content))


Fault = tuple[str, DeclaredNotice, dict[str, object]]
"""Where a fault is, its code, and values of its notice."""


def _clipped_interrupted_and_dark(folder: Path) -> list[Fault]:
    def without_an_edge(v: np.ndarray) -> np.ndarray:
        starts = np.flatnonzero((v[1:] > 2.5) & (v[:-1] <= 2.5))
        v = v.copy()
        v[starts[7] - 20 : starts[7] + 200] = v[:220].mean()
        return v

    change(folder, "vibrometer.h5", "velocity_2", lambda v: np.clip(v, -1.3, 1.3))
    change(folder, "bridge.h5", "Fz", lambda v: np.where(abs(np.arange(len(v)) - 9000) < 1000, 0.0, v))
    change(folder, "vibrometer.h5", "camera_trigger", without_an_edge)
    repaint(folder, "top-left", lambda image, i: image // 50 if 8 <= i < 20 else image)
    repaint(folder, "base-right", lambda image, i: image // 30)
    return [
        ("vibrometer.velocity_2", SIGNAL_DEFECT, {"defect": "clipped"}),
        ("bridge.Fz", SIGNAL_DEFECT, {"defect": " 0.4000"}),
        ("vibrometer.camera_trigger", IRREGULAR_EDGES, {"count": 1, "edges": 24, "kind": " 7)"}),
        ("top left", DARK_FRAMES, {"dark": 3, "examined": 8}),
        ("base right", DARK_IMAGES, {"full_scale": 1023}),
    ]


def _dead_silent_and_overexposed(folder: Path) -> list[Fault]:
    noise = np.random.default_rng(1)
    change(folder, "bridge.h5", "Fz", lambda v: np.full_like(v, 0.25))
    change(folder, "vibrometer.h5", "velocity_1", lambda v: noise.normal(size=len(v)) * 1e-3)
    repaint(folder, "top-right", lambda image, i: np.minimum(image.astype(float) * 2.0, 1023))
    for side in ("left", "right"):
        (folder / "Fz-0080" / f"base-{side}" / "0023.tif").unlink()
    return [
        ("bridge.Fz", LOOK_CONSTANT_CHANNEL, {"value": 0.25, "unit": "mV/V"}),
        ("vibrometer.velocity_1", DRIVEN_LINE_MISSING, {"frequency_hz": 80.0}),
        ("top right", OVEREXPOSED, {"full_scale": 1023}),
        ("base", FIRST_EDGE_UNSTATED, {"frames": 23, "edges": 24}),
    ]


def _cameras_exchanged_and_of_another_pair(folder: Path) -> list[Fault]:
    left, right, aside = (folder / "Fz-0080" / f"top-{side}" for side in ("left", "right", "aside"))
    left.rename(aside)
    right.rename(left)
    aside.rename(right)
    turn(folder, "base", 0.03)
    return [("top", CAMERAS_EXCHANGED, {}), ("base", CALIBRATION_CONTRADICTED, {})]


def _folded_and_truncated(folder: Path) -> list[Fault]:
    edit(folder / "Fz-0080" / "recording.toml", "frequencies = [80.0]", "frequencies = [76.7]")
    path = folder / "Fz-0080" / "base-left" / "0000.tif"
    path.write_bytes(path.read_bytes()[:2000])
    return [("top", ALIASED_LINES, {"lines": "76.7 Hz"}), ("base", FILE_PROBLEM, {"reason": "0000.tif"})]


def _hum_drift_and_a_touched_camera(folder: Path) -> list[Fault]:
    change(folder, "bridge.h5", "Fz", lambda v: v + 0.05 * np.ptp(v) * np.sin(2 * np.pi * 50 * np.arange(len(v)) / 2e4))
    change(folder, "bridge.h5", "Fz", lambda v: v + np.linspace(0, 0.5, len(v)) * np.ptp(v))
    turn(folder, "top", 4e-4)
    return [
        ("bridge.Fz", MAINS_PICKUP, {"frequency_hz": pytest.approx(50.0, abs=0.01)}),
        ("bridge.Fz", SIGNAL_DRIFT, {"unit": "mV/V"}),
        ("top", EPIPOLAR_OFFSET, {"offset_px": pytest.approx(0.6, abs=0.3)}),
    ]


def _one_camera_and_a_pair_out_of_focus(folder: Path) -> list[Fault]:
    blur(folder, "top-left", 3.0)
    for side in ("left", "right"):
        blur(folder, f"base-{side}", 4.0)
    return [("top", CAMERA_OUT_OF_FOCUS, {"side": "left"}), ("base right", SPECKLE_SIZE, {})]


def _has(notice: Notice, values: dict[str, object]) -> bool:
    """Whether a notice has these values; of texts, parts."""
    found = ((notice.values[name], value) for name, value in values.items())
    return all(value in one if isinstance(value, str) else one == value for one, value in found)


@pytest.mark.parametrize(
    ("damage", "level"),
    [
        (_clipped_interrupted_and_dark, "wrong"),
        (_dead_silent_and_overexposed, "wrong"),
        (_cameras_exchanged_and_of_another_pair, "wrong"),
        (_folded_and_truncated, "wrong"),
        (_hum_drift_and_a_touched_camera, "look"),
        (_one_camera_and_a_pair_out_of_focus, "look"),
    ],
)
def test_faults_are_named(campaign, damage, level):
    expected = damage(campaign)
    found = look(campaign / "Fz-0080")
    assert found.level == level, found.findings
    for where, declared, values in expected:
        notices = [f.notice for f in found.findings if (f.level, f.where, f.code) == (level, where, declared.code)]
        assert any(_has(notice, values) for notice in notices), found.findings


# Mistakes of the manifests: the data are those of the sound recording.


def state(folder: Path, old: str, new: str) -> None:
    edit(folder / "Fz-0080" / "recording.toml", old, new)


def place(folder: Path, name: str, change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> None:
    """State another pose of a pair."""
    path = folder / "rig.toml"
    rig = tomllib.loads(path.read_text())
    pair = rig["stereo"][name]
    rotation, translation = change(np.array(pair["rotation"]), np.array(pair["translation"]))
    pair |= {"rotation": rotation.tolist(), "translation": translation.tolist()}
    path.write_text(to_toml(rig))


Mistake = dict[str, str]
"""Patterns of a notice's values."""


def _ten_times_the_scale_and_g(folder: Path) -> list[Mistake]:
    state(folder, "scale = 0.1\n", "scale = 1.0\n")
    state(folder, "scale = 100.0", f"scale = {100 / 9.80665}")
    return [
        {"readings": "laser as a whole .*10.0", "causes": r"ten .*\(laser as a whole\)"},
        {"readings": "base_acceleration .*0.10", "causes": r"m/s² \(base_acceleration\)"},
    ]


def _another_quantity(folder: Path) -> list[Mistake]:
    state(folder, '"velocity"', '"displacement"')
    return [{"readings": "1.57 rad", "causes": "quantity .*displacement"}]


def _aimed_along_x(folder: Path) -> list[Mistake]:
    text = "point = [0.033, 0.0, 0.069]\ndirection = [{}, 0.0, {}]"
    state(folder, text.format("0.0", "1.0"), text.format("1.0", "0.0"))
    return [{"causes": r"direction of velocity_1 .*\(0, 0, 1\)"}]


def _poses_from_sensor_to_camera(folder: Path) -> list[Mistake]:
    place(folder, "top", lambda rotation, translation: (rotation.T, translation))
    place(folder, "base", lambda rotation, translation: (rotation.T, -rotation.T @ translation))
    return [
        {"readings": "stereo top", "causes": "stereo.top.rotation "},
        {"readings": "stereo base", "causes": "stereo.base.*translation"},
    ]


def _axes_exchanged(folder: Path) -> list[Mistake]:
    exchange = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    place(folder, "top", lambda rotation, translation: (exchange @ rotation, exchange @ translation))
    return [{"causes": r"stereo.top.rotation .*90° .*\(−1, 0, 0\)"}]


def _late_pair(folder: Path) -> list[Mistake]:
    for side in ("left", "right"):
        (folder / "Fz-0080" / f"top-{side}" / "0000.tif").unlink()
    state(folder, 'stereo = "top"', 'stereo = "top"\nfirst_edge = 0')
    return [{"readings": "stereo top", "causes": " top .*1 edge later"}]


def _driven_along_x(folder: Path) -> list[Mistake]:
    state(folder, "direction = [0.0, 0.0, 1.0]\nf", "direction = [1.0, 0.0, 0.0]\nf")
    return [{"axis": "z", "direction": r"\[1.0, 0.0, 0.0\]"}]


@pytest.mark.parametrize(
    ("mistake", "declared"),
    [
        (_ten_times_the_scale_and_g, EXPLAINED_CONTRADICTION),
        pytest.param(_another_quantity, EXPLAINED_CONTRADICTION, marks=pytest.mark.slow),
        pytest.param(_aimed_along_x, EXPLAINED_CONTRADICTION, marks=pytest.mark.slow),
        (_poses_from_sensor_to_camera, EXPLAINED_CONTRADICTION),
        pytest.param(_axes_exchanged, EXPLAINED_CONTRADICTION, marks=pytest.mark.slow),
        (_late_pair, EXPLAINED_CONTRADICTION),
        (_driven_along_x, OTHER_DIRECTION_DRIVEN),
    ],
)
def test_mistakes_in_a_manifest_are_named_with_their_cause(campaign, mistake, declared):
    expected = mistake(campaign)
    found = look(campaign / "Fz-0080")
    assert found.verdict == "FIX MANIFEST", found.findings
    notices = [finding.notice for finding in found.findings if finding.code == declared.code]
    for values in expected:
        assert any(all(re.search(values[name], n.values[name]) for name in values) for n in notices), found.findings


def test_a_late_camera_of_a_pair_is_named(campaign):
    files = sorted((campaign / "Fz-0080" / "top-right").glob("*.tif"))
    for earlier, later in reversed(list(pairwise(files))):
        shutil.copy(earlier, later)
    found = look(campaign / "Fz-0080")
    assert found.verdict == "CHECK", found.findings
    # Its first picture stands twice, so that the first frame is right and the second one a copy.
    expected = r"right camera repeated 1 frame before frame 1.* right = \[\[0, 0\], \[1, 0\]\]"
    assert any(re.search(expected, finding.text) for finding in found.findings), found.findings


def test_other_kinds_are_judged_by_what_their_command_refuses(tmp_path, capsys):
    folder = simulate(tmp_path / "chirp", "chirp", 1)
    assert main(["look", str(folder)]) == 0
    assert capsys.readouterr().out.startswith("GREEN ")
    manifest = folder / "recording.toml"
    manifest.write_text(re.sub(r"(?m)^band = .*", "band = [5000.0, 9000.0]", manifest.read_text()))
    (finding,) = look(folder).findings
    assert (finding.verdict, "excitation." in finding.text) == ("FIX MANIFEST", True)
    assert str(check(load_manifest(folder)).problems[0]).endswith(finding.text.rpartition(": ")[2])


@pytest.mark.slow
def test_a_foil_that_repeats_is_named(tmp_path):
    folder = simulate(tmp_path / "foil", "demo", 1, violate=("foil-repeats=0.006",))
    found = look(folder)
    assert REPEATING_PATTERN.code in {finding.code for finding in found.findings}, found.findings


def test_the_light_is_the_status_and_a_page(campaign, capsys):
    change(campaign, "vibrometer.h5", "velocity_2", lambda v: np.clip(v, -1.3, 1.3))
    page = campaign.parent / "light.html"
    assert main(["look", str(campaign), "--page", str(page), "--aim", "0.01"]) == 1
    told = capsys.readouterr().out
    assert told.startswith("RED   Fz 80.0 Hz, simulated\nREPEAT: ")
    assert f"CHECK: {AIM_MISSED.code} " in told
    text = page.read_text(encoding="utf-8")
    assert '<header class="light wrong">\n<strong class="lit" style="--letters: 6">REPEAT</strong>' in text
    assert "clipped" in text
    assert re.search(r"last look <time>\d\d:\d\d:\d\d</time>", text)
    assert text.count('src="data:image/svg+xml;base64') == 1  # the clipped part of the trace
    assert "refresh" not in text
    assert '<meta http-equiv="refresh" content="2">' in look_page([look(campaign / "Fz-0080")], 2.0)


def test_the_page_of_a_watched_folder_turns_grey_when_the_program_has_ended(campaign, browser, tmp_path):
    repaint(campaign, "top-right", lambda image, i: np.minimum(image.astype(float) * 2.0, 1023))
    page, found = tmp_path / "light.html", look(campaign / "Fz-0080")
    page.write_text(look_page([found], WATCHED_S), encoding="utf-8")
    for late_s, word in ((MISSED * WATCHED_S - 4.0, "REPEAT"), (MISSED * WATCHED_S + 4.0, "NOT RUNNING")):
        context = browser.new_context(viewport={"width": 400, "height": 800})
        opened = context.new_page()
        opened.clock.install(time=time.time() + late_s)
        opened.goto(page.as_uri(), wait_until="commit")
        opened.wait_for_selector("header strong:visible")
        assert opened.locator("header strong:visible").all_inner_texts() == [word]
        assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
        grey = "rgb(92, 92, 92)"
        assert (opened.evaluate("getComputedStyle(document.querySelector('.light')).backgroundColor") == grey) == (
            word == "NOT RUNNING"
        )
        picture = opened.locator(".findings img").first
        assert picture.evaluate("one => one.decode().then(() => one.naturalWidth)") > 200
        context.close()


def test_saturated_pixels_are_outlined_where_they_are():
    image = np.full((240, 320), 300, dtype=np.uint16)
    image[100:140, 200:260] = 1023
    picture = mark_image(image, "saturated", image >= 1023)
    data = np.frombuffer(base64.b64decode(picture.source.partition(",")[2]), np.uint8)
    blue, _, red = cv2.imdecode(data, cv2.IMREAD_COLOR).astype(float).transpose(2, 0, 1)
    rows, columns = np.nonzero(red - blue > 100.0)
    assert (rows.min(), rows.max()) == (pytest.approx(98, abs=4), pytest.approx(141, abs=4))
    assert (columns.min(), columns.max()) == (pytest.approx(198, abs=4), pytest.approx(261, abs=4))


def test_the_page_is_renewed_while_the_program_runs_and_tells_that_it_looks(campaign, monkeypatch, tmp_path):
    monkeypatch.setattr("fusion.planning.look.look.WATCHED_S", 0.05)

    def written() -> tuple[int, str]:
        text = path.read_text(encoding="utf-8")
        return int(re.findall(r'data-written="(\d+)"', text)[0]), re.findall(r"<title>([A-Z ]+) ", text)[0]

    path = tmp_path / "light.html"
    with WatchedPage(path) as page:
        first, word = written()
        assert word == "LOOKING"
        page.show([])
        end = time.monotonic() + 20.0
        while written()[0] <= first + 100 and time.monotonic() < end:
            time.sleep(0.02)
        assert written()[0] > first + 100
        assert written()[1] == "KEEP"
        page.begin()
        assert written()[1] == "LOOKING"
    last = written()
    time.sleep(0.2)
    assert written() == last


def test_a_manifest_with_mistakes_is_refused(campaign, capsys):
    edit(campaign / "rig.toml", "mass = 2.4063", 'mass = "?"  # the true mass in kg')
    told = refusals(capsys)("look", campaign)
    assert "load.mass: " in told
    assert '"?"' in told
    with pytest.raises(InputError):
        look(campaign / "Fz-0080")


def test_the_noise_of_subsets_is_foreseen():
    # A texture without fine structure, white noise of known size.
    rng = np.random.default_rng(3)
    plain = cv2.GaussianBlur(rng.normal(size=(400, 400)), (0, 0), 2.0)
    plain = 4000 + 4000 * plain
    radius, sigma = 10, 12.0
    noisy = np.rint(plain + sigma * rng.normal(size=plain.shape)).astype(np.uint16)
    slope = np.gradient(plain, axis=1)
    truth = np.sqrt(2) * sigma / np.sqrt(np.mean(slope**2) * (2 * radius + 1) ** 2)
    assert _sigma_px(noisy, textured_area(noisy), radius) == pytest.approx(truth, rel=0.5)


def test_a_folder_that_fills_is_looked_at_again_and_its_uncertainty_is_foreseen(
    campaign, demo_evaluation, monkeypatch, capsys
):
    steps = []
    path, away = campaign / "Fz-0080" / "bridge.h5", campaign.parent / "bridge.h5"
    path.rename(away)

    def sleep(_: float) -> None:
        steps.append(None)
        if len(steps) == 2:  # at the second look nothing has changed
            away.rename(path)
        if len(steps) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr("fusion.planning.look.look.time.sleep", sleep)
    assert main(["look", str(campaign), "--watch"]) == 130
    told = capsys.readouterr().out
    assert told.count("RED") == 1
    assert f"REPEAT: {INCOMPLETE_RECORDING.code} " in told
    (good,) = re.findall(r"GREEN   Fz 80.0 Hz, simulated\nKEEP: (.*)", told, re.DOTALL)
    (share,) = re.findall(r"about ([0-9.]+) %", good)
    element = demo_evaluation.element
    main_element = element.polar[0][element.elements.index((2, 2))]
    assert float(share) == pytest.approx(200 * main_element.u_magnitude / main_element.magnitude, rel=0.3)


RANGE_TOO_SMALL = InputError(
    RESPONSE_RANGE_TOO_SMALL, "r.csv", "frequency_hz", found="20 to 100 Hz", expected="a range that contains 106.25 Hz"
)


@pytest.mark.parametrize(
    ("error", "verdict"),
    [
        (ValueError("a.tif: expected grey values up to 255 (bit depth 8), found 812"), "FIX MANIFEST"),
        (RANGE_TOO_SMALL, "FIX MANIFEST"),
        (ValueError("x.lvm: expected more digits than 0.0001 or an X column; give sample_rate"), "FIX MANIFEST"),
        (ValueError("x.tdms: expected a complete TDMS file, found its last segment cut off"), "REPEAT"),
        (ComputeError(POSITION_UNSTATED, instrument="channel Fz", key="point"), "FIX MANIFEST"),
        (ComputeError(NO_INSTRUMENT, quantity="a motion", reason=""), "FIX MANIFEST"),
        (ComputeError(NO_INSTRUMENT, quantity="a motion", reason=": no frame is followed"), "REPEAT"),
    ],
)
def test_a_refusal_that_names_a_key_is_one_of_the_manifest(error, verdict):
    assert [finding.verdict for finding in refusal_findings(error)] == [verdict]
