"""One draw of everything uncertain in a recording, and the estimate it gives."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.base import ComputeError
from fusion.estimation.least_squares import Solution
from fusion.estimation.measurement_model import (
    KINDS,
    ORDER_BELOW_ACCELERATION,
    CommonError,
    Observation,
    Reading,
    StereoReading,
    across,
    chain_name,
    placement_name,
)
from fusion.recording.manifest import ChannelEntry
from fusion.sensitivity.body import INERTIA_ENTRIES, Body, Part
from photogram.geometry import rotation_from_vector
from shaker.arrays import ComplexArray, FloatArray
from shaker.sine.phasor import derivative_factor

# Draws of unknowns by their names, the same whatever else is drawn and in whatever order.


@dataclass(frozen=True)
class Deviates:
    """`count` draws of every unknown, block `block` of the stream of `seed`: equal names are the same unknown."""

    seed: int
    block: int
    count: int

    def stream(self, name: str) -> np.random.Generator:
        """Return the generator of a name."""
        return np.random.default_rng([self.seed, self.block, zlib.crc32(name.encode())])

    def normal(self, name: str, *shape: int) -> FloatArray:
        """Return standard normal deviates (N, ...)."""
        return self.stream(name).standard_normal((self.count, *shape))

    def angle(self, name: str) -> FloatArray:
        """Return angles (N,) of which nothing is known."""
        return self.stream(name).uniform(0.0, 2.0 * np.pi, self.count)

    def noise(self, name: str, covariance: FloatArray, dof: FloatArray) -> FloatArray:
        """Return deviates (N, K, M) of covariances (K, M, M) known with `dof` (K,) degrees of freedom.

        A multivariate t-distribution, scaled and shifted, is what M values with an estimated covariance leave
        (JCGM 102, 5.3.2); for infinite degrees of freedom a normal one. What is not known (NaN) is zero.
        """
        values, vectors = np.linalg.eigh(np.nan_to_num(covariance))
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        drawn = np.einsum("kij,nkj->nki", root, self.normal(name, *covariance.shape[:2]))
        finite = np.isfinite(dof)
        freedom = np.where(finite, np.maximum(np.nan_to_num(dof, posinf=1.0), 1.0), 1.0)
        square = self.stream(f"{name}, squares").chisquare(freedom, (self.count, len(dof)))
        return np.asarray(drawn * np.where(finite, np.sqrt(freedom / square), 1.0)[:, :, None])


# What instruments read if their errors are what is drawn: readings and rows of the linear model, draw by draw.


Source = StereoReading | tuple[Reading, ...]
"""What an observation was made of: a stereo pair, or the channels of one instrument on one body."""
MULTIPLE_TOLERANCE = 1e-9
TRANSVERSE = "transverse sensitivity"


@dataclass(frozen=True)
class Instrument:
    """An observation, what it was made of, its `place` among all of them, and `gravity_mps2` (3,) where stated."""

    observation: Observation
    source: Source
    place: int
    gravity_mps2: FloatArray | None


@dataclass(frozen=True)
class Drawn:
    """N draws of an instrument: `readings` (N, K, M) = `design` (N, K, M, 6) · acceleration."""

    readings: ComplexArray
    design: ComplexArray


def pair_up(
    observations: Sequence[Observation],
    pairs: Sequence[StereoReading],
    readings: Sequence[Reading],
    gravity_mps2: FloatArray | None,
) -> tuple[Instrument, ...]:
    """Return every observation with the stereo pair or the channels that it was made of, in their order."""
    groups: dict[tuple[str, str, str], list[Reading]] = {}
    for reading in readings:
        kind = KINDS.get(reading.entry.quantity)
        if kind is not None:
            groups.setdefault((chain_name(reading), str(reading.entry.body), kind), []).append(reading)
    order = iter(pairs)
    return tuple(
        Instrument(seen, _source(seen, order, groups), place, gravity_mps2) for place, seen in enumerate(observations)
    )


def _source(
    seen: Observation, pairs: Iterator[StereoReading], groups: Mapping[tuple[str, str, str], Sequence[Reading]]
) -> Source:
    """What an observation was made of: the next pair, or the channels of one instrument on one body."""
    return next(pairs) if seen.kind == "photogrammetry" else tuple(groups[seen.name, seen.body, seen.kind])


def draw_instrument(instrument: Instrument, acceleration: ComplexArray, deviates: Deviates) -> Drawn:
    """Return what an instrument says of a motion if its unknowns are what is drawn.

    Readings are centred on those of the estimated `acceleration` (K, 6), zero where nobody observed it, so that their
    scatter about the estimate is not counted a second time. A relative error c of a reading, the same complex factor
    for all motions, is taken off as (1 + Re c)·exp(j·Im c), which is exact for scales, delays and responses; places and
    directions make new rows, the pose of a pair turns its vectors; what remains (calibration, errors periodic in the
    pixel) acts as its first-order effect, to which a calibration's second order adds some thousandths.
    """
    seen = instrument.observation
    value = np.einsum("kmj,kj->km", seen.design, acceleration)
    noise = deviates.noise(f"noise of instrument {instrument.place}", seen.phasors.covariance, seen.phasors.dof)
    channels = value.shape[1]
    readings = value + noise[..., :channels] + 1j * noise[..., channels:]
    placed, design = _placed(instrument, deviates)
    factor = np.ones_like(readings)
    for error in seen.common:
        if error.name in placed:
            continue
        drawn = deviates.normal(error.name)[:, None, None]
        relative = relative_change(error, seen.design)
        if relative is None:
            readings = readings - drawn * error.effect(acceleration)
        else:
            factor = factor * (1.0 + drawn * relative.real) * np.exp(1j * drawn * relative.imag)
    readings = readings / factor
    if isinstance(instrument.source, StereoReading):
        readings = _reposed(readings, instrument.source, deviates)
    return Drawn(readings, design)


def relative_change(error: CommonError, design: ComplexArray) -> ComplexArray | None:
    """Return the complex factors (K, M) by which an error multiplies the readings of any motion; None for others."""
    power = np.sum(np.abs(design) ** 2, axis=2)
    overlap = np.sum(error.slope * design.conj(), axis=2)
    relative = np.divide(overlap, power, out=np.zeros_like(overlap), where=power > 0.0)
    rest = np.abs(error.slope - relative[:, :, None] * design).max(initial=0.0)
    multiple = rest <= MULTIPLE_TOLERANCE * np.abs(error.slope).max(initial=0.0)
    return np.asarray(relative) if multiple and not np.any(np.nan_to_num(error.offset)) else None


def _placed(instrument: Instrument, deviates: Deviates) -> tuple[set[str], ComplexArray]:
    """Return the unknowns of placement, which are drawn exactly, and the rows (N, K, M, 6) that they make."""
    seen, source = instrument.observation, instrument.source
    if isinstance(source, StereoReading):
        names = {name for kind in ("position", "rotation") for name in _pose_names(source, kind)}
        return names, np.broadcast_to(seen.design, (deviates.count, *seen.design.shape))
    rows, names = [], set()
    for reading in source:
        point = _point(reading, deviates)
        direction = _direction(reading, deviates)
        rows.append(channel_rows(reading.entry, point, direction, seen.phasors.frequency_hz, instrument.gravity_mps2))
        names |= {placement_name(reading.entry, "point", axis) for axis in "xyz"}
        names |= {placement_name(reading.entry, kind, axis) for kind in ("direction", TRANSVERSE) for axis in "01"}
    return names, np.stack(rows, axis=2)


def _point(reading: Reading, deviates: Deviates) -> FloatArray:
    """Places (N, 3) where a channel may measure."""
    entry = reading.entry
    stated = np.zeros(3) if entry.point is None else np.array(entry.point, dtype=np.float64)
    u = np.broadcast_to(np.asarray(entry.point_uncertainty, dtype=np.float64), (3,))
    moved = [deviates.normal(placement_name(reading.entry, "point", axis)) for axis in "xyz"]
    return np.asarray(stated + u * np.stack(moved, axis=1))


def _direction(reading: Reading, deviates: Deviates) -> FloatArray:
    """Vectors (N, 3) along which a channel may be sensitive: its axis turned, and a leak at right angles to it.

    The size of a transverse sensitivity is known and its direction is not, so its angle is uniform.
    """
    entry = reading.entry
    stated = np.asarray(entry.direction, dtype=np.float64)
    stated = stated / np.linalg.norm(stated)
    sides = across(stated)
    tilt = np.stack([deviates.normal(placement_name(reading.entry, "direction", axis)) for axis in "01"], axis=1)
    spin = np.cross(stated, entry.direction_uncertainty * tilt @ sides)
    turned = np.einsum("nij,j->ni", rotation_from_vector(spin), stated)
    angle = deviates.angle(placement_name(reading.entry, TRANSVERSE, "0"))
    leak = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ sides
    return np.asarray(turned + entry.transverse_sensitivity * leak)


def channel_rows(
    entry: ChannelEntry,
    point: FloatArray,
    direction: FloatArray,
    frequency_hz: FloatArray,
    gravity_mps2: FloatArray | None,
) -> ComplexArray:
    """Return the rows (N, K, 6) of a channel at places r (N, 3) with sensitivity along d (N, 3).

    [d, r × d]·(jω)^n with n = 0, -1, -2 for acceleration, velocity, displacement; d × g/ω² is added to the rotations
    of an accelerometer, whose axis tilts against gravity; [0, d]/(jω) of a gyroscope.
    """
    factor = derivative_factor(frequency_hz, ORDER_BELOW_ACCELERATION[entry.quantity])
    rows = np.zeros((len(point), len(frequency_hz), 6))
    if entry.quantity == "angular_velocity":
        rows[:, :, 3:] = direction[:, None]
        return np.asarray(factor[:, None] * rows)
    rows[:, :, :3] = direction[:, None]
    rows[:, :, 3:] = np.cross(point, direction)[:, None]
    if entry.quantity == "acceleration" and gravity_mps2 is not None:
        omega2 = (2.0 * np.pi * frequency_hz) ** 2
        rows[:, :, 3:] += np.cross(direction, gravity_mps2)[:, None] / omega2[:, None]
    return np.asarray(factor[:, None] * rows)


def _pose_names(pair: StereoReading, kind: str) -> list[str]:
    """Names of the unknowns of a pair's pose, by axis."""
    return [f"stereo {pair.name}: pose {kind} {axis}" for axis in "xyz"]


def _reposed(readings: ComplexArray, pair: StereoReading, deviates: Deviates) -> ComplexArray:
    """Displacement phasors (N, K, 6) of a pair whose frame lies elsewhere: t' = R (t + theta × p), theta' = R theta."""
    u = np.asarray(pair.pair.pose_uncertainty, dtype=np.float64)
    position, rotation = (
        np.stack([deviates.normal(name) for name in _pose_names(pair, kind)], axis=1)
        for kind in ("position", "rotation")
    )
    turn = rotation_from_vector(u[3:] * rotation)
    shift, spin = readings[..., :3], readings[..., 3:]
    moved = shift + np.cross(spin, (u[:3] * position)[:, None])
    return np.concatenate([np.einsum("nij,nkj->nki", turn, part) for part in (moved, spin)], axis=-1)


# Load matrices of a body whose masses, centres and moments of inertia are what is drawn.


PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def draw_load_matrices(
    body: Body,
    frequency_hz: FloatArray,
    gravity_mps2: FloatArray | None,
    u_gravity_mps2: FloatArray | None,
    deviates: Deviates,
) -> ComplexArray:
    """Return N load matrices (N, K, 6, 6): mass, centre of mass and inertia of every part drawn, and whatever else.

    The parts' own numbers enter exactly; gravity, the joint and the air by their first-order changes.
    """
    own = {f"{part.name}: {what}" for part in body.parts for what in ("mass", "centre of mass", "inertia")}
    total = np.zeros((deviates.count, len(frequency_hz), 6, 6), dtype=np.complex128)
    for part in body.parts:
        terms = _polynomial(replace(body, parts=(part,)), frequency_hz, gravity_mps2)
        total += np.tensordot(_drawn_part(part, deviates), terms, 1)
    for change in body.matrix_changes(frequency_hz, gravity_mps2, u_gravity_mps2):
        if change.label not in own:
            total += deviates.normal(change.name)[:, None, None, None] * change.change
    return total


def _drawn_part(part: Part, deviates: Deviates) -> FloatArray:
    """Monomials (N, 16) of a drawn part: mass times (1, c, products of c) and the six entries of its inertia."""
    mass = part.mass_kg + part.u_mass_kg * deviates.normal(f"{part.name}: mass")
    centre = part.centre_of_mass_m + part.u_centre_of_mass_m * deviates.normal(f"{part.name}: centre of mass", 3)
    six = deviates.normal(f"{part.name}: inertia", 6)
    entries = tuple(np.array(INERTIA_ENTRIES).T)
    inertia = part.inertia_kgm2[entries] + part.u_inertia_kgm2[entries] * six
    products = [centre[:, i] * centre[:, j] for i, j in PAIRS]
    places = np.column_stack([np.ones(deviates.count), centre, *products])
    return np.column_stack([mass[:, None] * places, inertia])


def _polynomial(alone: Body, frequency_hz: FloatArray, gravity_mps2: FloatArray | None) -> ComplexArray:
    """Coefficients (16, K, 6, 6) of the monomials of `_drawn_part` in the load matrix of a body of one part.

    The matrix is linear in mass and inertia and of second order in the centre of mass: its values at 0, ±e_i and
    e_i + e_j tell all of it.
    """
    (part,) = alone.parts

    def at(mass: float, centre: FloatArray, inertia: FloatArray) -> ComplexArray:
        one = replace(part, mass_kg=mass, centre_of_mass_m=centre, inertia_kgm2=inertia)
        return replace(alone, parts=(one,)).load_matrix(frequency_hz, gravity_mps2)

    none, unit = np.zeros((3, 3)), np.eye(3)
    still = at(1.0, np.zeros(3), none)
    ahead, behind = ([at(1.0, sign * e, none) for e in unit] for sign in (1.0, -1.0))
    slope = [(a - b) / 2.0 for a, b in zip(ahead, behind, strict=True)]
    square = [(a + b) / 2.0 - still for a, b in zip(ahead, behind, strict=True)]
    mixed = [
        at(1.0, unit[i] + unit[j], none) - still - slope[i] - slope[j] - square[i] - square[j] for i, j in PAIRS[3:]
    ]
    turning = [at(0.0, np.zeros(3), _symmetric(i, j)) for i, j in INERTIA_ENTRIES]
    return np.stack([still, *slope, *square, *mixed, *turning])


def _symmetric(row: int, column: int) -> FloatArray:
    """Unit matrix entry (3, 3) with its mirror image."""
    matrix = np.zeros((3, 3))
    matrix[row, column] = matrix[column, row] = 1.0
    return matrix


# The estimate of a body's acceleration as a function of readings and rows, draw by draw.


CONVERGED = 1e-9
MOST_STEPS = 60


@dataclass(frozen=True)
class Estimator:
    """What turns readings into an acceleration: with the gain of the evaluation, whatever the rows are.

    `observations` that were fused; `gain` (P, N) on the reduced unknowns; `expand` (12K, P) from these to
    [Re A_k, Im A_k] of all lines. The estimate of a draw is the A for which gain · (readings - rows · A) = 0: the truth
    itself where readings and rows belong together, and the generalised least squares to first order.
    """

    observations: tuple[Observation, ...]
    gain: FloatArray
    expand: FloatArray

    @classmethod
    def of(cls, observations: Sequence[Observation], expand: FloatArray, solution: Solution) -> Estimator:
        """Return the estimator of a solved system."""
        return cls(tuple(observations), np.asarray(np.linalg.pinv(expand) @ solution.gain), expand)

    def acceleration(self, drawn: Sequence[Drawn], start: ComplexArray, hidden: ComplexArray) -> ComplexArray:
        """Return the estimates (N, K, 6) from N draws of every observation, found by steps with the fixed gain.

        `start` (K, 6): where to start; `hidden` (N, K, 6): motion that no reading tells, which the rows may see.
        """
        count, lines = hidden.shape[:2]
        unknowns = np.repeat((np.linalg.pinv(self.expand) @ stacked(start[None])[0])[None], count, axis=0)
        # What a step may leave: in each unknown's own unit, the largest of its kind in the estimate.
        limit = CONVERGED * np.max(np.abs(unknowns), initial=1e-300)
        for _ in range(MOST_STEPS):
            found = unstacked(unknowns @ self.expand.T, lines) + hidden
            rest = [d.readings - np.einsum("nkmj,nkj->nkm", d.design, found) for d in drawn]
            step = self._rows(rest) @ self.gain.T
            unknowns = unknowns + step
            if np.abs(step).max(initial=0.0) <= limit:
                return unstacked(unknowns @ self.expand.T, lines)
        raise ComputeError("the Monte Carlo run: places or directions are so uncertain that draws have no solution")

    def _rows(self, values: Sequence[ComplexArray]) -> FloatArray:
        """Values (N, K, M) of every observation as real rows (N, R): line by line, usable channels, Re then Im."""
        rows = []
        for observation, value in zip(self.observations, values, strict=True):
            for k, usable in enumerate(np.isfinite(observation.phasors.value)):
                rows += [value[:, k, usable].real, value[:, k, usable].imag]
        return np.concatenate(rows, axis=1)


def stacked(acceleration: ComplexArray) -> FloatArray:
    """Return (N, K, 6) as (N, 12K): [Re A_k, Im A_k] of all lines."""
    both = np.concatenate([acceleration.real, acceleration.imag], axis=-1)
    return np.asarray(both.reshape(len(acceleration), -1))


def unstacked(values: FloatArray, lines: int) -> ComplexArray:
    """Return (N, 12K) as (N, K, 6)."""
    both = values.reshape(len(values), lines, 12)
    return np.asarray(both[..., :6] + 1j * both[..., 6:])
