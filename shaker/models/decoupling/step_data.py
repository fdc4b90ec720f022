"""Records of several releases as one least squares problem: poles are shared, residues are shared by a load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.decoupling.model import pole_slopes
from shaker.models.decoupling.projection import Block, Slope
from shaker.models.decoupling.release_basis import ReleaseBasis, SampleBlocks, Shape, release_basis
from shaker.models.decoupling.start import averaged


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
