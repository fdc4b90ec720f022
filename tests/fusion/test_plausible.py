"""Questions about what a manifest states: none where it is right, key and suspicion where physics has a ground."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from fusion.recording.load import load_manifest
from fusion.simulate import PRESETS, RECORDINGS, simulate

ROOT = Path(__file__).resolve().parents[2]
Campaign = Callable[..., Path]
INERTIA = "inertia = [[0.0360, 0.0, 0.0], [0.0, 0.0360, 0.0], [0.0, 0.0, 0.0310]]"
CENTRE = "centre_of_mass = [0.0, 0.0, 0.0]\ncentre_of_mass_uncertainty = 1e-4"
# By hand. Ball of 6.9605 kg and 0.036 kg m^2: k = 71.9 mm, r = 113.7 mm, 1130 kg/m^3; of 1e3 times that inertia,
# 1130/31623. A centre of mass 2 m away is 28 k. 6.9605 kg weigh 68.3 N. 5.1e-7 V/V per N times 2000 N is 1.02 mV/V.
CASES = [
    ("rig.toml", CENTRE, CENTRE.replace("[0.0, 0.0, 0.0]", "[0.0, 0.0, 2.0]"), "load.centre_of_mass", "27.8 times"),
    ("rig.toml", "[2000.0, 2000.0, 4000.0,", "[2.0, 2.0, 4.0,", "sensor.capacity", "weighs 68.3 N"),
    ("rig.toml", "[5.1e-7, 0.0", "[5.1e-4, 0.0", "sensor.static_sensitivity", "1020 mV/V"),
    ("rig.toml", "gravity = [0.0, 0.0, -9.8125]", "gravity = [0.0, 0.0, 9.8125]", "environment.gravity", "hang"),
    ("rig.toml", "mass_uncertainty = 0.0010", "mass_uncertainty = 0.0010\ndensity = 7.9e4", "load.density", "79000"),
    ("recording.toml", "direction_uncertainty = 5e-3", "direction_uncertainty = 0.3", "direction_uncertainty", "17.2°"),
    ("recording.toml", "scale_uncertainty = 2.5e-4", "scale_uncertainty = 0.05", "velocity.scale_uncertainty", "5.0 %"),
    ("recording.toml", "delay = 0.0  ", "delay = 0.12  ", "velocity.delay", "12.8 periods of 106.25 Hz"),
    ("recording.toml", "point = [0.030, 0.0, 0.040]", "point = [3.0, 0.0, 4.0]", "velocity.point", "5 m"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "old", "new", "key", "reported"), CASES)
def test_what_has_no_ground_is_asked_about(make_campaign: Campaign, file, old, new, key, reported) -> None:
    manifest = load_manifest(make_campaign(replace=((file, old, new),)))
    notice = next(notice for notice in manifest.plausibility_notices if f"{key}:" in notice.text)
    assert reported in notice.text
    assert notice.where == file


def test_a_body_as_light_as_air_is_asked_about(make_campaign: Campaign) -> None:
    inertia = "inertia = [[36.0, 0.0, 0.0], [0.0, 36.0, 0.0], [0.0, 0.0, 31.0]]"
    manifest = load_manifest(make_campaign(replace=(("rig.toml", INERTIA, inertia),)))
    (notice,) = manifest.plausibility_notices
    assert all(number in notice.text for number in ("6.9605 kg", "0.036 kg/m^3"))
    assert notice.where == "rig.toml"


def test_cameras_far_apart_are_asked_about(make_campaign: Campaign) -> None:
    """150 m between cameras 0.3 m from the sensor: a base line in mm."""
    recording = make_campaign()
    file = recording.parent / "calibration" / "top.json"
    file.write_text(file.read_text().replace("[-0.15, 0, 0]", "[-150, 0, 0]"))
    (notice,) = load_manifest(recording).plausibility_notices
    assert all(number in notice.text for number in ("150 m", "0.3 m"))


@pytest.mark.parametrize(
    ("rotation", "translation", "reported"),
    [
        ("[[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]", "[-0.18, 0, 0.135]", None),
        ("[[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]", "[-0.00018, 0, 0.000135]", "3 × 10⁻⁴ m"),
        ("[[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]]", "[-0.18, 0, 0.135]", "−"),
    ],
)
def test_axes_that_do_not_cross_near_the_sensor_are_asked_about(
    make_campaign: Campaign, rotation: str, translation: str, reported: str | None
) -> None:
    """Right camera 0.225 m to the right, turned by the larger angle of a triangle 3-4-5: axes cross 0.3 m away."""
    recording = make_campaign()
    file = recording.parent / "calibration" / "top.json"
    text = file.read_text().replace("[-0.15, 0, 0]", translation)
    file.write_text(text.replace('[[1, 0, 0], [0, 1, 0], [0, 0, 1]], "trans', f'{rotation}, "trans'))
    notices = load_manifest(recording).plausibility_notices
    assert [reported in notice.text for notice in notices if reported is not None] == [True] * (reported is not None)
    assert reported is not None or not notices


def test_a_pair_that_looks_away_is_asked_about(make_campaign: Campaign) -> None:
    """A rotation of 180 degrees about x turns the camera 0.3 m above the sensor towards it; none, upwards."""
    upwards = ("rig.toml", "[0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]   #", "[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]   #")
    (notice,) = load_manifest(make_campaign(replace=(upwards,))).plausibility_notices
    assert notice.text.count("180°") == 2


def test_the_examples_of_the_document_are_not_doubted(make_campaign: Campaign) -> None:
    assert load_manifest(make_campaign()).plausibility_notices == ()


@pytest.mark.slow
@pytest.mark.parametrize("preset", [preset for preset in PRESETS if preset not in ("files", "targets", "elastomer")])
def test_right_presets_are_not_doubted(preset: str, tmp_path: Path) -> None:
    switches = {"frames": 8, "recordings": 1, "image_scale": 0.3} if preset in RECORDINGS else {}
    simulate(tmp_path / "out", preset, 1, **switches)
    recordings = list((tmp_path / "out").glob("*/recording.toml"))
    assert recordings
    assert {path.parent.name: found for path in recordings if (found := load_manifest(path).plausibility_notices)} == {}


def test_the_demo_is_not_doubted() -> None:
    assert load_manifest(ROOT / "sample_images" / "demo" / "Fz-0080").plausibility_notices == ()


NOTICED = {"two lasers exchanged", "rotation of a pair from sensor to camera"}
"""Mistakes of which only a contradiction of instruments tells, not its cause."""


@pytest.fixture(scope="module")
def mistakes() -> ModuleType:
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        return importlib.import_module("mistakes")
    finally:
        sys.path.remove(str(ROOT / "benchmarks"))


@pytest.mark.slow
def test_plausible_mistakes_are_asked_about(mistakes: ModuleType, tmp_path: Path) -> None:
    """The whole path, `check` and `run`, of the light recording: as the document's table says."""
    campaign = mistakes.right("uniaxial", tmp_path)
    usual = mistakes.said(campaign).texts
    own = [mistake for mistake in mistakes.MISTAKES if "uniaxial" in mistake.rigs]
    silent = {mistake.name for mistake in own if not mistakes.asked(mistake, campaign, usual)[0]}
    assert silent <= NOTICED
    masses = [mistake for mistake in mistakes.BLIND if mistake.name.startswith("mass") and "uniaxial" in mistake.rigs]
    assert len(masses) == 2
    assert all(mistakes.asked(mistake, campaign, usual)[0] for mistake in masses)
