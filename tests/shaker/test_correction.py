"""The sensor model against simulation and a real calibration: its bands, their U, the correction by it."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from real_data import SHOCK, SHOCK_RATE_HZ, Shock, as_sensor, read_shock
from scipy import signal
from sensitivity_factory import DAMPING, FREQUENCY, LAG, STATIC, STIFFNESS, lag, measured, resonance

from shaker.identification.sensitivity import fit_chain, sensor_model
from shaker.identification.sensor import (
    NO_CHAIN,
    ChainModel,
    Load,
    SensorExcitation,
    SensorModel,
    correct_phasors,
    correct_record,
    usable_band,
)
from shaker.model_notices import SIGNAL_ABOVE_BAND
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import ComplexArray, FloatArray

MASS, INTERNAL = 4.236, 0.769
DRIVES: tuple[SensorExcitation, ...] = ("base", "force")


CHAINS = [
    NO_CHAIN,
    ChainModel("delay", np.array([4e-5])),
    ChainModel("lag", np.array([4e-5])),
    ChainModel("delay_lag", np.array([3e-5, 4e-5])),
    ChainModel("second_order", np.array([4e-5, 2e-9])),
    ChainModel("butterworth", np.array([6e-5])),
]


def model(chain: ChainModel = NO_CHAIN, damping: float = DAMPING, relative: float = 0.0) -> SensorModel:
    """A sensor whose parameters are known to `relative`, independently."""
    values = np.array([STATIC, STIFFNESS, damping, INTERNAL, *chain.parameters])
    return SensorModel(STATIC, STIFFNESS, damping, INTERNAL, chain, np.diag((relative * values) ** 2), "(V/V)/N")


def off_by_one_u(one: SensorModel, load: Load) -> Iterator[tuple[SensorModel, Load]]:
    """Yield sensor and load, of which each time another number is off by its standard uncertainty."""
    values = np.array([one.sensitivity, one.stiffness, one.damping, one.internal_mass, *one.chain.parameters])
    for u in np.diag(np.sqrt(one.covariance.diagonal())):
        scalars, chain = np.split(values + u, [4])
        yield SensorModel(*scalars.tolist(), ChainModel(one.chain.kind, chain), one.covariance, one.unit), load
    yield one, replace(load, mass=load.mass + load.u_mass)


def state_space(drive: SensorExcitation, time_s: float) -> signal.StateSpace:
    """Output of a sensor behind a first-order lag for the force on its load, from the equations of motion.

    States: deflection, its rate, output. M·ẍ = -k·x - b·ẋ + F, F = -M·a_base for a moving base, output ∝ k·x.
    """
    total = MASS + INTERNAL
    row = [-STIFFNESS / total, -DAMPING / total, 0.0]
    a = np.array([[0.0, 1.0, 0.0], row, [STATIC * STIFFNESS / time_s, 0.0, -1.0 / time_s]])
    force = signal.StateSpace(a, [[0.0], [1.0 / total], [0.0]], [[0.0, 0.0, 1.0]], [[0.0]])
    if drive == "force":
        return force
    # The load's absolute acceleration is (-k·x - b·ẋ)/M with either sign of the drive.
    return signal.StateSpace(a, force.B, [row, [0.0, 0.0, 1.0]], [[0.0], [0.0]])


@pytest.mark.parametrize("drive", DRIVES)
def test_output_factor_is_that_of_the_equations_of_motion(drive):
    one, load = model(ChainModel("lag", np.array([LAG]))), Load(MASS, drive)
    at = np.array([1.0, 300.0, 1000.0, 1490.0, 1600.0, 6000.0])
    system, s = state_space(drive, LAG), 2j * np.pi * at
    response = np.stack([system.C @ np.linalg.solve(x * np.eye(3) - system.A, system.B)[:, 0] for x in s])
    expected = response[:, 0] if drive == "force" else -response[:, 1] / (MASS * response[:, 0])
    assert np.allclose(one.output_factor(at, load), expected, rtol=1e-9)


@settings(max_examples=12, deadline=None)
@given(
    drive=st.sampled_from(DRIVES),
    mass=st.floats(0.1, 20.0),
    damping=st.floats(100.0, 1e5),
    chain=st.sampled_from(CHAINS),
)
def test_derivatives(drive, mass, damping, chain):
    one, load, at = model(chain, damping), Load(mass, drive), np.array([20.0, 700.0, 1900.0])
    slopes = one.log_slopes(at, load)
    values = np.array([STATIC, STIFFNESS, damping, INTERNAL, *chain.parameters, mass])

    def logarithm(moved: FloatArray) -> ComplexArray:
        other = SensorModel(*moved[:4].tolist(), ChainModel(chain.kind, moved[4:-1]), one.covariance, one.unit)
        return np.log(other.output_factor(at, replace(load, mass=float(moved[-1]))))

    for index, size in enumerate(values):
        step = 1e-6 * size * np.eye(len(values))[index]
        by_difference = (logarithm(values + step) - logarithm(values - step)) / 2e-6
        assert np.allclose(slopes[:, index] * size, by_difference, rtol=1e-4, atol=1e-8)


def test_bands_are_the_published_ones_of_light_damping_and_the_textbook_s_of_heavy_damping():
    load = Load(MASS, "force")
    one = model(damping=1e-3)
    for permitted, share in ((0.05, 0.2182), (0.10, 0.3015), (0.01, 0.0995)):
        band = usable_band(one, load, permitted)
        assert band.upper_hz / one.resonance_hz(load) == pytest.approx(share, abs=6e-5)
        assert band.upper_hz / one.resonance_hz(load) == pytest.approx(np.sqrt(permitted / (1.0 + permitted)), rel=1e-6)
        assert band.limit == "rise"
    # |H| never exceeds 1.05, and falls to 0.95 at 0.84 f₀, the largest root of |H|² = 0.95²
    one = model(damping=1.2 * np.sqrt(STIFFNESS * (MASS + INTERNAL)))
    square, band = np.roots([1.0, 2.0 * (2.0 * 0.36 - 1.0), 1.0 - 0.95**-2]), usable_band(one, load, 0.05)
    assert band.limit == "drop"
    assert band.upper_hz / one.resonance_hz(load) == pytest.approx(np.sqrt(square.max()), rel=1e-9)


def test_band_of_a_moving_base_is_that_of_the_chain():
    base = Load(MASS, "base")
    band = usable_band(model(ChainModel("lag", np.array([LAG])), damping=1e-6), base, 0.05)
    assert band.upper_hz == pytest.approx(np.sqrt(0.95**-2 - 1.0) / (2.0 * np.pi * LAG), rel=1e-6)
    limited = usable_band(model(ChainModel("delay", np.array([LAG])), damping=1e-6), base, 0.05, 0.1)
    assert (limited.limit, limited.upper_hz) == ("phase", pytest.approx(0.1 / (2.0 * np.pi * LAG), rel=1e-6))
    assert usable_band(model(ChainModel("delay", np.array([LAG])), damping=0.0), base, 0.05).upper_hz == np.inf
    heavier = usable_band(model(ChainModel("lag", np.array([LAG])), damping=1e-6), Load(3.0 * MASS, "base"), 0.05)
    assert heavier.upper_hz == pytest.approx(band.upper_hz, rel=1e-9)


@pytest.mark.parametrize(
    ("drive", "chain", "phase"),
    [
        ("force", NO_CHAIN, None),
        ("force", ChainModel("lag", np.array([LAG])), 0.05),
        ("base", ChainModel("second_order", np.array([LAG, 2e-9])), None),
    ],
)
def test_uncertainty_of_the_edge_is_its_change_by_every_number(drive, chain, phase):
    one, load = model(chain, relative=1e-4), Load(MASS, drive, 2e-4)
    band = usable_band(one, load, 0.05, phase)
    changes = [usable_band(*other, 0.05, phase).upper_hz - band.upper_hz for other in off_by_one_u(one, load)]
    assert np.linalg.norm(changes) == pytest.approx(band.u_upper_hz, rel=2e-3)


def test_sensitivity_and_mechanics_join():
    """Draws of the truth: the joint parameters err as their joint covariance says, that of b with the lag included."""
    rng = np.random.default_rng(6)
    mechanics = np.array([STIFFNESS, DAMPING, INTERNAL])
    root = np.diag([5e-4, 0.3, 3e-3] * mechanics) @ np.linalg.cholesky(
        [[1.0, 0.2, 0.8], [0.2, 1.0, 0.1], [0.8, 0.1, 1.0]]
    )
    distance, errors = [], []
    for _ in range(60):
        found = mechanics + root @ rng.standard_normal(3)
        spring = replace(resonance(u_b=0.3), k=float(found[0]), b=float(found[1]), r_kb=0.2)
        one = sensor_model(fit_chain(measured(lag(FREQUENCY), rng), "lag", spring), found, root @ root.T)
        error = np.array([one.sensitivity, one.stiffness, one.damping, one.internal_mass, one.chain.lag_s])
        error -= np.array([STATIC, *mechanics, LAG])
        size = np.sqrt(one.covariance.diagonal())
        correlation = one.covariance / np.multiply.outer(size, size)
        distance.append(float(error / size @ np.linalg.solve(correlation, error / size)))
        errors.append(error / size)
    assert np.mean(distance) == pytest.approx(5.0, abs=4.5 * np.sqrt(10.0 / 60))
    assert np.std(errors, axis=0) == pytest.approx(np.ones(5), abs=0.3)
    with pytest.raises(ValueError, match=r"^fit: "):
        sensor_model(fit_chain(measured(lag(FREQUENCY)), "lag", None), mechanics, root @ root.T)


def test_phasors_are_corrected_with_the_uncertainty_of_the_model():
    one, load = model(ChainModel("lag", np.array([LAG])), relative=3e-5), Load(MASS, "force", 1e-4)
    at, force = np.array([100.0, 700.0, 1200.0]), np.array([[10.0 + 2.0j], [5.0j], [-3.0 + 0.0j]])
    output = force * one.output_factor(at, load)[:, None]
    noise = np.full((3, 1, 1), (1e-4 * STATIC) ** 2) * np.eye(2)
    phasors = Phasors(at, output, noise, ("S1",), ("V/V",), np.full(3, 50.0))
    corrected = correct_phasors(phasors, one, load)
    assert corrected.phasors.unit == ("N",)
    assert np.allclose(corrected.phasors.value, force, rtol=1e-12)
    factors = [other.output_factor(at, moved) for other, moved in off_by_one_u(one, load)]
    changes = output[:, 0] / np.array(factors) - force[:, 0]
    for line, factor in enumerate(one.output_factor(at, load)):
        pairs = np.stack([changes[:, line].real, changes[:, line].imag])
        expected = pairs @ pairs.T + (1e-4 * STATIC / abs(factor)) ** 2 * np.eye(2)
        assert np.allclose(corrected.covariance[line], expected, rtol=1e-2, atol=1e-3 * expected.trace())
    refused("^phasors: .*V", correct_phasors, replace(phasors, unit=("V",)), one, load)


RATE, BAND = 100e3, 4000.0


def pulse(time_s: FloatArray) -> FloatArray:
    """A smooth pulse of 100 N, 0.4 ms wide, that has less than 1e-6 above 4 kHz, on a slow ramp."""
    return np.asarray(100.0 * np.exp(-0.5 * ((time_s - 0.02) / 2e-4) ** 2) + 3.0 + 20.0 * time_s)


@cache
def simulated(rate: float = RATE, seconds: float = 0.04) -> tuple[FloatArray, FloatArray]:
    """Force and output of a sensor that rings at 1.48 kHz, simulated in time at ten times the rate."""
    time = np.arange(round(10 * rate * seconds)) / (10 * rate)
    force, system = pulse(time), state_space("force", LAG)
    start = np.linalg.solve(system.A, -system.B[:, 0] * force[0])
    return force[::10], np.asarray(signal.lsim(system, force, time, X0=start)[1])[::10]


def test_record_is_corrected():
    one, load = model(ChainModel("lag", np.array([LAG]))), Load(MASS, "force")
    force, output = simulated()
    assert np.abs(output / STATIC - force).max() > 10.0
    found = correct_record(output, RATE, one, load, BAND)
    inner = slice(found.settling, -found.settling)
    assert found.unit == "N"
    assert np.abs(found.force - force)[inner].max() < 0.01
    assert np.all(found.u == 0.0)


@settings(max_examples=8, deadline=None)
@given(delay=st.floats(-3e-4, 3e-4), index=st.integers(0, 200), size=st.floats(1.0, 1e6))
def test_one_end_does_not_see_the_other(delay, index, size):
    one, load = model(ChainModel("delay", np.array([delay]))), Load(MASS, "base")
    output = np.random.default_rng(0).standard_normal(3000)
    plain = correct_record(output, RATE, one, load, BAND)
    output[index] += size
    moved = correct_record(output, RATE, one, load, BAND)
    far = slice(index + plain.settling + 200 - index, None)
    reach = np.abs(moved.force - plain.force)
    assert reach[far].max() < 1e-4 * reach.max()


def test_correction_is_linear_and_a_constant_is_divided_by_the_static_factor():
    one, load = model(ChainModel("second_order", np.array([LAG, 2e-9]))), Load(MASS, "base")
    found = correct_record(np.full(4000, 1e-4), RATE, one, load, BAND)
    assert np.allclose(found.force, 1e-4 / STATIC / (1.0 + INTERNAL / MASS), rtol=2e-5)
    assert found.removed_rms < 1e-4 * found.force[0]
    assert found.notices == ()


def test_uncertainty_of_a_record_is_its_change_by_every_number_and_its_noise():
    one, load = model(ChainModel("lag", np.array([LAG])), relative=1e-5), Load(MASS, "force", 1e-5)
    _, output = simulated()
    found = correct_record(output, RATE, one, load, BAND)
    changed = [correct_record(output, RATE, *other, BAND).force - found.force for other in off_by_one_u(one, load)]
    np.testing.assert_allclose(np.linalg.norm(changed, axis=0), found.u, rtol=1e-2, atol=1e-2 * found.u.max())
    white = 0.05 * STATIC * np.random.default_rng(9).standard_normal(20000)
    noisy = correct_record(white, RATE, model(), load, BAND, u_noise=0.05 * STATIC)
    assert np.std(noisy.force) == pytest.approx(noisy.u[0], rel=0.05)


def test_a_signal_above_the_band_gives_a_notice():
    one, load = model(), Load(MASS, "base")
    time = np.arange(4000) / RATE
    tone = STATIC * np.cos(2.0 * np.pi * 9000.0 * time)
    found = correct_record(tone, RATE, one, load, BAND)
    assert found.removed_rms == pytest.approx(np.sqrt(0.5) / (1.0 + INTERNAL / MASS), rel=0.02)
    (notice,) = found.notices
    assert notice.code == SIGNAL_ABOVE_BAND.code
    assert (notice.values["rms"], notice.values["band_hz"]) == (found.removed_rms, BAND)


def test_wrong_calls_are_refused():
    one, load = model(), Load(MASS, "base")
    with pytest.raises(ValueError, match=r"^band_hz: .* 40000 .* 45000"):
        correct_record(np.zeros(4000), RATE, one, load, 45e3)
    refused("^output: ", correct_record, np.zeros(100), RATE, one, load, 1000.0)
    refused("^permitted: ", usable_band, one, load, 1.0)
    refused("permitted_phase_rad", usable_band, one, load, 0.1, 4.0)
    refused("mass, u_mass", Load, 0.0, "base")
    refused("^stiffness: ", replace, one, stiffness=-1.0)
    with pytest.raises(ValueError, match=r"^load: "):
        usable_band(replace(one, internal_mass=-0.1), Load(0.05, "force"), 0.1)


SEISMIC = Load(1.0, "force")


@pytest.fixture(scope="module")
def shock(data_dir: Path) -> Shock:
    folder = data_dir / "accelerometer_calibration"
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} does not exist")
    return read_shock(folder)


def test_files_are_labelled_right_and_phases_are_degrees(shock):
    assert (len(shock.frequency_hz), len(shock.input), len(shock.output)) == (49, 18000, 18000)
    ratio = np.abs(np.fft.rfft(shock.output)[1:6] / np.fft.rfft(shock.input)[1:6])
    assert ratio == pytest.approx(np.abs(shock.value[0]), rel=0.025)
    # Read as rad the table would delay the output by 28 µs; the shock says less than 1 µs.
    assert abs(shock.delay_s()) < 1e-6
    fit = shock.fit(delay=False)
    assert fit.damping_ratio / (np.pi * fit.frequency_hz) < 1e-6


def test_model_of_the_table_predicts_the_shock_and_lacks_its_ringing(shock):
    fit = shock.fit(delay=True)
    assert fit.chi_squared / fit.dof == pytest.approx(1.0, abs=0.3)
    error = shock.error(fit.model)
    assert error.std() < 0.021
    assert error[SHOCK].std() < 0.05
    static = shock.error(lambda f: np.full(len(f), np.abs(shock.value[0]) + 0j))
    assert error.std() < 0.9 * static.std()
    assert np.abs(error).max() < 0.65 * np.abs(static).max()
    left, frequency = np.abs(np.fft.rfft(error)) ** 2, np.fft.rfftfreq(len(shock.input), 1.0 / SHOCK_RATE_HZ)
    assert left[(frequency > 40e3) & (frequency < 70e3)].sum() > 0.7 * left.sum()


@pytest.mark.parametrize(("permitted", "tolerance"), [(0.01, 0.04), (0.05, 0.03), (0.10, 0.01)])
def test_band_of_the_model_is_where_the_table_rises(shock, permitted, tolerance):
    band = usable_band(as_sensor(shock.fit(delay=True)), SEISMIC, permitted)
    rise = np.abs(shock.value) / np.abs(shock.value[0])
    measured = float(np.interp(1.0 + permitted, rise, shock.frequency_hz))
    assert (band.limit, band.upper_hz) == ("rise", pytest.approx(measured, rel=tolerance))


def test_corrected_output_has_the_peak_of_the_shock(shock):
    fit = shock.fit(delay=True)
    sensor, rigid = as_sensor(fit), SensorModel(1.0, 1e20, 0.0, 0.0, NO_CHAIN, np.zeros((4, 4)), "1/N")
    assert np.allclose(sensor.output_factor(shock.frequency_hz, SEISMIC), fit.model(shock.frequency_hz), rtol=2e-3)
    true, plain = (
        correct_record(record, SHOCK_RATE_HZ, rigid, SEISMIC, 20e3).force for record in (shock.input, shock.output)
    )
    corrected = correct_record(shock.output, SHOCK_RATE_HZ, sensor, SEISMIC, 20e3).force
    assert corrected.max() / true.max() == pytest.approx(1.0, abs=0.008)
    assert plain.max() / true.max() / np.abs(shock.value[0]) > 1.025
