"""Noise of releases that is not white: hum, drift, colour, and coarse converters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from shaker.decoupling.common_pole_search import criterion
from shaker.decoupling.model import Poles
from shaker.decoupling.release_problem import (
    TIMES,
    PoleFit,
    ReleaseTiming,
    StepProblem,
    by_record,
    inverse_normal,
    moving,
)
from shaker.release.load_response import average_blocks
from shaker.release.record import StepRecord
from shakercal._common.arrays import FloatArray

# A filter that whitens the noise at rest.

_ORDER, _CORRELATED = 8, 26.1  # taps; 99.9 % quantile of N·Σr² over as many lags for white noise, χ² of 8
_FEWEST = 4  # blocks at rest per tap, at least


def whitening_filter(rests: Sequence[FloatArray]) -> tuple[float, ...]:
    """Return the taps of a filter that whitens noise (N, C), none for white noise.

    The prediction error of an autoregression, common to all outputs, from their mean correlation.
    """
    from scipy.linalg import solve_toeplitz

    long = [rest - rest.mean(axis=0) for rest in rests if len(rest) >= _FEWEST * _ORDER]
    if not long:
        return ()
    sums = [sum(float(np.vdot(rest[lag:], rest[: len(rest) - lag])) for rest in long) for lag in range(_ORDER + 1)]
    count = sum(rest.size for rest in long)
    share = np.array(sums) / max(sums[0], 1e-300)
    if not count * float(np.sum(share[1:] ** 2)) > _CORRELATED:
        return ()
    taps = solve_toeplitz(share[:-1], share[1:])
    left = 1.0 - float(taps @ share[1:])  # variance of the prediction error over that of the noise
    return tuple((np.array([1.0, *(-taps)]) / np.sqrt(max(left, 1e-12))).tolist())


# Hum and drift, as unknowns of every record.

_MAINS_HZ, _ORDERS = (50.0, 60.0), (1, 2, 3, 5, 7)  # of public grids, and the orders that rectifiers draw
_BELOW = 0.75  # highest hum over the lowest mode
_SIGMAS = 5.0  # gain of a line in standard deviations of that of white noise, from which it is an unknown
_AS_HUM = (0.05, 0.1)  # distance from a line over the mains, and damping ratio, of a mode that may be hum


def with_hum(problem: StepProblem, poles: Poles, releases: Sequence[ReleaseTiming]) -> tuple[StepProblem, Poles]:
    """Return the problem with significant hum and drift as unknowns, and the other poles."""
    series = len(problem.records) * problem.records[0].samples.value.shape[1]  # outputs of all records
    best = problem, poles, criterion(problem, poles, problem.point(poles, releases).loss)
    for base in _MAINS_HZ:
        rings = _without_hum(poles, base)
        top_hz = _BELOW * float(rings.frequency_hz.min())
        lines = (0.0, *(order * base for order in _ORDERS if order * base < top_hz))
        least = _with_lines(problem, lines).point(rings, releases).loss
        chosen = []
        for hz in lines:
            others = _with_lines(problem, tuple(other for other in lines if other != hz))
            dof = series if hz == 0.0 else 2 * series
            gain = (others.point(rings, releases).loss - least) / max(least / problem.values, 1e-300)
            if gain > dof + _SIGMAS * np.sqrt(2.0 * dof):
                chosen.append(hz)
        smaller = _with_lines(problem, tuple(chosen))
        score = criterion(smaller, rings, smaller.point(rings, releases).loss)
        if chosen and score < best[2]:
            best = smaller, rings, score
    return best[0], best[1]


def _with_lines(problem: StepProblem, lines_hz: tuple[float, ...]) -> StepProblem:
    """Return the problem with lines as unknowns."""
    return replace(problem, records=tuple(record.with_hums(lines_hz) for record in problem.records))


def _without_hum(poles: Poles, base_hz: float) -> Poles:
    """Return poles without lightly damped ones near multiples of the mains, if others remain."""
    order = poles.frequency_hz / base_hz
    near = np.abs(order - np.maximum(np.round(order), 1.0)) < _AS_HUM[0]
    hum = near & (poles.damping_ratio < _AS_HUM[1]) & (np.round(order) <= _ORDERS[-1])
    if np.all(hum):
        return poles
    return Poles(poles.frequency_hz[~hum], poles.damping_ratio[~hum], poles.real_hz)


# Covariance of noise that is not white.

_OCTAVE = 10  # lines below which those of the octave above count
_NARROW = 5  # least number of lines in a mean
_WIDE = 8  # lines over the number in a mean


def coloured_roots(
    problem: StepProblem, fit: PoleFit, precision: FloatArray, errors: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return roots (P, K), (D·C·(2M + Q), K) of the covariance beyond white noise.

    Of parameters, and of coefficients.

    The density of each output's residual, a mean over records and neighbouring lines, beyond its variance. The fit
    absorbs most of the slowest lines, which have the density of the octave above. `errors`: (A, C) of each record by a
    coarse converter in units of the weights, common to all samples before or after a release, and to a load's records.
    """
    point, poles = fit.solution.point, fit.poles
    inverse = inverse_normal(point.normal[0] + np.diag(precision))
    grid_hz, excess = _excess(problem, fit)
    size, outputs = poles.count, errors[0].shape[1]
    parameters, roots = len(inverse), list[FloatArray]()

    def add(element: int, both: FloatArray) -> None:
        root = np.zeros((parameters + len(problem.components) * outputs * size, both.shape[1]))
        root[:parameters] = both[:parameters]
        root[parameters + element * size : parameters + (element + 1) * size] = both[parameters:]
        roots.append(root)

    for d, component in enumerate(problem.components):
        solved, jacobian, design = point.solved[d], point.jacobians[d], point.blocks[d].design
        index = jacobian.parameter_index
        along = np.tensordot(solved.basis, np.tensordot(solved.basis.T, jacobian.rows, 1), 1)
        free, gain = jacobian.rows - along, poles.smooth @ solved.root @ solved.root.T
        levels = np.zeros((outputs, parameters + size, 2))
        for k, (i, table, weights, rows) in enumerate(_tables(problem, fit, component, solved.coefficients)):
            samples, mine = problem.records[i].samples, np.r_[:size, size + TIMES * k : size + TIMES * (k + 1)]
            lines, hz = np.fft.rfft(table, axis=0), _lines_hz(problem, i)
            late = samples.time_s > fit.releases[i].middle_s
            sides = np.stack([~late, late], axis=1)
            for c in range(outputs):
                by_theta = np.hstack([inverse[:, index] @ free[rows, :, c].T, inverse[:, index[mine]] @ weights[c]])
                by_eta = np.zeros((size, by_theta.shape[1]))
                by_eta[:, : rows.stop - rows.start] = gain @ design[rows].T
                both = np.concatenate([by_theta, by_eta])
                levels[c] += both @ (table.T @ problem.records[i].whitened(errors[i][:, c, None] * sides))
                weighted = np.sqrt(2.0 * np.interp(hz, grid_hz, excess[:, c]) / len(table))[:, None] * lines
                if np.any(weighted):
                    root: FloatArray = np.linalg.qr(np.concatenate([weighted.real, weighted.imag]))[1]
                    add(d * outputs + c, both @ root.T)
        for c in range(outputs):
            if np.any(levels[c]):
                add(d * outputs + c, levels[c])
    whole = np.hstack([np.zeros((parameters + len(problem.components) * outputs * size, 0)), *roots])
    return whole[:parameters], whole[parameters:]


def _tables(
    problem: StepProblem, fit: PoleFit, component: str, coefficients: FloatArray
) -> Iterator[tuple[int, FloatArray, FloatArray, slice]]:
    """Yield each record of a load with columns (A, B + R), weights, basis rows.

    The columns span all changes of the record.

    Of the changes with the parameters, weights (C, p, R) are those of the columns orthogonal to the basis.
    """
    poles = fit.poles
    re, im, real = np.split(poles.smooth @ coefficients, [poles.modes, 2 * poles.modes])
    residues, start = np.concatenate([2 * (re + 1j * im), real]), 0
    for i in problem.record_indices(component):
        record = problem.records[i]
        basis = record.explained(poles, fit.releases[i]).basis
        answered = record.response_derivatives(poles.values, fit.releases[i], fixed_poles=False)
        columns, weights = moving(answered, residues, poles, fit.releases[i])
        free = record.without_level(columns.T)
        free -= basis @ (basis.T @ free)
        yield i, np.hstack([basis, free]), weights, slice(start, start + basis.shape[1])
        start += basis.shape[1]


def _lines_hz(problem: StepProblem, record: int) -> FloatArray:
    """Return the frequencies of the lines of a record."""
    samples = problem.records[record].samples
    return np.asarray(np.fft.rfftfreq(len(samples.value), samples.step_s * float(samples.length[0])))


def _excess(problem: StepProblem, fit: PoleFit) -> tuple[FloatArray, FloatArray]:
    """Return frequencies (K,) and the density (K, C) of the residual beyond its variance."""
    rests = dict(by_record(problem, fit))
    longest = max(rests, key=lambda i: len(rests[i]))
    grid_hz = _lines_hz(problem, longest)
    power = np.zeros((len(grid_hz), next(iter(rests.values())).shape[1]))
    for i, rest in rests.items():
        lines = np.abs(np.fft.rfft(rest, axis=0)) ** 2 / len(rest)
        for c in range(power.shape[1]):
            power[:, c] += np.interp(grid_hz, _lines_hz(problem, i), lines[:, c]) / len(rests)
    number = np.arange(len(grid_hz))
    half = np.maximum(_NARROW, number // _WIDE) // 2
    first = np.where(number < _OCTAVE, np.maximum(number, 1), number - half)
    last = np.minimum(np.where(number < _OCTAVE, 2 * number + 2, number + half + 1), len(grid_hz))
    sums = np.concatenate([np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)])
    mean = (sums[last] - sums[first]) / np.maximum(last - first, 1)[:, None]
    scatter = 1.0 + _SIGMAS / np.sqrt(len(rests) * np.maximum(last - first, 1))[:, None]
    white = np.mean(power[1:], axis=0)
    return grid_hz, np.where(mean > scatter * white, mean - white, 0.0)


# The step of a converter.

_SHORTEST = 16  # samples in which a variance is computed, at least
_UNSPREAD = 0.5  # further share of the rounding's standard deviation that the fit may leave


def converter_steps(records: Sequence[StepRecord]) -> FloatArray:
    """Return the steps (C,) of the converters, the smallest differences of samples."""
    steps = np.full(len(records[0].channels), np.inf)
    for record in records:
        for c, row in enumerate(record.samples):
            steps[c] = min(steps[c], float(np.min(np.diff(np.unique(row)), initial=np.inf)))
    return np.asarray(np.where(np.isfinite(steps), steps, 0.0))


def noise_with_steps(noise: FloatArray, steps: FloatArray) -> FloatArray:
    """Return the noise (C,) at rest, at least that of rounding.

    An error that noise does not spread follows the signal, so that noise is taken as larger.
    """
    return np.asarray(np.maximum(noise, (1.0 + _UNSPREAD * _left(noise**2, steps)) * steps / np.sqrt(12.0)))


def converter_errors(records: Sequence[StepRecord], problem: StepProblem, fit: PoleFit) -> list[FloatArray]:
    """Return standard uncertainties (A, C) of each record by rounding that nothing spreads.

    The noise at rest and the variance by ringing, within a period of the lowest mode, decide.
    """
    from scipy.ndimage import uniform_filter1d

    steps, period_s = converter_steps(records), 1.0 / float(fit.poles.frequency_hz.min())
    rests = [
        record.samples[:, record.time_s < release.middle_s - release.duration_s]
        for record, release in zip(records, fit.releases, strict=True)
    ]
    noise = np.median([[_dither(row, step) for row, step in zip(rest, steps, strict=True)] for rest in rests], axis=0)
    errors = []
    for record, prepared in zip(records, problem.records, strict=True):
        size = max(_SHORTEST, round(period_s * record.sample_rate_hz))
        mean, square = (uniform_filter1d(record.samples**power, size, axis=1, mode="nearest") for power in (1, 2))
        variance = np.maximum(square - mean**2, (noise**2 + steps**2 / 12.0)[:, None])
        error = steps[:, None] / np.sqrt(12.0) * _left(variance, steps[:, None])
        errors.append(average_blocks(error, int(prepared.samples.length[0])).T)
    return errors


def _dither(row: FloatArray, step: float) -> float:
    """Return the standard deviation of noise (N,) before rounding, 0 for two values.

    Of Gaussian noise, from the shares of samples below the second value and above the last but one.
    """
    from scipy.special import ndtri

    values, counts = np.unique(row, return_counts=True)
    if len(values) < 3 or step <= 0.0:
        return 0.0
    low, high = counts[0] / len(row), 1.0 - counts[-1] / len(row)
    return float((values[-1] - values[0] - step) / (ndtri(high) - ndtri(low))) if low < high else 0.0


def _left(variance: FloatArray, steps: FloatArray) -> FloatArray:
    """Return the share of a level's rounding error that a variance of samples leaves.

    Gaussian noise of σ leaves q/π·exp(-2π²σ²/q²), with the step q.
    """
    spread = np.maximum(variance - steps**2 / 12.0, 0.0)
    return np.asarray(np.exp(-2.0 * np.pi**2 * spread / np.maximum(steps, 1e-300) ** 2))
