"""Records of releases as a multi-output fit sees them, and where it starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker.arrays import ComplexArray, FloatArray
from shaker.decoupling.model import Block, Slope, pole_slopes

# Poles that many decaying records share, from the signal space of their windows.


_WINDOW = 128
_STANDS_OUT = 30.0
"""Noise alone reaches this density, over its mean, once in exp(30) lines."""
_ABOVE_NOISE = 1.5
_MOST = 40
_CALMEST, _QUICKEST = 0.0, 0.4


def highest_frequency(parts: Sequence[FloatArray], rate_hz: float) -> float:
    """Return the highest frequency in Hz at which a record (C, N) of unit noise swings clearly above its noise."""
    highest = 0.0
    for part in parts:
        window = np.hanning(part.shape[1])
        lines = np.fft.rfft((part - part.mean(axis=1, keepdims=True)) * window, axis=1)
        density = np.abs(lines) ** 2 / np.sum(window**2)
        floor = np.maximum(1.0, np.median(density[:, density.shape[1] // 2 :], axis=1, keepdims=True) / np.log(2.0))
        clear = np.flatnonzero(np.any(density > _STANDS_OUT * floor, axis=0))
        highest = max(highest, float(clear[-1] if clear.size else 1) * rate_hz / part.shape[1])
    return highest


def averaged(samples: FloatArray, size: int) -> FloatArray:
    """Return means (…, A) over blocks of `size` samples (…, N); samples that fill no block are left out."""
    count = samples.shape[-1] // size
    return np.asarray(samples[..., : count * size].reshape(*samples.shape[:-1], count, size).mean(axis=-1))


def shared_poles(parts: Sequence[FloatArray], rate_hz: float) -> ComplexArray:
    """Return the upper poles in rad/s of decaying records (C, N) of equal white noise that share a sampling rate.

    All windows of L samples of Σ a·exp(p t) lie in the span of the vectors exp(p n/f), n = 0 … L - 1, whatever a is:
    the eigenvectors of the sum of their products above the noise span it, and a shift by one sample turns it by
    exp(p/f) (Hua and Sarkar, matrix pencil, IEEE Trans. ASSP 38 (1990) 814; Roy and Kailath, ESPRIT, 1989).
    """
    length = min(_WINDOW, min(part.shape[1] for part in parts) // 2)
    gram = np.zeros((length, length))
    windows = 0
    for part in parts:
        for row in part:
            table = np.lib.stride_tricks.sliding_window_view(row, length)
            gram += table.T @ table
            windows += len(table)
    value, vector = np.linalg.eigh(gram / windows)
    noise = float(np.median(value[: length // 2]))
    count = int(np.clip(np.count_nonzero(value > _ABOVE_NOISE * noise), 3, min(_MOST, length // 2)))
    space = vector[:, -count:]
    turns = np.linalg.eigvals(np.linalg.lstsq(space[:-1], space[1:], rcond=None)[0])
    poles = np.log(turns[np.abs(turns) > 1e-6] + 0j) * rate_hz
    ratio = -poles.real / np.abs(poles)
    kept = (poles.imag > 2e-3 * rate_hz) & (poles.imag < 0.9 * np.pi * rate_hz)
    return np.asarray(poles[kept & (ratio > _CALMEST) & (ratio < _QUICKEST)])


# What poles answer to a release, in averages over blocks of samples, with the slopes that a fit needs.


Shape = Literal["ramp", "smooth"]
SHORTEST = 1e-3
"""A release shorter than this share of a sample counts as a step."""


@dataclass(frozen=True)
class ReleaseBasis:
    """Answers (A, P) of 1/(s - p) to a load that goes from 0 to 1, and their slopes: over p (analytic), over the middle
    of the release, over its duration with the middle held."""

    value: ComplexArray
    by_pole: ComplexArray
    by_middle: ComplexArray
    by_duration: ComplexArray


@dataclass(frozen=True)
class SampleBlocks:
    """Times of samples that are averaged: `count` blocks of `size` samples at `rate_hz`, the first at `start_s`."""

    start_s: float
    rate_hz: float
    count: int
    size: int


def release_basis(
    poles: ComplexArray, blocks: SampleBlocks, middle_s: float, duration_s: float, shape: Shape
) -> ReleaseBasis:
    """Return what poles (P,) in rad/s answer, averaged over blocks (A,).

    The load goes along a straight line ("ramp") or half a cosine ("smooth") of `duration_s` around `middle_s`. With τ
    from the onset, x = pT and S the release's spectrum, (1 - e^-x)/x or π²(1 + e^-x)/(2(x² + π²)): after the release
    (S e^{pτ} - 1)/p, of which a block's mean is closed; during it sample by sample.
    """
    p = np.asarray(poles, dtype=np.complex128)
    short = duration_s * blocks.rate_hz < SHORTEST
    length = 0.0 if short else duration_s
    onset = middle_s - length / 2.0
    first = blocks.start_s + np.arange(blocks.count) * blocks.size / blocks.rate_hz - onset
    late = first >= length
    touched = ~late & (first + (blocks.size - 1) / blocks.rate_hz > 0.0)
    parts = [np.zeros((blocks.count, len(p)), dtype=np.complex128) for _ in range(4)]
    for part, found in zip(parts, _after(p, first[late] - length, length, blocks, shape), strict=True):
        part[late] = found
    if touched.any():
        tau = (first[touched][:, None] + np.arange(blocks.size) / blocks.rate_hz).ravel()
        for part, found in zip(parts, _sampled(p, tau, length, blocks.rate_hz, shape), strict=True):
            part[touched] = found.reshape(-1, blocks.size, len(p)).mean(axis=1)
    value, by_pole, by_onset, by_duration = parts
    return ReleaseBasis(value, by_pole, by_onset, by_duration - by_onset / 2.0)


def _spectrum(x: ComplexArray, shape: Shape) -> tuple[ComplexArray, ...]:
    """Factors (a, b), (a', b') with S = a + b·e^-x and ∂S/∂x = a' + b'·e^-x."""
    if shape == "ramp":
        return 1 / x, -1 / x, -1 / x**2, (1 + x) / x**2
    below = x**2 + np.pi**2
    half = np.pi**2 / 2
    return half / below, half / below, -2 * half * x / below**2, -half / below - 2 * half * x / below**2


def _after(
    p: ComplexArray, since_s: FloatArray, length: float, blocks: SampleBlocks, shape: Shape
) -> tuple[ComplexArray, ...]:
    """Mean answers and slopes over p, onset and duration of blocks whose first sample is `since_s` after the end."""
    inside = np.arange(blocks.size)[:, None] / blocks.rate_hz
    turns = np.exp(inside * p)
    mean, mean_slope = turns.mean(axis=0), (inside * turns).mean(axis=0)
    grown = np.exp(since_s[:, None] * p)
    decay, decay_slope = grown * mean, since_s[:, None] * grown * mean + grown * mean_slope
    if length == 0.0:
        value = (decay - 1) / p
        return value, (decay_slope - value) / p, -decay, -decay / 2
    a, b, a_slope, b_slope = _spectrum(p * length, shape)
    through = np.exp(p * length)
    share, share_slope = a * through + b, a_slope * through + b_slope
    value = (share * decay - 1) / p
    by_pole = (share * decay_slope + length * (share_slope + share) * decay - value) / p
    return value, by_pole, -share * decay, share_slope * decay


def _sampled(p: ComplexArray, tau: FloatArray, length: float, rate_hz: float, shape: Shape) -> tuple[ComplexArray, ...]:
    """Answers and slopes over p, onset and duration at single times since the onset."""
    found = tuple(np.zeros((len(tau), len(p)), dtype=np.complex128) for _ in range(4))
    single = SampleBlocks(0.0, rate_hz, 1, 1)
    after, during = tau >= length, (tau > 0.0) & (tau < length)
    for whole, part in zip(found, _after(p, tau[after] - length, length, single, shape), strict=True):
        whole[after] = part
    if during.any():
        follow = _along_line if shape == "ramp" else _along_cosine
        for whole, part in zip(found, follow(p, tau[during][:, None], length), strict=True):
            whole[during] = part
    return found


def _along_line(p: ComplexArray, t: FloatArray, length: float) -> tuple[ComplexArray, ...]:
    """Answers and slopes while the load goes along a line: y = (expm1(pt)/p - t)/(pT)."""
    grown = np.expm1(p * t)
    value = (grown / p - t) / (p * length)
    by_pole = (t * (grown + 1.0) - grown / p) / (p**2 * length) - value / p
    return value, by_pole, -(p * value + t / length), -value / length


def _along_cosine(p: ComplexArray, t: FloatArray, length: float) -> tuple[ComplexArray, ...]:
    """Answers and slopes while the load goes along half a cosine, w = π/T.

    y = expm1(pt)/(2p) - (p e^{pt} - p cos wt + w sin wt)/(2(p² + w²)).
    """
    turn = np.pi / length
    cosine, sine = np.cos(turn * t), np.sin(turn * t)
    grown, below = np.exp(p * t), p**2 + turn**2
    above = p * grown - p * cosine + turn * sine
    value = np.expm1(p * t) / (2 * p) - above / (2 * below)
    by_pole = (t * grown - np.expm1(p * t) / p) / (2 * p)
    by_pole += p * above / below**2 - ((1.0 + p * t) * grown - cosine) / (2 * below)
    by_turn = turn * above / below**2 - (p * t * sine + sine + turn * t * cosine) / (2 * below)
    return value, by_pole, -(p * value + (1.0 - cosine) / 2.0), -by_turn * turn / length


# Records of several releases as one least squares problem: poles are shared, residues are shared by a load.


@dataclass(frozen=True)
class Poles:
    """Common poles: `frequency_hz` and `damping_ratio` (M,) of the modes, `real_hz` (Q,)."""

    frequency_hz: FloatArray
    damping_ratio: FloatArray
    real_hz: FloatArray

    @property
    def modes(self) -> int:
        """Number of modes."""
        return len(self.frequency_hz)

    @property
    def count(self) -> int:
        """Number of parameters, which is that of the columns of a design too."""
        return 2 * self.modes + len(self.real_hz)

    @property
    def vector(self) -> FloatArray:
        """All parameters."""
        return np.concatenate([self.frequency_hz, self.damping_ratio, self.real_hz])

    def with_vector(self, vector: FloatArray) -> Poles:
        """Return poles of other parameters."""
        f, z, hz = np.split(vector[: self.count], [self.modes, 2 * self.modes])
        return Poles(f, z, hz)

    @property
    def allowed(self) -> bool:
        """Whether these are poles of modes that swing and decay, as those of a sensor do."""
        damped = np.all((self.damping_ratio > 0.0) & (self.damping_ratio < 0.7))
        return bool(damped and np.all(self.frequency_hz > 0) and np.all(self.real_hz > 0))

    @property
    def values(self) -> ComplexArray:
        """Poles in rad/s, those of the modes first."""
        omega, zeta = 2 * np.pi * self.frequency_hz, self.damping_ratio
        upper = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
        return np.concatenate([upper, -2 * np.pi * self.real_hz + 0j])

    def with_mode(self, pole: complex) -> Poles:
        """Return these and one more mode."""
        f, z = (
            np.append(self.frequency_hz, abs(pole) / (2 * np.pi)),
            np.append(self.damping_ratio, -pole.real / abs(pole)),
        )
        return Poles(f, np.clip(z, 1e-4, 0.9), self.real_hz)

    def with_real(self, hz: float) -> Poles:
        """Return these and one more real pole."""
        return replace(self, real_hz=np.append(self.real_hz, hz))

    def without(self, place: int) -> Poles:
        """Return these without one: a mode, or counted behind them a real pole."""
        if place < self.modes:
            return replace(
                self,
                frequency_hz=np.delete(self.frequency_hz, place),
                damping_ratio=np.delete(self.damping_ratio, place),
            )
        return replace(self, real_hz=np.delete(self.real_hz, place - self.modes))

    @property
    def smooth(self) -> FloatArray:
        """Basis (2M + Q, 2M - 1) of the coefficients of outputs that start smoothly: Σ R·p^k = 0, k = 0 … Q."""
        return np.asarray(np.linalg.qr(self._moments()[0], mode="complete")[0][:, len(self.real_hz) + 1 :])

    @property
    def smooth_slopes(self) -> FloatArray:
        """How that basis turns with every parameter (2M + Q, 2M + Q, 2M - 1): Gᵀ·S = 0, dS = -G·(GᵀG)⁻¹·dGᵀ·S."""
        moments, slopes = self._moments()
        held = np.linalg.pinv(moments).T
        return np.asarray(-held @ (np.transpose(slopes, (0, 2, 1)) @ self.smooth))

    def _moments(self) -> tuple[FloatArray, FloatArray]:
        """What gives Σ R·p^k (2M + Q, Q + 1) in units of the fastest pole, and its slopes by parameter in front."""
        m, values = self.modes, self.values
        unit = float(np.abs(values).max())
        k = np.arange(len(self.real_hz) + 1)
        power = (values[:, None] / unit) ** k
        grows = k * (values[:, None] / unit) ** np.maximum(k - 1, 0) / unit
        found = np.concatenate([2 * power[:m].real, -2 * power[:m].imag, power[m:].real])
        slopes = np.zeros((self.count, *found.shape))
        for i, slope in enumerate(np.concatenate(pole_slopes(self.frequency_hz, self.damping_ratio))):
            change = slope * grows[i % m]
            slopes[i, i % m], slopes[i, m + i % m] = 2 * change.real, -2 * change.imag
        for q in range(len(self.real_hz)):
            slopes[2 * m + q, 2 * m + q] = -2 * np.pi * grows[m + q].real
        return found, slopes

    def columns(self, place: int) -> list[int]:
        """Return the columns of a design that belong to one pole."""
        return [place, place + self.modes] if place < self.modes else [place + self.modes]


@dataclass(frozen=True)
class Release:
    """When a load changes: middle and duration in s, whether the duration is fitted, and how the load goes."""

    middle_s: float
    duration_s: float
    free: bool
    shape: Shape


@dataclass(frozen=True)
class Sampled:
    """One record ready for a fit: means over blocks of samples (A, C) over their noise, times, load."""

    name: str
    component: str
    amplitude: float
    data: FloatArray
    blocks: SampleBlocks


@dataclass(frozen=True)
class StepProblem:
    """All records by load component: the least squares problem of poles and releases.

    A sensor's outputs follow displacements, so that no load, however sudden, gives them a velocity at once, and every
    real pole is a lag of the amplifier behind them: H falls as s^-(2 + Q), Σ R·p^k = 0 for k = 0 … Q in every element.
    This is what tells the beginning of a release from a delay of the outputs; designs have the columns that are left
    (`Poles.smooth`).

    Parameters: those of the poles, then middle and duration of every record in the order of `records`.
    """

    records: tuple[Sampled, ...]
    components: tuple[str, ...]

    @property
    def values(self) -> int:
        """Number of data."""
        return sum(record.data.size for record in self.records)

    def vector(self, poles: Poles, releases: Sequence[Release]) -> FloatArray:
        """Return all parameters."""
        own = [value for release in releases for value in (release.middle_s, release.duration_s)]
        return np.concatenate([poles.vector, own])

    def scale(self, poles: Poles) -> FloatArray:
        """Return the size of a change of every parameter that matters."""
        rate = self.records[0].blocks.rate_hz
        parts = (1e-2 * poles.frequency_hz, np.full(poles.modes, 1e-2), 0.5 * poles.real_hz)
        return np.concatenate([*parts, np.full(2 * len(self.records), 1.0 / rate)])

    def split(
        self, vector: FloatArray, poles: Poles, releases: Sequence[Release]
    ) -> tuple[Poles, tuple[Release, ...]] | None:
        """Return poles and releases of a vector, None where they are not allowed."""
        found, own = poles.with_vector(vector), vector[poles.count :].reshape(-1, 2)
        if not found.allowed:
            return None
        moved = [
            replace(
                release,
                middle_s=float(row[0]),
                duration_s=max(0.0, float(row[1])) if release.free else release.duration_s,
            )
            for release, row in zip(releases, own, strict=True)
        ]
        return found, tuple(moved)

    def blocks(self, poles: Poles, releases: Sequence[Release], *, slopes: bool = True) -> list[Block]:
        """Return one block of rows per load component, with slopes or, for a mere comparison, without."""
        found = []
        for component in self.components:
            places = [i for i, record in enumerate(self.records) if record.component == component]
            found.append(_component_block(self, poles, releases, places, slopes))
        return found


def prepared(samples: FloatArray, noise: FloatArray, size: int) -> FloatArray:
    """Return means over `size` samples (C, N) over their noise (C,), as (A, C), the mean of the record taken off."""
    data = averaged(samples, size).T / (noise / np.sqrt(size))
    return np.asarray(data - data.mean(axis=0))


def decay_start(blocks: SampleBlocks, release: Release) -> int:
    """Return the first block of samples of which none is taken while the load changes."""
    end_s = release.middle_s + release.duration_s / 2.0
    return max(0, int(np.ceil((end_s - blocks.start_s) * blocks.rate_hz / blocks.size)))


def _component_block(
    problem: StepProblem, poles: Poles, releases: Sequence[Release], places: Sequence[int], wanted: bool
) -> Block:
    """All records of one load; the level of each is taken off data and design alike."""
    designs: list[FloatArray] = []
    slopes: list[Slope] = []
    smooth, row = poles.smooth, 0
    left = np.arange(smooth.shape[1])
    for i in places:
        record, release = problem.records[i], releases[i]
        basis = release_basis(poles.values, record.blocks, release.middle_s, release.duration_s, release.shape)
        rows = slice(row, row + record.blocks.count)
        designs.append(_level_off(record.amplitude * _columns(basis.value, poles.modes)))
        row = rows.stop
        if not wanted:
            continue
        turns = enumerate(poles.smooth_slopes)
        slopes += [_smoothed(slope, smooth) for slope in _pole_slopes(poles, basis, record.amplitude, rows)]
        slopes += [Slope(place, rows, left, designs[-1] @ turn) for place, turn in turns if np.any(turn)]
        timed = ((0, basis.by_middle), (1, basis.by_duration if release.free else None))
        for k, change in timed:
            if change is not None:
                value = _level_off(record.amplitude * _columns(change, poles.modes))
                slopes.append(Slope(poles.count + 2 * i + k, rows, left, value @ smooth))
    data = np.concatenate([problem.records[i].data for i in places])
    return Block(np.concatenate(designs) @ smooth, data, tuple(slopes))


def _smoothed(slope: Slope, smooth: FloatArray) -> Slope:
    """The slope of a design that has the columns of outputs that start smoothly."""
    return replace(slope, columns=np.arange(smooth.shape[1]), value=slope.value @ smooth[slope.columns])


def _columns(value: ComplexArray, modes: int) -> FloatArray:
    """Columns (A, 2M + Q) that Re and Im of the residues and the real residues multiply."""
    upper, real = value[:, :modes], value[:, modes:]
    return np.concatenate([2 * upper.real, -2 * upper.imag, real.real], axis=1)


def _pole_slopes(poles: Poles, basis: ReleaseBasis, amplitude: float, rows: slice) -> list[Slope]:
    """How the columns of each pole follow its parameters."""
    m, found = poles.modes, []
    for k, slope in enumerate(pole_slopes(poles.frequency_hz, poles.damping_ratio)):
        change = basis.by_pole[:, :m] * slope
        for i in range(m):
            value = _level_off(amplitude * np.stack([2 * change[:, i].real, -2 * change[:, i].imag], axis=1))
            found.append(Slope(k * m + i, rows, np.array([i, m + i]), value))
    for q in range(len(poles.real_hz)):
        value = _level_off(-2 * np.pi * amplitude * basis.by_pole[:, m + q : m + q + 1].real)
        found.append(Slope(2 * m + q, rows, np.array([2 * m + q]), value))
    return found


def _level_off(value: FloatArray) -> FloatArray:
    """Take the mean of every column off."""
    return np.asarray(value - value.mean(axis=0))
