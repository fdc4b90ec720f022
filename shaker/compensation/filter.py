"""Compensation filters, scheduled on the load of a sensor, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker.lti.indices import step_shares
from shaker.lti.system import LinearSystem, ModalModel
from shaker.release.load_model import LoadModel
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, check_shape

# Dynamics of a sensor that a filter compensates: modes, real poles and static gain, with covariance.


@dataclass(frozen=True, repr=False)
class SensorDynamics(Arrays):
    """The poles of a sensor that a filter cancels, and the whole sensor.

    Modes `frequency_hz` (M,), rising, with `damping_ratio` (M,); real poles at -2π·`real_hz` (Q,); `static_gain` =
    H(0); the whole sensor `system`, output unit per load unit. `covariance` (P, P), P = 2M + Q + 1, of `vector` =
    [frequency_hz, damping_ratio, real_hz, static_gain], None if unknown. `scatter` (P, P): the part of it from the
    scatter of records, None without.
    """

    frequency_hz: FloatArray
    damping_ratio: FloatArray
    real_hz: FloatArray
    static_gain: float
    system: LinearSystem
    covariance: FloatArray | None = None
    scatter: FloatArray | None = None

    def __post_init__(self) -> None:
        modes, reals = len(self.frequency_hz), len(self.real_hz)
        check_shape("damping_ratio", self.damping_ratio, (modes,))
        if modes + reals == 0:
            raise ValueError("frequency_hz: expected a mode or a real pole to compensate, found none")
        for name in ("frequency_hz", "real_hz"):
            if not np.all(getattr(self, name) > 0):
                raise ValueError(f"{name}: expected positive numbers, found {getattr(self, name).tolist()}")
        if np.any(self.damping_ratio < 0) or np.any(self.damping_ratio >= 1):
            found = self.damping_ratio.tolist()
            raise ValueError(f"damping_ratio: expected 0 or more and below 1 of a stable sensor, found {found}")
        if not np.isfinite(self.static_gain) or self.static_gain == 0:
            raise ValueError(f"static_gain: expected a number other than 0, found {self.static_gain}")
        for name in ("covariance", "scatter"):
            if getattr(self, name) is not None:
                check_shape(name, getattr(self, name), (2 * modes + reals + 1,) * 2)

    @property
    def vector(self) -> FloatArray:
        """All parameters (P,) in the order of `covariance`."""
        return np.concatenate([self.frequency_hz, self.damping_ratio, self.real_hz, [self.static_gain]])

    @property
    def other_poles(self) -> ComplexArray:
        """Uncancelled poles of the whole sensor in rad/s."""
        left = list(self.system.poles)
        for pole in np.concatenate(cancelled_poles(self)):
            left.pop(int(np.argmin(np.abs(np.array(left) - pole))))
        return np.array(left, dtype=np.complex128)

    @property
    def u(self) -> FloatArray:
        """Standard uncertainties (P,) of `vector`, NaN without a covariance."""
        if self.covariance is None:
            return np.full(len(self.vector), np.nan)
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def single_mode(frequency_hz: float, damping_ratio: float, static_gain: float = 1.0) -> SensorDynamics:
    """Return the exact dynamics G = gain·ω²/(s² + 2ζωs + ω²)."""
    omega = 2 * np.pi * frequency_hz
    below = np.array([1.0, 2 * damping_ratio * omega, omega**2])
    system = LinearSystem.from_coefficients(np.array([static_gain * omega**2]), below)
    frequency, damping = np.array([float(frequency_hz)]), np.array([float(damping_ratio)])
    return SensorDynamics(frequency, damping, np.zeros(0), static_gain, system)


def modal_dynamics(model: ModalModel, *, modes: int = 1, real_poles: bool = False) -> SensorDynamics:
    """Return the `modes` with the largest shares in the step response, optionally real poles."""
    count = len(model.frequency_hz)
    if not 0 <= modes <= count:
        raise ValueError(f"modes: expected 0 to {count}, as many as the model has, found {modes}")
    share = np.abs(model.residue / model.poles[:count])
    chosen = np.argsort(-share, kind="stable")[:modes]
    chosen = chosen[np.argsort(model.frequency_hz[chosen])]

    def vector(one: ModalModel) -> FloatArray:
        reals = one.real_hz if real_poles else np.zeros(0)
        return np.concatenate([one.frequency_hz[chosen], one.damping_ratio[chosen], reals, [one.static_gain]])

    value, covariance = (vector(model), None) if model.covariance is None else model.propagate(vector)
    f, zeta, real, gain = np.split(value, np.cumsum([modes, modes, len(value) - 2 * modes - 1]))
    return SensorDynamics(f, zeta, real, float(gain[0]), model.system, covariance)


def loaded_dynamics(model: LoadModel, load_mass: float, *, modes: int = 1) -> SensorDynamics:
    """Return the dynamics with a load in kg: modes with the largest shares."""
    system = model.system(load_mass)
    upper = np.flatnonzero(system.poles.imag > 0)
    if not len(upper):
        raise ValueError(f"load_mass: expected a load with which the sensor oscillates, found {load_mass} kg")
    if modes < 0:
        raise ValueError(f"modes: expected 0 or more, found {modes}")
    chosen = np.sort(np.argsort(-step_shares(system)[upper], kind="stable")[:modes])

    def vector(one: LinearSystem) -> FloatArray:
        poles = one.poles[one.poles.imag > 0][chosen]
        return np.concatenate([np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles), [one.static_gain]])

    covariance = None
    if model.total_covariance is not None:
        covariance = model.propagate(lambda one: vector(one.system(load_mass)))[1]
        covariance[-1, -1] += model.u_sensitivity**2
    f, zeta, gain = np.split(vector(system), [len(chosen), 2 * len(chosen)])
    return SensorDynamics(f, zeta, np.zeros(0), float(gain[0]), system, covariance)


# Target dynamics of a compensated sensor.

MODE_SPACING = 2.0
"""Smallest spacing of further modes over the target's frequency."""


@dataclass(frozen=True)
class CompensationTarget:
    """Target frequency in Hz and damping ratio of the lowest compensated mode.

    Further compensated modes have the same damping ratio and their frequency, but at least twice, four times, … the
    target's. `real_hz`: target of the slowest compensated real pole, the others change by the same factor; required
    only with a real pole. `low_pass_hz`: corner of a second-order Butterworth low-pass in the filter, None without. It
    reduces the noise.
    """

    frequency_hz: float
    damping_ratio: float
    real_hz: float | None = None
    low_pass_hz: float | None = None

    def __post_init__(self) -> None:
        for name in ("frequency_hz", "damping_ratio", "real_hz", "low_pass_hz"):
            value = getattr(self, name)
            if value is not None and not (value > 0 and np.isfinite(value)):
                raise ValueError(f"{name}: expected a positive number, found {value}")


def best_damping(permitted_error: float) -> float:
    """Return the damping ratio with the widest band 1 ± δ of one mode.

    Its peak 1/(2ζ√(1 - ζ²)) is 1 + δ: ζ² = [1 - √(1 - (1 + δ)⁻²)]/2; 0.540 for 10 %, 0.590 for 5 %.
    """
    if not 0 < permitted_error < 1:
        raise ValueError(f"permitted_error: expected above 0 and below 1, found {permitted_error}")
    return float(np.sqrt(0.5 * (1.0 - np.sqrt(1.0 - (1.0 + permitted_error) ** -2))))


def band_ratio(damping_ratio: float, permitted_error: float) -> float:
    """Return f/fn up to which one mode stays within |H|/H(0) = 1 ± δ.

    With x = (f/fn)², |H|⁻² = x² - 2(1 - 2ζ²)x + 1; the lower of the roots for 1 + δ, if it is crossed, and 1 - δ.
    """
    middle = 1.0 - 2.0 * damping_ratio**2
    up = middle**2 - 1.0 + (1.0 + permitted_error) ** -2
    if middle > 0 and up > 0:
        return float(np.sqrt(middle - np.sqrt(up)))
    return float(np.sqrt(middle + np.sqrt(middle**2 - 1.0 + (1.0 - permitted_error) ** -2)))


def cancelled_poles(sensor: SensorDynamics) -> list[ComplexArray]:
    """Return the cancelled poles in rad/s: the pair of each mode, then each real pole."""
    pairs = [mode_poles(f, z) for f, z in zip(sensor.frequency_hz, sensor.damping_ratio, strict=True)]
    return [*pairs, *(np.array([-2 * np.pi * f + 0j]) for f in sensor.real_hz)]


def target_poles(sensor: SensorDynamics, target: CompensationTarget) -> list[ComplexArray]:
    """Return the poles in rad/s that replace the cancelled ones, by section."""
    poles = []
    if len(sensor.frequency_hz):
        least = target.frequency_hz * MODE_SPACING * np.arange(1, len(sensor.frequency_hz))
        frequencies = [target.frequency_hz, *np.maximum(sensor.frequency_hz[1:], least)]
        poles = [mode_poles(float(f), target.damping_ratio) for f in frequencies]
    if len(sensor.real_hz):
        if target.real_hz is None:
            raise ValueError("real_hz: expected the target of the slowest real pole, found none")
        factor = target.real_hz / np.min(sensor.real_hz)
        poles += [np.array([-2 * np.pi * factor * f + 0j]) for f in sensor.real_hz]
    return poles


def low_pass_poles(target: CompensationTarget) -> list[ComplexArray]:
    """Return the poles in rad/s of the low-pass section, or no section."""
    return [] if target.low_pass_hz is None else [mode_poles(target.low_pass_hz, float(np.sqrt(0.5)))]


def mode_poles(frequency_hz: float, damping_ratio: float) -> ComplexArray:
    """Return both poles in rad/s of a mode, real for a damping ratio from 1."""
    root = np.sqrt(complex(damping_ratio**2 - 1.0))
    return np.asarray(2 * np.pi * frequency_hz * np.array([-damping_ratio + root, -damping_ratio - root]))


# Continuous compensation filter: the sensor's denominator over that of the target.


@dataclass(frozen=True)
class Compensation:
    """Continuous compensation filter: denominator of the sensor over that of the target.

    Attributes
    ----------
    sensor : dynamics with the poles to cancel
    target : target dynamics, at least as many poles, so that the filter is proper
    calibrated : static gain 1/H(0), so that the output is the load; default False: static gain 1

    Notes
    -----
    G_c(s) = gain·Π_i [Π(s - zero)/Π(s - pole)]_i, each factor i scaled to 1 at s = 0 (paper "load characteristics",
    eqs. 15 and 17, for one mode).

    Examples
    --------
    >>> from shaker import Compensation
    >>> from shaker.compensation.filter import CompensationTarget, single_mode
    >>> faster = Compensation(single_mode(300.0, 0.02), CompensationTarget(1000.0, 0.7))
    >>> print(f"gain {abs(faster.system.response([1000.0])[0]):.1f} at 1 kHz")
    gain 7.2 at 1 kHz
    """

    sensor: SensorDynamics
    target: CompensationTarget
    calibrated: bool = False

    def __post_init__(self) -> None:
        target_poles(self.sensor, self.target)

    @property
    def gain(self) -> float:
        """G_c(0)."""
        return 1.0 / self.sensor.static_gain if self.calibrated else 1.0

    @property
    def factors(self) -> list[tuple[ComplexArray, ComplexArray]]:
        """Zeros and poles in rad/s of every factor: low-pass, modes, real poles."""
        first = [(np.zeros(0, dtype=np.complex128), poles) for poles in low_pass_poles(self.target)]
        return [*first, *zip(cancelled_poles(self.sensor), target_poles(self.sensor, self.target), strict=True)]

    @property
    def system(self) -> LinearSystem:
        """The filter as zeros, poles and gain."""
        zeros, poles = (np.concatenate(part) for part in zip(*self.factors, strict=True))
        return LinearSystem(zeros, poles, self.gain * float(np.real(np.prod(poles) / np.prod(zeros))))

    @property
    def compensated(self) -> LinearSystem:
        """Sensor and filter in a row, without the cancelled poles."""
        whole, made = self.sensor.system, self.system
        return LinearSystem(whole.zeros, np.concatenate([self.sensor.other_poles, made.poles]), made.gain * whole.gain)

    def sensitivities(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return ∂ ln G_c/∂θ (K, P) by the parameters of `sensor.vector`.

        A mode has the factor 1 + 2ζs/ω + s²/ω², a real pole 1 + s/a; the static gain counts if calibrated.
        """
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None]
        omega, a = 2 * np.pi * self.sensor.frequency_hz, 2 * np.pi * self.sensor.real_hz
        zeta = self.sensor.damping_ratio
        mode = 1.0 + 2.0 * zeta * s / omega + (s / omega) ** 2
        by_frequency = -2 * np.pi * (2.0 * zeta * s / omega**2 + 2.0 * s**2 / omega**3) / mode
        by_real = -2 * np.pi * s / a**2 / (1.0 + s / a)
        by_gain = np.full_like(s, -1.0 / self.sensor.static_gain if self.calibrated else 0.0)
        return np.concatenate([by_frequency, 2.0 * s / omega / mode, by_real, by_gain], axis=1)


# Digital compensation filter: second-order sections of static gain 1, and discretisation error.

Discretisation = Literal["matched", "tustin"]
HIGHEST_SHARE = 0.45
"""Largest frequency of a pole or zero over the sampling rate."""
DISCRETE_RELATIVE_STEP = 1e-6  # of central differences


@dataclass(frozen=True, repr=False)
class Sections(Arrays, shapes="sos S 6"):
    """Second-order sections of a digital filter at `sample_rate_hz`.

    y = gain·Π_i (b0 + b1 z⁻¹ + b2 z⁻²)/(1 + a1 z⁻¹ + a2 z⁻²) u. `sos` (S, 6): rows [b0, b1, b2, 1, a1, a2] in
    processing order. Each has the static gain 1, so that a change of the coefficients between two samples does not
    affect a constant signal.
    """

    sos: FloatArray
    gain: float
    sample_rate_hz: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(self.sos[:, 3] != 1.0):
            raise ValueError(f"sos: expected sections with a0 = 1, found {self.sos[:, 3].tolist()}")

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the frequency response (K,) in powers of 1 - z⁻¹, which avoids cancellation."""
        w = -np.expm1(-2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None] / self.sample_rate_hz)
        c0, c1, c2 = self.sos.reshape(-1, 2, 3).transpose(2, 1, 0)  # numerator and denominator of every section
        top, bottom = (c0 + c1 + c2)[:, None] + w * ((-c1 - 2.0 * c2)[:, None] + w * c2[:, None])
        return np.asarray(self.gain * np.prod(top / bottom, axis=1))


def discretise(compensation: Compensation, sample_rate_hz: float, method: Discretisation = "matched") -> Sections:
    """Return the digital filter at a sampling rate.

    "matched": z = exp(s/fs) of every pole and zero, so that the zeros cancel the poles of the sampled sensor at every
    rate. "tustin": s = K(z - 1)/(z + 1) with K = ω/tan(ω/2fs), which keeps the frequency of every cancelled mode.
    """
    if method not in ("matched", "tustin"):
        raise ValueError(f'method: expected "matched" or "tustin", found "{method}"')
    fastest = max(float(np.max(np.abs(np.concatenate(factor)))) for factor in compensation.factors) / (2 * np.pi)
    if not fastest <= HIGHEST_SHARE * sample_rate_hz:
        least = fastest / HIGHEST_SHARE
        expected = f"at least {least:.6g} for a filter to {fastest:.6g} Hz"
        raise ValueError(f"sample_rate_hz: expected {expected}, found {sample_rate_hz:g}")
    rows = [section_row(zeros, poles, sample_rate_hz, method) for zeros, poles in compensation.factors]
    return Sections(np.stack(rows), compensation.gain, float(sample_rate_hz))


def pad_sections(sections: Sections, count: int) -> Sections:
    """Return the filter as `count` sections; the added ones have the gain 1."""
    if count < len(sections.sos):
        raise ValueError(f"count: expected at least {len(sections.sos)}, as many as there are, found {count}")
    more = np.tile([1.0, 0.0, 0.0, 1.0, 0.0, 0.0], (count - len(sections.sos), 1))
    return Sections(np.concatenate([sections.sos, more]), sections.gain, sections.sample_rate_hz)


def section_row(zeros: ComplexArray, poles: ComplexArray, rate_hz: float, method: Discretisation) -> FloatArray:
    """Return one section (6,) of zeros and poles in rad/s, with static gain 1.

    A low-pass, which has no zeros, always uses Tustin's rule, prewarped at its corner.
    """
    constant = None
    if method == "tustin" or not len(zeros):
        omega = float(np.abs(zeros[0] if len(zeros) else poles[0]))
        constant = omega / np.tan(0.5 * omega / rate_hz)
    if not len(zeros):
        bottom, rest = _polynomial(poles, rate_hz, constant)
        return np.concatenate([np.array([0.25, 0.5, 0.25]) * rest, bottom])
    (top, rest_top), (bottom, rest_bottom) = (_polynomial(part, rate_hz, constant) for part in (zeros, poles))
    return np.concatenate([top * (rest_bottom / rest_top), bottom])


def _polynomial(roots: ComplexArray, rate_hz: float, constant: float | None) -> tuple[FloatArray, float]:
    """Return Π(1 - r z⁻¹) (3,) of the images r, and its static value."""
    if constant is None:
        images, rest = np.exp(roots / rate_hz), -np.expm1(roots / rate_hz)
    else:
        images, rest = (1.0 + roots / constant) / (1.0 - roots / constant), -2.0 * roots / (constant - roots)
    coefficients = np.array([1.0, 0.0, 0.0])
    coefficients[1] = -np.sum(images).real
    coefficients[2] = np.prod(images).real if len(roots) == 2 else 0.0
    return coefficients, float(np.prod(rest).real)


def parameter_sections(
    compensation: Compensation, sample_rate_hz: float, method: Discretisation = "matched"
) -> tuple[Sections, ...]:
    """Return the filters of ∂y/∂θ, one per parameter θ of `sensor.vector`.

    They are the filter with ∂b/∂θ instead of b in the section of θ, by central differences.
    """
    base, sensor = discretise(compensation, sample_rate_hz, method), compensation.sensor
    modes, reals = len(sensor.frequency_hz), len(sensor.real_hz)
    first, targets = len(base.sos) - modes - reals, target_poles(sensor, compensation.target)

    def numerator(parameter: int, section: int, by: float) -> FloatArray:
        """Return the numerator of a section for a changed sensor value and the same target."""
        value = sensor.vector.copy()
        value[parameter] += by
        if section < modes:
            zeros = mode_poles(value[section], value[modes + section])
        else:
            zeros = np.array([-2 * np.pi * value[modes + section] + 0j])
        return section_row(zeros, targets[section], sample_rate_hz, method)[:3]

    slopes = []
    for parameter, section in enumerate([*range(modes), *range(modes), *(modes + np.arange(reals))]):
        size = DISCRETE_RELATIVE_STEP * (1.0 if modes <= parameter < 2 * modes else sensor.vector[parameter])
        sos = base.sos.copy()
        change = numerator(parameter, section, size) - numerator(parameter, section, -size)
        sos[first + section, :3] = change / (2.0 * size)
        slopes.append(Sections(sos, base.gain, base.sample_rate_hz))
    by_gain = -base.gain / sensor.static_gain if compensation.calibrated else 0.0
    return (*slopes, Sections(base.sos, by_gain, base.sample_rate_hz))


def discretisation_error(compensation: Compensation, sections: Sections, frequency_hz: FloatArray) -> ComplexArray:
    """Return G_d/G_c - 1 (K,) of the digital and the continuous filter."""
    return np.asarray(sections.response(frequency_hz) / compensation.system.response(frequency_hz) - 1.0)


# Streaming compensation filter.


class CompensationFilter:
    """Streaming compensation filter for blocks (C, N) of `channels` channels.

    It keeps its state between blocks: any split into blocks gives the same bits as one block.

    Parameters
    ----------
    sections
        the filter
    channels
        number of channels C, default 1
    level
        (C,) or a number, level at which the filter starts settled, unit of the input, default 0; None: the first
        sample

    Notes
    -----
    `switch` changes the coefficients before the next sample. Every section keeps its last two inputs and outputs, so
    that the output is continuous. A constant signal is not affected; a smooth one changes by at most its change over
    one sample.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import Compensation, CompensationFilter
    >>> from shaker.compensation.filter import CompensationTarget, discretise, single_mode
    >>> sections = discretise(Compensation(single_mode(300.0, 0.02), CompensationTarget(1000.0, 0.7)), 20e3)
    >>> run = CompensationFilter(sections, level=None)
    >>> first, second = run(np.ones((1, 100))), run(np.ones((1, 100)))
    >>> print(first[0, -1].round(9), second[0, -1].round(9))  # a constant load does not change
    1.0 1.0
    """

    def __init__(self, sections: Sections, channels: int = 1, level: FloatArray | float | None = 0.0) -> None:
        if channels < 1:
            raise ValueError(f"channels: expected 1 or more, found {channels}")
        self._sections = sections
        self._channels = channels
        self._past = np.zeros((len(sections.sos) + 1, 2, channels))
        self._state = np.zeros((len(sections.sos), 2, channels))
        self._started = level is not None
        if level is not None:
            self._settle(np.broadcast_to(np.asarray(level, dtype=np.float64), (channels,)))

    def __call__(self, block: FloatArray) -> FloatArray:
        """Return the compensated block (C, N); samples that are not finite are refused."""
        from scipy.signal import sosfilt

        signal = np.ascontiguousarray(block, dtype=np.float64)
        check_shape("block", signal, (self._channels, None))
        if not np.all(np.isfinite(signal)):
            raise ValueError("block: expected finite samples, found others")
        if not signal.shape[1]:
            return signal
        if not self._started:
            self._settle(signal[:, 0])
            self._started = True
        self._remember(0, signal)
        for number, row in enumerate(self._sections.sos):
            state = np.ascontiguousarray(self._state[number].T)[None]
            signal, after = sosfilt(row[None], signal, axis=1, zi=state)
            self._state[number] = after[0].T
            self._remember(number + 1, signal)
        return np.asarray(self._sections.gain * signal)

    def switch(self, sections: Sections) -> None:
        """Use other coefficients from the next sample on, with equal number of sections and rate."""
        if sections.sos.shape != self._sections.sos.shape:
            raise ValueError(f"sections: expected {len(self._sections.sos)}, found {len(sections.sos)}")
        if sections.sample_rate_hz != self._sections.sample_rate_hz:
            expected = self._sections.sample_rate_hz
            raise ValueError(f"sections: expected a rate of {expected} Hz, found {sections.sample_rate_hz} Hz")
        self._sections = sections
        for number, (_, b1, b2, _, a1, a2) in enumerate(sections.sos):
            x, y = self._past[number], self._past[number + 1]
            self._state[number, 1] = b2 * x[1] - a2 * y[1]
            self._state[number, 0] = b1 * x[1] - a1 * y[1] + b2 * x[0] - a2 * y[0]

    def _settle(self, level: FloatArray) -> None:
        """Set the state to that of a constant level."""
        self._past[0] = level
        for number, row in enumerate(self._sections.sos):
            self._past[number + 1] = self._past[number] * (np.sum(row[:3]) / np.sum(row[3:]))
        self.switch(self._sections)

    def _remember(self, number: int, signal: FloatArray) -> None:
        """Store the last two samples between two sections, the older first."""
        samples = np.concatenate([self._past[number], signal[:, -2:].T])
        self._past[number] = samples[-2:]
