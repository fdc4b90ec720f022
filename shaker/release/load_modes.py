"""Series of loads: output, masses, measured resonances, and load models fitted to them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shaker.labels import mechanical_units
from shaker.release.load_model import upper_poles
from shaker.release.record import ReleaseReading, StepRecord
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, check_shape
from shakercal._common.digits import typeset
from shakercal._common.fitting import BlockJacobian, LinearBlock, LMOptions, SeparablePoint, levenberg_marquardt

# The output, and the masses of a series of loads as named unknowns.


@dataclass(frozen=True)
class SeriesOutput:
    """Recorded output: load component, channel, unit, static output per N or N·m with its u."""

    component: str
    channel: str
    unit: str
    sensitivity: float = 1.0
    u_sensitivity: float = 0.0

    @property
    def mass_unit(self) -> str:
        """Printed unit of the mass, or of the moment of inertia."""
        return typeset(mechanical_units(self.component).inertia)


@dataclass(frozen=True, repr=False)
class SeriesMasses(Arrays, shapes="load R; names Q; moving_effect Q; load_effect R Q"):
    """Moving mass and load masses (R,) in kg, with their named errors.

    One standard uncertainty of each part in `names` (Q,) changes them by `moving_effect` (Q,) and `load_effect` (R, Q).
    An adapter in two records is therefore one unknown.
    """

    moving: float
    load: FloatArray
    names: tuple[str, ...]
    moving_effect: FloatArray
    load_effect: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.moving > 0:
            raise ValueError(f"moving: expected a mass above 0, found {self.moving}")
        if np.any(self.load < 0):
            raise ValueError(f"load: expected masses of at least 0, found {float(np.min(self.load))}")

    @property
    def u_moving(self) -> float:
        """Standard uncertainty of the moving mass."""
        return float(np.linalg.norm(self.moving_effect))

    @property
    def u_load(self) -> FloatArray:
        """Standard uncertainties of the load masses (R,)."""
        return np.asarray(np.linalg.norm(self.load_effect, axis=1))

    def at(self, deviates: FloatArray) -> tuple[float, FloatArray]:
        """Return moving and load masses for deviations (Q,) of the named errors in standard uncertainties."""
        return self.moving + float(self.moving_effect @ deviates), self.load + self.load_effect @ deviates


def stated_masses(moving: float, u_moving: float, load: FloatArray, u_load: FloatArray | None = None) -> SeriesMasses:
    """Return masses with one error each of the moving and every different load mass."""
    loads = np.asarray(load, dtype=np.float64)
    spread = np.zeros(len(loads)) if u_load is None else np.asarray(u_load, dtype=np.float64)
    uncertain = np.unique(loads[spread > 0.0])
    names = ("moving mass", *(f"load mass {value:.6g} kg" for value in uncertain))
    moved = np.append(u_moving, np.zeros(len(uncertain)))
    of_load = np.where(loads[:, None] == uncertain, spread[:, None], 0.0)
    effect = np.hstack([np.zeros((len(loads), 1)), of_load])
    first = 0 if u_moving > 0.0 else 1
    return SeriesMasses(float(moving), loads, names[first:], moved[first:], effect[:, first:])


# Resonances and dampings of every load, from records or stated.


@dataclass(frozen=True, repr=False)
class Resonances(
    Arrays, shapes="names R; frequency_hz R 2; u_frequency_hz R 2; damping_ratio R 2; u_damping_ratio R 2"
):
    """First and second mode of R records, natural frequencies in Hz, NaN where unknown.

    `u_…`: standard uncertainties, 0 if none is stated; the scatter about a model then determines them.
    """

    names: tuple[str, ...]
    frequency_hz: FloatArray
    u_frequency_hz: FloatArray
    damping_ratio: FloatArray
    u_damping_ratio: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        finite = self.frequency_hz[np.isfinite(self.frequency_hz)]
        if np.any(finite <= 0) or np.any(np.isnan(self.frequency_hz[:, 0])):
            raise ValueError("frequency_hz: expected a first resonance above 0 of every record, found none")

    def without_second(self, mask: BoolArray) -> Resonances:
        """Return the resonances without the second modes of the records in a mask (R,)."""
        left_out = mask[:, None] & [False, True]
        values = (self.frequency_hz, self.u_frequency_hz, self.damping_ratio, self.u_damping_ratio)
        return Resonances(self.names, *(np.where(left_out, np.nan, value) for value in values))


def stated_resonances(
    first_hz: FloatArray, u_first_hz: FloatArray | None = None, second_hz: FloatArray | None = None
) -> Resonances:
    """Return resonances without damping: first (R,), second or NaN of equal relative u."""
    first = np.asarray(first_hz, dtype=np.float64)
    u = np.zeros_like(first) if u_first_hz is None else np.asarray(u_first_hz, dtype=np.float64)
    second = np.full_like(first, np.nan) if second_hz is None else np.asarray(second_hz, dtype=np.float64)
    both = np.stack([first, second], axis=1)
    empty = np.full_like(both, np.nan)
    return Resonances(tuple(f"{f:g} Hz" for f in first), both, both * (u / first)[:, None], empty, empty)


# The decimated free oscillation after a release, to which the poles of a load are fitted.

RATE_OVER_FIRST = 16.0
"""Sampling rate over the first resonance: second modes up to six times the first stay in the passband."""
PASSBAND = 0.42  # edge of the decimating filter's passband over the decimated rate
TAPS = 20  # length of the decimating filter, in samples of the decimated record
FEWEST = 64  # samples after the release
SEARCH = LMOptions(initial_damping=1e-4, damping_decrease=0.2, min_damping=1e-15, max_damping=1e12)
"""Damping of a search for poles, stiffnesses and dampings; it ends at a predicted gain of 10⁻¹⁰ of the loss."""


@dataclass(frozen=True, repr=False)
class FreeDecay(Arrays, shapes="time_s N; value N"):
    """The output of one record after the end of its release.

    `value` (N,) at `time_s` (N,) is low-pass filtered and decimated by `decimation`. The filter, as the release of any
    shape, multiplies every exponential by a constant, which the free amplitudes contain; poles do not change.
    """

    name: str
    time_s: FloatArray
    value: FloatArray
    decimation: int

    @property
    def rate_hz(self) -> float:
        """Sampling rate."""
        return float((len(self.time_s) - 1) / (self.time_s[-1] - self.time_s[0]))


def free_decay(record: StepRecord, channel: str, reading: ReleaseReading) -> FreeDecay:
    """Return the free oscillation of one channel after its release."""
    from scipy.signal import firwin, upfirdn

    begin = reading.onset_s + 2.0 * reading.u_onset_s + reading.release_s + reading.u_release_s
    first = int(np.ceil((begin - record.start_s) * record.sample_rate_hz)) + 1
    value = record.samples[record.channels.index(channel)][max(first, 0) :]
    if len(value) < FEWEST:
        raise ValueError(f"record: expected {FEWEST} samples of {record.name} after the release, found {len(value)}")
    rings = value - reading.steady
    size = np.abs(np.fft.rfft((rings - np.mean(rings)) * np.hanning(len(value))))
    peak_hz = float(np.argmax(np.where(np.arange(len(size)) < 3, 0.0, size))) * record.sample_rate_hz / len(value)
    decimation = max(1, int(record.sample_rate_hz / (RATE_OVER_FIRST * peak_hz)))
    time_s = record.start_s + (max(first, 0) + np.arange(len(value))) / record.sample_rate_hz
    if decimation > 1 and len(value) >= (TAPS + FEWEST) * decimation:
        taps = firwin(TAPS * decimation + 1, PASSBAND, window=("kaiser", 6.0), fs=float(decimation))
        whole = (len(value) - len(taps)) // decimation + 1
        value = upfirdn(taps, value - reading.steady, 1, decimation)[TAPS : TAPS + whole] + reading.steady
        time_s = time_s[TAPS * decimation // 2 :: decimation][:whole]
    else:
        decimation = 1
    return FreeDecay(record.name, time_s, np.asarray(value), decimation)


def project_amplitudes(decay: FreeDecay, poles: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return the residual (N,) of free modes (M,) and its derivatives (N, 2M).

    y = b + Σ Re{a_m exp(p_m t)} with b and a_m by linear least squares; derivatives by Re p and Im p of each pole.
    """
    point = free_modes(decay, poles)
    return point.residuals[0][:, 0], -point.solved[0].orthogonal_complement(point.jacobians[0].rows)[:, :, 0]


def free_modes(decay: FreeDecay, poles: ComplexArray) -> SeparablePoint:
    """Return modes (M,) with free amplitudes as a point of [Re p, Im p]."""
    t = decay.time_s - decay.time_s[0]
    waves = np.exp(t[:, None] * poles)

    def changes(coefficients: FloatArray) -> BlockJacobian:
        amplitude = coefficients[1:, 0].reshape(2, -1)
        swing = t[:, None] * waves * (amplitude[0] + 1j * amplitude[1])
        change = np.stack([swing.real, -swing.imag], axis=2).reshape(len(t), -1, 1)
        return BlockJacobian(np.arange(change.shape[1]), change)

    design = np.hstack([np.ones((len(t), 1)), waves.real, -waves.imag])
    parameters = np.stack([poles.real, poles.imag], axis=1).ravel()
    return SeparablePoint(parameters, (LinearBlock(design, decay.value[:, None], changes),))


def coloured_normal(slope: FloatArray, residual: FloatArray) -> FloatArray:
    """Return Jᵀ R J (P, P), R by the smoothed periodogram of the residual (N,)."""
    count = len(residual)
    power = np.abs(np.fft.rfft(residual)) ** 2 / count
    width = min(101, max(3, len(power) // 8) | 1)
    padded = np.pad(power, width // 2, mode="reflect")
    smooth = np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
    lines = np.fft.rfft(slope, axis=0)
    weight = np.full(len(smooth), 2.0)
    weight[0] = 1.0
    if count % 2 == 0:
        weight[-1] = 1.0
    return np.asarray((lines.conj().T * (smooth * weight / count)) @ lines).real


# Modes of one record after its release.

PARTS = (1, 3, 9, 27)  # beginnings of the record, by their share 1/n, for modes of any damping
NEAREST = 2  # number of starts that are fitted, those of least residual
SEPARATE = 1.15  # lowest ratio of a second mode to the first
CLEAR = 8.0  # height of a line over the median of the spectrum of a possible mode
SURE = 1e-6  # largest chance in noise of a second mode that is accepted
HEAVIEST, VAGUEST = 0.3, 0.05
"""Largest damping ratio and relative uncertainty of the frequency of a second mode that is used."""


@dataclass(frozen=True, repr=False)
class RecordModes(Arrays):
    """Upper poles (M,) in rad/s of a record, with their covariance.

    The covariance is of [Re p, Im p] of each mode. `noise`: standard deviation of the residual, in output units.
    """

    name: str
    poles: ComplexArray
    covariance: FloatArray
    noise: float

    @property
    def frequency_hz(self) -> FloatArray:
        """Natural frequencies (M,)."""
        return np.asarray(np.abs(self.poles) / (2.0 * np.pi))

    @property
    def damping_ratio(self) -> FloatArray:
        """Damping ratios (M,)."""
        return np.asarray(-self.poles.real / np.abs(self.poles))

    @property
    def u(self) -> tuple[FloatArray, FloatArray]:
        """Standard uncertainties of frequencies and damping ratios (M,)."""
        p, size, modes = self.poles, np.abs(self.poles), np.arange(len(self.poles))
        by_f = np.stack([p.real, p.imag], axis=1) / (2.0 * np.pi * size[:, None])
        by_zeta = np.stack([-(p.imag**2), p.real * p.imag], axis=1) / size[:, None] ** 3
        blocks = self.covariance.reshape(len(p), 2, len(p), 2)[modes, :, modes]
        u_f, u_zeta = (np.sqrt(np.einsum("mi,mij,mj->m", by, blocks, by)) for by in (by_f, by_zeta))
        return u_f, u_zeta


def record_modes(decay: FreeDecay) -> RecordModes:
    """Return the first mode of a record, and a significant second one."""
    from scipy.special import fdtrc

    one = _fitted(decay, _starts(decay, decay.value - np.mean(decay.value), 0.0), np.zeros(0, dtype=np.complex128))
    left, _ = project_amplitudes(decay, one.poles)
    floor_hz = SEPARATE * float(one.frequency_hz[0])
    starts = _starts(decay, left, floor_hz)
    if not starts:
        return one
    two = _fitted(decay, starts, one.poles)
    free = len(decay.value) - 9
    gain = (one.noise**2 * (free + 4) - two.noise**2 * free) / 4.0 / two.noise**2
    f, z = float(two.frequency_hz[1]), float(two.damping_ratio[1])
    usable = 0.0 < z < HEAVIEST and f > floor_hz and float(two.u[0][1]) < VAGUEST * f
    return two if usable and fdtrc(4, free, max(gain, 0.0)) < SURE else one


def as_resonances(records: list[RecordModes]) -> Resonances:
    """Return the modes of all records as one table."""
    table = np.full((4, len(records), 2), np.nan)
    for r, modes in enumerate(records):
        table[:, r, : len(modes.poles)] = modes.frequency_hz, modes.u[0], modes.damping_ratio, modes.u[1]
    return Resonances(tuple(modes.name for modes in records), *table)


def _starts(decay: FreeDecay, value: FloatArray, above_hz: float) -> list[complex]:
    """Return poles of the highest spectral line, for beginnings of the record."""
    starts = []
    for part in PARTS:
        count = len(value) // part
        if count < 32:
            break
        size = np.abs(np.fft.rfft((value[:count] - np.mean(value[:count])) * np.hanning(count), 4 * count))
        hertz = np.fft.rfftfreq(4 * count, 1.0 / decay.rate_hz)
        size[(hertz <= above_hz) | (hertz < 2.0 * decay.rate_hz / count)] = 0.0
        index = int(np.argmax(size))
        if size[index] > CLEAR * np.median(size[size > 0.0]) or above_hz == 0.0:
            omega, half = 2.0 * np.pi * float(hertz[index]), count // 2
            wave = np.hanning(half) * np.exp(-1j * omega * np.arange(half) / decay.rate_hz)
            early, late = abs(wave @ value[:half]), abs(wave @ value[half : 2 * half])
            rate = float(max(np.log(early / max(late, 1e-300)), 0.1) * decay.rate_hz / half)
            starts.append(complex(-rate, omega))
    return starts


def _fitted(decay: FreeDecay, starts: list[complex], poles_before: ComplexArray) -> RecordModes:
    """Return the best fit from start poles and one additional pole."""
    tried = [free_modes(decay, np.append(poles_before, start)) for start in starts]
    if not tried:
        raise ValueError(f"decay: expected an oscillation after the release of {decay.name}, found none")
    tried.sort(key=lambda point: point.loss)
    ends = [
        levenberg_marquardt(lambda x: free_modes(decay, x[::2] + 1j * x[1::2]), point, SEARCH).point
        for point in tried[:NEAREST]
    ]
    best = min(ends, key=lambda point: point.loss)
    poles = np.asarray(best.parameters[::2] + 1j * best.parameters[1::2])
    residual, slope = project_amplitudes(decay, poles)
    inner = np.linalg.inv(slope.T @ slope)
    free = len(residual) - 1 - 2 * len(best.parameters)
    covariance = inner @ coloured_normal(slope, residual) @ inner * len(residual) / free
    return RecordModes(decay.name, poles, covariance, float(np.sqrt(residual @ residual / free)))


# Fit of load models to the resonances: rows, unknowns, result.

LARGEST = 100.0  # |logarithm| of a stiffness or damping above which a step has diverged
FLOOR = 1e-8  # relative uncertainty if none is stated or estimated yet


@dataclass(frozen=True)
class SeriesProblem:
    """A fit of ln f and ln ζ of the observed modes.

    A rigid load has first modes only. Unknown x (X,): logarithms of k and, unless `rigid`, k_L; then of c and c_L if a
    damping is measured; then the named mass errors in standard uncertainties.
    """

    measured: Resonances
    masses: SeriesMasses
    rigid: bool

    def __post_init__(self) -> None:
        check_shape("masses", self.masses.load, (len(self.measured.names),))
        if not self.rigid and (self.rows[0].sum() < 2 or not np.any(self.masses.load > 0)):
            raise ValueError(
                "measured: expected two resonances, one of them with a load, to determine the coupling, found "
                f"{int(self.rows[0].sum())}"
            )

    @cached_property
    def rows(self) -> tuple[BoolArray, BoolArray]:
        """Masks of the frequencies and of the dampings (R, 2) in the fit."""
        seen = np.isfinite(self.measured.frequency_hz)
        seen[:, 1] &= (self.masses.load > 0) & (not self.rigid)
        return seen, seen & (np.nan_to_num(self.measured.damping_ratio) > 0)

    @cached_property
    def powers(self) -> FloatArray:
        """Powers (P, S) of the exponentials in springs and dampers.

        c_L = c·k_L/k if only one damping is measured; all dampings are 0 without any.
        """
        springs = 1 if self.rigid else 2
        dampers = min(springs, int(self.rows[1].sum()))
        powers = np.zeros((2 * springs, springs + dampers))
        powers[::2, :springs] = np.eye(springs)
        powers[1::2, springs:] = np.eye(springs, dampers)
        if dampers == 1 and springs == 2:
            powers[3] = [-1.0, 1.0, 1.0]
        return powers

    @property
    def springs(self) -> int:
        """Number of stiffnesses."""
        return len(self.powers) // 2

    @property
    def dampers(self) -> int:
        """Number of dampings that the measured ones determine."""
        return int(self.powers.shape[1]) - self.springs

    @property
    def dof(self) -> tuple[int, int]:
        """Degrees of freedom of the frequencies and of the dampings."""
        f, z = self.rows
        return int(f.sum()) - self.springs, int(z.sum()) - self.dampers

    def numbers(self, x: FloatArray) -> FloatArray:
        """Return stiffnesses and dampings of unknowns x, dampings 0 if none is measured."""
        numbers = np.exp(self.powers @ x[: self.powers.shape[1]])
        numbers[1::2] *= self.dampers > 0
        return np.asarray(numbers)

    def unknowns(self, fit: SeriesFit) -> FloatArray:
        """Return the unknowns (X,) that a fit found."""
        springs, dampers = fit.numbers[::2], fit.numbers[1::2][: self.dampers]
        return np.concatenate([np.log(springs), np.log(dampers), fit.deviates])

    def deviates(self, x: FloatArray) -> FloatArray:
        """Return the named mass errors (Q,) among the unknowns."""
        return x[self.powers.shape[1] :]

    def is_sound(self, x: FloatArray) -> bool:
        """Return whether the unknowns x are in the range of a real sensor."""
        moving, loads = self.masses.at(self.deviates(x))
        logarithms = np.abs(x[: self.powers.shape[1]])
        return bool(np.all(logarithms < LARGEST) and moving > 0.0 and np.all(loads[self.masses.load > 0] > 0.0))

    def number_rates(self, x: FloatArray) -> FloatArray:
        """Return the derivatives (P, S) of the numbers by the logarithms of springs and dampers."""
        return np.asarray(self.numbers(x)[:, None] * self.powers)

    def poles(self, x: FloatArray, record: int) -> tuple[ComplexArray, ComplexArray]:
        """Return the upper poles (M,) of one record and their derivatives (M, X)."""
        moving, loads = self.masses.at(self.deviates(x))
        load = float(loads[record]) if self.masses.load[record] > 0 else 0.0
        poles, moved = upper_poles(self.numbers(x), moving, load)
        by_mass = np.outer(moved[:, -2], self.masses.moving_effect)
        by_mass = by_mass + np.outer(moved[:, -1], self.masses.load_effect[record])
        return poles, np.hstack([moved[:, :-2] @ self.number_rates(x), by_mass])

    def modes(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies and damping ratios (2, R, 2) with derivatives of ln f and ζ."""
        values = np.full((2, len(self.masses.load), 2), np.nan)
        rates = np.zeros((*values.shape, len(x)))
        for r in range(values.shape[1]):
            poles, change = self.poles(x, r)
            count, size = len(poles), np.abs(poles)
            along = (np.conj(poles)[:, None] * change).real / size[:, None] ** 2
            values[0, r, :count], values[1, r, :count] = size / (2.0 * np.pi), -poles.real / size
            rates[0, r, :count] = along
            rates[1, r, :count] = -change.real / size[:, None] + (poles.real / size)[:, None] * along
        return values, rates

    def residual(self, x: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return weighted residuals (N + Q,) of ln f, ln ζ, masses, and their derivatives."""
        (f, z), rates = self.modes(x)
        f_rows, z_rows = self.rows
        left, slopes = [np.log(f[f_rows] / self.measured.frequency_hz[f_rows])], [rates[0][f_rows]]
        if self.dampers:
            with np.errstate(invalid="ignore", divide="ignore"):
                left.append(np.log(z[z_rows] / self.measured.damping_ratio[z_rows]))
                slopes.append(rates[1][z_rows] / z[z_rows][:, None])
        prior, by_prior = self.prior(x)
        residual = np.concatenate([np.concatenate(left) / sigma, prior])
        return residual, np.vstack([np.vstack(slopes) / sigma[:, None], by_prior])

    def prior(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the stated masses as residuals (Q,) with their derivatives (Q, X)."""
        deviates = self.deviates(x)
        return deviates, np.eye(len(x))[len(x) - len(deviates) :]

    def stated(self) -> tuple[FloatArray, FloatArray]:
        """Return the stated relative standard uncertainties of the fitted frequencies and dampings."""
        f_rows, z_rows = self.rows
        seen = self.measured
        f = seen.u_frequency_hz[f_rows] / seen.frequency_hz[f_rows]
        z = seen.u_damping_ratio[z_rows] / seen.damping_ratio[z_rows] if self.dampers else np.zeros(0)
        return np.nan_to_num(f), np.nan_to_num(z)

    def groups(self, x: FloatArray) -> list[tuple[FloatArray, FloatArray, int]]:
        """Return deviations, stated uncertainties and dof of ln f and of ln ζ."""
        f, z = self.stated()
        left = self.residual(x, np.ones(len(f) + len(z)))[0]
        parts = left[: len(f)], left[len(f) : len(f) + len(z)]
        return list(zip(parts, (f, z), self.dof, strict=True))

    def sigma(self, scatter: tuple[float, float]) -> FloatArray:
        """Return relative standard deviations (N,) of all rows including `scatter`."""
        parts = [np.sqrt(u**2 + tau**2 + FLOOR**2) for u, tau in zip(self.stated(), scatter, strict=True)]
        return np.concatenate(parts)

    def start(self, ratio: float) -> FloatArray:
        """Return unknowns (X,) for a ratio k_L/k from the lightest load."""
        lightest = int(np.argmin(self.masses.load))
        shape = np.array([1.0, 0.0] if self.rigid else [1.0, 0.0, ratio, 0.0])
        load = float(self.masses.load[lightest])
        omega = 2.0 * np.pi * float(self.measured.frequency_hz[lightest, 0])
        k = (omega / abs(upper_poles(shape, self.masses.moving, load)[0][0])) ** 2
        springs = np.log(k * shape[::2])
        zeta = self.measured.damping_ratio[self.rows[1]]
        dampers = springs[: self.dampers] + (np.log(2.0 * np.median(zeta) / omega) if self.dampers else 0.0)
        return np.concatenate([springs, dampers, np.zeros(len(self.masses.names))])


@dataclass(frozen=True, repr=False)
class SeriesFit(Arrays):
    """Parameters of a load model from a series of R records.

    `numbers` (P,): stiffness and damping, and those of the coupling unless rigid; dampings are 0 if none was measured.
    `deviates` (Q,): named mass errors in standard uncertainties. `covariance` (P + Q, P + Q) of both, None if the
    scatter is unknown. `frequency_hz`, `damping_ratio` (R, 2) of the model. `scatter`: relative standard deviations of
    frequencies and of dampings about the model in addition to the stated ones. `chi_squared` of both for the stated
    uncertainties, with `dof`. `excess`: χ² above that of the best minimum.
    """

    numbers: FloatArray
    deviates: FloatArray
    covariance: FloatArray | None
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    scatter: tuple[float, float]
    chi_squared: tuple[float, float]
    dof: tuple[int, int]
    excess: float = 0.0
