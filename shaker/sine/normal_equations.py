"""Sampling times and normal equations of damped sines for long records.

The normal equations are summed block by block without a design matrix. In a block of local times τ around its centre
t_b, a line Re{X exp(s·t)} with s = -δ + jω is Re{X exp(s·t_b) · exp(s·τ)}. Its columns are those of any other block,
multiplied by exp(s·t_b). Columns of uniform blocks are therefore computed once. Times count from the middle of the
record.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from math import factorial

import numpy as np

from shaker.io.channel import Stacked
from shaker.sine.aliasing import angles, condition_number, sine_columns
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray, check_shape

# Sampling times of a record, cut into blocks whose phases are exact however long the record is.

LONG = 1 << 17  # samples from which a record is never copied and its residual never stored
_BLOCKS = 2048  # blocks of a long record
_SHORT_BLOCK = 2048  # samples in a block of a short one
_ROUNDING = 8.0  # units in the last place by which the times of a uniform grid may deviate


@dataclass(frozen=True)
class _Grid:
    """A uniform grid with exact `start_s` and `interval_s`, and the blocks' `centre` samples."""

    start_s: Fraction
    interval_s: Fraction
    middle: int
    centre: IntArray


@dataclass(frozen=True)
class Timeline:
    """Times of S samples in B blocks: t = `middle_s` + `centre_s[b]` + local time.

    Attributes
    ----------
    edges : (B + 1,), rows at which blocks begin.
    middle_s : middle of the record in s.
    centre_s : (B,), block centres from the middle in s.
    local_s : local times of one block where sampling is uniform, else of all samples (S,).
    grid : the uniform grid, None where sampling is not uniform.
    """

    edges: IntArray
    middle_s: float
    centre_s: FloatArray
    local_s: FloatArray
    grid: _Grid | None

    @property
    def samples(self) -> int:
        """Number of samples."""
        return int(self.edges[-1])

    def rows(self, block: int) -> slice:
        """Return the rows of a block."""
        return slice(int(self.edges[block]), int(self.edges[block + 1]))

    def local(self, block: int) -> FloatArray:
        """Return the local times of a block's samples, counted from its centre."""
        rows = self.rows(block)
        return self.local_s[: rows.stop - rows.start] if self.grid else self.local_s[rows]

    def is_full(self, block: int) -> bool:
        """Return whether a block has the same local times as all other full ones."""
        return self.grid is not None and self.edges[block + 1] - self.edges[block] == len(self.local_s)

    def turns(self, frequency_hz: float) -> FloatArray:
        """Return the fractional periods (B,) from the record's middle to each block.

        Each block is represented by its centre. On a grid a phase accumulator of 64 bits is used (as in a numerically
        controlled oscillator): 3·10⁶ samples leave no more than 10⁻¹² rad.
        """
        if self.grid is None:
            return np.mod(frequency_hz * self.centre_s, 1.0)
        step = round(Fraction(frequency_hz) * self.grid.interval_s % 1 * 2**64) % 2**64
        offsets = (self.grid.centre - self.grid.middle).view(np.uint64)
        return np.asarray((offsets * np.array([step], dtype=np.uint64)) / 2.0**64, dtype=np.float64)

    def middle_turns(self, frequency_hz: float) -> float:
        """Return the fractional periods from time zero to the middle of the record."""
        if self.grid is None:
            return float(np.mod(frequency_hz * self.middle_s, 1.0))
        middle = self.grid.start_s + self.grid.middle * self.grid.interval_s
        return float(Fraction(frequency_hz) * middle % 1)


def timeline(times: FloatArray, used: BoolArray | None) -> Timeline:
    """Return the blocks of a record; times that are uniform within rounding become a grid."""
    grid = _uniform(times) if len(times) > _SHORT_BLOCK else None
    if grid is not None:
        return _on_grid(*grid, len(times))
    edges = _edges(len(times))
    middle = float(np.mean(times if used is None else times[used]))
    local = times - middle
    centre = np.array([local[a:b].mean() for a, b in pairwise(edges)])
    local -= np.repeat(centre, np.diff(edges))
    return Timeline(edges, middle, centre, local, None)


def _edges(samples: int) -> IntArray:
    """Return the rows (B + 1,) at which blocks begin and the last one ends."""
    length = min(samples, _SHORT_BLOCK) if samples <= LONG else -(-samples // _BLOCKS)
    return np.append(np.arange(0, samples, max(length, 1)), samples).astype(np.int64)


def _on_grid(start_s: Fraction, interval_s: Fraction, samples: int) -> Timeline:
    edges = _edges(samples)
    length = int(edges[1])
    middle = (samples - 1) // 2
    centre = edges[:-1] + length // 2
    interval = float(interval_s)
    local = np.asarray((np.arange(length) - length // 2) * interval, dtype=np.float64)
    grid = _Grid(start_s, interval_s, middle, centre)
    centre_s = np.asarray((centre - middle) * interval, dtype=np.float64)
    return Timeline(edges, float(start_s + middle * interval_s), centre_s, local, grid)


def _uniform(time_s: FloatArray) -> tuple[Fraction, Fraction] | None:
    """Return exact start and interval of the line through times uniform within rounding, else None."""
    samples = len(time_s)
    start, interval = float(time_s[0]), float(time_s[-1] - time_s[0]) / (samples - 1)
    tolerance = _ROUNDING * float(np.spacing(max(abs(float(time_s[0])), abs(float(time_s[-1])))))
    if not interval > 0.0:
        return None
    half = (samples - 1) / 2.0
    total = moment = 0.0
    for first in range(0, samples, LONG):
        index = np.arange(first, min(first + LONG, samples))
        deviation = time_s[index[0] : index[-1] + 1] - (start + interval * index)
        if not np.max(np.abs(deviation)) <= tolerance:
            return None
        total += float(np.sum(deviation))
        moment += float(deviation @ (index - half))
    slope = moment / (samples * (samples**2 - 1.0) / 12.0)
    first_s = Fraction(start) + Fraction(total / samples) - Fraction(slope) * Fraction(half)
    return first_s, Fraction(interval) + Fraction(slope)


# The noise around lines from the residual of a long uniform record, without ever holding it.

_ORDERS = 4  # powers of time per block: 30 bins off in 2048 blocks, they leave 2·10⁻⁷ of an ordinate


@dataclass(frozen=True)
class Demodulator:
    """Discrete Fourier transform of a record at chosen bins (K, M).

    There are K groups of neighbouring bins. In each block the record is demodulated by the middle bin of a group and
    multiplied by the powers of time of a Taylor series. The remaining exponential is smooth over a block. These moments
    therefore yield all bins of the group, without the droop and the aliases of a decimation.
    """

    timeline: Timeline
    bins: IntArray

    @property
    def centre(self) -> IntArray:
        """Bin (K,) by which each group is demodulated."""
        return np.asarray((self.bins.min(axis=1) + self.bins.max(axis=1)) // 2)

    def columns(self) -> FloatArray:
        """Return cosines and sines times powers of time (L, 2·K·4) in a block."""
        length = int(self.timeline.edges[1])
        index = np.arange(length) - length // 2
        angle = 2.0 * np.pi * np.mod(np.multiply.outer(index, self.centre) / self.timeline.samples, 1.0)
        turn = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
        powers = (index / self._half)[:, None] ** np.arange(_ORDERS)
        return np.asfortranarray((turn[..., None] * powers[:, None, None, :]).reshape(length, -1))

    def transform(self, moments: FloatArray) -> ComplexArray:
        """Return the transform (K, M, C) from the blocks' sums (B, 2·K·4, C)."""
        blocks, _, channels = moments.shape
        groups, samples = self.bins.shape[0], self.timeline.samples
        parts = moments.reshape(blocks, 2, groups, _ORDERS, channels)
        together = parts[:, 0] + 1j * parts[:, 1]
        centre = self.timeline.edges[:-1] + int(self.timeline.edges[1]) // 2
        offsets, inverse_index = np.unique(self.bins - self.centre[:, None], return_inverse=True)

        def turns(bins: IntArray) -> ComplexArray:
            """Return exp(-2πj·j·n/N) of bins (M,) at the block centres, from whole numbers."""
            angle = 2.0 * np.pi * (np.multiply.outer(bins, centre) % samples) / samples
            return np.asarray(np.cos(angle) - 1j * np.sin(angle))

        # Equal for all groups: phase of the neighbours relative to the bin in the middle.
        change = 2.0 * np.pi * offsets * self._half / samples
        scale = np.array([(-1j) ** m / factorial(m) for m in range(_ORDERS)])
        series = scale * change[:, None] ** np.arange(_ORDERS)
        kernel = (turns(offsets)[:, :, None] * series[:, None, :]).reshape(len(offsets), -1)
        rotated = together * turns(self.centre).T[:, :, None, None]
        by_group = rotated.transpose(1, 0, 2, 3).reshape(groups, -1, channels)
        found = np.take_along_axis(kernel @ by_group, inverse_index.reshape(self.bins.shape)[:, :, None], axis=1)
        return found

    @property
    def _half(self) -> float:
        return int(self.timeline.edges[1]) / 2.0


# Normal equations of damped sines, gathered block by block without a design matrix.

_CHUNK = 1 << 16  # values worked on at a time: they stay in the processor's cache


@dataclass(frozen=True)
class SineSamples:
    """Samples `values` (S, C) with weights `root` = 1/σ, 0 for rows left out."""

    timeline: Timeline
    values: FloatArray | Stacked
    root: FloatArray | None

    @property
    def count(self) -> int:
        """Number of rows that are used."""
        return self.timeline.samples if self.root is None else int(np.count_nonzero(self.used_rows()))

    def used_rows(self) -> BoolArray:
        """Return which rows (S,) are used."""
        if self.root is None:
            return np.ones(self.timeline.samples, dtype=np.bool_)
        return np.asarray(self.root > 0.0 if self.root.ndim == 1 else (self.root > 0.0).all(axis=1))

    def drop_rows(self, rows: BoolArray) -> SineSamples:
        """Return the samples without some rows (S,)."""
        if self.root is None:
            return replace(self, root=(~rows).astype(np.float64))
        return replace(self, root=np.where(rows if self.root.ndim == 1 else rows[:, None], 0.0, self.root))

    def chunks(self) -> Iterator[Chunk]:
        """Yield all blocks: those with the same columns together, in few large products."""
        times = self.timeline
        blocks, length, channels = len(times.centre_s), int(times.edges[1]), self.values.shape[1]
        most = max(1, _CHUNK // (length * channels))
        for first in range(0, blocks, most):
            last = min(first + most, blocks)
            rows = slice(int(times.edges[first]), int(times.edges[last]))
            if times.is_full(last - 1) and (self.root is None or np.all(self.root[rows] == 1.0)):
                values = self.values[rows].reshape(last - first, length, channels).transpose(1, 0, 2)
                yield Chunk(first, last, channels, values.reshape(length, -1), None)
            else:
                for block in range(first, last):
                    rows = times.rows(block)
                    values, root = self.values[rows], None
                    if self.root is not None and not np.all(self.root[rows] == 1.0):
                        root = self.root[rows].reshape(len(values), -1)
                        values = np.where((root == 0.0).any(axis=1)[:, None], 0.0, values)
                    yield Chunk(block, block + 1, channels, values, root)


@dataclass(frozen=True)
class Chunk:
    """Blocks `first` to `last` - 1 side by side; one with weights is alone."""

    first: int
    last: int
    channels: int
    values: FloatArray
    root: FloatArray | None

    def weighted(self, values: FloatArray, power: int) -> FloatArray:
        """Return values times a power of their weights."""
        return values if self.root is None else values * self.root**power

    def columns(self, columns: SineColumns, timeline: Timeline, common: FloatArray) -> FloatArray:
        """Return the columns of these blocks; `common` are those of all full ones."""
        shared = self.first == 0 or timeline.is_full(self.first)
        return common if shared else columns.local(timeline.local(self.first))

    def by_block(self, sums: FloatArray) -> FloatArray:
        """Return sums (P, B·C) of the blocks as (B, P, C)."""
        return sums.reshape(len(sums), -1, self.channels).swapaxes(0, 1)

    def side_by_side(self, parts: FloatArray) -> FloatArray:
        """Return parts (B, P, C) of the blocks as (P, B·C)."""
        return parts.swapaxes(0, 1).reshape(parts.shape[1], -1)

    def in_order(self, values: FloatArray) -> FloatArray:
        """Return values (n, B·C) as samples (B·n, C) in the order of time."""
        return self.by_block(values).reshape(-1, self.channels)


@dataclass(frozen=True)
class SineColumns:
    """Columns of a fit: lines, offset, drift, and slopes.

    A line has Re and Im of exp((-δ + 2πjf)·t) in turn. `frequency_hz`, `decay_per_s`: f and δ (K,). The slopes are the
    lines' columns times t, the effect of a change of frequency or decay rate.
    """

    frequency_hz: FloatArray
    decay_per_s: FloatArray
    drift: bool
    slopes: bool

    @property
    def lines(self) -> int:
        """Number of lines."""
        return len(self.frequency_hz)

    @property
    def linear(self) -> int:
        """Number of columns without the slopes."""
        return 2 * self.lines + (2 if self.drift else 1)

    def local(self, local_s: FloatArray) -> FloatArray:
        """Return the columns (n, P) at local times (n,)."""
        lines, decay = self.lines, self.decay_per_s
        columns = np.empty((len(local_s), self.linear + (2 * lines if self.slopes else 0)), order="F")
        for k in range(lines):
            angle = angles(self.frequency_hz[k] * local_s)
            envelope = np.exp(-decay[k] * local_s) if decay[k] else 1.0
            columns[:, 2 * k] = np.cos(angle) * envelope
            columns[:, 2 * k + 1] = -np.sin(angle) * envelope
        columns[:, 2 * lines] = 1.0
        if self.drift:
            columns[:, 2 * lines + 1] = local_s
        if self.slopes:
            columns[:, self.linear :] = columns[:, : 2 * lines] * local_s[:, None]
        return columns

    def block_transforms(self, timeline: Timeline) -> FloatArray:
        """Return matrices (B, P, P) from coefficients of the record to blocks."""
        lines, linear, centre = self.lines, self.linear, timeline.centre_s
        size = linear + (2 * lines if self.slopes else 0)
        matrix = np.zeros((len(centre), size, size))
        for k in range(lines):
            angle = 2.0 * np.pi * timeline.turns(float(self.frequency_hz[k]))
            factor = np.exp(1j * angle - self.decay_per_s[k] * centre)
            turn = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]]).transpose(2, 0, 1)
            block_columns = slice(2 * k, 2 * k + 2)
            matrix[:, block_columns, block_columns] = turn
            if self.slopes:
                slope = slice(linear + 2 * k, linear + 2 * k + 2)
                matrix[:, slope, slope] = turn
                matrix[:, block_columns, slope] = centre[:, None, None] * turn
        matrix[:, 2 * lines, 2 * lines] = 1.0
        if self.drift:
            matrix[:, 2 * lines + 1, 2 * lines + 1] = 1.0
            matrix[:, 2 * lines, 2 * lines + 1] = centre
        return matrix


@dataclass(frozen=True)
class SineNormalEquations:
    """Sums over all samples: `gram`, `right`, `power`.

    `gram` (D, D, P, P) of the weighted columns, `right` (P, C), `power` (C,). D = 1 where all channels have the same
    weights, else C. `power` is that of the values, and is summed only if there are slopes.
    """

    gram: FloatArray
    right: FloatArray
    power: FloatArray


def normal_equations(samples: SineSamples, columns: SineColumns) -> SineNormalEquations:
    """Return the normal equations of a fit from one pass over its samples."""
    timeline = samples.timeline
    transforms = columns.block_transforms(timeline)
    size, channels = transforms.shape[1], samples.values.shape[1]
    common = columns.local(timeline.local(0))
    common_gram = common.T @ common
    each = samples.root is not None and samples.root.ndim == 2
    gram = np.zeros((channels, channels, size, size) if each else (1, 1, size, size))
    shares_columns = np.zeros(len(timeline.centre_s), dtype=np.bool_)
    local_right = np.empty((len(timeline.centre_s), size, channels))
    power = np.zeros(channels)
    for chunk in samples.chunks():
        basis = chunk.columns(columns, timeline, common)
        weighted = chunk.weighted(chunk.values, 2)
        if columns.slopes:
            pair = weighted.reshape(-1, channels), chunk.values.reshape(-1, channels)
            power += np.einsum("ij,ij->j", *pair)
        local_right[chunk.first : chunk.last] = chunk.by_block(basis.T @ weighted)
        if chunk.root is None and basis is common:
            shares_columns[chunk.first : chunk.last] = True
        else:
            turn = transforms[chunk.first]
            root = np.ones((1, 1)) if chunk.root is None else chunk.root
            kinds = root.shape[1]
            weighted = (root[:, :, None] * basis[:, None, :]).reshape(len(basis), kinds * size)
            block_gram = (weighted.T @ weighted).reshape(kinds, size, kinds, size).transpose(0, 2, 1, 3)
            gram += turn.T @ block_gram @ turn
    chosen = transforms[shares_columns]
    gram += np.sum(chosen.swapaxes(1, 2) @ common_gram @ chosen, axis=0)
    right = np.sum(transforms.swapaxes(1, 2) @ local_right, axis=0)
    return SineNormalEquations(gram, np.asarray(right), power)


def residuals(
    samples: SineSamples, columns: SineColumns, coefficients: FloatArray
) -> Iterator[tuple[Chunk, FloatArray, FloatArray]]:
    """Yield chunks with their columns (n, P) and weighted residual (n, B·C)."""
    timeline = samples.timeline
    local_coefficients = columns.block_transforms(timeline)[:, :, : len(coefficients)] @ coefficients
    common = columns.local(timeline.local(0))
    for chunk in samples.chunks():
        basis = chunk.columns(columns, timeline, common)
        residual = chunk.values - basis @ chunk.side_by_side(local_coefficients[chunk.first : chunk.last])
        yield chunk, basis, chunk.weighted(residual, 1)


def as_complex(coefficients: FloatArray, lines: int) -> ComplexArray:
    """Return the complex amplitudes (K, ...) of coefficients (2K or more, ...)."""
    return np.asarray(coefficients[0 : 2 * lines : 2] + 1j * coefficients[1 : 2 * lines : 2])


# Least squares with a design matrix, for short records and for channels too many for a covariance.

SINGULAR = 1e6  # condition above which the normal equations carry no information about some line


@dataclass(frozen=True)
class SineSolution:
    """Least-squares solution: `coefficients` (P, C), `inverse` (P, P) of XᵀX, `residual` (S, C)."""

    coefficients: FloatArray
    inverse: FloatArray
    residual: FloatArray
    condition: float

    def phasors(self, lines: int) -> tuple[ComplexArray, FloatArray]:
        """Return phasors (K, C) of the first lines, and their variance for unit noise."""
        scale = np.sqrt(2.0 / len(self.residual))
        spread = np.diag(self.inverse)[: 2 * lines].reshape(-1, 2).mean(axis=1)
        return np.asarray(scale * as_complex(self.coefficients, lines).conj()), scale**2 * spread


def solve_sines(columns: FloatArray, data: FloatArray) -> SineSolution:
    """Solve columns · coefficients = data by refined normal equations.

    Columns are (S, P), data (S, C). The columns have about unit length, and a condition number below 10⁶ is required.
    The refined solution therefore has the accuracy of an orthogonal factorisation in a fraction of its time.
    """
    samples, parameters = columns.shape
    check_samples(samples, parameters)
    gram = columns.T @ columns
    condition = condition_number(gram)
    check_condition(condition)
    inverse = np.linalg.inv(gram)
    coefficients = inverse @ (columns.T @ data)
    coefficients += inverse @ (columns.T @ (data - columns @ coefficients))
    return SineSolution(coefficients, np.asarray(inverse), data - columns @ coefficients, condition)


def sine_amplitudes(
    time_s: FloatArray, values: FloatArray, frequency_hz: FloatArray
) -> tuple[FloatArray, ComplexArray]:
    """Return offset (C,) and phasors (K, C) of `values` (S, C) as `fit_sines`, without covariance."""
    check_shape("values", values, (len(time_s), None))
    solution = solve_sines(sine_columns(time_s, frequency_hz), values)
    return solution.coefficients[-1] / np.sqrt(len(time_s)), solution.phasors(len(frequency_hz))[0]


class SineSums:
    """Sines at the same times in N series of C values, added in parts.

    Samples may be missing. Only sums are stored, (2K + 1)² numbers for each series. Values count from `origin` (N, C),
    which lies near them.
    """

    def __init__(self, time_s: FloatArray, frequency_hz: FloatArray, origin: FloatArray) -> None:
        self._columns, self._origin = sine_columns(time_s, frequency_hz), origin
        (series, channels), parameters = origin.shape, self._columns.shape[1]
        self._gram = np.zeros((series, parameters, parameters))
        self._right = np.zeros((parameters, series, channels))
        self._square = np.zeros((series, channels))
        self._added = 0
        self.count: IntArray = np.zeros(series, np.int64)

    def add(self, values: FloatArray) -> None:
        """Add the next samples (S, N, C); a NaN marks a missing sample."""
        rows = self._columns[self._added : self._added + len(values)]
        present = np.asarray(np.isfinite(values).all(axis=2))
        filled = np.where(present[..., None], values - self._origin, 0.0)
        products = (rows[:, :, None] * rows[:, None, :]).reshape(len(rows), -1)
        self._gram += (present.T.astype(np.float64) @ products).reshape(self._gram.shape)
        self._right += (rows.T @ filled.reshape(len(rows), -1)).reshape(self._right.shape)
        self._square += (filled**2).sum(axis=0)
        self._added += len(values)
        self.count = self.count + present.sum(axis=0)

    def solve(self, freedom: int) -> tuple[FloatArray, ComplexArray, FloatArray]:
        """Return offsets (N, C), phasors (K, N, C) and their u (K, N, C).

        u is that of the real and of the imaginary part. NaN for a series with fewer than `freedom` samples beyond the
        unknowns, or whose samples cannot separate the lines. u² = s²·(XᵀX)⁻¹ with the variance s² of the residual, mean
        of both parts.
        """
        samples, parameters = self._columns.shape
        good = self.count >= parameters + freedom
        good[good] = [condition_number(gram) < SINGULAR for gram in self._gram[good]]
        gram, right = self._gram[good], self._right[:, good].swapaxes(0, 1)
        inverse = np.linalg.inv(gram)
        coefficients = inverse @ right
        coefficients += inverse @ (right - gram @ coefficients)
        rest = np.maximum(self._square[good] - (coefficients * right).sum(axis=1), 0.0)
        variance = rest / np.maximum(self.count[good] - parameters, 1)[:, None]
        lines = (parameters - 1) // 2
        spread = np.diagonal(inverse, axis1=1, axis2=2)[:, :-1].reshape(len(inverse), lines, 2).mean(axis=2)
        value = np.full((lines, *self._origin.shape), np.nan, dtype=np.complex128)
        u = np.full(value.shape, np.nan)
        scale = np.sqrt(2.0 / samples)
        value[:, good] = scale * (coefficients[:, 0:-1:2] - 1j * coefficients[:, 1:-1:2]).swapaxes(0, 1)
        u[:, good] = scale * np.sqrt(spread[:, :, None] * variance[:, None]).swapaxes(0, 1)
        offset = np.full(self._origin.shape, np.nan)
        offset[good] = self._origin[good] + coefficients[:, -1] / np.sqrt(samples)
        return offset, value, u


def check_samples(samples: int, parameters: int) -> None:
    """Refuse a fit without degrees of freedom."""
    if samples <= parameters:
        raise ValueError(f"time_s: expected more than {parameters} complete samples, found {samples}")


def check_condition(condition: float) -> None:
    """Refuse lines that alias onto each other."""
    if not condition < SINGULAR:
        raise ValueError(
            f"frequency_hz: expected lines that the sampling times can separate, found condition number "
            f"{condition:.2g}; drop those that usable_lines names"
        )
