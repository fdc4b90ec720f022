"""Simulations that break what the program assumes: the physics by hand, and what a violation leaves as it was."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType

import h5py
import numpy as np
import pytest
import tifffile
from contracts import refused as raises
from scipy.stats import binom
from support import DOCS, RefusedCommand, folder_contents, truth_of

from fusion.estimation.estimation_notices import SINGLE_ERROR_NOT_ASSESSED
from fusion.instruments.channel import ChainUncertainty, ChannelReading
from fusion.phasors.channel_phasors import ChannelResult, describe_folds, folding
from fusion.phasors.phasor_notices import (
    ALIASED_HARMONICS,
    CUBIC_DISTORTION,
    HARMONIC_DISTORTION,
    HIGH_HARMONICS_NOT_ASSESSED,
    LINE_UNSTEADY,
    OUTPUT_UNSTEADY,
)
from fusion.phasors.steadiness import distortions, folding_notices
from fusion.recording.manifest import ChannelEntry
from fusion.sensitivity.sensitivity_notices import OUTPUT_CONTRADICTS
from fusion.simulate import simulate
from fusion.simulate.preset import Preset, read_preset
from fusion.simulate.sines import recorded_phasors, runs
from fusion.simulate.violations import CATALOGUE, GRAVITY_UNIT, violations
from fusion.simulate.world import Draws, World, make_world
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.phasor import Phasors

IMAGES = {name for name, violation in CATALOGUE.items() if violation.needs == "images"}


def _world(*names: str, frequency_hz: float = 1000.0) -> tuple[World, Draws]:
    """The rig of the sweep without errors, driven along z and a tenth along x."""
    motion = ((6.0, 1e-6, 60.0, 0.0, 0.0, 0.0),)
    preset = replace(read_preset(Preset, "sweep"), fundamental_hz=frequency_hz, multiples=(1,), acceleration=motion)
    draws = Draws(1, False, violations=violations(names, preset))
    return make_world(preset, draws, 0.0), draws


def _readings(quantity: str, *names: str, frequency_hz: float = 1000.0) -> np.ndarray:
    """Phasors of all channels of a quantity over those of the same rig without violations."""
    both = []
    for broken in (names, ()):
        world, draws = _world(*broken, frequency_hz=frequency_hz)
        specs = [(daq, spec) for daq in world.preset.daqs for spec in daq.channels if spec.quantity == quantity]
        both.append(np.array([recorded_phasors(world, daq, spec, draws)[0] for daq, spec in specs]))
    return np.asarray(both[0] / both[1])


@pytest.mark.parametrize(("first_hz", "deviation"), [(25250.0, -0.0006), (12625.0, -0.0025), (8417.0, -0.0057)])
def test_a_steel_rod_pulls_less_than_its_top_says(first_hz: float, deviation: float) -> None:
    """Rods of 5, 10, 15 cm (c = 5050 m/s, f = c/4L) at 1 kHz: F/(m·a of the top) − 1 = −0.06, −0.25, −0.57 %."""
    (plain, _), (rod, draws) = _world(), _world(f"elastic-axial={first_hz}")
    top = rod.observed_motion(draws, "load", "velocity", np.array([0.0, 0.0, 0.0973])).acceleration[0, 2]
    foot = rod.observed_motion(draws, "load", "velocity", np.zeros(3)).acceleration[0, 2]
    stiff, more = plain.load_wrench[0, 2].real, (rod.load_wrench - plain.load_wrench)[0, 2].real
    mass = rod.preset.load.mass  # what sits inside the sensor is no part of the rod
    assert (mass * 60.0 + more) / (mass * top.real) - 1.0 == pytest.approx(deviation, abs=2e-4)
    assert foot == pytest.approx(60.0)
    assert stiff == pytest.approx((mass + rod.preset.internal.mass) * 60.0)


def test_a_load_bends_far_below_its_resonance_as_a_cantilever_under_its_own_weight() -> None:
    """m·a·L³/(8·E·I) with ω₁² = 12.362·E·I/(m·L³): the tip moves by 1.545·a/ω₁², its slope is 4/(3·L) of that."""
    world, draws = _world("elastic-bending=3000", frequency_hz=30.0)
    tip = world.observed_motion(draws, "load", "camera", np.array([0.0, 0.0, 0.0973])).acceleration[0]
    ratio = (30.0 / 3000.0) ** 2
    assert tip[4] * 0.0973 / (6.0 * ratio) == pytest.approx(1.545 * 4.0 / 3.0, rel=0.2)
    assert (tip[0] + tip[4] * 0.0973) / 6.0 - 1.0 == pytest.approx(1.545 * ratio, rel=0.05)
    np.testing.assert_allclose(tip[[2, 5]], [60.0, 0.0])


def test_a_cable_is_a_spring_to_the_room() -> None:
    (plain, _), (held, _) = _world(frequency_hz=53.7), _world("cable=1000", frequency_hz=53.7)
    more = (held.load_wrench - plain.load_wrench)[0]
    displacement = -60.0 / (2.0 * np.pi * 53.7) ** 2
    assert more[2] == pytest.approx(1000.0 * displacement)
    assert more[4] == pytest.approx(0.0973 * 300.0 * displacement / 10.0 - 0.03 * more[2])  # r × F of the clamp
    np.testing.assert_allclose(held.outputs[0], np.einsum("cj,j->c", held.sensitivity[0], held.load_wrench[0]))


def test_beams_of_one_mirror_lose_the_cosine_of_their_angle() -> None:
    """48 mm off the axis at 0.5 m: cos(atan(0.096)) of the axial motion, and its sine of the transverse one."""
    found = _readings("velocity", "scanner-fan=0.5")
    angle = np.arctan(0.048 / 0.5)
    x = np.array([0.0, 0.0, 0.0, 0.0, 1.0, -1.0, -1.0, 1.0]) / np.sqrt(2.0)
    expected = np.cos(angle) + 0.1 * np.sin(angle) * x
    np.testing.assert_allclose(found[4:], expected[4:], atol=2e-5)


def test_a_tilted_head_mixes_transverse_motion_into_every_beam_alike() -> None:
    found = _readings("velocity", "head-tilt=0.005")
    np.testing.assert_allclose(found, 1.0 - 0.6 * 0.005 * 0.1 - 0.005**2 / 2.0, atol=1e-7)
    np.testing.assert_array_equal(_readings("acceleration", "head-tilt"), 1.0)


@pytest.mark.parametrize(("name", "kinds"), [("camera", ["camera"]), ("laser", ["velocity"])])
def test_what_shakes_loses_its_own_motion_and_nothing_else_does(name: str, kinds: list[str]) -> None:
    world, draws = _world(f"{name}-shake=0.01")
    for kind in ("camera", "velocity", "acceleration"):
        seen = world.observed_motion(draws, "base", kind, np.zeros(3)).acceleration - world.motion["base"].acceleration
        expected = -0.6 * np.exp(0.7j) if kind in kinds else 0.0
        assert seen[0, 2] == pytest.approx(expected)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Return a function that writes one short recording with some violations, once."""
    made: dict[Sequence[str], Path] = {}

    def write(preset: str, *names: str) -> Path:
        key = (preset, *names)
        if key not in made:
            switches = {"demo": {"frames": 8, "image_scale": 0.3}}.get(preset, {"recordings": 1, "frames": 12})
            folder = tmp_path_factory.mktemp("violated") / "campaign"
            made[key] = simulate(folder, preset, 3, **switches, violate=names)
        return made[key]

    return write


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_a_violation_changes_something_and_says_so(name: str, written: Callable[..., Path]) -> None:
    preset = "demo" if name in IMAGES or CATALOGUE[name].needs == "cameras" else "matrix"
    plain, broken = written(preset), written(preset, name)
    assert truth_of(broken)["violated"] == {name: CATALOGUE[name].size}
    assert "violated" not in truth_of(plain)
    one, other = folder_contents(plain.parent), folder_contents(broken.parent)
    changed = {file for file in one if one[file] != other.get(file)}
    assert {file for file in changed if not file.endswith("truth.json")}


def test_what_people_mistake_changes_those_channels_only(written: Callable[..., Path]) -> None:
    """The same errors and the same noise: a channel reversed is the channel reversed."""
    names = ("laser-reversed=2", "outputs-exchanged", "unit-mistaken")
    with (
        h5py.File(written("matrix") / "channels.h5") as plain,
        h5py.File(written("matrix", *names) / "channels.h5") as b,
    ):
        for name in plain:
            one, other = np.asarray(plain[name], dtype=np.float64), np.asarray(b[name], dtype=np.float64)
            if name in ("velocity_1x", "velocity_1y"):
                np.testing.assert_array_equal(other, -one)
            elif name.startswith("acceleration"):
                np.testing.assert_allclose(other * GRAVITY_UNIT, one, rtol=1e-6)
            elif name.startswith("velocity"):
                np.testing.assert_array_equal(other, one)
        moved = [name for name in plain if name[0] in "FM" and not np.array_equal(plain[name], b[name])]
        assert len(moved) == 2
        np.testing.assert_array_equal(plain[moved[0]], b[moved[1]])


def test_what_is_misstated_is_off_by_as_many_uncertainties_and_nothing_else_is(written: Callable[..., Path]) -> None:
    plain, broken = (truth_of(written("matrix", *names))["drawn"] for names in ((), ("mass=5",)))
    assert broken.pop("load.mass")[0] - plain.pop("load.mass")[0] == pytest.approx(5 * 0.0005)
    assert broken == plain


def test_lost_frames_are_renumbered(written: Callable[..., Path]) -> None:
    plain, broken = written("demo"), written("demo", "frames-lost=1")
    pictures = [sorted((folder / "top-left").iterdir()) for folder in (plain, broken)]
    assert [file.name for file in pictures[1]] == [f"{number:04d}.tif" for number in range(7)]
    same = [
        np.array_equal(tifffile.imread(pictures[0][i]), tifffile.imread(pictures[1][j])) for i, j in ((3, 3), (5, 4))
    ]
    assert same == [True, True]
    assert len(list((broken / "base-left").iterdir())) == 8


def test_a_wrong_violation_is_refused_in_one_sentence(tmp_path: Path, refused: RefusedCommand) -> None:
    for preset, text, said in (
        ("demo", "nonsense", "head-tilt"),
        ("demo", "mass=-1", "-1"),
        ("demo", "mass=five", "five"),
        ("sweep", "lamp-flicker", "sweep"),
        ("matrix", "camera-shake", "matrix"),
        ("steps", "mass", "nitsche2018"),
    ):
        error = refused("simulate", str(tmp_path / "new"), "--preset", preset, "--violate", text)
        assert "--violate" in error
        assert said in error
    assert not any(tmp_path.iterdir())


def test_every_name_is_refused_twice_and_runs_of_all_presets_take_them() -> None:
    preset = runs("sweep")[0].preset
    raises("mass", violations, ("mass", "mass=2"), preset)
    assert violations(("mass", "cable=10"), preset).sizes == {"mass": 5.0, "cable": 10.0}


def test_the_document_lists_every_violation_and_its_verdict() -> None:
    text = (DOCS / "assumptions-tables.md").read_text(encoding="utf-8")
    for name, violation in CATALOGUE.items():
        assert f"| `{name}` | {violation.size:g} {violation.unit} |" in text
        assert any(f"`{name}={violation.size:g}`" in row for row in _verdicts())


def _verdicts() -> dict[str, str]:
    """Verdict of every row of the document's table, by what was violated and on which rig."""
    text = (DOCS / "assumptions-tables.md").read_text(encoding="utf-8")
    table = text.partition("<!-- violations -->")[2].partition("<!-- end of violations -->")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[3:]]
    return {f"{row[0]} on {row[1]}": row[-1] for row in rows}


@pytest.fixture(scope="module")
def benchmark() -> Iterator[ModuleType]:
    """The benchmark, which evaluates each recording once for all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS.parent / "benchmarks"))
        module = importlib.import_module("violations")
        patch.setattr(module, "draw", cache(module.draw))
        yield module


def test_a_laser_of_the_wrong_sign_is_named(benchmark: ModuleType) -> None:
    (row,) = benchmark.rows(1, [("full", ("laser-reversed",))])
    assert (row.noticed, row.verdict) == (1.0, "noticed")
    assert "velocity_1" in row.suspects


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "name"),
    [
        ("full", "laser-reversed"),
        ("full", "lasers-exchanged"),
        ("full", "output-reversed"),
        ("full", "outputs-exchanged"),
        ("full", "converter-nonlinearity"),
        ("full", "folded-harmonic"),
        ("full", "inertia"),
        ("full", "frames-lost"),
    ],
)
def test_the_verdicts_of_the_document_stand(rig: str, name: str, benchmark: ModuleType) -> None:
    """Few draws of what is noticed always, or moves nothing."""
    (row,) = benchmark.rows(4, [(rig, (name,))])
    violated = f"`{name}={CATALOGUE[name].size:g}` {CATALOGUE[name].unit}"
    assert row.verdict == _verdicts()[f"{violated} on {rig}"]


@pytest.mark.slow
@pytest.mark.parametrize("names", [("point",), ("direction",), ("direction", "transverse-motion")])
def test_one_wrong_point_of_four_does_not_end_silently(names: tuple[str, ...], benchmark: ModuleType) -> None:
    """No U that is right otherwise covers it: every recording lists the rotation that it moves, and the channels."""
    for seed in range(1, 9):
        notices = benchmark.draw(benchmark.RIGS["full"], names, seed).notices
        (text,) = (text for text in notices if SINGLE_ERROR_NOT_ASSESSED.code in text and "[load]" in text)
        assert re.search(r"ry by up to [^)]*velocity_1, velocity_3\)", text)
    (row,) = benchmark.rows(8, [("full", names)])
    assert row.listed == 1.0
    assert row.verdict in ("listed", "covered")


@pytest.mark.parametrize(
    ("name", "code", "numbers"),
    [
        ("outputs-exchanged", OUTPUT_CONTRADICTS.code, "Fy and Fz"),
        ("output-reversed", OUTPUT_CONTRADICTS.code, "3.11 rad"),
        # Of x - ε·x³ the third harmonic is ε/4, the fundamental lowered by 3ε/4.
        ("converter-nonlinearity", CUBIC_DISTORTION.code, "(0.1247 ± 0.0027) %"),
        ("converter-nonlinearity", CUBIC_DISTORTION.code, "small by about 0.37 %"),
        ("folded-harmonic", OUTPUT_UNSTEADY.code, "106.25 Hz"),
    ],
)
def test_the_error_of_an_output_is_named(name: str, code: str, numbers: str, benchmark: ModuleType) -> None:
    found = benchmark.draw(benchmark.RIGS["full"], (name,), 4)
    assert any(code in text and numbers in text for text in found.notices), found.notices


@pytest.mark.parametrize("name", ["converter-nonlinearity", "folded-harmonic"])
def test_what_is_said_of_an_output_is_in_the_uncertainty_of_the_element(name: str, benchmark: ModuleType) -> None:
    plain, found = (benchmark.draw(benchmark.RIGS["full"], names, 4) for names in ((), (name,)))
    assert abs(found.error[0]) > plain.expanded[0]
    assert found.distance[0] <= 1.0
    assert found.expanded[0] < 4.0 * abs(found.error[0])


@pytest.mark.parametrize(("rig", "seed"), [("full", 4), ("1020.3 Hz", 2)])  # at 1 kHz the clock alone turns 0.14 rad
def test_correct_outputs_have_no_notice(rig: str, seed: int, benchmark: ModuleType) -> None:
    notices = benchmark.draw(benchmark.RIGS[rig], (), seed).notices
    declared = OUTPUT_CONTRADICTS, CUBIC_DISTORTION, HARMONIC_DISTORTION, OUTPUT_UNSTEADY, LINE_UNSTEADY
    assert not [text for text in notices if any(one.code in text for one in declared)]


def test_a_beat_that_changes_no_slope_is_seen(benchmark: ModuleType) -> None:
    """Where phase is as uncertain as the clock and amplitude turns back, the phasor wanders all the same."""
    notices = benchmark.draw(benchmark.RIGS["full"], ("folded-harmonic",), 22).notices
    assert any(OUTPUT_UNSTEADY.code in text and "phasor" in text and "Fz" in text for text in notices)


def _waves(name: str, quantity: str, shares: Sequence[complex], turn: complex) -> ChannelResult:
    """A channel of a wave of 50 Hz with harmonics 2 and 3 of the acceleration, read with a factor; u = 10⁻⁵ of it."""
    frequency = 50.0 * np.arange(1, 4)
    order = {"velocity": -1, "output": 0}[quantity]
    value = turn * np.array([1.0, *shares]) * (2j * np.pi * frequency) ** order
    spread = np.abs(value[0]) * 1e-5 * np.arange(1, 4.0) ** order
    covariance = spread[:, None, None] ** 2 * np.eye(2)
    found = Phasors(frequency, value[:, None], covariance, (name,), ("1",), np.full(3, 100.0))
    empty = np.empty(0)
    plain = (found, 0.0, *[empty] * 5)
    return ChannelResult(name, "daq", quantity, "load", "1", 1e3, 1000, *plain, harmonics=found)


def test_harmonics_of_the_motion_are_no_distortion_of_the_outputs() -> None:
    """A linear sensor of either sign passes them; what comes on top, and that alone, is told."""
    frequency = np.array([50.0])
    none = np.zeros(1)
    lines = LineFrequencies(frequency, none, frequency, np.ones(1, dtype=np.int64), ("",), ())
    motion = (0.02 * np.exp(0.4j), 0.05 * np.exp(1.9j))
    lasers = [_waves("laser_1", "velocity", motion, 3.0 + 1.0j), _waves("laser_2", "velocity", motion, 3.1 + 1.0j)]
    for sign in (1.0, -1.0):
        output = _waves("Fz", "output", motion, sign * 2e-6 * (3.0 + 1.0j))
        assert list(distortions([*lasers, output], lines)) == []
        (found,) = distortions(
            [*lasers, _waves("Fz", "output", (motion[0], motion[1] + 0.03j), sign * 2e-6 * (3.0 + 1.0j))], lines
        )
        assert (found.notice.code, found.notice.where) == (CUBIC_DISTORTION.code, "Fz")
        assert float(found.notice.values["share"]) == pytest.approx(3.0, rel=1e-3)
        assert found.doubt.share == pytest.approx(0.09, rel=1e-3)  # three times the harmonic's
    assert list(distortions([output], lines)) == []  # nothing tells what the motion has
    # What one laser alone has is a fault of the laser, not of the output.
    found = list(distortions([lasers[0], _waves("Fz", "output", (0.0, 0.0), 2e-6 + 0.0j)], lines))
    assert {one.doubt.channel for one in found} == {"laser_1"}


def test_a_rate_folds_the_harmonics_next_to_its_own_multiple() -> None:
    """At eight samples a period the seventh and the ninth harmonic look like the fundamental."""
    found = folding([1000.0], 8000.0, 8000, 20)
    assert [(fold.multiple, fold.fundamental_hz, fold.line_hz) for fold in found] == [
        (m, 1000.0, 1000.0) for m in (7, 9, 15, 17)
    ]
    assert describe_folds(found).count("1000 Hz") == 8
    assert folding([1000.0], 8000.0, 8000) == []  # none of the first five
    assert [fold.multiple for fold in folding([1600.0], 8000.0, 8000)] == [4]
    assert folding([1000.3], 8000.0, 8000, 20) == []
    near = folding([1000.3], 8000.0, 2400, 20)  # 2.4 Hz apart, the next 4.8 Hz, bins of 3.3 Hz
    assert [(fold.multiple, fold.line_hz) for fold in near] == [(7, 1000.3), (9, 1000.3)]


def test_high_harmonics_that_fold_are_told_where_those_seen_promise_them() -> None:
    """Ten samples a period: a third harmonic of 5 % promises 5 %·(3/9)² = 0.56 % at the ninth, against u/3."""
    lines = LineFrequencies(np.array([50.0]), np.zeros(1), np.array([50.0]), np.ones(1, dtype=np.int64), ("",), ())

    def aliases(third: float, u_scale: float, response: Path | None = None) -> tuple[str, str]:
        channel = replace(_waves("Fz", "output", (0.0, third), 2e-6 + 0.0j), sample_rate_hz=500.0)
        entry = ChannelEntry(name="Fz", quantity="output", channel="Fz", scale_uncertainty=u_scale)
        entry = entry.model_copy(update={"response": response})
        notices = folding_notices([channel], [ChannelReading(entry, channel.phasors, ChainUncertainty())], lines)
        listed = {notice.code: notice.values["aliases"] for notice in notices}
        return listed.get(ALIASED_HARMONICS.code, ""), listed.get(HIGH_HARMONICS_NOT_ASSESSED.code, "")

    important, _ = aliases(0.05, 1e-3)
    assert "harmonic 9 of" in important  # 0.56 % against 0.033 %, at the 19th still 0.125 %
    assert "harmonic 19 of" in important
    assert aliases(0.05, 1e-2)[0].count("harmonic ") == 2  # 9 and 11, against 0.33 %
    assert aliases(0.05, 0.1)[0] == ""
    assert aliases(0.0, 1e-3)[1].count("harmonic ") == 3
    assert aliases(0.05, 1e-3, Path("response.csv")) == ("", "")


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["full", "53.7 Hz", "1020.3 Hz"])
def test_instruments_that_are_as_stated_contradict_each_other_as_often_as_the_test_says(
    rig: str, benchmark: ModuleType
) -> None:
    """By chi-square with the stereo pair's noise (27 degrees of freedom) as exact 3 to 6 % fail at 1 %."""
    found = np.array([benchmark.draw(benchmark.RIGS[rig], (), seed).probability for seed in range(1, 25)])
    for share in (0.01, 0.05, 0.2, 0.5):
        assert binom.ppf(1e-3, len(found), share) <= np.sum(found < share) <= binom.isf(1e-3, len(found), share)
