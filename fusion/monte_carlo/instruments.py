"""What instruments read if their errors are what is drawn: readings and rows of the linear model, draw by draw."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.manifest import ChannelEntry
from fusion.monte_carlo.deviates import Deviates
from fusion.observe import (
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
from photogram.rigid import rotation_from_vector
from shaker._checks import ComplexArray, FloatArray
from shaker.signals.phasor import derivative_factor

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
