"""Normal equations of damped sines, gathered block by block without a design matrix.

In a block of local times τ around its centre t_b, a line Re{X exp(s·t)}, s = -δ + jω, is Re{X exp(s·t_b) · exp(s·τ)}:
its columns are those of any other block, turned by exp(s·t_b). Columns of uniform blocks are therefore made once.
Times are counted from the middle of the record throughout.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray
from shaker.signals.sine.times import Timeline

_CHUNK = 1 << 16  # values worked on at a time: they stay in the processor's cache


@dataclass(frozen=True)
class Samples:
    """What is fitted: `values` (S, C) at the times of `timeline`, rows weighted by `root` (S,) or (S, C), 0 = left out.

    `root` is one over the standard deviation; None stands for ones.
    """

    timeline: Timeline
    values: FloatArray
    root: FloatArray | None

    @property
    def count(self) -> int:
        """Number of rows that take part."""
        return self.timeline.samples if self.root is None else int(np.count_nonzero(self.kept()))

    def kept(self) -> BoolArray:
        """Return which rows (S,) take part."""
        if self.root is None:
            return np.ones(self.timeline.samples, dtype=np.bool_)
        return np.asarray(self.root > 0.0 if self.root.ndim == 1 else (self.root > 0.0).all(axis=1))

    def without(self, rows: BoolArray) -> Samples:
        """Return the same samples less some rows (S,)."""
        if self.root is None:
            return replace(self, root=(~rows).astype(np.float64))
        return replace(self, root=np.where(rows if self.root.ndim == 1 else rows[:, None], 0.0, self.root))

    def chunks(self) -> Iterator[Chunk]:
        """Yield all blocks: those with the same columns side by side, the others alone.

        Few large products instead of many small ones, which threads of the linear algebra would fight over.
        """
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
                yield from (self._alone(b) for b in range(first, last))

    def _alone(self, block: int) -> Chunk:
        """Return one block, its values zero where left out."""
        rows, channels = self.timeline.rows(block), self.values.shape[1]
        root = None if self.root is None else self.root[rows].reshape(rows.stop - rows.start, -1)
        if root is None or np.all(root == 1.0):
            return Chunk(block, block + 1, channels, self.values[rows], None)
        gone = (root == 0.0).any(axis=1)
        return Chunk(block, block + 1, channels, np.where(gone[:, None], 0.0, self.values[rows]), root)


@dataclass(frozen=True)
class Chunk:
    """Blocks `first` to `last` - 1 side by side: `values` (n, B·C), weights `root` (n, 1) or (n, C), None for ones.

    A block with weights stands alone.
    """

    first: int
    last: int
    channels: int
    values: FloatArray
    root: FloatArray | None

    def weighted(self, values: FloatArray, power: int) -> FloatArray:
        """Return values times a power of their weights."""
        return values if self.root is None else values * self.root**power

    def columns(self, columns: Columns, timeline: Timeline, common: FloatArray) -> FloatArray:
        """Return the columns of these blocks, `common` those of the first one and all full ones."""
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
class Tones:
    """Frequencies and decay rates (K,) of the lines exp((-δ + 2πjf)·t)."""

    frequency_hz: FloatArray
    decay_per_s: FloatArray


@dataclass(frozen=True)
class Columns:
    """The columns of a fit: Re and Im of each of the `tones` in turn, offset, `drift`, and the `slopes`.

    The slopes are the lines' columns times t: what a change of frequency or decay rate does.
    """

    tones: Tones
    drift: bool
    slopes: bool

    @property
    def linear(self) -> int:
        """Number of columns without the slopes."""
        return 2 * len(self.tones.frequency_hz) + (2 if self.drift else 1)

    def local(self, local_s: FloatArray) -> FloatArray:
        """Return the columns (n, P) at local times (n,)."""
        tones, lines = self.tones, len(self.tones.frequency_hz)
        columns = np.empty((len(local_s), self.linear + (2 * lines if self.slopes else 0)), order="F")
        for k in range(lines):
            # Whole turns are taken off before the angle is formed, so long records keep their last digits.
            angle = 2.0 * np.pi * np.mod(tones.frequency_hz[k] * local_s, 1.0)
            envelope = np.exp(-tones.decay_per_s[k] * local_s) if tones.decay_per_s[k] else 1.0
            columns[:, 2 * k] = np.cos(angle) * envelope
            columns[:, 2 * k + 1] = -np.sin(angle) * envelope
        columns[:, 2 * lines] = 1.0
        if self.drift:
            columns[:, 2 * lines + 1] = local_s
        if self.slopes:
            columns[:, self.linear :] = columns[:, : 2 * lines] * local_s[:, None]
        return columns

    def turned(self, timeline: Timeline) -> FloatArray:
        """Return the matrices (B, P, P) that turn coefficients of the record into those of each block."""
        lines, linear, centre = len(self.tones.frequency_hz), self.linear, timeline.centre_s
        size = linear + (2 * lines if self.slopes else 0)
        matrix = np.zeros((len(centre), size, size))
        for k in range(lines):
            angle = 2.0 * np.pi * timeline.turns(float(self.tones.frequency_hz[k]))
            factor = np.exp(1j * angle - self.tones.decay_per_s[k] * centre)
            turn = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]]).transpose(2, 0, 1)
            own = slice(2 * k, 2 * k + 2)
            matrix[:, own, own] = turn
            if self.slopes:
                slope = slice(linear + 2 * k, linear + 2 * k + 2)
                matrix[:, slope, slope] = turn
                matrix[:, own, slope] = centre[:, None, None] * turn
        matrix[:, 2 * lines, 2 * lines] = 1.0
        if self.drift:
            matrix[:, 2 * lines + 1, 2 * lines + 1] = 1.0
            matrix[:, 2 * lines, 2 * lines + 1] = centre
        return matrix


@dataclass(frozen=True)
class Normal:
    """Sums over all samples: `gram` (D, D, P, P) of the weighted columns, `right` (P, C), `power` (C,) of the values.

    D = 1 where all channels have the same weights, else C; the power is summed only where there are slopes.
    """

    gram: FloatArray
    right: FloatArray
    power: FloatArray


def normal_equations(samples: Samples, columns: Columns) -> Normal:
    """Gather the normal equations of a fit in one pass over its samples."""
    timeline = samples.timeline
    turned = columns.turned(timeline)
    size, channels = turned.shape[1], samples.values.shape[1]
    common = columns.local(timeline.local(0))
    common_gram = common.T @ common
    each = samples.root is not None and samples.root.ndim == 2
    gram = np.zeros((channels, channels, size, size) if each else (1, 1, size, size))
    alike = np.zeros(len(timeline.centre_s), dtype=np.bool_)
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
            alike[chunk.first : chunk.last] = True
        else:
            turn = turned[chunk.first]
            gram += turn.T @ _weighted_gram(basis, chunk.root) @ turn
    chosen = turned[alike]
    gram += np.sum(chosen.swapaxes(1, 2) @ common_gram @ chosen, axis=0)
    right = np.sum(turned.swapaxes(1, 2) @ local_right, axis=0)
    return Normal(gram, np.asarray(right), power)


def _weighted_gram(basis: FloatArray, root: FloatArray | None) -> FloatArray:
    """Return the Gram matrices (D, D, P, P) of a block's columns, weighted for each channel."""
    if root is None:
        return np.asarray((basis.T @ basis)[None, None])
    size, kinds = basis.shape[1], root.shape[1]
    weighted = (root[:, :, None] * basis[:, None, :]).reshape(len(basis), kinds * size)
    return np.asarray((weighted.T @ weighted).reshape(kinds, size, kinds, size).transpose(0, 2, 1, 3))


def residuals(
    samples: Samples, columns: Columns, coefficients: FloatArray
) -> Iterator[tuple[Chunk, FloatArray, FloatArray]]:
    """Yield chunk by chunk the blocks, their columns (n, P) and their residual (n, B·C), weighted, zero where left out.

    `coefficients` (P or fewer, C): those of the first columns.
    """
    timeline = samples.timeline
    own = columns.turned(timeline)[:, :, : len(coefficients)] @ coefficients
    common = columns.local(timeline.local(0))
    for chunk in samples.chunks():
        basis = chunk.columns(columns, timeline, common)
        residual = chunk.values - basis @ chunk.side_by_side(own[chunk.first : chunk.last])
        yield chunk, basis, chunk.weighted(residual, 1)


def as_complex(coefficients: FloatArray, lines: int) -> ComplexArray:
    """Return the complex amplitudes (K, ...) of coefficients (2K or more, ...)."""
    return np.asarray(coefficients[0 : 2 * lines : 2] + 1j * coefficients[1 : 2 * lines : 2])
