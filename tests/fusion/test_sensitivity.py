"""Load and ratio against closed forms, perturbed inputs, Monte Carlo, and the GUM Tree Calculator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import coverage_matrix
import GTC
import numpy as np
import pytest
from contracts import refused
from instrument_factory import TRUTH, moving, output
from scipy.stats import binom
from simulated_phasors import simulate_phasors

from fusion.estimation.fuse import Acceleration
from fusion.estimation.uncertainty import Influence, polar_elements
from fusion.instruments.channel import ChannelReading, Outputs, delay_errors, output_phasors
from fusion.sensitivity.analyse import analyse
from fusion.sensitivity.load_phasors import LoadResult, describe_other_loads, load_phasors
from fusion.sensitivity.monte_carlo import propagate
from fusion.sensitivity.moving_body import Body, make_moving_part
from fusion.sensitivity.ratio import (
    PriorMatrix,
    Sensitivity,
    StatedMatrix,
    driven_component,
    mass_notices,
    parasitic_loads,
    prior_matrix,
    sensitivity_ratio,
    sensor_element,
    static_unknowns,
)
from fusion.sensitivity.sensitivity_notices import (
    CROSS_TALK_BOUND,
    ELEMENT_CHANGED,
    MASS_DOUBTED,
    OTHER_LOADS_NOT_ASSESSED,
    UNOBSERVED_MOTION_LARGE,
)
from fusion.simulate.sines import runs
from fusion.simulate.world import Draws
from shaker.labels import LOAD_COMPONENTS

GRAVITY = (0.0, 0.0, -9.8125)
OUTPUT = 2e-7 * np.exp(-0.01j)
PARTS = (
    ("load", 6.9605, [1e-3, 2e-3, 0.02], np.diag([0.036, 0.036, 0.031]), (1e-3, 1e-4, 1e-4)),
    ("internal mass", 0.769, [0.0, 0.0, 0.0], np.zeros((3, 3)), (2e-3, 1e-3, 1e-5)),
)
BODY = Body(tuple(make_moving_part(*part) for part in PARTS), gravity_mps2=GRAVITY)
NOISE = np.diag(np.tile([1, 1, 1, 100, 100, 100.0], 2)) * 189.0**2  # of 1e-4 of the motion: times 1e-8
ONLY_Z = np.array([False, False, True, False, False, False])


def acceleration(sigma: float = 1e-4, observed: Any = True) -> Acceleration:
    return moving(TRUTH, sigma**2 * NOISE, observed=observed)


def ratio(outputs: list[ChannelReading], source: Acceleration, body: Body = BODY) -> Sensitivity:
    load = load_phasors(source, body)
    return sensitivity_ratio(output_phasors(outputs), load, 2, [1, 2])


def test_force_of_a_centred_mass_is_mass_times_acceleration():
    body = Body((make_moving_part("load", 7.0, np.zeros(3), np.diag([1.0, 2.0, 3.0])),))
    load = load_phasors(acceleration(), body)
    np.testing.assert_allclose(load.phasors.value[:, :3], 7.0 * TRUTH[:, :3])
    np.testing.assert_allclose(load.phasors.value[:, 3:], TRUTH[:, 3:] * [1, 2, 3])
    np.testing.assert_allclose(load.phasors.u_re[:, 2], 7.0 * 189.0e-4)
    reverse = load_phasors(acceleration(), replace(body, sense="on_sensor"))
    np.testing.assert_allclose(reverse.phasors.value, -load.phasors.value)


def test_parameter_contributions_are_the_change_of_the_load():
    source = acceleration(sigma=0.0)
    load = load_phasors(source, BODY)
    labels = {entry.label: entry for entry in load.uncertainty.grouped()}
    heavier = replace(BODY, parts=(make_moving_part("load", 6.9615, *PARTS[0][2:4]), BODY.parts[1]))
    change = load_phasors(source, heavier).phasors.value - load.phasors.value
    stacked = np.concatenate([change.real, change.imag], axis=1)
    expected = stacked[:, :, None] * stacked[:, None, :]
    np.testing.assert_allclose(labels["load: mass"].covariance, expected, rtol=1e-6, atol=1e-12)
    assert {"load: mass", "load: centre of mass", "load: inertia", "internal mass: mass"} <= set(labels)
    total = np.sum([entry.covariance for entry in load.uncertainty.grouped()], axis=0)
    np.testing.assert_allclose(total, load.phasors.covariance)


def test_unobserved_motion_is_bounded_or_refused():
    centred = Body((make_moving_part("load", 7.0, [0.0, 0.0, 0.05], np.diag([0.036, 0.036, 0.031]), (0.0, 1e-4, 0.0)),))
    load = load_phasors(acceleration(observed=ONLY_Z), centred)
    assert np.array_equal(load.observed[0], ONLY_Z)
    hidden = next(entry for entry in load.uncertainty.grouped() if entry.label == "unobserved rx")
    # 7 kg · 0.1 mm · (10 % of 189 m/s^2 over 0.1 m)/√2 in real and imaginary part.
    assert np.sqrt(hidden.covariance[0, 2, 2]) == pytest.approx(7.0 * 1e-4 * 0.1 * 189.0 / 0.1 / np.sqrt(2))
    (notice,) = (notice for notice in load.notices if notice.code == UNOBSERVED_MOTION_LARGE.code)
    # rx and ry by one axis of the centre of mass each: √2 · 0.1 mm · 1/m, over √2 for one part of a phasor.
    assert notice.values["load"] == "Fz"
    assert notice.values["u_percent"] == pytest.approx(0.01, rel=1e-3)
    eccentric = Body((make_moving_part("load", 7.0, [0.06, 0.0, 0.05], np.diag([0.036, 0.036, 0.031])),))
    open_load = load_phasors(acceleration(observed=ONLY_Z), eccentric)
    assert not open_load.observed[0, 2]
    assert np.isnan(open_load.phasors.value[0, 2])
    result = ratio([output(np.ones(2))], acceleration(observed=ONLY_Z), eccentric)
    assert not result.observed.any()
    assert not result.notices, "lines without a result are reported once, of the whole recording"


def test_unobserved_motion_is_one_cause_of_all_load_components():
    body = Body((make_moving_part("load", 7.0, [0.0, 0.0, 0.05], np.diag([0.036, 0.036, 0.031])),))
    load = load_phasors(acceleration(observed=ONLY_Z), body)
    hidden = next(entry for entry in load.uncertainty.grouped() if entry.label == "unobserved rx")
    # A rotation about x pushes the raised mass along -y and turns it: Fy/Mx = -m c/(J + m c²), one cause.
    fy, mx = np.sqrt(hidden.covariance[0, [1, 3], [1, 3]])
    assert fy / mx == pytest.approx(7.0 * 0.05 / (0.036 + 7.0 * 0.05**2))
    assert hidden.covariance[0, 1, 3] == pytest.approx(-fy * mx)
    assert hidden.covariance[0, 1, 9] == 0.0
    # The whole estimate keeps what is not given: zero, as uncertain as the unobserved motion makes it.
    assert load.value[0, 1] == 0.0
    assert np.isnan(load.phasors.value[0, 1])
    assert np.all(np.isfinite(load.uncertainty.covariance))


def test_a_line_that_nobody_read_has_no_load():
    seen = np.array([[True] * 6, [False] * 6])
    load = load_phasors(acceleration(observed=seen), BODY)
    assert load.observed.all(axis=1).tolist() == [True, False]
    assert np.isnan(load.value[1]).all()
    assert np.isfinite(load.uncertainty.covariance[0]).all()
    assert np.isnan(load.uncertainty.covariance[1]).all()
    result = ratio([output(OUTPUT * np.ones(2))], acceleration(observed=seen))
    assert np.isfinite(result.value[:, 0, 2]).tolist() == [True, False]


def test_channels_of_one_amplifier_share_its_errors():
    value = np.array([1e-5, 2e-6])
    own = {"scale_uncertainty": 1e-3, "individual_uncertainty": 2e-4}
    pair = output_phasors(
        [output(value, common="amplifier", **own), output(value, name="Fx", common="amplifier", **own)]
    )
    names = {i.name: i for i in pair.uncertainty.influences}
    assert set(names) == {"amplifier: scale", *(f"amplifier: individual scale {name}" for name in ("Fz", "Fx"))}
    np.testing.assert_allclose(names["amplifier: scale"].effect[:, :2], 1e-3 * np.stack([value, value], axis=1))
    assert {i.label for i in names.values()} == {"output scale", "output individual scale"}
    np.testing.assert_allclose(names["amplifier: individual scale Fx"].effect[0], [0.0, 2e-4 * value[0], 0.0, 0.0])
    apart = output_phasors([output(value, **own), output(value, name="Fx", **own)])
    assert len(apart.uncertainty.influences) == 4
    refused("at least one", output_phasors, [])


def test_ratio_returns_the_sensitivity():
    load = load_phasors(acceleration(), BODY)
    force = load.phasors.value[:, 2]
    result = ratio([output(OUTPUT * force), output(0.0 * force, name="Fx")], acceleration())
    np.testing.assert_allclose(result.value[:, 0, 2], OUTPUT, rtol=1e-12)
    np.testing.assert_allclose(result.value[:, 1, 2], 0.0, atol=1e-20)
    assert result.kind == ("ratio", "harmonic")
    shares = np.abs(load.value[0]) / np.array([2e3, 2e3, 4e3, 100, 100, 100])
    assert f"Mx {100 * shares[3] / shares[2]:.2f} %" in describe_other_loads(load, 2, (2e3, 2e3, 4e3, 100, 100, 100))
    assert result.observed.tolist() == [[False, False, True, False, False, False]] * 2
    assert np.isnan(result.value[:, :, [0, 1, 3, 4, 5]]).all()
    # A vanishing output has the uncertainty of its noise over the force and none from the load.
    u = np.sqrt(result.covariance[0, 1, 2, 0, 0])
    assert u == pytest.approx(1e-9 / abs(force[0]), rel=1e-9)


def test_driven_component():
    assert driven_component((0.0, -1.0, 0.2)) == 1
    assert driven_component((0.0, 0.0, 1.0, 0.5, 0.0, 0.0), (2e3, 2e3, 4e3, 100, 100, 100)) == 3
    refused("direction", driven_component, (0.0, 0.0, 0.0))


GTC_HZ = np.array([212.5])
GTC_MOTION = np.array([[0.4 - 0.1j, 0.2j, 40.0 * np.exp(0.7j), 0.0, 0.0, 0.0]])
MASSES = (("load", 6.9605, 1e-3), ("internal mass", 0.769, 2e-3))
GTC_OUTPUT = np.array([[6.2e-5 * np.exp(0.66j), 2.0e-7 - 1e-7j]])
CORRELATED = {
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
    turn = -2j * np.pi * GTC_HZ[0]
    parts = [make_moving_part(name, mass, np.zeros(3), np.zeros((3, 3)), (u, 0.0, 0.0)) for name, mass, u in MASSES]
    load = load_phasors(_acceleration(turn), Body(tuple(parts)))
    stated = {"common": "amplifier", "scale_uncertainty": SCALE}
    noisy = *CORRELATED["output"], delay_errors("clock bridge: time", GTC_HZ, CLOCK), GTC_HZ
    readings = zip(GTC_OUTPUT.T, ("Fz", "Fx"), strict=True)
    outputs = output_phasors([output(value, *noisy, name=name, **stated) for value, name in readings])
    ratio = sensitivity_ratio(outputs, load, 2, [1])
    unknowns = {name: GTC.ureal(0.0, u, label=name) for name, u in (("scale", SCALE), ("delay", DELAY))}
    unknowns |= {"time": GTC.ureal(0.0, CLOCK)}
    unknowns |= {name: GTC.ureal(mass, u) for name, mass, u in MASSES}
    (spread, dof), (noise, output_dof) = CORRELATED["motion"], CORRELATED["output"]
    gtc_load, gtc_outputs = {}, []
    for place in (0, 2):
        motion = GTC.ucomplex(complex(GTC_MOTION[0, place]), tuple(spread.ravel()), dof)
        # Accelerometer and sensor hang on one amplifier and one clock.
        errors = 1.0 + unknowns["scale"] + turn * unknowns["delay"] + turn * unknowns["time"]
        gtc_load[place] = motion * errors * (unknowns["load"] + unknowns["internal mass"])
    for value in GTC_OUTPUT[0]:
        signal = GTC.ucomplex(complex(value), tuple(noise.ravel()), output_dof)
        gtc_outputs.append(signal * (1.0 + unknowns["scale"] + turn * unknowns["time"]))
    return Case(load, outputs, ratio, gtc_load, gtc_outputs, unknowns)


def _acceleration(turn: complex) -> Acceleration:
    spread, dof = CORRELATED["motion"]
    names = (("amplifier: scale", "1", SCALE, SCALE), ("accelerometer: delay", "s", DELAY, turn * DELAY))
    names += (("clock bridge: time", "s", CLOCK, turn * CLOCK),)
    influences = tuple(
        Influence(name, name, u, unit, np.concatenate([(GTC_MOTION * slope).real, (GTC_MOTION * slope).imag], axis=1))
        for name, unit, u, slope in names
    )
    noise = {"noise": "accelerometer: noise", "influences": influences}
    return moving(GTC_MOTION, np.kron(spread, np.eye(6)), dof, frequency=GTC_HZ, **noise)


def _agrees(value: complex, covariance: np.ndarray, dof: float, expected: Any) -> None:
    assert value == pytest.approx(complex(GTC.value(expected)), rel=1e-12)
    np.testing.assert_allclose(covariance.ravel(), GTC.variance(expected), rtol=1e-9)
    assert dof == pytest.approx(GTC.dof(expected), rel=1e-9)


@pytest.mark.parametrize("channel", [0, 1])
def test_ratio_of_outputs_and_load_that_share_unknowns(case, channel):
    expected = case.gtc_outputs[channel] / case.gtc_load[2]
    found = case.ratio
    _agrees(found.value[0, channel, 2], found.covariance[0, channel, 2], found.dof[0, channel, 2], expected)
    assert 5.0 < found.dof[0, channel, 2] < 1e4


def test_load_and_outputs_alone_and_elements_together(case):
    dof, pair = case.load.uncertainty.dof(), np.array([2, 8])
    _agrees(case.load.value[0, 2], case.load.uncertainty.covariance[0][np.ix_(pair, pair)], dof[0, 2], case.gtc_load[2])
    pair = np.array([0, 2])
    covariance, dof = case.outputs.uncertainty.covariance[0], case.outputs.uncertainty.dof()
    _agrees(case.outputs.phasors.value[0, 0], covariance[np.ix_(pair, pair)], dof[0, 0], case.gtc_outputs[0])
    # Elements of one recording are correlated.
    first, second = (signal / case.gtc_load[2] for signal in case.gtc_outputs)
    expected = np.reshape(GTC.get_covariance(first, second), (2, 2))
    found = case.ratio.uncertainty.covariance[0]
    np.testing.assert_allclose(found[np.ix_([0, 2], [1, 3])], expected, rtol=1e-9)


def test_share_of_other_loads(case):
    unknowns = static_unknowns(StatedMatrix(("Fz", "Fx"), None, STATIC, 3e-3, None, 0.0), ("Fz", "Fx"), STATIC)
    shares = parasitic_loads(case.outputs, case.load, STATIC, 2, unknowns)
    static = GTC.ureal(STATIC[1, 0], 3e-3 * STATIC[1, 0])
    element, expected = shares.element(0, 1), static * case.gtc_load[0] / case.gtc_outputs[1]
    mixed = element.r * element.u_re * element.u_im
    covariance = np.array([[element.u_re**2, mixed], [mixed, element.u_im**2]])
    _agrees(complex(element.re, element.im), covariance, element.dof, expected)
    # The other channel answers to Fx and, a little, to Fy.
    force = (STATIC[0, 0] * case.load.value[0, 0] + STATIC[0, 1] * case.load.value[0, 1]) / GTC_OUTPUT[0, 0]
    assert shares.value[0, 0] == pytest.approx(force, rel=1e-12)
    alone = parasitic_loads(case.outputs, case.load, np.diag([0.0, 0.0, 2e-7, 0, 0, 0])[[2, 2]], 2)
    assert alone.value[0, 0] == 0.0


def test_what_is_not_stated_of_a_static_matrix_is_the_same_for_share_and_element(case):
    """0.1 % of main elements, 0.1 % of the rated output beside them: in the share of other loads as in the element."""
    stated = StatedMatrix(("Fz", "Fx"), np.array([2e3, 2e3, 4e3, 100.0, 100.0, 100.0]), STATIC)
    known = prior_matrix(stated, ("Fz", "Fx"), 2, [1.0, 1.0])
    assert known is not None
    share = parasitic_loads(case.outputs, case.load, STATIC, 2, known.unknowns).uncertainty
    (own,) = (part for part in share.grouped() if part.label == "static sensitivity")
    assert stated.capacity is not None
    u = 1e-3 * np.hypot(STATIC[0], 2e-7 * 4e3 / stated.capacity)  # rated output of Fz: 2e-7·4 kN
    expected = np.linalg.norm(np.delete(u * case.load.value[0], 2)) / abs(GTC_OUTPUT[0, 0])
    assert np.sqrt(own.covariance[0, 0, 0] + own.covariance[0, 2, 2]) == pytest.approx(expected, rel=1e-9)
    assert stated.u_relative == 1e-3
    assert replace(stated, u_static=2e-3).u_relative == 2e-3


def test_budget_is_that_of_gtc(case):
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
    assert entries["accelerometer: noise"].dof[0] == CORRELATED["motion"][1]


def known_of(case: Case, **stated: Any) -> PriorMatrix | None:
    """What is known of the matrix of both outputs under Fz, of rated loads 2 kN, 4 kN, 100 N.m."""
    capacity = np.array([2e3, 2e3, 4e3, 100.0, 100.0, 100.0])
    return prior_matrix(
        StatedMatrix(("Fz", "Fx"), capacity, **{"static": None} | stated), ("Fz", "Fx"), 2, GTC_OUTPUT[0]
    )


@pytest.mark.parametrize("channel", [0, 1])
def test_element_and_its_uncertainty_are_those_of_gtc(case, channel):
    # Outputs of Fz and Fx in this order; no load but Fx and Fz, and every unknown by hand.
    static = np.array([[5e-9, 0.0, 2.0e-7, 0.0, 0.0, 0.0], [5.1e-7, 0.0, 3e-9, 0.0, 0.0, 0.0]])
    known = known_of(case, static=static, u_static=3e-3, u_cross_talk=2e-4)
    assert (known.main, known.rows, known.static) == (0, (0, 1), True)
    only = replace(case.load, value=np.where([True, False, True, False, False, False], case.load.value, 0.0))
    found = sensor_element(case.outputs, only, known, [1])
    capacity, main = np.array([2e3, 2e3, 4e3]), (2, 0)
    elements = {}
    for c, j in ((0, 0), (0, 2), (1, 0), (1, 2)):
        rated = 0.0 if main[c] == j else 2e-4 * static[c, main[c]] * capacity[main[c]] / capacity[j]
        elements[c, j] = GTC.ureal(static[c, j], float(np.hypot(3e-3 * static[c, j], rated)))
    # The driven element's own course is the evidence for those of others, in any direction of the complex plane.
    u = abs(GTC_OUTPUT[0, 0] / (static[0] @ only.value[0]) - 1.0) / np.sqrt(2.0)
    for c, j in ((0, 0), (1, 0)):
        elements[c, j] = elements[c, j] * GTC.ucomplex(1.0 + 0j, u)
    one, three = case.gtc_load[0], case.gtc_load[2]
    course = case.gtc_outputs[0] / (elements[0, 0] * one + elements[0, 2] * three)
    expected = (case.gtc_outputs[channel] - course * elements[channel, 0] * one) / three
    assert found.value[0, channel, 2] == pytest.approx(complex(GTC.value(expected)), rel=1e-12)
    variance = found.covariance[0, channel, 2].ravel()
    np.testing.assert_allclose(variance, GTC.variance(expected), rtol=1e-9, atol=1e-12 * variance[0])
    assert found.kind == ("element",)


def test_element_of_a_matrix_that_keeps_its_proportions_is_exact_where_the_ratio_is_not():
    rng = np.random.default_rng(4)
    static = np.diag([5e-7, 5e-7, 2e-7, 9e-6, 9e-6, 8e-6]) + 1e-8 * rng.standard_normal((6, 6))
    load = load_phasors(acceleration(), BODY)
    true = static * 0.97 * np.exp(-0.1j)
    signals = load.value @ true.T
    outputs = output_phasors([output(signals[:, c], name=f"S{c}") for c in range(6)])
    names = outputs.phasors.channels
    stated = StatedMatrix(tuple(reversed(names)), None, static[::-1].copy())
    element = sensor_element(outputs, load, prior_matrix(stated, names, 2, np.ones(6)), [1, 2])
    np.testing.assert_allclose(element.value[0, :, 2], true[:, 2], rtol=1e-10)
    # Harmonics are no part of the curve.
    assert np.isnan(element.value[1]).all()
    ratio = sensitivity_ratio(outputs, load, 2, [1, 2])
    assert abs(ratio.value[0, 2, 2] / true[2, 2] - 1.0) > 2e-4


def test_rated_cross_talk_bounds_what_other_loads_put_into_the_main_output(case):
    known = known_of(case, cross_talk=0.02)
    assert (known.rows, known.static) == ((0,), False)
    element = sensor_element(case.outputs, case.load, known, [1])
    assert element.elements == ((0, 2),)
    assert element.value[0, 0, 2] == pytest.approx(case.ratio.value[0, 0, 2], rel=1e-12)
    # |S_zj| ≤ 0.02·|S_zz|·4000 N/capacity_j, uniform: u = bound/√3.
    extra = element.covariance[0, 0, 2] - case.ratio.covariance[0, 0, 2]
    share = case.load.value[0, :2] / case.load.value[0, 2] * 0.02 / np.sqrt(3.0) * 4e3 / 2e3
    change = case.ratio.value[0, 0, 2] * share
    expected = np.array([[c.real, c.imag] for c in change])
    np.testing.assert_allclose(extra, expected.T @ expected, rtol=1e-6)
    assert [entry.count for entry in element.budget if entry.label == "rated cross-talk"] == [5]
    # U holds 95 % of what bounds and all else make of it, and no more: draws of the bounds beside a normal rest.
    ((found,),) = element.polar
    ((rest,),) = polar_elements(case.ratio.value[0, 0, 2].reshape(1, 1), case.ratio.uncertainty.at([0]))
    along = change / case.ratio.value[0, 0, 2] * found.magnitude
    rng = np.random.default_rng(4)
    off = np.sqrt(3.0) * rng.uniform(-1.0, 1.0, (100_000, len(change))) @ along.real
    off += rest.expanded_magnitude / 1.96 * rng.standard_normal(100_000)
    assert found.expanded_magnitude == pytest.approx(np.quantile(np.abs(off), 0.95), rel=0.015)
    assert found.expanded_magnitude <= np.sqrt(3.0) * np.abs(along.real).sum() + rest.expanded_magnitude


def test_without_knowledge_of_cross_talk_there_is_no_element(case):
    diagonal = np.array([[0.0, 0.0, 2e-7, 0.0, 0.0, 0.0], [5.1e-7, 0.0, 0.0, 0.0, 0.0, 0.0]])
    assert known_of(case) is None
    assert known_of(case, static=diagonal, u_static=1e-3) is None
    assert known_of(case, static=diagonal, u_static=1e-3, cross_talk=0.01).static is False
    assert known_of(case, static=diagonal, u_cross_talk=1e-3).rows == (0, 1)
    # The output that belongs to the load was not recorded.
    stated = StatedMatrix(("Fz", "Fx"), None, diagonal, u_cross_talk=1e-3)
    assert prior_matrix(stated, ("Fx",), 2, [1.0]) is None


def check_coverage(recording: str, driven: str, trials: int) -> None:
    counts = coverage_matrix.count_elements(
        recording, driven, range(1, trials + 1), {"static_sensitivity_uncertainty": 1e-3}
    )
    for count in counts:
        # The acceptance region of 95 %, so wide that a perfect program fails once in a thousand such comparisons.
        low, high = binom.ppf([5e-4, 1.0 - 5e-4], trials, 0.95)
        assert low <= np.sum(count.element.covered) <= high
        u_element, u_ratio = (np.median([one.u_magnitude for one in t.stated]) for t in (count.element, count.ratio))
        assert u_element < 2.0 * u_ratio


def test_transverse_excitation_beside_a_moment_covers_the_element_but_not_by_the_ratio():
    counts = coverage_matrix.count_elements("6-x-mass-+y", "Fx", range(1, 9), {"static_sensitivity_uncertainty": 1e-3})
    for count in counts:
        assert np.mean(count.bias).real == pytest.approx(-0.004, abs=0.001)
        assert np.sum(count.ratio.covered) <= 2
        assert binom.ppf(5e-4, 8, 0.95) <= np.sum(count.element.covered)


@pytest.mark.slow
@pytest.mark.parametrize(("recording", "driven"), coverage_matrix.DRIVEN)
def test_element_of_every_recording_of_the_uniaxial_campaign_is_covered(recording, driven):
    check_coverage(recording, driven, 40)


def test_a_single_recording_reports_the_missing_matrix_and_has_no_element():
    run = next(run for run in runs("matrix") if run.preset.recording == "5-x")
    setup = coverage_matrix.uniaxial_setup(run, 0, {})
    truth = coverage_matrix.uniaxial_truth(run, np.random.default_rng(1))
    known, _ = simulate_phasors(replace(setup, sensitivity=truth), Draws(1, True))
    blank = {"static_sensitivity": None}
    rated, bare = (known.sensor.model_copy(update=blank | more) for more in ({"cross_talk": 0.02}, {}))
    found = analyse(replace(known, sensor=rated))
    (bound,) = (notice for notice in found.notices if notice.code == CROSS_TALK_BOUND.code)
    assert bound.values["cross_talk"] == 0.02
    assert found.element.elements == ((0, 0),)
    assert found.element.covariance[0, 0, 0, 0, 0] > found.sensitivity.covariance[0, 0, 0, 0, 0]
    found = analyse(replace(known, sensor=bare))
    assert found.element is None
    assert OTHER_LOADS_NOT_ASSESSED.code in {notice.code for notice in found.notices}
    found = analyse(known)
    assert OTHER_LOADS_NOT_ASSESSED.code not in {notice.code for notice in found.notices}
    upside = [[-value for value in row] for row in known.sensor.static_sensitivity]
    wrong = analyse(replace(known, sensor=known.sensor.model_copy(update={"static_sensitivity": upside})))
    assert ELEMENT_CHANGED.code in {notice.code for notice in wrong.notices}
    drawn = propagate(known, found, 4000, 1)
    (element,) = [result for result in drawn.results if result.name == "element"]
    assert element.elements == tuple(f"{name} per Fx" for name in LOAD_COMPONENTS)
    # Of the main element; the ellipses of cross elements are needles, across which second order shows (and is told).
    np.testing.assert_allclose(element.first_holds[:, 0], 0.95, atol=0.015)
    u, first = (np.sqrt(np.trace(c, axis1=2, axis2=3)) for c in (element.covariance, element.first_covariance))
    np.testing.assert_allclose(u, first, rtol=0.05)
    bounded = analyse(replace(known, sensor=rated))
    (element,) = [r for r in propagate(replace(known, sensor=rated), bounded, 4000, 1).results if r.name == "element"]
    spread = element.covariance
    np.testing.assert_allclose(spread, element.first_covariance, rtol=0.1, atol=0.05 * spread.max())


@pytest.mark.parametrize(
    ("size", "resonance"),
    [
        (1 / (1 - (80 / 300) ** 2), "300 Hz"),
        (1 / (1 - (80 / 700) ** 2), None),  # 1.3 % above rest
        (1 / (1 - (2000 / 9000) ** 2), None),  # 5 % above, but at a frequency near the resonance
        (0.95, "no resonance"),
        (0.98, None),
        (1.5, None),  # reported by the outputs that contradict the matrix
        (1.1 * np.exp(0.5j), None),
    ],
)
def test_an_element_that_no_resonance_explains_doubts_the_masses(size, resonance):
    frequency_hz = 2000.0 if size == 1 / (1 - (2000 / 9000) ** 2) else 80.0
    notices = list(mass_notices("Fz per Fz", complex(size), frequency_hz))
    assert len(notices) == (resonance is not None)
    for notice in notices:
        assert notice.code == MASS_DOUBTED.code
        assert resonance in notice.values["resonance"]
