"""Transfer functions of motions that are sampled far below the Nyquist rate."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from shaker.sine.phasor import derivative_factor
from shaker.sine.solve import SineFit
from shaker.timebase.edges import PASS_BAND, kernel_reach, resample
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, IntArray, check_shape

if TYPE_CHECKING:
    from scipy.sparse import csc_array

MOST_UNKNOWNS, MOST_KNOTS, FEWEST_KNOTS = 500, 120, 8
"""Unknowns of one component; splines over the band per channel (chosen for time and memory)."""
MIN_FREE_FRAMES = 20
"""Frames beyond the unknowns without prior (chosen)."""
_DRIFT_HZ = 0.25  # up to which any motion of the frames is drift
_FIRST = 0.8  # of the lowest frequency of the band, from which down motion has a factor per octave
_OUTSIDE = 2  # parts outside the band with a factor of each reference: above it, and the first octave below
_HIGH = (1.05, 1.25, 2.2)  # of the highest one: from here to there motion above has one factor, up to the last
_DEGREE = 3
_RANK = 1e-9  # singular value over the largest, below which a combination of columns is not determined
_ROUNDS, _FALSE_ALARM = 3, 0.01  # of the search for outliers; probability of one by chance
_SMOOTHNESS = np.linspace(-2.0, 12.0, 57)  # decades of the variance of the prior's strongest part over the noise
_COMPATIBLE = 1.0  # rise of -2·log likelihood to the largest variance within one standard deviation
_STEPS = 10  # of the local spread of the prior
_NEIGHBOURS = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9.0


@dataclass(frozen=True)
class ReferenceSignals(Arrays, shapes="values S C; order C"):
    """Channels that are sampled fast enough, at `start_s` + i / `rate_hz`.

    Attributes
    ----------
    values : (S, C), samples.
    order : (C,), time derivatives from a displacement: 0, 1 of velocities, 2 of accelerations, forces and outputs.
    rate_hz, start_s : sampling rate in Hz and time of the first sample in s.
    band_hz : band of the excitation.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker.frf.sampled_motion import ReferenceSignals
    >>> ReferenceSignals(np.zeros((4000, 1)), np.array([2]), 1000.0, 0.0, (20.0, 200.0)).duration_s
    4.0
    """

    values: FloatArray
    order: IntArray
    rate_hz: float
    start_s: float
    band_hz: tuple[float, float]

    @property
    def duration_s(self) -> float:
        """Length of the record."""
        return len(self.values) / self.rate_hz


class _ReferenceSpectra:
    """Displacement-like spectra of the references, and splines over the logarithm of the frequency.

    `value` (M, R): at `frequency_hz` (M,). `weight` (M,), `outside` (O, M): of motion in the band; above it, then in
    octaves below.
    """

    def __init__(self, signals: ReferenceSignals, exposure_s: float) -> None:
        from scipy.fft import next_fast_len

        low, high = signals.band_hz
        self.count = int(np.clip(MOST_UNKNOWNS // (2 * signals.values.shape[1]), FEWEST_KNOTS, MOST_KNOTS))
        self.signals = signals
        self.margin_s = min(4.0 / low, 0.1 * signals.duration_s)  # where the ends of the record act
        length = next_fast_len(len(signals.values) + int(2.0 * self.margin_s * signals.rate_hz))
        frequency_hz: FloatArray = np.fft.rfftfreq(length, 1.0 / signals.rate_hz).astype(np.float64)
        octaves = max(1, round(float(np.log2(_FIRST * low / (2.0 * _DRIFT_HZ)))))
        steps = [low * _FIRST * 0.5**number for number in range(octaves + 1)]
        ramps = [_ramp(frequency_hz, (0.5 * step, step)) for step in steps]
        above = _ramp(frequency_hz, (_HIGH[0] * high, _HIGH[1] * high))
        top = min(_HIGH[2] * high, 0.9 * 0.5 * signals.rate_hz)
        over = _ramp(frequency_hz, (0.9 * top, top))
        self._used = slice(*(np.flatnonzero((ramps[-1] > 0.0) & (over < 1.0))[[0, -1]] + [0, 1]).tolist())
        self.frequency_hz = frequency_hz[self._used]
        outside = [above * (1.0 - over), *(lower - upper for upper, lower in pairwise(ramps))]
        self.outside = np.stack(outside)[:, self._used]
        self.weight = (ramps[0] * (1.0 - above))[self._used]
        centred = signals.values - signals.values.mean(axis=0)
        gain = np.sinc(self.frequency_hz * exposure_s) * 2.0 / length
        self.value = np.fft.rfft(centred, length, axis=0)[self._used] * gain[:, None]
        self.value *= displacement_factors(self.frequency_hz, signals.order)
        self._length_s = length / signals.rate_hz
        self._points = next_fast_len(int(np.ceil(self._length_s * self.frequency_hz[-1] / PASS_BAND)) + 1)

    def basis(self, frequency_hz: FloatArray) -> csc_array:
        """Return the cubic splines (M, J) at frequencies, constant outside the band."""
        from scipy.interpolate import BSpline

        low, high = np.log(self.signals.band_hz)
        step = (high - low) / (self.count - _DEGREE)
        knots = low + step * np.arange(-_DEGREE, self.count + 1)
        inside = np.clip(np.log(frequency_hz), low, high - 1e-9 * step)
        return BSpline.design_matrix(inside, knots, _DEGREE).tocsc()

    def usable(self, time_s: FloatArray) -> BoolArray:
        """Return the times (F,) that are not near the ends of the record."""
        inside = time_s - self.signals.start_s
        return np.asarray((inside > self.margin_s) & (inside < self.signals.duration_s - self.margin_s))

    def at_times(self, spectra: Iterable[ComplexArray], time_s: FloatArray) -> ComplexArray:
        """Return the analytic signals (F, N) of N spectra (M,) at times (F,)."""
        found, reach = list[ComplexArray](), kernel_reach(1.0)
        position = (time_s - self.signals.start_s) * self._points / self._length_s + reach
        for spectrum in spectra:
            padded = np.zeros(self._points, dtype=np.complex128)
            padded[self._used] = spectrum
            signal = np.pad(np.fft.ifft(padded) * self._points, reach, mode="wrap")
            found.append(np.asarray(resample(signal.real, position) + 1j * resample(signal.imag, position)))
        return np.stack(found, axis=1)


def _columns_of(matrix: csc_array) -> Iterator[FloatArray]:
    """Yield the columns of a sparse matrix."""
    for number in range(matrix.shape[1]):
        yield matrix[:, [number]].toarray()[:, 0]


def displacement_factors(frequency_hz: FloatArray, order: IntArray) -> ComplexArray:
    """Return the factors (K, R) from phasors of time derivatives to those of displacements."""
    return np.stack([derivative_factor(frequency_hz, -int(one)) for one in order], axis=1)


def _ramp(frequency_hz: FloatArray, ends: tuple[float, float]) -> FloatArray:
    """Return a cosine ramp from 0 to 1 between two frequencies."""
    share = np.clip((frequency_hz - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * share))


@dataclass(frozen=True, eq=False)
class _Parts:
    """Columns of unknowns that are free, and of others with a prior, decomposed.

    The free ones (F, P) are U·S·Vᵀ without undetermined combinations: `left` (F, P') = U, `inverse` (P, P') = V/S.
    `rest` (F, Q): the others times `spread` (Q,), orthogonal to U, from which U·`share` was subtracted; `eigen` (Q,),
    `vectors` (Q, Q) of restᵀ·rest. `spread`: relative standard deviations of the prior.
    """

    left: FloatArray
    inverse: FloatArray
    share: FloatArray
    rest: FloatArray
    eigen: FloatArray
    vectors: FloatArray
    spread: FloatArray

    @classmethod
    def of(cls, free: FloatArray, prior: FloatArray) -> Self:
        """Decompose the columns, with a prior of equal spread."""
        left, size, right = np.linalg.svd(free, full_matrices=False)
        determined = size > _RANK * size[0]
        zero = np.empty((0, 0))
        bare = cls(left[:, determined], right[determined].T / size[determined], zero, zero, zero, zero, zero)
        return bare.with_spread(prior, np.ones(prior.shape[1]))

    def with_spread(self, prior: FloatArray, spread: FloatArray) -> Self:
        """Return the decomposition with another spread of the prior."""
        columns = prior * spread
        share = self.left.T @ columns
        rest = columns - self.left @ share
        eigen, vectors = np.linalg.eigh(rest.T @ rest)
        return replace(self, share=share, rest=rest, eigen=np.maximum(eigen, 0.0), vectors=vectors, spread=spread)


@dataclass(frozen=True, eq=False)
class _Smoother:
    """Least squares of one component with a prior.

    `variance`: of its noise; `damping`: that over the variance of the prior.
    """

    parts: _Parts
    damping: float
    variance: float

    @classmethod
    def of(cls, parts: _Parts, values: FloatArray) -> Self:
        """Select both variances for values (F,) by restricted maximum likelihood."""
        remaining = values - parts.left @ (parts.left.T @ values)
        total, freedom = float(remaining @ remaining), len(values) - parts.left.shape[1]
        power = (parts.vectors.T @ (parts.rest.T @ remaining)) ** 2
        damping = 10.0**-_SMOOTHNESS * max(float(parts.eigen[-1]), np.finfo(np.float64).tiny)
        shrunk = parts.eigen + damping[:, None]
        squares = np.maximum(total - (power / shrunk).sum(axis=1), np.finfo(np.float64).eps * total)
        criterion = freedom * np.log(squares) + np.log(shrunk / damping[:, None]).sum(axis=1)
        best = int(np.flatnonzero(criterion < criterion.min() + _COMPATIBLE)[-1])
        return cls(parts, float(damping[best]), float(squares[best] / freedom))

    @property
    def freedom(self) -> float:
        """Degrees of freedom that the unknowns use."""
        eigen = self.parts.eigen
        return float(self.parts.left.shape[1] + np.sum(eigen / (eigen + self.damping)))

    def solve(self, values: FloatArray) -> FloatArray:
        """Return the unknowns (P + Q,) of values (F,)."""
        parts = self.parts
        other = parts.vectors @ ((parts.vectors.T @ (parts.rest.T @ values)) / (parts.eigen + self.damping))
        return np.concatenate([parts.inverse @ (parts.left.T @ values - parts.share @ other), parts.spread * other])

    def weights(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return weights of the values, and roots of the prior.

        (N, F) and (N, Q), in rows (N, P + Q) of the unknowns. The root times its transpose is the covariance by
        deviations that the frames leave possible.
        """
        parts = self.parts
        free = rows[:, : len(parts.inverse)] @ parts.inverse
        other = (rows[:, len(parts.inverse) :] * parts.spread - free @ parts.share) @ parts.vectors
        filtered = other / (parts.eigen + self.damping)
        root = filtered * np.sqrt(self.damping * self.variance)
        return free @ parts.left.T + (filtered @ parts.vectors.T) @ parts.rest.T, root

    def expected_squares(self, values: FloatArray) -> FloatArray:
        """Return expected squares (Q,) of the unknowns of values (F,) over their prior variance."""
        parts = self.parts
        found = self.solve(values)[len(parts.inverse) :] ** 2 * self.damping / self.variance
        return found + (parts.vectors**2 @ (self.damping / (parts.eigen + self.damping))) * parts.spread**2


@dataclass(frozen=True, eq=False, repr=False)
class SampledMotion:
    """A motion as filtered references: its transfer function, and its residuals.

    Attributes
    ----------
    used : (F,), frames of the fit: complete, inside the record of the references, no outliers.
    rate : (F, C), time derivative of the motion in the band at the used frames, else NaN.
    residual : (F, C), the rest after drift and motion at the used frames, else NaN.
    noise : (C, C), covariance of a frame's noise.
    freedom : (C,), degrees of freedom that the unknowns use.
    """

    used: BoolArray
    rate: FloatArray
    residual: FloatArray
    noise: FloatArray
    freedom: FloatArray
    spectra: _ReferenceSpectra
    columns: _Columns
    smoothers: tuple[_Smoother, ...]
    unknowns: FloatArray

    @property
    def dof(self) -> float:
        """Degrees of freedom of the noise, of the component with the fewest."""
        return float(np.count_nonzero(self.used) - self.freedom.max())

    def phasors(self, frequency_hz: FloatArray, references: ComplexArray) -> SampledPhasors:
        """Return the motion at lines with phasors (K, R) of the references, as recorded.

        Raises `ValueError` for lines outside the band. The covariance contains noise, and the deviations of the
        transfer function from its estimate.
        """
        rows, lines, components = self._rows(frequency_hz, references), len(frequency_hz), len(self.noise)
        flat = rows.reshape(2 * lines, -1)
        both = [smoother.weights(flat) for smoother in self.smoothers]
        weights = np.stack([weight.reshape(lines, 2, -1) for weight, _ in both])
        covariance = np.einsum("ab,akif,bkjf->kiajb", self.noise, weights, weights, optimize=True)
        for a, (_, root) in enumerate(both):
            part = root.reshape(lines, 2, -1)
            covariance[:, :, a, :, a] += part @ part.swapaxes(1, 2)
        shape = lines, 2 * components, 2 * components
        return SampledPhasors(self.used, weights, covariance.reshape(shape))

    def gains(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the factors (K, C, R) from recorded phasors of the references to the motion."""
        references = len(self.columns.scale)
        shape = references, len(frequency_hz), references
        single = np.broadcast_to(np.eye(references, dtype=np.complex128)[:, None], shape)
        parts = [self._rows(frequency_hz, one) @ self.unknowns for one in single]
        return np.stack([part[:, 0] + 1j * part[:, 1] for part in parts], axis=2)

    def _rows(self, frequency_hz: FloatArray, references: ComplexArray) -> FloatArray:
        """Return rows (K, 2, P + Q) of real and imaginary part over the unknowns."""
        spectra, columns = self.spectra, self.columns
        check_shape("references", references, (len(frequency_hz), len(columns.scale)))
        low, high = spectra.signals.band_hz
        if np.any((frequency_hz < low * (1.0 - 1e-9)) | (frequency_hz > high * (1.0 + 1e-9))):
            raise ValueError(f"frequency_hz: expected lines from {low:g} to {high:g} Hz")
        moved = references * displacement_factors(frequency_hz, spectra.signals.order) / columns.scale
        filtered = np.einsum("kc,kj->kcj", moved, spectra.basis(frequency_hz) @ columns.by_smoothness)
        zero = np.zeros((len(frequency_hz), columns.nuisances))
        both = np.concatenate([zero, *_split(np.stack([filtered, 1j * filtered]))], axis=1)
        return np.stack([both.real, both.imag], axis=1)


@dataclass(frozen=True, eq=False)
class SampledPhasors:
    """Phasors of a sampled motion as a linear function of its frames.

    `used` (F,): frames; `weights` (C, K, 2, F'): of the used frames in real and imaginary part of each line;
    `covariance` (K, 2C, 2C): of all real, then all imaginary parts.
    """

    used: BoolArray
    weights: FloatArray
    covariance: FloatArray

    def of(self, series: FloatArray) -> ComplexArray:
        """Return the phasors (K, C) of a motion (F, C), or of its changes."""
        parts = np.einsum("ckif,fc->kic", self.weights, series[self.used])
        return np.asarray(parts[:, 0] + 1j * parts[:, 1])


@dataclass(frozen=True, eq=False, repr=False)
class SampledFit(SineFit):
    """Motion of the frames by the channels, in the form of a sine approximation.

    `remaining` (F, C): residuals of the frames, NaN where not used.
    """

    remaining: FloatArray

    def residual_of(self, time_s: FloatArray, values: FloatArray) -> FloatArray:
        """Return the residuals (F, C) of the frames."""
        return self.remaining


@dataclass(frozen=True, eq=False)
class _Columns:
    """Columns of the frames for drift and motion.

    `values` (F, P + Q): drift and motion outside the band, levels and slopes, second differences. `free`: P without a
    prior, the first `nuisances` of which are outside the band. `scale` (R,): of the references. `by_smoothness` (J, J):
    from level, slope and second differences to coefficients of splines.
    """

    values: FloatArray
    free: int
    nuisances: int
    scale: FloatArray
    by_smoothness: FloatArray

    @classmethod
    def of(cls, spectra: _ReferenceSpectra, time_s: FloatArray, drift: FloatArray) -> _Columns:
        """Return the columns at times (F,), after those of drift (F, D)."""
        splines, by_smoothness = spectra.basis(spectra.frequency_hz), _by_smoothness(spectra.count)
        outside, filtered, scale = [drift], list[ComplexArray](), list[float]()
        steadiest = int(np.argmin(spectra.signals.order))  # at low frequencies, where integrals of noise grow
        for number, value in enumerate(spectra.value.T):
            inside = spectra.weight * value
            moving = spectra.at_times((spline * inside for spline in _columns_of(splines)), time_s)
            scale.append(max(float(np.std(moving.sum(axis=1).real)), np.finfo(np.float64).tiny))
            weights = spectra.outside if number == steadiest else spectra.outside[:_OUTSIDE]
            slow = spectra.at_times(weights * value, time_s) / scale[-1]
            outside += [slow.real, -slow.imag]
            filtered.append(moving @ by_smoothness / scale[-1])
        both = np.stack(filtered, axis=1)
        free, prior = _split(np.stack([both.real, -both.imag]))
        nuisance = np.concatenate(outside, axis=1)
        values, count = np.concatenate([nuisance, free, prior], axis=1), nuisance.shape[1]
        return cls(values, count + free.shape[1], count, np.array(scale), by_smoothness)

    def filters(self, unknowns: FloatArray) -> ComplexArray:
        """Return the coefficients (R, J, C) of the splines by unknowns (P + Q, C)."""
        references, components = len(self.scale), unknowns.shape[1]
        free = unknowns[self.nuisances : self.free].reshape(2, references, 2, components)
        prior = unknowns[self.free :].reshape(2, references, -1, components)
        real, imaginary = np.concatenate([free, prior], axis=2)
        return np.asarray(self.by_smoothness @ (real + 1j * imaginary) / self.scale[:, None, None])

    def spread(self, squares: FloatArray) -> FloatArray:
        """Return the spread (Q,) of the prior by expected squares (Q,), smooth over the band."""
        size = squares.reshape(2 * len(self.scale), -1).mean(axis=0)
        smooth = np.convolve(np.pad(size, 2, mode="edge"), _NEIGHBOURS, mode="valid")
        return np.tile(np.sqrt(smooth / smooth.max()), 2 * len(self.scale))


def _by_smoothness(count: int) -> FloatArray:
    """Return a matrix (J, J) of level, slope and second differences for coefficients of splines."""
    differences = np.diff(np.eye(count), 2, axis=0)
    level = np.stack([np.ones(count), np.linspace(-1.0, 1.0, count)], axis=1)
    return np.hstack([level, differences.T @ np.linalg.inv(differences @ differences.T)])


def _split(columns: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return level and slope, then second differences, of columns.

    (N, 4R) and (N, 2R(J - 2)) of (2, N, R, J).
    """
    flat = np.moveaxis(columns, 0, 1)
    return flat[..., :2].reshape(len(flat), -1), flat[..., 2:].reshape(len(flat), -1)


def fit_sampled_motion(
    signals: ReferenceSignals, time_s: FloatArray, motion: FloatArray, exposure_s: float = 0.0
) -> SampledMotion:
    """Estimate how a slowly sampled motion follows from fast references.

    Parameters
    ----------
    signals
        Channels that the same excitation moves.
    time_s
        (F,), middles of the exposures in s, on the clock of the references, at any rate.
    motion
        (F, C), displacements and rotations, means over the exposure; NaN in frames without a motion.
    exposure_s
        Length of the exposure in s.

    Returns
    -------
    The motion as filtered references.

    Raises
    ------
    ValueError
        Too few frames.

    Notes
    -----
    The motion is Σ_c h_c * x_c, x_c the references integrated to displacements. Frames alias, but the references do
    not: a frame at the time t observes Σ_c Re Σ_f H_c(f)·X_c(f)·sinc(f·T)·exp(j2πft), which is linear in H_c. Each
    H_c is a cubic spline over log f (P-splines: Eilers and Marx, Statistical Science 11 (1996) 89). Its second
    differences have a prior, whose variance is selected by restricted maximum likelihood for each component. The
    variance varies over the band by expectation and maximisation, so that a resonance does not roughen the rest. Level
    and slope of H_c are free: references that determine the body by kinematics need no differences. The covariance is
    that of the posterior: noise and the deviations that the frames leave possible. It covers a smooth function on
    average over the band (Nychka, JASA 83 (1988) 1134). A resonance that no reference shows, and only a part of the
    frames, is covered less often. Outside the band the motion has one factor above it and one per octave below, of
    which those far below apply to the reference with the fewest derivatives only. Cosines below 0.25 Hz model drift.
    Outlying frames are left out.
    """
    check_shape("time_s", time_s, (None,))
    check_shape("motion", motion, (len(time_s), None))
    spectra = _ReferenceSpectra(signals, exposure_s)
    used = spectra.usable(time_s) & np.isfinite(motion).all(axis=1)
    duration_s = float(np.ptp(time_s[used])) if used.any() else 0.0
    drifts = 2 + int(2.0 * _DRIFT_HZ * duration_s)
    needed = drifts + 2 * len(spectra.outside) + (4 + 2 * _OUTSIDE) * signals.values.shape[1] + MIN_FREE_FRAMES
    if np.count_nonzero(used) < needed:
        found = f"{np.count_nonzero(used)} within the record of the channels"
        raise ValueError(f"motion: expected at least {needed} frames for the unknowns, found {found}")
    phase = np.pi * (time_s[used] - time_s[used][0]) / max(duration_s, 1e-9)
    columns = _Columns.of(spectra, time_s[used], np.cos(np.multiply.outer(phase, np.arange(drifts))))
    fitted = _fit(spectra, columns, motion, used)
    for _ in range(_ROUNDS):
        outlying = _outliers(fitted)[used]
        if not outlying.any():
            break
        columns, used = replace(columns, values=columns.values[~outlying]), used.copy()
        used[np.flatnonzero(used)[outlying]] = False
        fitted = _fit(spectra, columns, motion, used)
    filters, splines = columns.filters(fitted.unknowns), spectra.basis(spectra.frequency_hz)
    moving = np.zeros((splines.shape[0], motion.shape[1]), dtype=np.complex128)
    for value, one in zip(spectra.value.T, filters, strict=True):
        moving += value[:, None] * (splines @ one)
    moving *= (2j * np.pi * spectra.frequency_hz * spectra.weight)[:, None]
    rate = np.full(motion.shape, np.nan)
    rate[used] = spectra.at_times(moving.T, time_s[used]).real
    return replace(fitted, rate=rate)


def _fit(spectra: _ReferenceSpectra, columns: _Columns, motion: FloatArray, used: BoolArray) -> SampledMotion:
    """Fit the used frames, whose columns are given."""
    values, prior = motion[used].T, columns.values[:, columns.free :]
    parts = _Parts.of(columns.values[:, : columns.free], prior)
    smoothers = [_Smoother.of(parts, component) for component in values]
    for _ in range(_STEPS):
        squares = [one.expected_squares(component) for one, component in zip(smoothers, values, strict=True)]
        parts = parts.with_spread(prior, columns.spread(np.mean(squares, axis=0)))
        smoothers = [_Smoother.of(parts, component) for component in values]
    residual, rate = np.full(motion.shape, np.nan), np.full(motion.shape, np.nan)
    unknowns = np.stack([one.solve(component) for one, component in zip(smoothers, values, strict=True)], axis=1)
    residual[used] = motion[used] - columns.values @ unknowns
    sigma = np.sqrt([smoother.variance for smoother in smoothers])
    noise = np.corrcoef(residual[used].T).reshape(len(sigma), -1) * np.outer(sigma, sigma)
    freedom = np.array([smoother.freedom for smoother in smoothers])
    return SampledMotion(used, rate, residual, noise, freedom, spectra, columns, tuple(smoothers), unknowns)


def _outliers(found: SampledMotion) -> BoolArray:
    """Return frames (F,) with a residual beyond that of noise in 99 of 100 records."""
    size = np.abs(found.residual)
    spread = np.nanmedian(size, axis=0) / NormalDist().inv_cdf(0.75)
    limit = NormalDist().inv_cdf(1.0 - _FALSE_ALARM / (2.0 * np.count_nonzero(found.used) * size.shape[1]))
    return np.asarray(np.any(np.nan_to_num(size) > limit * np.maximum(spread, np.finfo(np.float64).tiny), axis=1))
