"""Load and ratio against closed forms, perturbed inputs, Monte Carlo, and the GUM Tree Calculator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import GTC
import numpy as np
import pytest
from contracts import coverage_contract

from fusion.estimation.fuse import Acceleration
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty
from fusion.instruments.channel import ChainUncertainty, Reading
from fusion.instruments.output import Outputs, output_phasors
from fusion.sensitivity.body import Body, make_part
from fusion.sensitivity.load import LoadResult, load_phasors
from fusion.sensitivity.ratio import Sensitivity, driven_component, parasitic_loads, sensitivity_ratio
from shaker.sine.phasor import Phasors

FREQUENCY = np.array([106.25, 212.5])
MOTION = np.array([[0.5, -0.3j, 189.0, 4.0j, -3.0, 1.0], [0.01, 0.02, 0.9 - 0.2j, 0.1, 0.05j, 0.02]], dtype=complex)
GRAVITY = (0.0, 0.0, -9.8125)
OUTPUT = 2e-7 * np.exp(-0.01j)
PARTS = (
    ("load", 6.9605, [1e-3, 2e-3, 0.02], np.diag([0.036, 0.036, 0.031]), (1e-3, 1e-4, 1e-4)),
    ("internal mass", 0.769, [0.0, 0.0, 0.0], np.zeros((3, 3)), (2e-3, 1e-3, 1e-5)),
)
BODY = Body(tuple(make_part(*part) for part in PARTS), gravity_mps2=GRAVITY)


def acceleration(motion: np.ndarray = MOTION, sigma: float = 1e-4, observed: np.ndarray | None = None) -> Acceleration:
    seen = np.ones(motion.shape, dtype=bool) if observed is None else np.broadcast_to(observed, motion.shape)
    spread = sigma**2 * np.array([1, 1, 1, 100, 100, 100.0]) * 189.0**2
    covariance = np.repeat(np.diag(np.tile(spread, 2))[None], len(motion), axis=0)
    mask = ~np.tile(seen, (1, 2))
    covariance = np.where(mask[:, :, None] | mask[:, None, :], np.nan, covariance)
    units = ("m/s^2",) * 3 + ("rad/s^2",) * 3
    value = np.where(seen, motion, complex(np.nan, np.nan))
    names = ("x", "y", "z", "rx", "ry", "rz")
    found = Phasors(FREQUENCY, value, covariance, names, units, np.full(len(motion), 50.0))
    noise = Uncertainty((Contribution("noise", "A", covariance, found.dof),))
    return Acceleration("load", "fused", found, seen, ("top",), noise, (), 0.0, 0, (), ())


def output(value: np.ndarray, name: str = "Fz", u_noise: float = 1e-9, **changes: Any) -> Reading:
    entry = {
        "name": name, "channel": name, "quantity": "output", "common": None, "scale_uncertainty": 0.0,
        "delay_uncertainty": 0.0, "individual_uncertainty": 0.0,
    }  # fmt: skip
    covariance = np.repeat(u_noise**2 * np.eye(2)[None], len(value), axis=0)
    found = Phasors(
        FREQUENCY, value[:, None].astype(complex), covariance, (name,), ("V/V",), np.full(len(value), 100.0)
    )
    return Reading(SimpleNamespace(**(entry | changes)), found, ChainUncertainty())


def ratio(outputs: list[Reading], source: Acceleration, body: Body = BODY) -> Sensitivity:
    load = load_phasors(source, replace(body, gravity_mps2=GRAVITY))
    return sensitivity_ratio(output_phasors(outputs), load, 2, [1, 2], (2e3, 2e3, 4e3, 100, 100, 100))


def test_force_of_a_centred_mass_is_mass_times_acceleration():
    body = Body((make_part("load", 7.0, np.zeros(3), np.diag([1.0, 2.0, 3.0])),))
    load = load_phasors(acceleration(), body)
    np.testing.assert_allclose(load.phasors.value[:, :3], 7.0 * MOTION[:, :3])
    np.testing.assert_allclose(load.phasors.value[:, 3:], MOTION[:, 3:] * [1, 2, 3])
    np.testing.assert_allclose(load.phasors.u_re[:, 2], 7.0 * 189.0e-4)
    reverse = load_phasors(acceleration(), replace(body, sense="on_sensor"))
    np.testing.assert_allclose(reverse.phasors.value, -load.phasors.value)


def test_gravity_tilt_pulls_a_tilted_mass_sideways():
    # The weight of a body tilted by theta, in its own axes: F = m theta × g beyond the weight at rest.
    body = Body((make_part("load", 7.0, np.zeros(3), np.zeros((3, 3))),), gravity_mps2=GRAVITY)
    motion = np.zeros((2, 6), complex)
    motion[:, 2], motion[:, 4] = 1.0, 5.0
    tilt = -5.0 / (2 * np.pi * FREQUENCY) ** 2
    load = load_phasors(acceleration(motion), body)
    np.testing.assert_allclose(load.phasors.value[:, 0], 7.0 * tilt * GRAVITY[2])


def test_parameter_contributions_are_the_change_of_the_load():
    source = acceleration(sigma=0.0)
    load = load_phasors(source, BODY)
    labels = {entry.label: entry for entry in load.contributions}
    heavier = replace(BODY, parts=(make_part("load", 6.9615, *PARTS[0][2:4]), BODY.parts[1]))
    change = load_phasors(source, heavier).phasors.value - load.phasors.value
    stacked = np.concatenate([change.real, change.imag], axis=1)
    expected = stacked[:, :, None] * stacked[:, None, :]
    np.testing.assert_allclose(labels["load: mass"].covariance, expected, rtol=1e-6, atol=1e-12)
    assert {"load: mass", "load: centre of mass", "load: inertia", "internal mass: mass"} <= set(labels)
    total = np.sum([entry.covariance for entry in load.contributions], axis=0)
    np.testing.assert_allclose(total, load.phasors.covariance)


def test_unobserved_motion_is_bounded_or_refused():
    only_z = np.array([False, False, True, False, False, False])
    centred = Body((make_part("load", 7.0, [0.0, 0.0, 0.05], np.diag([0.036, 0.036, 0.031]), (0.0, 1e-4, 0.0)),))
    load = load_phasors(acceleration(observed=only_z), centred)
    assert load.observed[0].tolist() == [False, False, True, False, False, False]
    hidden = next(entry for entry in load.contributions if entry.label == "unobserved rx")
    # 7 kg · 0.1 mm · (2 % of 189 m/s^2 over 0.1 m)/√2 in real and imaginary part.
    assert np.sqrt(hidden.covariance[0, 2, 2]) == pytest.approx(7.0 * 1e-4 * 0.02 * 189.0 / 0.1 / np.sqrt(2))
    assert any(notice.severity == "warning" for notice in load.notices)
    eccentric = Body((make_part("load", 7.0, [0.06, 0.0, 0.05], np.diag([0.036, 0.036, 0.031])),))
    refused = load_phasors(acceleration(observed=only_z), eccentric)
    assert not refused.observed[0, 2]
    assert np.isnan(refused.phasors.value[0, 2])
    result = ratio([output(np.ones(2))], acceleration(observed=only_z), eccentric)
    assert not result.observed.any()
    assert "no sensitivity" in result.notices[0].text


def test_unobserved_motion_is_one_cause_of_all_load_components():
    only_z = np.array([False, False, True, False, False, False])
    body = Body((make_part("load", 7.0, [0.0, 0.0, 0.05], np.diag([0.036, 0.036, 0.031])),))
    load = load_phasors(acceleration(observed=only_z), body)
    hidden = next(entry for entry in load.contributions if entry.label == "unobserved rx")
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
        [output(value, "Fz", common="amplifier", **own), output(value, "Fx", common="amplifier", **own)]
    )
    names = {i.name: i for i in pair.uncertainty.influences}
    assert set(names) == {"amplifier: scale", *(f"amplifier: individual scale {name}" for name in ("Fz", "Fx"))}
    np.testing.assert_allclose(names["amplifier: scale"].effect[:, :2], 1e-3 * np.stack([value, value], axis=1))
    assert {i.label for i in names.values()} == {"output scale", "output individual scale"}
    np.testing.assert_allclose(names["amplifier: individual scale Fx"].effect[0], [0.0, 2e-4 * value[0], 0.0, 0.0])
    apart = output_phasors([output(value, "Fz", **own), output(value, "Fx", **own)])
    assert len(apart.uncertainty.influences) == 4
    with pytest.raises(ValueError, match="at least one"):
        output_phasors([])


def test_ratio_returns_the_sensitivity():
    load = load_phasors(acceleration(), BODY)
    force = load.phasors.value[:, 2]
    result = ratio([output(OUTPUT * force), output(0.0 * force, "Fx")], acceleration())
    np.testing.assert_allclose(result.value[:, 0, 2], OUTPUT, rtol=1e-12)
    np.testing.assert_allclose(result.value[:, 1, 2], 0.0, atol=1e-20)
    assert result.kind == ("ratio", "harmonic")
    assert "beside Fz = 100 %" in result.notices[0].text
    assert "Mx" in result.notices[0].text
    assert result.observed.tolist() == [[False, False, True, False, False, False]] * 2
    assert np.isnan(result.value[:, :, [0, 1, 3, 4, 5]]).all()
    # A vanishing output has the uncertainty of its noise over the force and none from the load.
    u = np.sqrt(result.covariance[0, 1, 2, 0, 0])
    assert u == pytest.approx(1e-9 / abs(force[0]), rel=1e-9)


def test_budget_adds_up_and_knows_magnitude_from_phase():
    force = load_phasors(acceleration(), BODY).phasors.value[:, 2]
    result = ratio([output(OUTPUT * force, scale_uncertainty=1e-4, delay_uncertainty=1e-6)], acceleration())
    entries = {entry.label: entry for entry in result.budget}
    np.testing.assert_allclose(entries["output scale"].u_relative[:, 0], 1e-4)
    np.testing.assert_allclose(entries["output scale"].u_phase_rad, 0.0, atol=1e-12)
    np.testing.assert_allclose(entries["output delay"].u_phase_rad[:, 0], 2 * np.pi * FREQUENCY * 1e-6)
    np.testing.assert_allclose(entries["output delay"].u_relative, 0.0, atol=1e-12)
    np.testing.assert_allclose(entries["load: mass"].u_relative[0], 1e-3 / 7.7295, rtol=1e-3)
    variance = np.sum([e.u_relative**2 + e.u_phase_rad**2 for e in result.budget], axis=0)
    trace = np.trace(result.covariance[:, :, 2], axis1=-2, axis2=-1)
    np.testing.assert_allclose(variance * abs(OUTPUT) ** 2, trace, rtol=1e-9)


def test_regions_cover_the_truth():
    rng = np.random.default_rng(7)
    truth = load_phasors(acceleration(), BODY).phasors.value[:, 2]

    def estimate(_: int) -> tuple[complex, np.ndarray]:
        drawn = []
        for name, mass, centre, inertia, (u_mass, u_centre, u_inertia) in PARTS:
            moved = centre + u_centre * rng.normal(size=3)
            drawn.append(make_part(name, mass + u_mass * rng.normal(), moved, inertia, (u_mass, u_centre, u_inertia)))
        source = acceleration(sigma=1e-4)
        spread = np.sqrt(np.diagonal(source.phasors.covariance, axis1=1, axis2=2))
        noise = spread * rng.normal(size=spread.shape)
        shaken = replace(source.phasors, value=MOTION + noise[:, :6] + 1j * noise[:, 6:])
        gain = 1 + 3e-4 * rng.normal() - 2j * np.pi * FREQUENCY * 1e-6 * rng.normal()
        signal = OUTPUT * truth * gain + 1e-9 * (rng.normal(size=2) + 1j * rng.normal(size=2))
        reading = output(signal, scale_uncertainty=3e-4, delay_uncertainty=1e-6)
        result = ratio([reading], replace(source, phasors=shaken), Body(tuple(drawn)))
        return result.value[0, 0, 2], result.covariance[0, 0, 2]

    coverage_contract(estimate, OUTPUT, 200)


def test_driven_component():
    assert driven_component((0.0, -1.0, 0.2)) == 1
    assert driven_component((0.0, 0.0, 1.0, 0.5, 0.0, 0.0), (2e3, 2e3, 4e3, 100, 100, 100)) == 3
    with pytest.raises(ValueError, match="direction"):
        driven_component((0.0, 0.0, 0.0))


GTC_HZ = np.array([212.5])
GTC_MOTION = np.array([[0.4 - 0.1j, 0.2j, 40.0 * np.exp(0.7j), 0.0, 0.0, 0.0]])
MASSES = (("load", 6.9605, 1e-3), ("internal mass", 0.769, 2e-3))
GTC_OUTPUT = np.array([[6.2e-5 * np.exp(0.66j), 2.0e-7 - 1e-7j]])
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
    turn = -2j * np.pi * GTC_HZ[0]
    load = load_phasors(_acceleration(turn), Body(tuple(make_part(*_part(*mass)) for mass in MASSES)))
    outputs = output_phasors([_reading(0, "Fz"), _reading(1, "Fx")])
    ratio = sensitivity_ratio(outputs, load, 2, [1])
    unknowns = {name: GTC.ureal(0.0, u, label=name) for name, u in (("scale", SCALE), ("delay", DELAY))}
    unknowns |= {"time": GTC.ureal(0.0, CLOCK)}
    unknowns |= {name: GTC.ureal(mass, u) for name, mass, u in MASSES}
    (spread, dof), (noise, output_dof) = NOISE["motion"], NOISE["output"]
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
        Influence(name, name, u, unit, np.concatenate([(GTC_MOTION * slope).real, (GTC_MOTION * slope).imag], axis=1))
        for name, unit, u, slope in names
    )
    total = Uncertainty((Contribution("accelerometer: noise", "A", covariance, np.array([dof])),), influences)
    units = ("m/s^2",) * 3 + ("rad/s^2",) * 3
    found = Phasors(GTC_HZ, GTC_MOTION, total.covariance, ("x", "y", "z", "rx", "ry", "rz"), units, np.array([dof]))
    seen = np.ones((1, 6), dtype=bool)
    return Acceleration("load", "fused", found, seen, ("accelerometer",), total, (), 0.0, 0, (), ())


def _reading(place: int, name: str) -> Reading:
    noise, dof = NOISE["output"]
    value = GTC_OUTPUT[:, place, None]
    entry = SimpleNamespace(
        name=name, channel=name, quantity="output", common="amplifier", scale_uncertainty=SCALE, delay_uncertainty=0.0,
        individual_uncertainty=0.0,
    )  # fmt: skip
    found = Phasors(GTC_HZ, value, noise[None], (name,), ("V/V",), np.array([dof]))
    return Reading(entry, found, ChainUncertainty(clock="bridge", u_clock_s=CLOCK))


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


def test_load_and_outputs_alone(case):
    dof, pair = case.load.uncertainty.dof(), np.array([2, 8])
    _agrees(case.load.value[0, 2], case.load.uncertainty.covariance[0][np.ix_(pair, pair)], dof[0, 2], case.gtc_load[2])
    pair = np.array([0, 2])
    covariance, dof = case.outputs.uncertainty.covariance[0], case.outputs.uncertainty.dof()
    _agrees(case.outputs.phasors.value[0, 0], covariance[np.ix_(pair, pair)], dof[0, 0], case.gtc_outputs[0])


def test_elements_of_one_recording_are_correlated(case):
    first, second = (signal / case.gtc_load[2] for signal in case.gtc_outputs)
    expected = np.reshape(GTC.get_covariance(first, second), (2, 2))
    found = case.ratio.uncertainty.covariance[0]
    np.testing.assert_allclose(found[np.ix_([0, 2], [1, 3])], expected, rtol=1e-9)


def test_share_of_other_loads(case):
    shares = parasitic_loads(case.outputs, case.load, STATIC, 2, 3e-3)
    static = GTC.ureal(STATIC[1, 0], 3e-3 * STATIC[1, 0])
    element, expected = shares.element(0, 1), static * case.gtc_load[0] / case.gtc_outputs[1]
    mixed = element.r * element.u_re * element.u_im
    covariance = np.array([[element.u_re**2, mixed], [mixed, element.u_im**2]])
    _agrees(complex(element.re, element.im), covariance, element.dof, expected)
    # The other channel answers to Fx and, a little, to Fy.
    force = (STATIC[0, 0] * case.load.value[0, 0] + STATIC[0, 1] * case.load.value[0, 1]) / GTC_OUTPUT[0, 0]
    assert shares.value[0, 0] == pytest.approx(force, rel=1e-12)
    (notice,) = shares.notices(0, 0, "output Fz at 212.5 Hz")
    assert f"({100.0 * force.real:.2f} ± " in notice.text
    assert not parasitic_loads(case.outputs, case.load, np.diag([0.0, 0.0, 2e-7, 0, 0, 0])[[2, 2]], 2).notices(0, 0, "")


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
    assert entries["accelerometer: noise"].dof[0] == NOISE["motion"][1]
