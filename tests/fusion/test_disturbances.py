"""What acts beside the excitation: against draws of the physics, written without the program's own propagation."""

from __future__ import annotations

import numpy as np
import pytest
from contracts import coverage_contract

from fusion.estimation.fuse import fuse
from fusion.estimation.measurement_model import Deviates
from fusion.estimation.uncertainty import Contribution, Uncertainty
from fusion.instruments.channel import ChainUncertainty, ChannelReading, observe_channels, output_phasors
from fusion.recording.environment import Environment
from fusion.recording.manifest import ChannelEntry
from fusion.recording.rig import Rig, RigLoad, Sensor
from fusion.sensitivity.disturbances import (
    at_reference_temperature,
    not_assessed,
    unstated_chain,
    with_base_strain,
    with_support_motion,
)
from fusion.sensitivity.moving_body import load_body
from fusion.sensitivity.ratio import Sensitivity
from fusion.sensitivity.sensitivity_notices import (
    BASE_STRAIN_NOT_ASSESSED,
    CABLES_NOT_ASSESSED,
    OUTPUT_LAGS,
    OUTPUT_LEADS_LOAD,
    SUPPORT_MOTION_NOT_ASSESSED,
    TEMPERATURE_NOT_ASSESSED,
)
from shaker.labels import LOAD_COMPONENTS
from shaker.sine.phasor import Phasors

FREQUENCY_HZ = np.array([80.0, 160.0])
SENSOR = Sensor(
    name="s",
    channels=("Fz",),
    unit="V/V",
    sense="on_load",
    internal_mass=0.0,
    temperature_coefficient=-4e-4,
    temperature_coefficient_uncertainty=5e-5,
    reference_temperature=20.0,
    base_strain_sensitivity=2e-3,
)
LOAD = RigLoad(
    mass=5.0,
    centre_of_mass=(0.0, 0.0, 0.0),
    inertia=np.diag([0.01, 0.01, 0.01]).tolist(),
    cable_stiffness=(0.0, 0.0, 2e4),
    cable_stiffness_uncertainty=(0.0, 0.0, 3e3),
)


def reading(entry: ChannelEntry, value: complex, u: float = 1e-10) -> ChannelReading:
    values = np.full((2, 1), value, dtype=np.complex128)
    covariance = np.repeat(u**2 * abs(value) ** 2 * np.eye(2)[None], 2, axis=0)
    channels, unit = (entry.name,), ("1",)
    return ChannelReading(
        entry, Phasors(FREQUENCY_HZ, values, covariance, channels, unit, np.full(2, 1e3)), ChainUncertainty()
    )


def test_outputs_are_those_at_the_reference_temperature():
    """A sensor of known sensitivity at 20 °C is read at 26 °C: coefficient and thermometer err as stated."""
    at_reference, around = 3e-4 + 4e-4j, Environment(sensor_temperature=26.0, sensor_temperature_uncertainty=0.5)
    entry = ChannelEntry(name="Fz", quantity="output", channel="Fz")

    def estimate(trial):
        rng = np.random.default_rng(trial)
        alpha, warmer = -4e-4 + 5e-5 * rng.standard_normal(), 6.0 + 0.5 * rng.standard_normal()
        outputs = output_phasors([reading(entry, at_reference * (1.0 + alpha * warmer))])
        corrected = at_reference_temperature(outputs, SENSOR, around)
        spread = np.sqrt(np.diagonal(corrected.uncertainty.covariance[0]))
        return corrected.phasors.value[0], 1.96 * spread

    coverage_contract(estimate, np.array([at_reference]), 400)
    untouched = output_phasors([reading(entry, at_reference)])
    assert at_reference_temperature(untouched, SENSOR, Environment()) is untouched


def test_strain_of_the_foot_is_in_u_of_the_outputs_whatever_these_are():
    """The table bends by up to 50 µm/m: 2e-3 per m/m of it in any phase, in an output of 1 mV/V and in one of none."""
    entries = [ChannelEntry(name=name, quantity="output", channel=name) for name in ("Fz", "Mx")]
    outputs = output_phasors([reading(entries[0], 1e-3), reading(entries[1], 1e-9)])
    strained = with_base_strain(outputs, SENSOR, Environment(base_strain=5e-5))
    rng = np.random.default_rng(3)
    drawn = 2e-3 * 5e-5 * np.sqrt(rng.uniform(size=20000)) * np.exp(2j * np.pi * rng.uniform(size=20000))
    u = np.sqrt(np.diagonal(strained.uncertainty.covariance[1]))
    np.testing.assert_allclose(u, np.repeat([drawn.real.std(), drawn.imag.std()], 2), rtol=0.02)
    own = strained.draw(Deviates(1, 0, 4000))
    np.testing.assert_allclose(own.real.std(axis=0), drawn.real.std(), rtol=0.05)
    assert {one.label for one in strained.uncertainty.influences} == {"strain of the sensor's foot"}
    for unstated in (Environment(), Environment(base_strain=0.0)):
        assert with_base_strain(outputs, SENSOR, unstated) is outputs


def test_a_shaken_support_is_in_u_of_lasers_alone_and_accelerometers_find_it():
    """Lasers read the body less their support, whose phasor lies anywhere in a disc of 2 % of the motion."""
    points = ((0.05, 0.0, 0.0), (-0.03, 0.04, 0.0), (-0.03, -0.04, 0.0))
    z = {"body": "load", "direction": (0.0, 0.0, 1.0), "scale_uncertainty": 1e-5}
    lasers = [ChannelEntry(name=f"v{n}", quantity="displacement", point=p, **z) for n, p in enumerate(points)]
    others = [ChannelEntry(name=f"a{n}", quantity="acceleration", point=p, **z) for n, p in enumerate(points)]
    true = 10.0

    def recorded(rng, entries):
        support = 0.02 * np.sqrt(rng.uniform()) * np.exp(2j * np.pi * rng.uniform())
        given = []
        for entry in entries:
            optical = entry.quantity == "displacement"
            # Noise far below the disc, yet within what double precision tells apart in squares.
            own = reading(entry, true * (1.0 - support) if optical else true, 1e-7)
            factor = -1.0 / (2.0 * np.pi * FREQUENCY_HZ[:, None]) ** 2 if optical else 1.0
            given.append(
                ChannelReading(entry, own.phasors.scaled(np.broadcast_to(factor, (2, 1)).astype(complex)), own.chain)
            )
        return with_support_motion(observe_channels(given), 0.02)

    def deviations(entries, trials):
        fused = [fuse(recorded(np.random.default_rng(trial), entries)) for trial in range(trials)]
        off = np.array([result.phasors.value[0, 2] - true for result in fused])
        return off, np.sqrt(fused[0].uncertainty.covariance[0][2, 2])

    off, u = deviations(lasers, 50)
    assert 0.85 < u / np.std([off.real, off.imag]) < 1.2  # both parts have the disc's variance
    off, u = deviations([*lasers, *others], 8)
    assert u < 1e-4
    assert np.max(np.abs(off)) < 4e-4


def test_what_the_rig_does_not_state_is_said_to_be_missing():
    z = {"body": "load", "point": (0.0, 0.0, 0.0), "direction": (0.0, 0.0, 1.0), "scale_uncertainty": 1e-3}
    laser, other = (
        observe_channels([reading(ChannelEntry(name=q, quantity=q, **z), 1.0)]) for q in ("velocity", "acceleration")
    )
    known = Environment(sensor_temperature=23.0, support_motion=1e-4, base_strain=0.0)
    rig = Rig(format=1, name="r", sensor=SENSOR, load=LOAD, environment=known)
    assert not list(not_assessed(rig, laser, load_body(rig, ()), 80.0))
    silent = rig.model_copy(update={"environment": None, "load": LOAD.model_copy(update={"cable_stiffness": None})})
    notices = {notice.code: notice for notice in not_assessed(silent, laser, load_body(silent, ()), 80.0)}
    temperature, cables = notices[TEMPERATURE_NOT_ASSESSED.code], notices[CABLES_NOT_ASSESSED.code]
    assert temperature.values["share"] == pytest.approx(1e-4 * 5.0)
    assert "`environment.base_strain` is" in notices[BASE_STRAIN_NOT_ASSESSED.code].values["missing"]
    assert "no instrument" in notices[SUPPORT_MOTION_NOT_ASSESSED.code].values["detectable"]
    # 1 kN/m on 5 kg: 1000/(5·(2π·80)²) = 0.0792 %; at 800 Hz a hundredth of that, which is not reported.
    assert cables.values["share"] == pytest.approx(1000.0 / (5.0 * (2.0 * np.pi * 80.0) ** 2), rel=1e-6)
    assert "0.08 %" in cables.possible_size
    both = [*laser, *other]
    notices = {notice.code: notice for notice in not_assessed(silent, both, load_body(silent, ()), 800.0)}
    assert "accelerometers" in notices[SUPPORT_MOTION_NOT_ASSESSED.code].values["detectable"]
    assert CABLES_NOT_ASSESSED.code not in notices


def test_cables_carry_part_of_the_force():
    """A mass between the sensor and a spring to the room: F + (-k·x) = m·a, with x = -a/ω² and k as it is drawn."""
    rig, acceleration = Rig(format=1, name="r", load=LOAD), 10.0 + 2.0j
    body = load_body(rig, ())
    assert body is not None
    motion = np.array([0.0, 0.0, acceleration, 0.0, 0.0, 0.0])
    estimate = (body.load_matrix(FREQUENCY_HZ) @ motion)[:, 2]
    effects = [change.effect for change in body.matrix_changes(FREQUENCY_HZ) if change.label == "stiffness of cables"]
    u = np.sqrt(sum(np.abs(effect @ motion)[:, 2] ** 2 for effect in effects))
    drawn = 2e4 + 3e3 * np.random.default_rng(1).standard_normal(4000)
    place = -acceleration / (2.0 * np.pi * FREQUENCY_HZ[:, None]) ** 2
    force = 5.0 * acceleration + drawn * place
    np.testing.assert_allclose(estimate, 5.0 * acceleration + 2e4 * place[:, 0], rtol=1e-12)
    np.testing.assert_allclose(u, np.std(force, axis=1), rtol=0.05)


@pytest.mark.parametrize(
    ("turn_rad", "stated", "expected"),
    [
        (-20e-3, {}, (OUTPUT_LAGS.code, 20.0)),
        (np.pi + 12e-3, {}, (OUTPUT_LEADS_LOAD.code, 12.0)),
        (-3e-3, {}, None),
        (-20e-3, {"delay": 4e-5}, None),
        (-20e-3, {"delay_uncertainty": 1e-6}, None),
    ],
)
def test_an_unstated_amplifier_is_reported(turn_rad, stated, expected):
    entry = ChannelEntry(name="bridge", quantity="output", channel="Fz", **stated)
    value = np.full((2, 1, 6), np.nan, dtype=np.complex128)
    value[:, 0, 2] = 7e-7 * np.exp(1j * turn_rad)
    spread = Contribution("noise", "A", np.repeat(1e-20 * np.eye(2)[None], 2, axis=0), np.full(2, np.inf))
    found = Sensitivity(
        FREQUENCY_HZ, value, ((0, 2),), Uncertainty((spread,), ()), ("Fz",), LOAD_COMPONENTS, "V/V",
        ("ratio", "harmonic"), (),
    )  # fmt: skip
    notices = list(unstated_chain(found, [entry], 2, signed=True))
    assert len(notices) == (expected is not None)
    for notice in notices:
        assert (notice.code, notice.values["output"]) == (expected[0], "bridge")
        assert notice.values["lag_mrad"] == pytest.approx(expected[1])
        assert notice.values["lag_us"] == pytest.approx(1e3 * expected[1] / (2.0 * np.pi * 80.0))
    assert list(unstated_chain(None, [entry], 2, signed=True)) == []
    assert list(unstated_chain(found, [entry], 0, signed=True)) == []
