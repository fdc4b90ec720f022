"""Motion that no instrument observes is bounded by what is driven, or nothing that it can reach has a value."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bench_factory import ACCELERATION, FORCE_OUTPUT, Bench, write_bench
from contracts import acceptance
from instrument_factory import FREQUENCY, channels, exact_reading, with_values
from simulated_phasors import lines_at
from support import evaluated, region_distance

from fusion.errors import ComputeError
from fusion.estimation.estimation_notices import UNBOUNDED_MOTION, UNBOUNDED_READINGS
from fusion.estimation.least_squares import Unbounded
from fusion.estimation.measurement_model import UnobservedMotion
from fusion.planning.check import check
from fusion.recording.load import load_manifest
from fusion.recording.placement import perpendicular_axes
from fusion.sensitivity.analyse import Inputs, analyse, driven_motion
from fusion.sensitivity.moving_body import Body, make_moving_part
from fusion.sensitivity.sensitivity_notices import DIRECTION_DOUBTED, UNOBSERVED_MOTION_ASSUMED, UNOBSERVED_MOTION_LARGE

LINES = lines_at(FREQUENCY[:1].tolist(), [1])
AIMED, LIMIT = 0.02, 0.1
STATED = {"direction_uncertainty": AIMED, "scale_uncertainty": 1e-4, "individual_uncertainty": 1e-5}
SIZE = np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
BODY = Body((make_moving_part("load", 2.0, (0.0, 0.0, 0.0), np.diag([1e-3] * 3)),))
X, Y, Z = np.eye(3)


def tilted(degrees: float, towards: np.ndarray = X) -> np.ndarray:
    """The axis z turned towards another one."""
    return np.cos(np.radians(degrees)) * Z + np.sin(np.radians(degrees)) * towards


def seen(along: list[np.ndarray], quantity: str = "acceleration", **stated: float) -> list:
    """Channels at the origin."""
    return [
        channels([(f"a{i}", (0.0, 0.0, 0.0), tuple(d))], np.array([1e-4]), quantity, **{**STATED, **stated})
        for i, d in enumerate(along)
    ]


def read(along: list[np.ndarray], motion: np.ndarray, rng: np.random.Generator) -> list:
    """Accelerometers that look aside and scale by what is stated of them, and read a motion (6,)."""
    found = []
    for blank, nominal in zip(seen(along), along, strict=True):
        aside = AIMED * rng.normal(size=2) @ perpendicular_axes(nominal)
        value = (nominal + aside) @ motion[:3] * (1.0 + 1e-4 * rng.normal())
        noise = 1e-4 * (rng.normal() + 1j * rng.normal())
        found.append(with_values(blank, np.array([[value + noise]])))
    return found


def drawn(direction: tuple[float, ...], rng: np.random.Generator) -> np.ndarray:
    """A motion (6,) along what is driven, with others at the limit of what a shaker may do."""
    phase = np.exp(2j * np.pi * rng.uniform(size=7))
    return 50.0 * phase[0] * (np.array(driven_motion(direction)) + LIMIT * phase[1:]) * SIZE


COVERED = {
    "along": ((0.0, 0.0, 1.0), [Z], 2),
    "10 degrees": (tuple(tilted(10.0)), [Z], 2),
    "45 degrees": (tuple(tilted(45.0)), [Z], 2),
    "75 degrees": (tuple(tilted(75.0)), [Z], 2),
    "a moment goes along": ((0.0, 0.0, 1.0, 1e-3, 0.0, 0.0), [Z], 2),
    "only the sum of two axes": (tuple(tilted(45.0)), [tilted(45.0), Y], 1),
    "three axes": (tuple(tilted(45.0)), [X, Y, Z], 0),
}


@pytest.mark.parametrize("case", COVERED)
def test_regions_cover_whatever_the_drive_does_beside_what_is_observed(case):
    direction, along, component = COVERED[case]
    rng, trials, held = np.random.default_rng(4), 20, 0
    for _ in range(trials):
        motion = drawn(direction, rng)
        fused = analyse(Inputs(LINES, tuple(read(along, motion, rng)), body=BODY, direction=direction)).accelerations[0]
        assert fused.observed[0, component]
        held += region_distance(fused.phasors.value[0], motion, fused.uncertainty)[component] <= 1.0
    assert held >= acceptance(trials)[0]


UNBOUNDED = {
    "across": ((0.0, 0.0, 1.0), [X], "z"),
    "two axes across": ((0.0, 0.0, 1.0), [X, Y], "z"),
    "other axis stated": ((1.0, 0.0, 0.0), [Z], "x"),
    "nearly across": (tuple(tilted(88.0)), [Z], "x and z"),
    "moment": ((0.0, 0.0, 0.0, 1.0, 0.0, 0.0), [X, Y, Z], "rx"),
    "moment about the axis that is seen": ((0.0, 0.0, 0.0, 0.0, 0.0, 1.0), [Z], "rz"),
}


@pytest.mark.parametrize("case", UNBOUNDED)
def test_without_a_limit_there_is_no_value_of_what_could_contain_the_drive(case):
    direction, along, missing = UNBOUNDED[case]
    observations = [exact_reading(o, np.array([[1.0, 2.0, 3.0, 0.0, 0.0, 0.0]])) for o in seen(along)]
    inputs = Inputs(LINES, tuple(observations), body=BODY, direction=direction)
    with pytest.raises(Unbounded) as refused:
        analyse(inputs)
    assert refused.value.code == UNBOUNDED_READINGS.code
    assert refused.value.values["driven"] == f"{missing} of the load"


def test_what_the_drive_cannot_reach_keeps_its_value():
    # Directions are exact: what is observed along x holds no z.
    (across_z,) = (
        exact_reading(o, np.array([[1.0, 0, 3.0, 0, 0, 0]])) for o in seen([X], "velocity", direction_uncertainty=0.0)
    )
    found = analyse(Inputs(LINES, (across_z,), body=BODY, direction=(0.0, 0.0, 1.0)))
    assert found.accelerations[0].observed[0].tolist() == [True, *[False] * 5]
    assert found.load.value[0, 0] == pytest.approx(2.0)
    assert np.isnan(found.load.value[0, 2])


def test_sources_are_bounded_by_the_drive_that_others_observe():
    rng, trials, held = np.random.default_rng(8), 20, 0
    for _ in range(trials):
        motion = drawn((0.0, 0.0, 1.0), rng)
        laser, accelerometer = read([Z, X], motion, rng)
        found = analyse(
            Inputs(LINES, (replace(laser, kind="vibrometer"), accelerometer), body=BODY, direction=(0.0, 0.0, 1.0))
        )
        alone = next(a for a in found.accelerations if a.source == "accelerometer")
        held += region_distance(alone.phasors.value[0], motion, alone.uncertainty)[0] <= 1.0
    assert held >= acceptance(trials)[0]


BEAM = {"scale": 1.0, "scale_uncertainty": 1e-3, "direction_uncertainty": 5e-3}


@pytest.mark.parametrize(
    ("direction", "aim", "component"),
    [([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], "x"), ([0.0, 0.0, 1.0], [0.0, 1.0, 0.0], "z")],
)
def test_a_recording_without_its_driven_axis_names_the_missing_instrument(tmp_path, direction, aim, component):
    keys = {**BEAM, "direction": aim}
    run = write_bench(
        tmp_path, {"acc": Bench(ACCELERATION, "m/s^2", keys=keys), "Fz": FORCE_OUTPUT}, direction=direction
    )
    with pytest.raises(ComputeError) as error:
        evaluated(run)
    assert (error.value.code, error.value.values["driven"]) == (UNBOUNDED_READINGS.code, f"{component} of the load")
    assert any("driven" in remark for remark in check(load_manifest(run)).remarks)


def test_motion_across_that_is_larger_than_the_drive_is_asked_about(tmp_path):
    rows = {"ax": ([1.0, 0.0, 0.0], 0.2), "ay": ([0.0, 1.0, 0.0], 0.1), "az": ([0.0, 0.0, 1.0], 50.0)}
    channels_ = {n: Bench(size, "m/s^2", keys={**BEAM, "direction": d}) for n, (d, size) in rows.items()}
    run = write_bench(tmp_path, {**channels_, "Fz": FORCE_OUTPUT}, direction=[1.0, 0.0, 0.0])
    (doubt,) = (n for n in evaluated(run).notices if n.where == "excitation.direction")
    assert doubt.severity == "warning"
    assert (doubt.code, doubt.values["component"]) == (DIRECTION_DOUBTED.code, "z")
    assert doubt.values["across"] == pytest.approx(50.0, rel=1e-2)
    assert doubt.values["along"] == pytest.approx(0.2, rel=1e-2)


@pytest.mark.parametrize("body", ["load", "base"])
def test_only_the_body_that_is_not_observed_along_the_drive_loses_its_values(tmp_path, body):
    along, aside = ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    other = "base" if body == "load" else "load"
    rows = {"across": (body, aside, 1.0), "along": (other, along, ACCELERATION)}
    channels_ = {n: Bench(a, "m/s^2", keys={**BEAM, "body": b, "direction": d}) for n, (b, d, a) in rows.items()}
    run = write_bench(tmp_path, {**channels_, "Fz": FORCE_OUTPUT})
    if body == "load":
        with pytest.raises(ComputeError) as error:
            evaluated(run)
        assert (error.value.code, error.value.values["driven"]) == (UNBOUNDED_READINGS.code, "z of the load")
    else:
        found = evaluated(run)
        assert np.isfinite(found.load.value[0, 2])
        assert [a.body for a in found.accelerations if a.source == "fused"] == ["load"]
        (notice,) = (notice for notice in found.notices if notice.code == UNBOUNDED_MOTION.code)
        assert notice.values["driven"] == "z of the base"


def test_what_an_oblique_drive_moves_unobserved_is_told(tmp_path):
    keys = {**BEAM, "direction_uncertainty": 0.02}
    channels_ = {"acc": Bench(ACCELERATION, "m/s^2", keys=keys), "Fz": FORCE_OUTPUT}
    run = write_bench(tmp_path, channels_, shaker={"transverse_motion": 0.1}, direction=[1.0, 0.0, 1.0])
    codes = UNOBSERVED_MOTION_LARGE.code, UNOBSERVED_MOTION_ASSUMED.code
    text = next(n.values["driven"] for n in evaluated(run).notices if n.code in codes)
    size = float(text.partition("x up to ")[2].split()[0])
    assert size == pytest.approx(50.0, rel=0.4)


@pytest.mark.parametrize("degrees", [5.0, 20.0, 45.0, 70.0])
def test_the_bound_is_the_worst_of_all_transverse_motions(degrees):
    beam, turns = tilted(degrees), np.linspace(0.0, 2.0 * np.pi, 721)
    transverse = LIMIT * (np.cos(turns)[:, None] * X + np.sin(turns)[:, None] * Y)
    found = (Z + transverse) @ beam / (Z @ beam)  # the drive, of amplitude 1, as one reading shows it
    bound = UnobservedMotion(LIMIT, LIMIT, (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)).gain(np.array([(Z @ beam) ** 2]))
    assert 1.0 / bound[0] == pytest.approx(found.min(), rel=1e-9)
