"""Sensor model: output over force with a load, usable band, correction of phasors and records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker.frf.chain import ChainResponse, common_covariance, split_ratio
from shaker.mechanics import laplace
from shaker.model_notices import SIGNAL_ABOVE_BAND
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, check_shape
from shakercal._common.notices import Notice
from shakercal._common.propagation import covariance_root

# Shapes that a measuring chain can give the sensitivity: delay, lag, low-pass of second order.

ChainKind = Literal["none", "delay", "lag", "butterworth", "second_order", "delay_lag"]

CHAIN_PARAMETERS: dict[ChainKind, tuple[str, ...]] = {
    "none": (),
    "delay": ("delay_s",),
    "lag": ("lag_s",),
    "butterworth": ("lag_s",),
    "second_order": ("lag_s", "square_s2"),
    "delay_lag": ("delay_s", "lag_s"),
}
"""Names of the parameters of each shape, in their order."""


@dataclass(frozen=True, repr=False)
class ChainModel(Arrays, shapes="names P; parameters P"):
    """Response exp(−sD) / (1 + a₁s + a₂s²) of a measuring chain, s = jω.

    `kind` selects the terms. `parameters` (P,) in the order of `CHAIN_PARAMETERS`: D `delay_s`, a₁ `lag_s`, a₂
    `square_s2`. A low-pass of second order has a₁ = 2ζ/ω_c and a₂ = 1/ω_c², a Butterworth filter a₂ = a₁²/2.
    """

    kind: ChainKind
    parameters: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return CHAIN_PARAMETERS[self.kind]

    @property
    def delay_s(self) -> float:
        """Pure delay D."""
        return self._value("delay_s")

    @property
    def lag_s(self) -> float:
        """a₁ = 2ζ/ω_c: the delay of the low-pass at low frequencies."""
        return self._value("lag_s")

    @property
    def square_s2(self) -> float:
        """a₂ = 1/ω_c²."""
        return 0.5 * self.lag_s**2 if self.kind == "butterworth" else self._value("square_s2")

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the response (K,) at frequencies in Hz."""
        s = laplace(frequency_hz)
        return np.asarray(np.exp(-s * self.delay_s) / self._divisor(s))

    def log_slopes(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the derivatives (K, P) of the logarithm of the response by the parameters."""
        s = laplace(frequency_hz)
        divisor = self._divisor(s)
        by_lag = -s * (1.0 + s * self.lag_s) if self.kind == "butterworth" else -s
        columns = {"delay_s": -s, "lag_s": by_lag / divisor, "square_s2": -s * s / divisor}
        return np.array([columns[name] for name in self.names], dtype=np.complex128).reshape(-1, len(s)).T

    def corner(self, covariance: FloatArray) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Return (f_c, u) in Hz and (ζ, u) of a low-pass of second order.

        f_c = 1/(2π√a₂), ζ = a₁/(2√a₂), for a₂ > 0, else None; u from the covariance (P, P) of the parameters.
        """
        if self.kind not in {"butterworth", "second_order"} or not self.square_s2 > 0.0:
            return None
        root = float(np.sqrt(self.square_s2))
        frequency, damping = 1.0 / (2.0 * np.pi * root), 0.5 * self.lag_s / root
        if self.kind == "butterworth":
            slopes = np.array([[-frequency / self.lag_s], [0.0]])
        else:
            slopes = np.array([[0.0, -0.5 * frequency], [0.5 * self.square_s2 / root, -0.5 * damping]]) / self.square_s2
        u = np.sqrt(np.maximum((slopes @ covariance @ slopes.T).diagonal(), 0.0)).tolist()
        return (frequency, u[0]), (damping, u[1])

    def _value(self, name: str) -> float:
        """Return a parameter, 0 if this kind does not have it."""
        return float(self.parameters[self.names.index(name)]) if name in self.names else 0.0

    def _divisor(self, s: ComplexArray) -> ComplexArray:
        """Return 1 + a₁s + a₂s²."""
        return np.asarray(1.0 + self.lag_s * s + self.square_s2 * s * s)


NO_CHAIN = ChainModel("none", np.empty(0))
"""A chain with the response 1."""


# The sensor: output for a force on its load.

SensorExcitation = Literal["base", "force"]

SENSOR_PARAMETERS = ("sensitivity", "stiffness", "damping", "internal_mass")


@dataclass(frozen=True)
class Load:
    """A mass on the sensor and its excitation.

    Attributes
    ----------
    mass : kg, or kg·m² for a rotation; above 0
    drive : "base" if the base below the sensor moves, "force" if a force acts on the load
    u_mass : standard uncertainty of `mass`, default 0

    Examples
    --------
    >>> from shaker import Load
    >>> Load(mass=4.236, drive="force", u_mass=3e-4)
    Load(mass=4.236, drive='force', u_mass=0.0003)
    """

    mass: float
    drive: SensorExcitation
    u_mass: float = 0.0

    def __post_init__(self) -> None:
        if not (self.mass > 0.0 and self.u_mass >= 0.0):
            raise ValueError(
                f"mass, u_mass: expected mass > 0 and u_mass >= 0, found {self.mass:g} and {self.u_mass:g}"
            )


@dataclass(frozen=True, repr=False)
class SensorModel(Arrays):
    """Static sensitivity, spring, damper, internal mass and measuring chain of a sensor.

    `sensitivity` S₀ in `unit`, `stiffness` k in N/m, `damping` b in kg/s, `internal_mass` m_i in kg, which may be
    estimated below 0; for a rotation N·m/rad, N·m·s/rad and kg·m². `covariance` (4 + P, 4 + P) of [S₀, k, b, m_i,
    parameters of the chain], NaN for a model that its data refute.
    """

    sensitivity: float
    stiffness: float
    damping: float
    internal_mass: float
    chain: ChainModel
    covariance: FloatArray
    unit: str

    def __post_init__(self) -> None:
        count = len(SENSOR_PARAMETERS) + len(self.chain.names)
        check_shape("covariance", self.covariance, (count, count))
        if not self.stiffness > 0.0:
            raise ValueError(f"stiffness: expected k > 0, found {self.stiffness:g}")

    def resonance_hz(self, load: Load) -> float:
        """Return √(k/(m + m_i))/2π, the undamped resonance with a load."""
        total = load.mass + self.internal_mass
        if not total > 0.0:
            raise ValueError(f"load: expected a positive sum of load and internal mass, found {total:g}")
        return float(np.sqrt(self.stiffness / total) / (2.0 * np.pi))

    def output_factor(self, frequency_hz: FloatArray, load: Load) -> ComplexArray:
        """Return the output per force on the load (K,), in `unit`, at frequencies in Hz.

        `force`: S₀·k/(k − (m + m_i)ω² + jωb)·chain. `base`, where m·a is the force on the load and (m + m_i)·a that in
        the spring: S₀·(1 + m_i/m)/(1 + jωb/k)·chain.
        """
        gain = self.sensitivity * (1.0 + self.internal_mass / load.mass if load.drive == "base" else 1.0)
        return np.asarray(gain / self._divisor(laplace(frequency_hz), load) * self.chain.response(frequency_hz))

    def log_slopes(self, frequency_hz: FloatArray, load: Load) -> ComplexArray:
        """Return derivatives (K, 4 + P + 1) of ln `output_factor` by parameters and load."""
        s, total = laplace(frequency_hz), load.mass + self.internal_mass
        divisor = self._divisor(s, load)
        by_force = np.asarray(-s * s / self.stiffness / divisor)
        mass = by_force if load.drive == "force" else np.full(len(s), 1.0 / total + 0j)
        by_load = mass if load.drive == "force" else mass - 1.0 / load.mass
        columns = [
            np.full(len(s), 1.0 / self.sensitivity + 0j),
            (divisor - 1.0) / self.stiffness / divisor,
            -s / self.stiffness / divisor,
            mass,
            *self.chain.log_slopes(frequency_hz).T,
            by_load,
        ]
        return np.stack(columns, axis=1)

    def covariance_root(self, load: Load) -> FloatArray:
        """Return deviations (4 + P + 1, E) of parameters and load mass."""
        count = len(self.covariance)
        if np.any(np.isnan(self.covariance)):  # a model that its data refute
            return np.full((count + 1, 1), np.nan)
        whole = np.zeros((count + 1, count + 1))
        whole[:count, :count], whole[count, count] = self.covariance, load.u_mass**2
        return covariance_root(whole)

    def response(self, frequency_hz: FloatArray, load: Load) -> ChainResponse:
        """Return `output_factor` with the relative deviations from the parameters' covariance."""
        errors = (self.log_slopes(frequency_hz, load) @ self.covariance_root(load)).T
        causes = tuple(f"sensor model {number}" for number in range(1, len(errors) + 1))
        return ChainResponse(self.output_factor(frequency_hz, load), np.asarray(errors), causes)

    def _divisor(self, s: ComplexArray, load: Load) -> ComplexArray:
        """Return (k + bs)/k, for a force plus Ms²/k."""
        mass = load.mass + self.internal_mass if load.drive == "force" else 0.0
        return np.asarray(1.0 + (self.damping + s * mass) * s / self.stiffness)


# Usable band of the static sensitivity.


Limit = Literal["rise", "drop", "phase", "nothing"]

_LIMITS: tuple[Limit, Limit, Limit] = ("rise", "drop", "phase")
_POINTS_PER_DECADE = 200  # of the grid that brackets the first edge: steps of 1 %


@dataclass(frozen=True)
class UsableBand:
    """Frequencies from 0 to `upper_hz` in which the output stays within a permitted deviation.

    `permitted`: relative deviation of the magnitude from its static value. `permitted_phase_rad`: deviation of the
    phase, None if it is not limited. `limit`: the criterion that limits the band; `upper_hz` is infinite if none does.
    """

    upper_hz: float
    u_upper_hz: float
    permitted: float
    permitted_phase_rad: float | None
    limit: Limit


def usable_band(
    model: SensorModel, load: Load, permitted: float, permitted_phase_rad: float | None = None
) -> UsableBand:
    """Return the band with `output_factor` within ± `permitted` of its value at f → 0.

    The factor (1 + m_i/m) of a moving base does not depend on frequency and is not a deviation here. Light damping
    without a chain gives f = f₀√(p/(1 + p)) for a force on the load: 0.2182 f₀ at 5 %, 0.3015 f₀ at 10 %. The edge
    moves with the parameters by -(∂Λ/∂θ)/(∂Λ/∂f), Λ the logarithm of the magnitude, or the phase.
    """
    if not 0.0 < permitted < 1.0:
        raise ValueError(f"permitted: expected a share between 0 and 1, found {permitted:g}")
    if permitted_phase_rad is not None and not 0.0 < permitted_phase_rad < np.pi:
        raise ValueError(f"permitted_phase_rad: expected more than 0 and less than π, found {permitted_phase_rad:g}")
    from scipy import optimize

    def excess(frequency_hz: FloatArray) -> FloatArray:
        ratio = model.output_factor(frequency_hz, load) / model.output_factor(np.zeros(1), load)
        size = np.abs(ratio)
        rotated = np.abs(np.angle(ratio)) - (np.inf if permitted_phase_rad is None else permitted_phase_rad)
        return np.stack([size - 1.0 - permitted, 1.0 - permitted - size, rotated])

    # From far below to far above all time constants, dense enough to meet the first edge.
    chain = model.chain
    times = [model.damping / model.stiffness, chain.delay_s, chain.lag_s, abs(chain.square_s2) ** 0.5]
    times += [1.0 / (2.0 * np.pi * model.resonance_hz(load))] if load.drive == "force" else []
    scales = [1.0 / (2.0 * np.pi * abs(time)) for time in times if time != 0.0] or [1.0]
    low, high = 1e-3 * min(scales), 1e2 * max(scales)
    grid = np.geomspace(low, high, int(_POINTS_PER_DECADE * np.log10(high / low)) + 1)
    outside = excess(grid) > 0.0
    if not outside.any():
        return UsableBand(np.inf, 0.0, permitted, permitted_phase_rad, "nothing")
    last = int(np.argmax(outside.any(axis=0)))
    first = float(grid[last - 1]) if last else 0.0
    edges = []
    for i in np.flatnonzero(outside[:, last]).tolist():
        edge = optimize.brentq(lambda f, i=i: excess(np.array([f]))[i, 0], first, grid[last], xtol=1e-9 * grid[last])
        edges.append((float(edge), i))
    upper, which = min(edges)
    turn, near = -1j if _LIMITS[which] == "phase" else 1.0, upper * (1.0 + np.array([-1e-5, 1e-5]))
    slopes = model.log_slopes(np.array([upper]), load) - model.log_slopes(np.zeros(1), load)
    moved = np.linalg.norm((turn * slopes @ model.covariance_root(load)).real)
    (change,) = np.diff(turn * np.log(model.output_factor(near, load))).real / np.diff(near)
    u = float(moved / abs(change))
    return UsableBand(upper, u, permitted, permitted_phase_rad, _LIMITS[which])


# Force on the load from the sensor's output by the inverse model, with its uncertainty.


TRANSITION = 0.25
"""Width of the taper's transition over the band; shorter ones need longer filters."""
ATTENUATION_DB = 100.0
"""Attenuation of the taper above the band, equal to its ripple below: 1e-5."""


@dataclass(frozen=True, repr=False)
class CorrectedPhasors(Arrays):
    """Phasors of the force and the errors from the sensor model.

    `phasors` contain the random covariance only. `errors` (E, K, 1): relative deviations from E independent causes,
    common to all lines and channels.
    """

    phasors: Phasors
    errors: ComplexArray

    def __post_init__(self) -> None:
        check_shape("errors", self.errors, (None, len(self.phasors.frequency_hz), 1))

    @property
    def covariance(self) -> FloatArray:
        """Covariance (K, 2C, 2C) of phasors and model errors together."""
        return np.asarray(self.phasors.covariance + common_covariance(self.phasors.value, self.errors))


@dataclass(frozen=True, repr=False)
class CorrectedRecord(Arrays, shapes="force N; u N; errors E N"):
    """Force on the load (N,) at the sampling instants of the output, up to `band_hz`.

    `u` (N,): standard uncertainty from noise and model. `errors` (E, N): force for one standard deviation of each of E
    independent causes of the model. Within `settling` samples of either end the result depends on the signal outside
    the record. `removed_rms`: rms of the output above the band, as force by the static factor.
    """

    force: FloatArray
    u: FloatArray
    errors: FloatArray
    unit: str
    sample_rate_hz: float
    band_hz: float
    settling: int
    removed_rms: float
    notices: tuple[Notice, ...]


def correct_phasors(phasors: Phasors, model: SensorModel, load: Load) -> CorrectedPhasors:
    """Return the force on the load from phasors of the output: divided by `output_factor`.

    Parameters
    ----------
    phasors
        phasors of the output, one channel or more
    model
        identified sensor model
    load
        mass on the sensor and its excitation

    Returns
    -------
    CorrectedPhasors : phasors of the force and the deviations that the model's covariance causes

    Examples
    --------
    >>> from shaker import Load, correct_phasors
    >>> force = correct_phasors(lines, sensor, Load(mass=4.236, drive="force")).phasors  # doctest: +SKIP
    """
    output, force = split_ratio(model.unit)
    other = [unit for unit in phasors.unit if unit != output]
    if other:
        raise ValueError(f"phasors: expected the output in {output}, found {', '.join(other)}")
    response = model.response(phasors.frequency_hz, load)
    corrected = phasors.scaled(1.0 / response.value[:, None], [force] * len(phasors.unit))
    return CorrectedPhasors(corrected, response.errors[:, :, None])


def correct_record(
    output: FloatArray, sample_rate_hz: float, model: SensorModel, load: Load, band_hz: float, *, u_noise: float = 0.0
) -> CorrectedRecord:
    """Return the force on the load from a uniformly sampled record of the output.

    Parameters
    ----------
    output
        (N,) record in the output unit of `model`
    sample_rate_hz
        sampling rate, Hz
    model
        identified sensor model
    load
        mass on the sensor and its excitation
    band_hz
        upper limit of the corrected band, Hz
    u_noise
        standard deviation of white noise of one sample, default 0

    Returns
    -------
    CorrectedRecord : force, its standard uncertainty and errors

    Raises
    ------
    ValueError : the record is shorter than the filter, or the band too wide for the rate

    Notes
    -----
    The spectrum is divided by `output_factor` and multiplied by a taper of zero phase: 1 up to `band_hz`, 0 from (1 +
    `TRANSITION`)·`band_hz`. The taper is the response of a symmetric Kaiser-window filter of 2h + 1 taps. The record is
    continued by its odd reflection over h samples and the delay of the chain at both ends. The covariance of the model
    is propagated by derivatives.

    Examples
    --------
    >>> from shaker import Load, correct_record
    >>> load = Load(mass=4.236, drive="force")
    >>> force = correct_record(output, 20e3, sensor, load, band_hz=900.0).force  # doctest: +SKIP
    """
    check_shape("output", output, (None,))
    from scipy import fft

    taps = _taper(sample_rate_hz, band_hz)
    settling = len(taps) // 2 + int(np.ceil(abs(model.chain.delay_s) * sample_rate_hz))
    if len(output) <= settling:
        raise ValueError(
            f"output: expected more than {settling} samples for a band of {band_hz:g} Hz at {sample_rate_hz:g} Hz, "
            f"found {len(output)}"
        )
    size = fft.next_fast_len(len(output) + 2 * settling, real=True)
    frequency = np.arange(size // 2 + 1) * (sample_rate_hz / size)
    taper = np.fft.rfft(np.roll(np.pad(taps, (0, size - len(taps))), -(len(taps) // 2))).real
    before = 2.0 * output[0] - output[settling:0:-1]
    after = 2.0 * output[-1] - output[-2 : -settling - 2 : -1]
    spectrum = np.fft.rfft(np.concatenate([before, output, after]), size)
    inverse = taper / model.output_factor(frequency, load)

    def back(values: ComplexArray) -> FloatArray:
        return np.asarray(np.fft.irfft(values, size, axis=-1)[..., settling : settling + len(output)])

    causes = (model.log_slopes(frequency, load) @ model.covariance_root(load)).T
    errors = back(-causes * inverse * spectrum)
    noise = u_noise * float(np.sqrt(np.mean(np.fft.irfft(inverse, size) ** 2) * size))
    u = np.sqrt(noise**2 + np.sum(errors**2, axis=0))
    static = float(model.output_factor(np.zeros(1), load)[0].real)
    beyond = float(np.std(output - back(taper * spectrum)) / abs(static))
    force = back(inverse * spectrum)
    least = max(float(np.sqrt(np.mean(u**2))), 10.0 ** (-ATTENUATION_DB / 20.0) * float(np.abs(force).max()))
    unit, notices = split_ratio(model.unit)[1], []
    if beyond > least:  # more than uncertainty and ripple
        notices.append(Notice(SIGNAL_ABOVE_BAND, "band", rms=beyond, unit=unit, band_hz=band_hz))
    return CorrectedRecord(force, u, errors, unit, sample_rate_hz, band_hz, settling, beyond, tuple(notices))


def _taper(sample_rate_hz: float, band_hz: float) -> FloatArray:
    highest = 0.5 * sample_rate_hz / (1.0 + TRANSITION)
    if not 0.0 < band_hz <= highest:
        raise ValueError(f"band_hz: expected up to {highest:g} Hz for {sample_rate_hz:g} Hz, found {band_hz:g}")
    from scipy import signal

    width = TRANSITION * band_hz
    count, beta = signal.kaiserord(ATTENUATION_DB, 2.0 * width / sample_rate_hz)
    middle = min(band_hz + 0.5 * width, 0.499999 * sample_rate_hz)
    return np.asarray(signal.firwin(count | 1, middle, window=("kaiser", beta), fs=sample_rate_hz))
