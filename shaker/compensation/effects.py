"""Effects of a compensation filter: bandwidth, noise, mismatch, uncertainty, force feedback."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shaker.compensation.filter import (
    Compensation,
    CompensationFilter,
    CompensationTarget,
    Discretisation,
    Sections,
    SensorDynamics,
    best_damping,
    cancelled_poles,
    discretise,
    low_pass_poles,
    mode_poles,
    parameter_sections,
    target_poles,
)
from shaker.lti.system import LinearSystem
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, check_shape

# Target for a permitted error of the whole sensor up to a specified frequency.

MODEL_ERROR_SHARE = 0.1
"""Share of the permitted error that is reserved for the uncertainty of the model, chosen."""
HIGHEST_FACTOR = 32.0  # range of the search for the target's frequency over the bandwidth
RESOLUTION = 1e-10  # relative, of the target's frequency
REACH, FINE = 4.0, 2001  # range over the target's frequency, and points, of the search for the widest band
POINTS = 257  # of a band


def target_for_bandwidth(
    sensor: SensorDynamics,
    bandwidth_hz: float,
    permitted_error: float = 0.1,
    real_hz: float | None = None,
    low_pass_hz: float | None = None,
) -> CompensationTarget:
    """Return the lowest target frequency that keeps the whole sensor within 1 ± δ."""
    from scipy.optimize import minimize_scalar

    if not bandwidth_hz > 0:
        raise ValueError(f"bandwidth_hz: expected a positive number, found {bandwidth_hz}")
    if not len(sensor.frequency_hz):
        raise ValueError("frequency_hz: expected a mode to compensate for a bandwidth, found real poles only")
    allowed = (1.0 - MODEL_ERROR_SHARE) * permitted_error
    start, gain = best_damping(allowed), _gains(sensor, np.linspace(0.0, bandwidth_hz, POINTS))
    template = CompensationTarget(bandwidth_hz, start, real_hz, low_pass_hz)

    def lowest(damping: float) -> float:
        """Return the lowest natural frequency that keeps the band, infinite if none does."""

        def within(frequency: float) -> bool:
            target = replace(template, frequency_hz=frequency, damping_ratio=float(damping))
            return bool(np.max(np.abs(gain(target) - 1.0)) <= allowed)

        low, high = bandwidth_hz / HIGHEST_FACTOR, bandwidth_hz * HIGHEST_FACTOR
        if not within(high):
            return float("inf")
        while high / low > 1.0 + RESOLUTION:
            middle = float(np.sqrt(low * high))
            low, high = (low, middle) if within(middle) else (middle, high)
        return high

    dampings = start + np.linspace(-0.25, 0.4, 27)
    tried = np.array([lowest(damping) for damping in dampings])
    if not np.any(np.isfinite(tried)):
        raise ValueError(
            f"bandwidth_hz: expected a band that uncompensated poles leave within ±{permitted_error:.2g}"
            f" of the static gain, found {bandwidth_hz:g}; compensate more modes or the real poles, "
            "or raise the low-pass"
        )
    near = dampings[int(np.argmin(tried))]
    best = minimize_scalar(lowest, bounds=(near - 0.025, near + 0.025), method="bounded", options={"xatol": 1e-7})
    damping = float(best.x) if best.fun <= np.min(tried) else float(near)
    return replace(template, frequency_hz=lowest(damping), damping_ratio=damping)


def target_for_frequency(
    sensor: SensorDynamics,
    frequency_hz: float,
    permitted_error: float = 0.1,
    real_hz: float | None = None,
    low_pass_hz: float | None = None,
) -> CompensationTarget:
    """Return the damping with the widest band 1 ± δ of the whole sensor."""
    allowed = (1.0 - MODEL_ERROR_SHARE) * permitted_error
    start = best_damping(allowed)
    template = CompensationTarget(frequency_hz, start, real_hz, low_pass_hz)
    if not len(sensor.frequency_hz):
        return template
    gain = _gains(sensor, np.linspace(0.0, REACH * frequency_hz, FINE))

    def reached(damping: float) -> int:
        outside = np.abs(gain(replace(template, damping_ratio=damping)) - 1.0) > allowed
        return int(np.argmax(np.append(outside, True)))

    dampings = np.concatenate([[start], start + np.arange(-250, 401) * 1e-3])
    best = int(np.argmax([reached(float(one)) for one in dampings]))
    return replace(template, damping_ratio=float(dampings[best]))


def _gains(sensor: SensorDynamics, frequency_hz: FloatArray) -> Callable[[CompensationTarget], FloatArray]:
    """Return a function from target to compensated gain over the static one (K,)."""
    s: ComplexArray = np.asarray(2j * np.pi * frequency_hz, dtype=np.complex128)

    def denominator(poles: list[ComplexArray]) -> ComplexArray:
        """Return Π(1 - s/p) (K,) over all poles p."""
        return np.asarray(np.prod(1.0 - s / np.concatenate(poles)[:, None], axis=0))

    rest = np.abs(sensor.system.at(s) / sensor.static_gain * denominator(cancelled_poles(sensor)))

    def gain(target: CompensationTarget) -> FloatArray:
        return np.asarray(rest / np.abs(denominator([*target_poles(sensor, target), *low_pass_poles(target)])))

    return gain


# Noise after a compensation filter.


def white_noise_gain(sections: Sections) -> float:
    """Return √Σh² of the impulse response, by which white noise grows."""
    from scipy.linalg import solve_discrete_lyapunov

    a, b, c, d = state_space(sections)
    spread = solve_discrete_lyapunov(a, np.outer(b, b), method="direct")
    return float(np.sqrt(c @ spread @ c + d**2))


def filtered_noise(sections: Sections, frequency_hz: FloatArray, density: FloatArray) -> tuple[FloatArray, float]:
    """Return the density (K,) of measured noise after a filter, and its standard deviation.

    Parameters
    ----------
    sections
        the filter
    frequency_hz
        (K,) rising, Hz
    density
        (K,) of the noise before the filter, unit/√Hz

    Returns
    -------
    tuple : density (K,) after the filter in unit/√Hz, and standard deviation over the range by the trapezoidal rule

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import Compensation, filtered_noise
    >>> from shaker.compensation.filter import CompensationTarget, discretise, single_mode
    >>> sections = discretise(Compensation(single_mode(300.0, 0.02), CompensationTarget(1000.0, 0.7)), 20e3)
    >>> after, rms = filtered_noise(sections, np.array([0.0, 100.0]), np.array([2e-6, 2e-6]))
    >>> print(f"{after[0]:.3g} {rms:.3g}")  # V/√Hz at rest, and V up to 100 Hz
    2e-06 1.89e-05
    """
    check_shape("density", density, frequency_hz.shape)
    if len(frequency_hz) < 2 or np.any(np.diff(frequency_hz) <= 0) or np.any(density < 0):
        raise ValueError("frequency_hz, density: expected rising frequencies and densities of at least 0, found others")
    after = np.abs(sections.response(frequency_hz)) * density
    return after, float(np.sqrt(np.trapezoid(after**2, frequency_hz)))


def state_space(sections: Sections) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return A (2S, 2S), B, C (2S,) and D with the streaming filter's states."""
    size = 2 * len(sections.sos)
    a, b, c, d = np.zeros((size, size)), np.zeros(size), np.zeros(size), 1.0
    for number, (b0, b1, b2, _, a1, a2) in enumerate(sections.sos):
        rows = slice(2 * number, 2 * number + 2)
        through = np.array([b1 - a1 * b0, b2 - a2 * b0])
        a[rows] += np.outer(through, c)
        a[rows, rows] += np.array([[-a1, 1.0], [-a2, 0.0]])
        b[rows] = through * d
        c, d = b0 * c, b0 * d
        c[2 * number] += 1.0
    return a, b, sections.gain * c, float(sections.gain * d)


# Mismatch of filter and sensor: another load, or an inaccurate model.

PERIODS = 6  # of the slowest oscillation
PER_PERIOD = 256  # points of the fastest oscillation


def with_parameters(sensor: SensorDynamics, vector: FloatArray) -> LinearSystem:
    """Return the whole sensor with other values of `SensorDynamics.vector`; other poles and zeros stay."""
    modes, reals = len(sensor.frequency_hz), len(sensor.real_hz)
    f, zeta, real, gain = np.split(np.asarray(vector, dtype=np.float64), np.cumsum([modes, modes, reals]))
    poles = [pole for one, damping in zip(f, zeta, strict=True) for pole in mode_poles(one, damping)]
    every = np.array([*sensor.other_poles, *poles, *(-2 * np.pi * real)])
    unscaled = LinearSystem(sensor.system.zeros, every, 1.0)
    return replace(unscaled, gain=float(gain[0]) / unscaled.static_gain)


def with_frequency(sensor: SensorDynamics, factor: float) -> LinearSystem:
    """Return the whole sensor with the frequencies of its cancelled modes times a factor."""
    vector = sensor.vector.copy()
    vector[: len(sensor.frequency_hz)] *= factor
    return with_parameters(sensor, vector)


def residual_ringing(compensation: Compensation, sensor: LinearSystem, after_s: float) -> float:
    """Return the largest |y/y(∞) - 1| of `sensor` with filter after `after_s`."""
    if not after_s >= 0:
        raise ValueError(f"after_s: expected 0 or more, found {after_s}")
    whole = sensor.times(compensation.system)
    swinging = np.abs(whole.poles.imag[whole.poles.imag > 0])
    if not len(swinging):
        return float(np.abs(whole.step(np.array([after_s]))[0] / whole.static_gain - 1.0))
    span = PERIODS * 2 * np.pi / np.min(swinging)
    count = int(min(1 << 15, PERIODS * PER_PERIOD * np.max(swinging) / np.min(swinging)))
    return float(np.max(np.abs(whole.step_between(after_s, after_s + span, count) / whole.static_gain - 1.0)))


# Uncertainty of a compensated signal by frequency and by sample.


@dataclass(frozen=True, repr=False)
class GainBand(Arrays):
    """Standard uncertainties of a compensated sensor over `frequency_hz` (K,). `u_gain` relative, `u_phase_rad`."""

    frequency_hz: FloatArray
    u_gain: FloatArray
    u_phase_rad: FloatArray


@dataclass(frozen=True, repr=False)
class CompensatedSignal(Arrays, shapes="value C N; u_model C N; u_scatter C N"):
    """Compensated samples `value` (C, N) with standard uncertainty `u` (C, N).

    `u_model` (C, N): contribution of the sensor's model, 0 without its covariance. `u_noise`: noise after the filter,
    the same for all samples. `u_scatter` (C, N): the part of `u_model` from the scatter of records.
    """

    value: FloatArray
    u_model: FloatArray
    u_noise: float
    u_scatter: FloatArray

    @property
    def u(self) -> FloatArray:
        """Standard uncertainty (C, N) from model and noise together."""
        return np.asarray(np.hypot(self.u_model, self.u_noise))


def gain_band(compensation: Compensation, frequency_hz: FloatArray) -> GainBand:
    """Return u of the compensated sensor to first order, Σ (∂ ln G_c/∂θ) δθ.

    Valid if u of a cancelled frequency is small against half the width ζ·fn of its resonance.
    """
    covariance = compensation.sensor.covariance
    if covariance is None:
        raise ValueError("sensor: expected a model with covariance, found none")
    slopes = compensation.sensitivities(frequency_hz)
    spreads = (np.sqrt(np.einsum("kp,pq,kq->k", part, covariance, part)) for part in (slopes.real, slopes.imag))
    return GainBand(np.asarray(frequency_hz), *spreads)


class CompensationWithUncertainty:
    """A `CompensationFilter` that gives the uncertainty of every sample.

    It also runs the filters of ∂y/∂θ: u² = gᵀVg + (noise·√Σh²)², g (P,) the derivatives at the sample, V the covariance
    of the sensor's parameters, `noise` the standard deviation of the input, white at the sampling rate. The
    contribution of the parameters is common to all samples, that of the noise is not.
    """

    def __init__(
        self,
        compensation: Compensation,
        sample_rate_hz: float,
        method: Discretisation = "matched",
        *,
        channels: int = 1,
        level: FloatArray | float | None = 0.0,
        noise: float = 0.0,
    ) -> None:
        sections = discretise(compensation, sample_rate_hz, method)
        covariance = compensation.sensor.covariance
        self._covariance = np.zeros((0, 0)) if covariance is None else covariance
        scatter = compensation.sensor.scatter
        self._scatter = np.zeros_like(self._covariance) if scatter is None else scatter
        self._filter = CompensationFilter(sections, channels, level)
        every = [] if covariance is None else parameter_sections(compensation, sample_rate_hz, method)
        self._slopes = [CompensationFilter(slope, channels, level) for slope in every]
        self._noise = noise * white_noise_gain(sections)

    def __call__(self, block: FloatArray) -> CompensatedSignal:
        """Return the compensated block (C, N) with its uncertainty."""
        value = self._filter(block)
        slopes = np.array([run(block) for run in self._slopes]).reshape(len(self._slopes), *value.shape)
        model, scatter = (
            np.sqrt(np.maximum(np.einsum("pcn,pq,qcn->cn", slopes, part, slopes), 0.0))
            for part in (self._covariance, self._scatter)
        )
        return CompensatedSignal(value, model, self._noise, scatter)


# Force feedback of a haptic handle through a sensor: a user pushes it against a virtual ball (section VI of the
# publication on load characteristics of force sensors, on simulated data).

RUNAWAY = 1e3
"""Force over the largest static force of the hand, above which a run is unstable."""
HIGHEST_GAIN = 1e4  # end of the search for the stability limit
GRID = 161  # gains over seven decades


@dataclass(frozen=True)
class HapticLoop:
    """Hand, device, ball and force control.

    The hand moves the handle of mass M at x through a spring and a damper, F_u = k_h(x_h - x) + b_h(v_h - v), with the
    motion x_h of the hand. M v' = F_u - F_a - B v. The ball pushes back with F_v = k·depth. The control makes the hand
    feel it: F_a = F_v + K(F_v - y) with the force y from the sensor and K = `force_gain`. The handle then feels like
    one of mass M/(1 + K). The actuator receives each F_a one sample late. Masses in kg, stiffnesses in N/m, dampings in
    N·s/m.
    """

    hand_stiffness: float
    hand_damping: float
    mass: float
    damping: float
    ball_stiffness: float
    force_gain: float
    sample_rate_hz: float

    def __post_init__(self) -> None:
        for name in ("hand_stiffness", "mass", "sample_rate_hz"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a positive number, found {getattr(self, name)}")
        for name in ("hand_damping", "damping", "ball_stiffness", "force_gain"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected 0 or more, found {getattr(self, name)}")


@dataclass(frozen=True, repr=False)
class FeedbackRun(Arrays):
    """Forces of user, sensor and ball.

    Samples (N,) in N; NaN after the loop became unstable. `applied` F_u, `indicated`: its value from the sensor,
    `fed_back` F_v of the ball. `tracking_error`: rms of F_u - F_v over rms of F_v during contact, infinite for an
    unstable run.
    """

    time_s: FloatArray
    applied: FloatArray
    indicated: FloatArray
    fed_back: FloatArray
    stable: bool
    tracking_error: float


@dataclass(frozen=True, repr=False)
class _Matrices(Arrays):
    """Sampled loop with states z and inputs [x_h, v_h, wall]."""

    a: FloatArray
    b: FloatArray
    read: FloatArray
    feed: FloatArray


def push(time_s: FloatArray, depth_m: float, duration_s: float) -> FloatArray:
    """Return the position of the hand (N,) for one push: depth·(1 - cos 2πt/T)/2."""
    return np.asarray(0.5 * depth_m * (1.0 - np.cos(2 * np.pi * np.minimum(time_s / duration_s, 1.0))))


def simulate_feedback(
    loop: HapticLoop,
    sensor: LinearSystem,
    sections: Sections | None,
    hand_m: FloatArray,
    wall_m: float = 0.0,
) -> FeedbackRun:
    """Return the forces as the hand moves along `hand_m` (N,) towards a ball at `wall_m`.

    `sensor`: output over force with its load, used over its static gain. `sections`: compensation with static gain 1,
    None without.
    """
    check_shape("hand_m", hand_m, (None,))
    speed = np.gradient(hand_m) * loop.sample_rate_hz
    inputs = np.stack([hand_m, speed, np.full(len(hand_m), wall_m)], axis=1)
    regimes = [_matrices(loop, sensor, sections, contact) for contact in (False, True)]
    limit = RUNAWAY * loop.hand_stiffness * float(np.max(np.abs(hand_m)) + 1e-12)
    forces, state = np.full((len(inputs), 3), np.nan), np.zeros(len(regimes[0].a))
    for sample, given in enumerate(inputs):
        now = regimes[int(state[0] > given[2])]
        forces[sample] = now.read @ state + now.feed @ given
        if not abs(forces[sample, 0]) < limit:
            forces[sample:] = np.nan
            break
        state = now.a @ state + now.b @ given
    applied, indicated, fed_back = forces.T
    touched, tracking_error = fed_back != 0.0, float("inf")
    if touched.any() and np.all(np.isfinite(forces)):
        error, size = (applied - fed_back)[touched], fed_back[touched]
        tracking_error = float(np.sqrt(np.mean(error**2) / np.mean(size**2)))
    time_s, stable = np.arange(len(hand_m)) / loop.sample_rate_hz, is_stable(loop, sensor, sections)
    return FeedbackRun(time_s, applied, indicated, fed_back, stable, tracking_error)


def is_stable(loop: HapticLoop, sensor: LinearSystem, sections: Sections | None) -> bool:
    """Return whether every eigenvalue of the sampled loop decays, with and without contact."""
    regimes = (_matrices(loop, sensor, sections, contact).a for contact in (False, True))
    return all(float(np.max(np.abs(np.linalg.eigvals(a)))) < 1.0 for a in regimes)


def largest_stable_gain(loop: HapticLoop, sensor: LinearSystem, sections: Sections | None) -> float:
    """Return the force gain at the limit of stability, from 0 to 10 000."""

    def stable(gain: float) -> bool:
        return is_stable(replace(loop, force_gain=gain), sensor, sections)

    if not stable(0.0):
        return 0.0
    grid = np.geomspace(1e-3, HIGHEST_GAIN, GRID)
    lost = next((index for index, gain in enumerate(grid) if not stable(float(gain))), None)
    if lost is None:
        return HIGHEST_GAIN
    low, high = (float(grid[lost - 1]) if lost else 0.0), float(grid[lost])
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def _matrices(loop: HapticLoop, sensor: LinearSystem, sections: Sections | None, contact: bool) -> _Matrices:
    """Return the sampled loop of z = [x, v, sensor, last F_a, filter]."""
    plant, drive, output = _plant(loop, sensor)
    size = len(plant)
    af, bf, cf, df = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    if sections is not None:
        af, bf, cf, df = state_space(replace(sections, gain=1.0))
    total = size + 1 + len(bf)
    output_row = np.concatenate([output, [0.0], np.zeros(len(bf))])
    indicated = df * output_row
    indicated[size + 1 :] += cf
    ball, ball_feed = np.zeros(total), np.zeros(3)
    if contact:
        ball[0], ball_feed[2] = loop.ball_stiffness, -loop.ball_stiffness
    gain = loop.force_gain
    a, b = np.zeros((total, total)), np.zeros((total, 3))
    a[:size, :size], a[:size, size], b[:size, :2] = plant, drive[:, 2], drive[:, :2]
    a[size], b[size] = (1.0 + gain) * ball - gain * indicated, (1.0 + gain) * ball_feed
    a[size + 1 :, size + 1 :] = af
    a[size + 1 :] += np.outer(bf, output_row)
    hand, hand_feed = np.zeros(total), np.array([loop.hand_stiffness, loop.hand_damping, 0.0])
    hand[:2] = -hand_feed[:2]
    return _Matrices(a, b, np.stack([hand, indicated, ball]), np.stack([hand_feed, np.zeros(3), ball_feed]))


def _plant(loop: HapticLoop, sensor: LinearSystem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return handle and sensor over one sample: state matrix, input matrix, output in N."""
    from scipy.signal import cont2discrete

    sensor_matrix, into, output = _modal(sensor)
    size = 2 + len(into)
    a, b = np.zeros((size, size)), np.zeros((size, 3))
    hand = np.array([loop.hand_stiffness, loop.hand_damping])
    a[0, 1], a[1, :2], b[1] = 1.0, -hand / loop.mass, np.array([*hand, -1.0]) / loop.mass
    a[1, 1] -= loop.damping / loop.mass
    a[2:, 2:], a[2:, :2], b[2:, :2] = sensor_matrix, -np.outer(into, hand), np.outer(into, hand)
    plant, drive, *_ = cont2discrete((a, b, np.eye(size), np.zeros((size, 3))), 1.0 / loop.sample_rate_hz)
    return plant, drive, np.concatenate([[0.0, 0.0], output])


def _modal(sensor: LinearSystem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B, C of a sensor over its static gain as decoupled modes."""
    from scipy.linalg import block_diag

    if len(sensor.zeros) >= len(sensor.poles):
        raise ValueError("sensor: expected more poles than zeros, found as many")
    blocks: list[list[list[float]]] = []
    into: list[float] = []
    output: list[float] = []
    for pole, residue in zip(sensor.poles, sensor.residues() / sensor.static_gain, strict=True):
        if pole.imag > 0:
            blocks.append([[pole.real, -pole.imag], [pole.imag, pole.real]])
            into += [1.0, 0.0]
            output += [2.0 * residue.real, -2.0 * residue.imag]
        elif pole.imag == 0:
            blocks.append([[pole.real]])
            into.append(1.0)
            output.append(residue.real)
    return block_diag(*blocks), np.array(into), np.array(output)
