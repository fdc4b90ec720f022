"""Linear model of instruments per line, and random draws of it.

Phasors = design · acceleration + common errors + noise. The modules of `fusion.instruments` describe each kind of
instrument as such an observation.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from fusion.estimation.uncertainty import Kind as ErrorType
from fusion.estimation.uncertainty import Scope
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, check_shape

Kind = Literal["photogrammetry", "vibrometer", "accelerometer"]
MULTIPLE_TOLERANCE = 1e-9
FULL = 1.0 - 1e-6
"""Share of the driven motion from which on readings show all of it, as of a component (`RESOLUTION_TOLERANCE`)."""
BODY_SIZE_M = 0.1
"""Length that compares rotations with translations where ranks are decided: a body of the size of a hand."""
SCALE = np.array([1.0, 1.0, 1.0, 1.0 / BODY_SIZE_M, 1.0 / BODY_SIZE_M, 1.0 / BODY_SIZE_M])


@dataclass(frozen=True)
class CommonError:
    """One real unknown of several readings, with a normal prior of mean zero.

    `name` identifies the unknown: equal names in several observations are one unknown. It contains the position of a
    channel, so that a channel at another position is another unknown. `label` groups it in a budget. `u`: standard
    uncertainty in `unit`; `scope`: how long the unknown keeps its value; `dof`: degrees of freedom of `u`.

    The effect of one standard uncertainty on the phasors is slope · A + offset, with `slope` (K, M, 6) and `offset` (K,
    M). It follows the estimate A (K, 6) and not the readings.
    """

    name: str
    label: str
    u: float
    unit: str
    scope: Scope
    slope: ComplexArray
    offset: ComplexArray
    type: ErrorType = "B"
    dof: float = np.inf

    def effect(self, acceleration: ComplexArray) -> ComplexArray:
        """Return the change (K, M) of the phasors per standard uncertainty at `acceleration` (K, 6)."""
        return np.asarray(np.einsum("kmj,kj->km", self.slope, acceleration) + self.offset)


class Geometry:
    """Position of an instrument as far as Monte Carlo draws it exactly: none here."""

    @property
    def unknowns(self) -> frozenset[str]:
        """Names of the common errors that `rows` and `moved` take over."""
        return frozenset()

    def rows(self, design: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return the rows of N draws of positions and directions, from the exact `design`."""
        return np.broadcast_to(design, (deviates.count, *design.shape))

    def moved(self, readings: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return readings (N, K, M) as instruments in N other places give them."""
        return readings


@dataclass(frozen=True)
class Observation:
    """Readings of one body by one instrument: a stereo pair, or channels of one chain.

    `phasors` (K lines, M channels; NaN where a line is not usable). `design` (K, M, 6), complex: phasors = design · [x
    y z rx ry rz accelerations at the sensor origin]. `members` (M,): names by which rows are tested for consistency.
    `stated`: a systematic uncertainty is stated, so the fusion uses it.

    `main` (K, M, 6): rows along the axis that beams nearly follow. They decide which components are observed; other
    components of unobserved motion then make the readings uncertain. None if `design` decides.
    """

    name: str
    kind: Kind
    body: str
    phasors: Phasors
    design: ComplexArray
    common: tuple[CommonError, ...]
    members: tuple[str, ...]
    stated: bool
    geometry: Geometry = field(default_factory=Geometry)
    main: ComplexArray | None = None

    def __post_init__(self) -> None:
        shape = (*self.phasors.value.shape, 6)
        check_shape("design", self.design, shape)
        for error in self.common:
            check_shape(f"slope of {error.name}", error.slope, shape)
            check_shape(f"offset of {error.name}", error.offset, shape[:2])
        if len(self.members) != shape[1]:
            raise ValueError(f"members: expected {shape[1]} names, found {len(self.members)}")

    @property
    def main_design(self) -> ComplexArray:
        """Return the rows (K, M, 6) that decide which components are observed."""
        return self.design if self.main is None else self.main

    @property
    def title(self) -> str:
        """Return the name of the instrument in budgets."""
        return f"stereo {self.name}" if self.kind == "photogrammetry" else self.name

    def draw(self, acceleration: ComplexArray, deviates: Deviates, noise: str) -> DrawnReadings:
        """Return the readings of a motion for drawn unknowns; `noise`: name of its random stream.

        Readings are centred on those of the estimated `acceleration` (K, 6), zero where it was not observed, so that
        their scatter about the estimate is not counted twice. A relative error c of a reading, the same complex factor
        for all motions, is corrected as (1 + Re c)·exp(j·Im c). This is exact for scales, delays and responses;
        positions and directions are exact too. The remaining errors (calibration, errors periodic in the pixel) act to
        first order; the second order of a calibration would add some thousandths.
        """
        value = np.einsum("kmj,kj->km", self.design, acceleration)
        both = deviates.noise(noise, self.phasors.covariance, self.phasors.dof)
        channels = value.shape[1]
        readings = value + both[..., :channels] + 1j * both[..., channels:]
        factor = np.ones_like(readings)
        placed = self.geometry.unknowns
        for error in (error for error in self.common if error.name not in placed):
            drawn = deviates.unknown(error.name, error.dof)[:, None, None]
            relative = relative_change(error, self.design)
            if relative is None:
                readings = readings - drawn * error.effect(acceleration)
            else:
                factor = factor * (1.0 + drawn * relative.real) * np.exp(1j * drawn * relative.imag)
        readings = self.geometry.moved(readings / factor, deviates)
        return DrawnReadings(readings, self.geometry.rows(self.design, deviates))


def relative_change(error: CommonError, design: ComplexArray) -> ComplexArray | None:
    """Return the factors of an error that multiplies any reading, None for others."""
    power = np.sum(np.abs(design) ** 2, axis=2)
    overlap = np.sum(error.slope * design.conj(), axis=2)
    relative = np.divide(overlap, power, out=np.zeros_like(overlap), where=power > 0.0)
    rest = np.abs(error.slope - relative[:, :, None] * design).max(initial=0.0)
    multiple = rest <= MULTIPLE_TOLERANCE * np.abs(error.slope).max(initial=0.0)
    return np.asarray(relative) if multiple and not np.any(np.nan_to_num(error.offset)) else None


@dataclass(frozen=True)
class DrawnReadings:
    """N draws of an instrument: `readings` = `design` · acceleration."""

    readings: ComplexArray
    design: ComplexArray


@dataclass(frozen=True)
class Deviates:
    """Random numbers: `count` draws of every unknown, for `block` of the stream of `seed`.

    Equal names are the same unknown. Draws of a name do not depend on other draws or their order.
    """

    seed: int
    block: int
    count: int

    def stream(self, name: str) -> np.random.Generator:
        """Return the generator of a name."""
        return np.random.default_rng([self.seed, self.block, zlib.crc32(name.encode())])

    def normal(self, name: str, *shape: int) -> FloatArray:
        """Return standard normal deviates (N, ...)."""
        return self.stream(name).standard_normal((self.count, *shape))

    def unknown(self, name: str, dof: float = np.inf) -> FloatArray:
        """Return standard draws (N,), normal or of Student's t for finite `dof` (JCGM 101, 6.4.9)."""
        drawn = self.normal(name)
        if np.isinf(dof):
            return drawn
        return drawn / np.sqrt(self.stream(f"{name}, squares").chisquare(dof, len(drawn)) / dof)

    def angle(self, name: str, *shape: int) -> FloatArray:
        """Return uniform angles (N, ...) over the full circle."""
        return self.stream(name).uniform(0.0, 2.0 * np.pi, (self.count, *shape))

    def noise(self, name: str, covariance: FloatArray, dof: FloatArray) -> FloatArray:
        """Return draws (N, K, M) of noise with covariances (K, M, M).

        M values with an estimated covariance of `dof` (K,) degrees of freedom have a scaled and shifted multivariate
        t-distribution (JCGM 102, 5.3.2), a normal one for infinite degrees of freedom. Values that are not known (NaN)
        are zero.
        """
        values, vectors = np.linalg.eigh(np.nan_to_num(covariance))
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        drawn = np.einsum("kij,nkj->nki", root, self.normal(name, *covariance.shape[:2]))
        finite = np.isfinite(dof)
        freedom = np.where(finite, np.maximum(np.nan_to_num(dof, posinf=1.0), 1.0), 1.0)
        square = self.stream(f"{name}, squares").chisquare(freedom, (self.count, len(dof)))
        return np.asarray(drawn * np.where(finite, np.sqrt(freedom / square), 1.0)[:, :, None])


@dataclass(frozen=True)
class UnobservedMotion:
    """Limits of unobserved motion: amplitude of a component over that of the driven motion.

    `transverse`: of translations; `rocking`: of rotations times 0.1 m. The default 10 % is the limit of ISO 16063-21
    for transverse motion of a shaker. An amplitude at its limit with uniform phase has the standard uncertainty
    limit/√2 in each part (arc-sine distribution), in each component that is not observed. This covers motion in phase
    with the drive; amplitudes uniform over the disc would have limit/2. Uniform amplitudes in a uniform direction, as
    in ISO 16063-21 (1/√18 with the transverse sensitivity), would have less.

    `drive` (6,): driven motion, translations and rotations times 0.1 m, a unit vector; None if it is not stated, and
    the largest observed component is the driven one. `driven` (K,): its amplitude as limited by other instruments, for
    those that do not observe it.
    """

    transverse: float = 0.1
    rocking: float = 0.1
    drive: tuple[float, ...] | None = None
    driven: FloatArray | None = None

    def unbounded(self, share: FloatArray) -> BoolArray:
        """Return the lines (K,) at which the driven motion has no limit."""
        limit = np.full(share.shape, np.inf) if self.driven is None else self.driven
        none = np.zeros(share.shape, np.bool_)
        return none if self.drive is None else np.isinf(np.where(share < FULL, limit, 0.0)) & np.isinf(self.gain(share))

    def gain(self, share: FloatArray) -> FloatArray:
        """Return the ratio (K,) by which the driven amplitude may exceed its observed part.

        Infinite without limit. The readings show P·(s·d + t) of the drive d with amplitude s and other motion t across
        it, |t| < λ|s|; `share` q² = |P·d|². d·P·(s·d + t)/q² is an estimate of s. P·d has the part q·√(1 - q²) across
        d, so t changes the estimate by at most λ|s|·√(1 - q²)/q: λ·tan θ for one reading at the angle θ to the drive.
        """
        q2 = np.maximum(share, np.finfo(np.float64).tiny)
        moved = max(self.transverse, self.rocking) * np.sqrt(np.maximum(1.0 - q2, 0.0) / q2)
        moved = np.where(share >= FULL, 0.0, np.minimum(moved, 1.0))
        return np.asarray(np.divide(1.0, 1.0 - moved, out=np.full(moved.shape, np.inf), where=moved < 1.0))

    def driven_amplitude(self, acceleration: ComplexArray, share: FloatArray) -> FloatArray:
        """Return the largest amplitude (K,) of the driven motion in m/s²; infinite without limit."""
        if self.drive is None:
            return np.zeros(len(acceleration))
        shown = np.abs(np.nan_to_num(acceleration) / SCALE @ np.array(self.drive))
        gain, seen = self.gain(share), np.maximum(share, np.finfo(np.float64).tiny)
        amplitude = np.where(np.isinf(gain), np.inf, shown / seen * np.where(np.isinf(gain), 0.0, gain))
        return (
            amplitude if self.driven is None else np.where(share < FULL, np.minimum(amplitude, self.driven), amplitude)
        )

    def amplitude(self, acceleration: ComplexArray, observed: BoolArray, share: FloatArray | None = None) -> FloatArray:
        """Return the assumed amplitudes (K, 6) of components that are not `observed` (K, 6).

        Zero for the others. `acceleration` (K, 6): the estimate; `share` (K,): observed part of the driven motion, None
        for all of it. Infinite if the driven motion has no limit.
        """
        share = np.ones(len(acceleration)) if share is None else share
        size = np.max(np.where(observed, np.abs(acceleration / SCALE), 0.0), axis=1, keepdims=True)
        driven = self.driven_amplitude(acceleration, share)[:, None]
        limit = np.repeat([self.transverse, self.rocking], 3) * SCALE
        along = np.abs(np.zeros(6) if self.drive is None else np.array(self.drive)) * SCALE
        lost = np.isinf(driven)
        assumed = limit * np.maximum(size, np.where(lost, 0.0, driven)) + along * np.where(lost, 0.0, driven)
        return np.asarray(np.where(observed, 0.0, np.where(lost, np.inf, assumed)))

    def __str__(self) -> str:
        """Return the limits in words."""
        return f"{self.transverse:.3g} of the driven motion (rotations over {BODY_SIZE_M} m: {self.rocking:.3g})"
