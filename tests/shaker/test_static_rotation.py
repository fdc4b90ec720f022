"""Harmonics over the angle of a head, gravity, and weights from first harmonics: published values, least squares."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from contracts import refused
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from shaker.static_rotation.harmonics import (
    air_density_at,
    fit_angles,
    gravity_at,
    moist_air_density,
    normal_gravity,
    standard_pressure,
    turning_sense,
)
from shaker.static_rotation.masses import DISAGREEMENT_SOURCE, ROWS, UNDETERMINED_SOURCE, fit_weights
from shaker.static_rotation.weight_model import (
    RotationRecord,
    SensorOutputs,
    head_record,
    start_values,
)


@pytest.mark.parametrize(
    ("latitude_deg", "height_m", "expected", "tolerance"),
    [
        (0.0, 0.0, 9.7803267715, 1e-10),  # GRS 80, Moritz 2000
        (90.0, 0.0, 9.8321863685, 1e-10),
        (45.0, 0.0, 9.806199203, 1e-8),  # GRS 80 at 45 degrees, Moritz 2000
        (52.296, 79.0, 9.8125, 5e-5),  # PTB, Braunschweig
        (51.03361, 149.0, 9.811161, 3e-6),  # geodetic laboratory of HTW Dresden, normal gravity of WGS 84
        (-45.0, 0.0, 9.806199203, 1e-8),
    ],
)
def test_normal_gravity_is_the_published_one(latitude_deg, height_m, expected, tolerance):
    assert normal_gravity(np.radians(latitude_deg), height_m) == pytest.approx(expected, abs=tolerance)


def test_gravity_falls_with_height_as_outside_a_sphere():
    ground, low, high = (normal_gravity(np.radians(50.0), height) for height in (0.0, 1000.0, 8000.0))
    assert (low - ground) / 1000.0 == pytest.approx(-3.086e-6, rel=1e-3)
    assert high == pytest.approx(ground / (1.0 + 8000.0 / 6_356_800.0) ** 2, rel=2e-5)
    refused("^latitude_rad: ", normal_gravity, 52.3, 0.0)


@pytest.mark.parametrize(
    ("latitude_deg", "height_m", "measured"),
    [(51.03361, 114.0, 9.811193), (52.29, 80.0, 9.812524), (48.15, 515.0, 9.80723), (46.95, 540.0, 9.80588)],
)
def test_measured_gravity_lies_within_u(latitude_deg, height_m, measured):
    local = gravity_at(np.radians(latitude_deg), height_m)
    assert abs(local.value - measured) < 2.0 * local.u
    assert local.u == pytest.approx(0.5e-4 * local.value)
    assert "GRS 80" in local.source


@pytest.mark.parametrize("pressure_pa", [95e3, 101.325e3, 105e3])
@pytest.mark.parametrize("temperature_c", [15.0, 20.0, 25.0])
@pytest.mark.parametrize("humidity", [0.2, 0.5, 0.7])
def test_air_is_that_of_the_shorter_formula_of_oiml(pressure_pa, temperature_c, humidity):
    """OIML R 111-1 (2004), E.3.1: relative uncertainty 2e-4 against the formula of 1981, 6e-5 below that of 2007."""
    h, t = 100.0 * humidity, temperature_c
    short = (0.34848 * pressure_pa / 100.0 - 0.009 * h * np.exp(0.061 * t)) / (273.15 + t)
    assert moist_air_density(pressure_pa, temperature_c, humidity) == pytest.approx(short, rel=4e-4)


def test_dry_air_is_nearly_an_ideal_gas_and_the_standard_atmosphere_that_of_iso_2533():
    ideal = 101_325.0 * 28.96546e-3 / (8.314472 * 293.15)
    assert moist_air_density(101_325.0, 20.0, 0.0) == pytest.approx(ideal / 0.99963, rel=5e-5)  # Z at 20 °C, 1 atm
    refused("^humidity: .*50", moist_air_density, 101_325.0, 20.0, 50.0)
    assert standard_pressure(0.0) == 101_325.0
    assert [standard_pressure(h) for h in (1000.0, 5000.0)] == pytest.approx([89_874.6, 54_019.9], rel=2e-5)


def test_u_of_air_is_that_of_drawn_conditions_and_smaller_where_more_is_measured():
    everything, height, unstated = (
        air_density_at(*local) for local in ((500.0, 95_500.0, 21.0, 0.4), (500.0, *[None] * 3), [None] * 4)
    )
    assert unstated.u > height.u > everything.u > 22e-6 * everything.value
    assert everything.source == "CIPM-2007 from pressure, temperature, humidity"
    assert height.source == "CIPM-2007 from height"
    spread = np.array([100.0, 0.5, 0.05]) * np.random.default_rng(5).standard_normal((3000, 3))
    drawn = [moist_air_density(*conditions) for conditions in np.array([95_500.0, 21.0, 0.4]) + spread]
    assert everything.u == pytest.approx(float(np.std(drawn)), rel=0.05)


STEPS = np.arange(16) * np.pi / 8.0
BOTH_SENSES = np.concatenate([STEPS, [2.0 * np.pi, 2.0 * np.pi], STEPS[::-1]])
CHANNELS = ("Fx", "Fy")


def _readings(angle: np.ndarray, rng: np.random.Generator, noise: float = 1e-3) -> np.ndarray:
    clean = np.stack([0.3 + 7.558 * np.cos(angle - 0.4), -0.2 - 7.532 * np.sin(angle - 0.4)], axis=1)
    return np.asarray(clean + noise * rng.standard_normal(clean.shape))


def test_a_sine_fit_is_that_of_least_squares():
    values = _readings(STEPS, np.random.default_rng(1))
    fit = fit_angles(CHANNELS, STEPS, values)
    design = np.stack([np.ones(16), np.cos(STEPS), np.sin(STEPS)], axis=1)
    expected, rss, *_ = np.linalg.lstsq(design, values, rcond=None)
    assert fit.terms == ("offset", "cos 1", "sin 1")
    np.testing.assert_allclose(fit.coefficient, expected, atol=1e-12)
    np.testing.assert_allclose(np.diag(fit.noise), rss / 13.0, rtol=1e-9)
    np.testing.assert_allclose(np.abs(fit.amplitude()), [7.558, 7.532], atol=2e-3)
    np.testing.assert_allclose(np.angle(fit.amplitude()[0]), -0.4, atol=1e-3)
    np.testing.assert_allclose(fit.coefficient[0], [0.3, -0.2], atol=2e-3)
    np.testing.assert_allclose(fit.curve(STEPS) + fit.residual, values, atol=1e-12)


def test_the_covariance_of_amplitudes_is_that_of_readings_with_correlated_noise():
    """Amplitudes are linear in the readings: by the change of each with each, over less than a whole turn."""
    angle, rng = np.linspace(0.0, 5.5, 12), np.random.default_rng(2)  # cosine and sine correlate
    values = _readings(angle, rng, 0.0) + rng.standard_normal((12, 2)) @ np.array([[1e-3, 0.8e-3], [0.0, 1e-3]])
    fit = fit_angles(CHANNELS, angle, values)

    def amplitudes(readings: np.ndarray) -> np.ndarray:
        found = fit_angles(CHANNELS, angle, readings).amplitude()
        return np.concatenate([found.real, found.imag])

    slopes = [amplitudes(values + 1e-6 * unit.reshape(12, 2)) - amplitudes(values) for unit in np.eye(24)]
    slope = np.array(slopes).T / 1e-6
    expected = slope @ np.kron(np.eye(12), fit.noise) @ slope.T
    np.testing.assert_allclose(fit.covariance(), expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("angle", [STEPS, BOTH_SENSES], ids=["one sense", "both senses"])
def test_false_terms_are_rare(angle):
    rng = np.random.default_rng(3)
    plain = sum(len(fit_angles(CHANNELS, angle, _readings(angle, rng)).terms) == 3 for _ in range(100))
    assert plain >= 97  # some nine tests of one in a thousand each


@pytest.mark.parametrize("order", [2, 3, 5])
def test_a_harmonic_enters_where_one_channel_shows_it(order):
    values = _readings(STEPS, np.random.default_rng(order))
    values[:, 1] += 0.01 * np.sin(order * STEPS + 0.3)
    fit = fit_angles(CHANNELS, STEPS, values)
    assert fit.orders == (1, order)
    assert (abs(fit.amplitude(order)[1]), fit.dof) == (pytest.approx(0.01, abs=1.5e-3), 11.0)


def test_drift_and_hysteresis_enter_and_leave_the_sine_alone():
    drift, sense = np.linspace(-1.0, 1.0, len(BOTH_SENSES))[:, None], turning_sense(BOTH_SENSES)[:, None]
    fit = fit_angles(CHANNELS, BOTH_SENSES, _readings(BOTH_SENSES, np.random.default_rng(4)) + 0.02 * drift)
    assert fit.terms[3:] == ("drift",)
    np.testing.assert_allclose(fit.coefficient[3], 0.02, atol=2e-3)
    np.testing.assert_allclose(np.abs(fit.amplitude()), [7.558, 7.532], atol=2e-3)
    values = _readings(BOTH_SENSES, np.random.default_rng(5)) + 0.01 * sense * np.array([1.0, -1.0])
    fit = fit_angles(CHANNELS, BOTH_SENSES, values)
    assert fit.terms[3:] == ("sense", "sense cos 1", "sense sin 1")
    reversal = fit.reversal()
    assert len(reversal.angle_rad) == 16
    np.testing.assert_allclose(reversal.difference.mean(axis=0), [0.02, -0.02], atol=2e-3)


def test_the_sense_of_rotation_is_that_of_the_shorter_path():
    degrees = np.radians([315.0, 337.5, 0.0, 22.5, 22.5, 0.0, 337.5])
    assert turning_sense(degrees).tolist() == [1, 1, 1, 1, 1, -1, -1]
    assert turning_sense(np.zeros(3)).tolist() == [0, 0, 0]


def test_coarse_readings_are_as_uncertain_as_their_last_digit_and_those_without_noise_exact():
    values = np.round(np.stack([10.0 * np.cos(STEPS), 0.4 + 0.0 * STEPS], axis=1), 0)
    values[0, 1] = 1.0
    assert np.all(np.diag(fit_angles(CHANNELS, STEPS, values).noise) >= 1.0 / 12.0 - 1e-12)
    for digit in (1e-6, 5e-4, 2e-9):  # and rounding is no harmonic
        fit = fit_angles(CHANNELS, STEPS, digit * np.round(_readings(STEPS, np.random.default_rng(8), 0.0) / digit))
        assert fit.orders == (1,)
        assert np.all(np.diag(fit.noise) >= 0.99 * digit**2 / 12.0)
    values = np.stack([np.cos(STEPS), np.sin(STEPS) + 0.1 * np.cos(2.0 * STEPS)], axis=1)
    fit = fit_angles(CHANNELS, STEPS, values)
    assert fit.orders == (1, 2)
    np.testing.assert_allclose(fit.amplitude(), [1.0, -1.0j], atol=1e-12)
    refused("^order: ", fit.amplitude, 4)
    assert abs(fit_angles(("a",), STEPS, 4e-318 * np.sin(STEPS)[:, None]).amplitude()[0]) < 1e-317


@settings(deadline=None, max_examples=15)
@given(
    st.lists(st.floats(0.0, 6.283), min_size=8, max_size=20, unique_by=lambda x: round(x, 1)),
    st.floats(0.1, 100.0),
    st.floats(-3.0, 3.0),
)
def test_angles_in_any_order_give_one_answer(angles, size, turn):
    angle = np.array(angles)
    values = (1.0 + size * np.cos(angle + turn))[:, None]
    design = np.stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)], axis=1)
    assume(np.linalg.cond(design) < 29.0)
    fit = fit_angles(("F",), angle, values)
    reversed_fit = fit_angles(("F",), angle[::-1] + 2.0 * np.pi, values[::-1])
    for found in (fit, reversed_fit):
        assert found.amplitude()[0] == pytest.approx(size * np.exp(1j * turn), rel=1e-6)


def test_readings_that_determine_no_sine_are_refused():
    refused("^angle_rad: .* 5 .* 1 ", fit_angles, ("F",), np.zeros(5), np.zeros((5, 1)))
    refused("^angle_rad: .* 3 ", fit_angles, ("F",), np.arange(3.0), np.zeros((3, 1)))
    refused("^angle_rad: .* 20 ", fit_angles, ("F",), np.linspace(0.0, 0.5, 20), np.zeros((20, 1)))
    refused(r"^reading: .*\(6, 1\)", fit_angles, ("F",), np.arange(6.0), np.zeros((5, 1)))
    refused("^reading: ", fit_angles, ("F",), np.arange(6.0), np.full((6, 1), np.nan))


X, Y, Z = np.eye(3)
SENSITIVITY = np.diag([5.1e-7, 5.1e-7, 2.0e-7, 9.1e-6, 9.1e-6, 8.2e-6])
NOISE = np.array([1e-9, 1e-9, 1e-9, 2e-9, 2e-9, 2e-9])


def _load(weight: float, centre=(0.0, 0.0, 0.0), axis=Z, down=-Y, angle: np.ndarray = STEPS) -> np.ndarray:
    """Loads (N, 6) on a sensor that is turned about an axis, by rotation matrices: gravity seen from the sensor."""
    force = weight * Rotation.from_rotvec(np.outer(-angle, axis)).apply(down)
    return np.hstack([force, np.cross(centre, force)])


def _outputs(matrix: np.ndarray = SENSITIVITY, relative: float = 0.0, sense: Literal[1, -1] = 1) -> SensorOutputs:
    """A calibration matrix known to a share of its elements."""
    return SensorOutputs(matrix, relative * matrix, sense)


def _rotation_record(
    loads: np.ndarray, matrix: np.ndarray = SENSITIVITY, axis: np.ndarray = Z, down: np.ndarray = -Y
) -> RotationRecord:
    """First harmonics of outputs with a little stated noise."""
    outputs = loads @ matrix.T
    fit = fit_angles(tuple("abcdef"[: len(matrix)]), STEPS, outputs)
    variance = np.tile((NOISE[: len(matrix)]) ** 2, 2)
    return head_record("one", fit.amplitude(), np.diag(variance), 1e9, axis, down)


def _parts(harmonic: np.ndarray) -> np.ndarray:
    return np.stack([harmonic.real, harmonic.imag])


def _harmonic(record: RotationRecord) -> np.ndarray:
    return np.asarray(record.response[0] + 1j * record.response[1])


@settings(deadline=None, max_examples=12)
@given(
    st.floats(0.5, 500.0),
    st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3),
    st.floats(-3.0, 3.0),
    st.lists(st.floats(-0.02, 0.02), min_size=2, max_size=2),
    st.sampled_from([(Z, -Y), (X, -Z), (Y, X), (-Z, (X + Y) / np.sqrt(2.0))]),
    st.sampled_from([1, -1]),
)
def test_weight_centre_zero_angle_and_axis_come_back(weight, centre, zero, tilt, stood, sense):
    axis, down = stood
    turn = Rotation.from_rotvec(tilt[0] * np.cross(axis, down) - tilt[1] * down)
    true_axis, true_down = turn.apply(axis), turn.apply(Rotation.from_rotvec(-zero * axis).apply(down))
    record = _rotation_record(sense * _load(weight, centre, true_axis, true_down), axis=axis, down=down)
    record = replace(record, covariance=record.covariance * 1e-10)
    fit = fit_weights([record], _outputs(sense=sense))
    assert fit.value[0] == pytest.approx(weight, rel=1e-7)
    np.testing.assert_allclose(fit.value[1:4] / weight, centre, atol=1e-7)
    assert np.exp(1j * fit.value[4]) == pytest.approx(np.exp(1j * zero), abs=1e-6)
    np.testing.assert_allclose(fit.value[5:7], tilt, atol=1e-6)
    assert fit.departure == 0.0


def test_the_effect_of_every_cause_is_the_change_of_the_values():
    """By fits of readings, matrices and angles that are off by one standard uncertainty each."""
    heavy = _rotation_record(_load(75.8, (0.0005, 0.001, 0.04)))
    records = [_rotation_record(_load(7.54, (0.001, -0.002, 0.01))), replace(heavy, name="heavy")]
    outputs, rows = _outputs(relative=1e-3), np.flatnonzero(np.arange(2 * ROWS) % ROWS != ROWS - 1)
    fit = fit_weights(records, outputs, 2e-4)

    def noisy(r: int, by: np.ndarray) -> np.ndarray:
        off = [replace(one, response=one.response + _parts(by) * (s == r)) for s, one in enumerate(records)]
        return fit_weights(off, outputs, 2e-4).value

    units = [turn * unit for unit in np.diag(NOISE) for turn in (1.0, 1.0j)]
    matrices = [outputs.sensitivity + np.outer(unit, unit) * outputs.u for unit in np.eye(6)]
    changed = {f"noise of {one.name}": [noisy(r, unit) for unit in units] for r, one in enumerate(records)}
    changed["calibration matrix"] = [
        fit_weights(records, replace(outputs, sensitivity=one), 2e-4).value for one in matrices
    ]
    heads = [
        [replace(one, response=one.response - _parts(1e-4j * turn * _harmonic(one).conj())) for one in records]
        for turn in (1.0, -1.0j)
    ]
    changed["angle of the head"] = [fit_weights(one, outputs, 2e-4).value for one in heads]
    u = np.sqrt(np.diag(fit.covariance))[rows]
    for source in fit.sources:
        if source.name in changed:
            change, effect = (np.array(changed[source.name]) - fit.value)[:, rows] / u, source.effect[rows].T / u
            np.testing.assert_allclose(change.T @ change, effect.T @ effect, atol=5e-3)


def test_what_two_recordings_share_cancels_in_their_ratio():
    fit = fit_weights([_rotation_record(_load(weight)) for weight in (50.0, 51.0)], _outputs(relative=1e-2))
    covariance = fit.covariance[np.ix_([0, ROWS], [0, ROWS])]
    assert np.sqrt(covariance[0, 0]) / 50.0 == pytest.approx(1e-2 / np.sqrt(2.0), rel=1e-3)
    across = np.array([1.0 / 50.0, -1.0 / 51.0])
    assert np.sqrt(across @ covariance @ across) < 1e-3


def test_two_force_channels_determine_the_weight_but_not_the_centre():
    record = _rotation_record(_load(20.0, (0.01, 0.02, 0.03)), SENSITIVITY[:2])
    fit = fit_weights([record], _outputs(SENSITIVITY[:2]))
    assert fit.value[0] == pytest.approx(20.0, rel=1e-6)
    undetermined = next(source for source in fit.sources if source.name == UNDETERMINED_SOURCE)
    size = np.linalg.norm(undetermined.effect, axis=1)
    assert np.all(size[1:4] > 19.0)
    assert size[0] < 1e-9
    assert np.isnan(fit.load[0, 2:]).all()


def test_cross_talk_in_the_matrix_is_taken_off():
    size, centre = np.sqrt(np.diag(SENSITIVITY)), (0.001, 0.002, 0.05)
    matrix = SENSITIVITY + 0.02 * np.random.default_rng(7).standard_normal((6, 6)) * np.outer(size, size)
    fit = fit_weights([_rotation_record(_load(70.0, centre), matrix)], _outputs(matrix))
    assert fit.value[0] == pytest.approx(70.0, rel=1e-6)
    np.testing.assert_allclose(fit.value[1:4] / 70.0, centre, atol=1e-6)
    np.testing.assert_allclose(fit.value[7:9], 70.0, rtol=1e-6)


def test_channels_that_disagree_enlarge_the_uncertainty():
    record = _rotation_record(_load(20.0), SENSITIVITY * np.array([1.01, 1.0, 1.0, 1.0, 1.0, 1.0]))
    fit = fit_weights([record], _outputs())
    behind = next(source for source in fit.sources if source.name == DISAGREEMENT_SOURCE)
    assert behind.dof == 2.0
    assert fit.departure == pytest.approx(0.01 / 2.0, rel=0.02)  # χ² = 2 (d/2u)² at two freedoms
    assert fit.value[0] == pytest.approx(20.1, rel=1e-4)
    assert np.sqrt(fit.covariance[0, 0]) == pytest.approx(20.0 * 0.005 / np.sqrt(2.0), rel=0.02)
    assert np.sqrt(fit.covariance[7, 7]) == pytest.approx(20.0 * 0.005, rel=0.02)
    assert fit_weights([record], _outputs(relative=0.01)).departure == 0.0


def test_readings_that_are_no_weight_are_refused():
    record = _rotation_record(_load(20.0))
    for change, match in (
        ({"axis": -Z, "direction": record.direction * [[1.0], [-1.0]]}, "^axis: "),
        ({"response": np.zeros((2, 6))}, "^amplitude: "),
    ):
        refused(match, start_values, replace(record, **change), _outputs())
    refused("^axis: ", replace, record, axis=Y)
    along, only = (
        _outputs(SENSITIVITY[2:3]),
        replace(record, response=record.response[:, 2:3], covariance=np.eye(2), loop=np.zeros((2, 1))),
    )
    refused("^sensitivity: ", start_values, only, along)
    refused("^records: ", fit_weights, [], along)
