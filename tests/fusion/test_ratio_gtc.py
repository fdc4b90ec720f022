"""Ratio, share of other loads and budget against the GUM Tree Calculator: outputs and load with unknowns in common."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import GTC
import numpy as np
import pytest

from fusion.estimation.consistency import Acceleration
from fusion.estimation.measurement_model import ChainUncertainty, Reading
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty
from fusion.sensitivity.body import Body, make_part
from fusion.sensitivity.load import LoadResult, Outputs, load_phasors, output_phasors
from fusion.sensitivity.ratio import Sensitivity, other_loads, sensitivity_ratio
from shaker.sine.phasor import Phasors

FREQUENCY = np.array([212.5])
MOTION = np.array([[0.4 - 0.1j, 0.2j, 40.0 * np.exp(0.7j), 0.0, 0.0, 0.0]])
MASSES = (("load", 6.9605, 1e-3), ("internal mass", 0.769, 2e-3))
OUTPUT = np.array([[6.2e-5 * np.exp(0.66j), 2.0e-7 - 1e-7j]])
NOISE = {
    "motion": (np.array([[3.0, 1.1], [1.1, 1.5]]) * 1e-4, 7.0),
    "output": (np.array([[9.0, -2.0], [-2.0, 7.0]]) * 1e-18, 11.0),
}
SCALE, DELAY, CLOCK = 8e-4, 2e-6, 1.5e-6
STATIC = np.array([[2e-7, 5e-9, 2.0e-7, 0.0, 0.0, 0.0], [5.1e-7, 0.0, 0.0, 0.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Case:
    """The same measurement as this program sees it and as uncertain numbers of GTC."""

    load: LoadResult
    outputs: Outputs
    ratio: Sensitivity
    gtc_load: dict[int, Any]
    gtc_outputs: list[Any]
    gtc_unknowns: dict[str, Any]


@pytest.fixture(scope="module")
def case() -> Case:
    turn = -2j * np.pi * FREQUENCY[0]
    load = load_phasors(_acceleration(turn), Body(tuple(make_part(*_part(*mass)) for mass in MASSES)))
    outputs = output_phasors([_reading(0, "Fz"), _reading(1, "Fx")])
    ratio = sensitivity_ratio(outputs, load, (0.0, 0.0, 1.0), [1], "V/V")
    unknowns = {name: GTC.ureal(0.0, u, label=name) for name, u in (("scale", SCALE), ("delay", DELAY))}
    unknowns |= {"time": GTC.ureal(0.0, CLOCK)}
    unknowns |= {name: GTC.ureal(mass, u) for name, mass, u in MASSES}
    (spread, dof), (noise, output_dof) = NOISE["motion"], NOISE["output"]
    gtc_load, gtc_outputs = {}, []
    for place in (0, 2):
        motion = GTC.ucomplex(complex(MOTION[0, place]), tuple(spread.ravel()), dof)
        # Accelerometer and sensor hang on one amplifier and one clock.
        errors = 1.0 + unknowns["scale"] + turn * unknowns["delay"] + turn * unknowns["time"]
        gtc_load[place] = motion * errors * (unknowns["load"] + unknowns["internal mass"])
    for value in OUTPUT[0]:
        signal = GTC.ucomplex(complex(value), tuple(noise.ravel()), output_dof)
        gtc_outputs.append(signal * (1.0 + unknowns["scale"] + turn * unknowns["time"]))
    return Case(load, outputs, ratio, gtc_load, gtc_outputs, unknowns)


def _part(name: str, mass: float, u: float) -> tuple[Any, ...]:
    return name, mass, np.zeros(3), np.zeros((3, 3)), (u, 0.0, 0.0)


def _acceleration(turn: complex) -> Acceleration:
    spread, dof = NOISE["motion"]
    covariance = np.zeros((1, 12, 12))
    for place in range(6):
        pair = np.array([place, place + 6])
        covariance[0, pair[:, None], pair] = spread
    names = (("amplifier: scale", "1", SCALE, SCALE), ("accelerometer: delay", "s", DELAY, turn * DELAY))
    names += (("clock bridge: time", "s", CLOCK, turn * CLOCK),)
    influences = tuple(
        Influence(name, name, u, unit, np.concatenate([(MOTION * slope).real, (MOTION * slope).imag], axis=1))
        for name, unit, u, slope in names
    )
    total = Uncertainty((Contribution("accelerometer: noise", "A", covariance, np.array([dof])),), influences)
    units = ("m/s^2",) * 3 + ("rad/s^2",) * 3
    found = Phasors(FREQUENCY, MOTION, total.covariance, ("x", "y", "z", "rx", "ry", "rz"), units, np.array([dof]))
    seen = np.ones((1, 6), dtype=bool)
    return Acceleration("load", "fused", found, seen, ("accelerometer",), total, (), 0.0, 0, (), ())


def _reading(place: int, name: str) -> Reading:
    noise, dof = NOISE["output"]
    value = OUTPUT[:, place, None]
    entry = SimpleNamespace(
        name=name, channel=name, quantity="output", common="amplifier", scale_uncertainty=SCALE, delay_uncertainty=0.0,
        individual_uncertainty=0.0,
    )  # fmt: skip
    found = Phasors(FREQUENCY, value, noise[None], (name,), ("V/V",), np.array([dof]))
    return Reading(entry, found, ChainUncertainty(clock="bridge", u_clock_s=CLOCK))


def _agrees(value: complex, covariance: np.ndarray, dof: float, expected: Any) -> None:
    assert value == pytest.approx(complex(GTC.value(expected)), rel=1e-12)
    np.testing.assert_allclose(covariance.ravel(), GTC.variance(expected), rtol=1e-9)
    assert dof == pytest.approx(GTC.dof(expected), rel=1e-9)


@pytest.mark.parametrize("channel", [0, 1])
def test_ratio_of_outputs_and_load_that_share_unknowns(case: Case, channel: int) -> None:
    expected = case.gtc_outputs[channel] / case.gtc_load[2]
    found = case.ratio
    _agrees(found.value[0, channel, 2], found.covariance[0, channel, 2], found.dof[0, channel, 2], expected)
    assert 5.0 < found.dof[0, channel, 2] < 1e4


def test_load_and_outputs_alone(case: Case) -> None:
    dof, pair = case.load.uncertainty.dof(), np.array([2, 8])
    _agrees(case.load.value[0, 2], case.load.uncertainty.covariance[0][np.ix_(pair, pair)], dof[0, 2], case.gtc_load[2])
    pair = np.array([0, 2])
    covariance, dof = case.outputs.uncertainty.covariance[0], case.outputs.uncertainty.dof()
    _agrees(case.outputs.phasors.value[0, 0], covariance[np.ix_(pair, pair)], dof[0, 0], case.gtc_outputs[0])


def test_elements_of_one_recording_are_correlated(case: Case) -> None:
    first, second = (signal / case.gtc_load[2] for signal in case.gtc_outputs)
    expected = np.reshape(GTC.get_covariance(first, second), (2, 2))
    found = case.ratio.uncertainty.covariance[0]
    np.testing.assert_allclose(found[np.ix_([0, 2], [1, 3])], expected, rtol=1e-9)


def test_share_of_other_loads(case: Case) -> None:
    shares = other_loads(case.outputs, case.load, STATIC, 2, 3e-3)
    static = GTC.ureal(STATIC[1, 0], 3e-3 * STATIC[1, 0])
    element, expected = shares.element(0, 1), static * case.gtc_load[0] / case.gtc_outputs[1]
    mixed = element.r * element.u_re * element.u_im
    covariance = np.array([[element.u_re**2, mixed], [mixed, element.u_im**2]])
    _agrees(complex(element.re, element.im), covariance, element.dof, expected)
    # The other channel answers to Fx and, a little, to Fy.
    force = (STATIC[0, 0] * case.load.value[0, 0] + STATIC[0, 1] * case.load.value[0, 1]) / OUTPUT[0, 0]
    assert shares.value[0, 0] == pytest.approx(force, rel=1e-12)
    (notice,) = shares.notices(0, 0, "output Fz at 212.5 Hz")
    assert f"({100.0 * force.real:.2f} ± " in notice.text
    assert not other_loads(case.outputs, case.load, np.diag([0.0, 0.0, 2e-7, 0, 0, 0])[[2, 2]], 2).notices(0, 0, "")


def test_budget_is_that_of_gtc(case: Case) -> None:
    expected = case.gtc_outputs[0] / case.gtc_load[2]
    entries = {entry.label: entry for entry in case.ratio.budget}
    names = {
        "load: mass": "load", "internal mass: mass": "internal mass", "accelerometer: delay": "delay",
        "amplifier: scale": "scale", "clock bridge: time": "time",
    }  # fmt: skip
    assert set(entries) == {*names, "accelerometer: noise", "output noise"}
    for label, name in names.items():
        unknown, entry = case.gtc_unknowns[name], entries[label]
        parts = (GTC.magnitude(expected), entry.u_relative), (GTC.phase(expected), entry.u_phase_rad)
        for part, (number, u) in enumerate(parts):
            size = 1.0 if part else GTC.value(number)
            slope = GTC.rp.u_component(number, unknown) / GTC.uncertainty(unknown) / size
            assert entry.coefficient[part, 0, 0] == pytest.approx(slope, rel=1e-9, abs=1e-12)
            assert u[0, 0] == pytest.approx(abs(slope) * entry.u, rel=1e-9, abs=1e-15)
        assert entry.u == pytest.approx(GTC.uncertainty(unknown))
    # What both share cancels: one clock and one amplifier tell nothing about their quotient.
    assert entries["clock bridge: time"].u_phase_rad[0, 0] == pytest.approx(0.0, abs=1e-15)
    assert entries["amplifier: scale"].u_relative[0, 0] == pytest.approx(0.0, abs=1e-15)
    assert entries["accelerometer: noise"].dof[0] == NOISE["motion"][1]
