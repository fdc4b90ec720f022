"""Motion of the supports of cameras and lasers by references, and instruments corrected for it.

A reference is a target at rest, or an instrument on a head. A support moves by H, six components like a body, and an
instrument on it reads rows·(A - H). A patch at rest in the view of cameras, or a beam at the room, reads -rows·H, an
accelerometer on a head rows·H. The prior of H is its possible size. Readings and prior are one linear model for each
line, solved before the fusion of the bodies.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import block_diag

from fusion.estimation.coverage import polar
from fusion.estimation.least_squares import RANK_TOLERANCE, RESOLUTION_TOLERANCE
from fusion.estimation.measurement_model import BODY_SIZE_M, SCALE, CommonError, Observation
from fusion.estimation.uncertainty import Kind, as_complex, element_covariance, real_stack
from fusion.estimation.variance_components import EstimatedNoise
from fusion.instruments.channel import ChannelGeometry
from fusion.instruments.stereo import StereoReading, carrier_of
from fusion.recording.placement import carrier, measuring_point
from fusion.recording.transducer import HEAD, STATIONARY
from fusion.sensitivity.disturbances import with_support_motion
from fusion.sensitivity.sensitivity_notices import SUPPORT_CORRECTED, SUPPORT_EXCEEDS_LIMIT, SUPPORT_UNCERTAIN
from photogram.camera import principal_components
from photogram.geometry import skew
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.phasor import Phasors, real_stacked
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.digits import number_text, round_to_uncertainty
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.recording.manifest import ChannelEntry

SHARES, RATIOS = np.geomspace(1e-5, 0.1, 13), (1.0, 0.3, 0.1)
"""Without a statement: possible standard deviations of a support's translation along the measured motion, over that
motion, and of the translations across, over the former."""
CONTRADICTED = 1e-3
"""Probability of readings below which a stated `support_motion` is rejected (chosen)."""
SMALL = 0.03
"""Effect of an error of a reference, over the standard deviation of H, below which it is omitted (chosen)."""
NOTED, SURE = 1e-4, 4.0
"""Motion of a support that is reported, over the measured motion, and over its standard uncertainty (chosen)."""
WEAK = 1e-3
"""Standard uncertainty of a support's motion, over the measured motion, above which it is reported (chosen)."""


@dataclass(frozen=True, repr=False, eq=False)
class SupportMotion(Arrays):
    """Motion of one support: acceleration `phasors` of its point at the sensor origin.

    They are NaN at lines without a reference and without a stated limit. `observed` (K, 6): components that the
    references determine; the others only have their possible size. `measured_mps2` (K,): largest translation that the
    instruments on it measure. `references`: names of the references. `carried`: names of the corrected rows of
    instruments.
    """

    name: str
    phasors: Phasors
    observed: BoolArray
    measured_mps2: FloatArray
    references: tuple[str, ...]
    carried: tuple[str, ...]


class _SupportReading(NamedTuple):
    """Some `columns` of an observation on one support; `sign` of its motion in references."""

    observation: Observation
    columns: list[int]
    sign: float

    def rows(self, line: int) -> ComplexArray:
        return np.asarray(self.sign * self.observation.design[line, self.columns])

    def values(self, line: int) -> ComplexArray:
        return self.observation.phasors.value[line, self.columns]


def without_supports(
    observations: Sequence[Observation], limit: float | None
) -> tuple[tuple[Observation, ...], tuple[SupportMotion, ...], tuple[Notice, ...]]:
    """Correct the instruments for the motion of supports with a reference, and remove the references.

    `limit`: largest amplitude of that motion over the measured motion (`environment.support_motion`), None if not
    stated; also for supports without a reference. The remaining uncertainty of H is an unknown of all instruments on
    the support.
    """
    bodies = [o for o in observations if o.body not in (STATIONARY, HEAD)]
    found, notices = list[SupportMotion](), list[Notice]()
    for name, references in _by_support(o for o in observations if o.body in (STATIONARY, HEAD)).items():
        carried = _by_support(bodies).get(name, [])
        if not carried:
            continue
        moved, errors, of_support = _settled(name, references, carried, limit)
        found.append(moved)
        notices += of_support
        names = {member for one in carried for member in _members(one)}
        bodies = [_corrected(o, [m in names for m in o.members], moved, errors) for o in bodies]
    return with_support_motion(bodies, limit, carried_by(found)), tuple(found), tuple(notices)


def _members(seen: _SupportReading) -> list[str]:
    return [seen.observation.members[column] for column in seen.columns]


def _by_support(observations: Sequence[Observation] | Iterator[Observation]) -> dict[str, list[_SupportReading]]:
    """Return the rows of observations by their support; channels without a head have none."""
    groups: dict[str, list[_SupportReading]] = {}
    for observation in observations:
        columns_of: dict[str, list[int]] = {}
        geometry = observation.geometry
        if isinstance(geometry, StereoReading):
            columns_of[carrier_of(geometry.name, geometry.pair)] = list(range(len(observation.members)))
        elif isinstance(geometry, ChannelGeometry):
            for column, entry in enumerate(geometry.entries):
                name = carrier(entry)
                if name is not None:
                    columns_of.setdefault(name, []).append(column)
        for name, columns in columns_of.items():
            groups.setdefault(name, []).append(
                _SupportReading(observation, columns, -1.0 if observation.body == STATIONARY else 1.0)
            )
    return groups


# One support: the prior of its motion, and the estimate from the readings of its references.


def _settled(
    name: str, references: Sequence[_SupportReading], carried: Sequence[_SupportReading], limit: float | None
) -> tuple[SupportMotion, list[CommonError], list[Notice]]:
    """Return the motion of one support, its uncertainty as (K, 6) `offset`s, and notices."""
    frequency = carried[0].observation.phasors.frequency_hz
    shape, observed = _shape([*references, *carried]), np.zeros((len(frequency), 6), dtype=np.bool_)
    value = np.full((len(frequency), 6), complex(np.nan, np.nan))
    covariance = np.full((len(frequency), 12, 12), np.nan)
    gains, dof, notices = list[FloatArray | None](), np.full(len(frequency), np.inf), list[Notice]()
    sizes = np.array([_sizes(carried, line) for line in range(len(frequency))])
    measured, stated = sizes.max(axis=1), None if limit is None else limit / 2.0
    for line, size in enumerate(measured.tolist()):
        read = _Readings.of(references, line)
        dof[line], observed[line] = read.dof, read.observed
        gains.append(None)
        if (len(read.values) == 0 and stated is None) or not size > 0.0:
            continue
        one = _estimate(read, shape * size, int(np.argmax(sizes[line])), stated)
        if one.contradicts:
            notices.append(Notice(SUPPORT_EXCEEDS_LIMIT, name, frequency_hz=frequency[line], limit=limit or 0.0))
        value[line], covariance[line], gains[-1] = as_complex(one.mean), one.covariance, one.gain
    titles = tuple(dict.fromkeys(member for seen in references for member in _members(seen)))
    members = tuple(dict.fromkeys(member for seen in carried for member in _members(seen)))
    phasors = Phasors(frequency, value, covariance, MOTION_COMPONENTS, component_units(2), dof)
    moved = SupportMotion(name, phasors, observed, measured, titles, members)
    reference_errors = [*_reference_errors(moved, references, gains)]
    effects = np.stack([np.zeros((len(frequency), 12)), *(real_stack(error.offset) for error in reference_errors)])
    whole = replace(phasors, covariance=covariance + np.einsum("eki,ekj->kij", effects, effects))
    notices += _notices(replace(moved, phasors=whole))
    return replace(moved, phasors=whole), [*_remaining_errors(moved), *reference_errors], notices


def _shape(seen: Sequence[_SupportReading]) -> FloatArray:
    """Return columns (6, 6) of the covariance of [Re H, Im H].

    For six unit standard deviations: translations at the support, and rotations as large as these over the distance L
    to the measured body, like cameras that rock about a pivot at that distance. H refers to the sensor origin, t - θ ×
    p of a support at p.
    """
    pivots, points = list[FloatArray](), list[FloatArray]()
    for observation, columns, _ in seen:
        geometry = observation.geometry
        if isinstance(geometry, StereoReading):
            pivots.append(np.array(geometry.pair.translation))
            points.append(np.zeros(3) if geometry.face_m is None else geometry.face_m)
        elif isinstance(geometry, ChannelGeometry):
            entries = [geometry.entries[column] for column in columns]
            pivots += [position for entry in entries if (position := _head_position(entry)) is not None]
            points += [measuring_point(entry) for entry in entries if entry.body != HEAD]
    middle = np.mean(points, axis=0) if points else np.zeros(3)
    pivot = np.mean(pivots, axis=0) if pivots else middle
    length = max(float(np.linalg.norm(pivot - middle)), BODY_SIZE_M)
    moved = np.eye(6)
    moved[:3, 3:] = skew(pivot)
    return moved @ np.diag(np.repeat([1.0, 1.0 / length], 3))


def _head_position(entry: ChannelEntry) -> FloatArray | None:
    """Return the position of a head: its mirror, else its instrument; None if not stated."""
    if entry.head is not None and entry.head.stated.mirror is not None:
        return np.array(entry.head.stated.mirror)
    return measuring_point(entry) if entry.body == HEAD else None


def _sizes(carried: Sequence[_SupportReading], line: int) -> FloatArray:
    """Return the largest translations (3,) along the axes, as acceleration, at a line."""
    sizes = np.zeros(3)
    for seen in carried:
        along = np.abs(seen.rows(line)[:, :3])
        square = np.maximum(np.sum(along**2, axis=1, keepdims=True), np.finfo(np.float64).tiny)
        read = np.abs(np.nan_to_num(seen.values(line)))[:, None] * along / square
        sizes = np.maximum(sizes, read.max(axis=0))
    return np.asarray(sizes)


class _Readings(NamedTuple):
    """Readings of references at a line.

    Real `rows` (N, 12), `values` (N,), their `noise` (N, N), the `estimated_noise` with its degrees of freedom, and
    their smallest number `dof`.
    """

    rows: FloatArray
    values: FloatArray
    noise: FloatArray
    estimated_noise: EstimatedNoise
    dof: float

    @property
    def observed(self) -> BoolArray:
        """Components (6,) in the space of the rows."""
        _, singular, right = np.linalg.svd(self.rows * np.tile(SCALE, 2), full_matrices=False)
        basis = right[singular > RANK_TOLERANCE * singular.max(initial=0.0)]
        return np.asarray(np.sum(basis[:, :6] ** 2, axis=0) > 1.0 - RESOLUTION_TOLERANCE)

    @classmethod
    def of(cls, references: Sequence[_SupportReading], line: int) -> _Readings:
        rows, values, count = [np.zeros((0, 12))], [np.zeros(0)], 0
        parts = list[tuple[IntArray, FloatArray, float]]()
        for seen in references:
            phasors, value = seen.observation.phasors, seen.values(line)
            finite = np.flatnonzero(np.isfinite(value))
            columns = np.array(seen.columns)[finite]
            both = np.concatenate([columns, columns + phasors.value.shape[1]])
            rows.append(real_stacked(seen.rows(line)[finite]))
            values.append(real_stack(value[finite]))
            indices = count + np.arange(len(both))
            parts.append((indices, phasors.covariance[line][np.ix_(both, both)], float(phasors.dof[line])))
            count += len(both)
        noise = np.asarray(block_diag(*(covariance for _, covariance, _ in parts)))
        noise_model, dof = EstimatedNoise.from_parts(parts, count), [dof for indices, _, dof in parts if len(indices)]
        return cls(
            np.concatenate(rows), np.concatenate(values), noise[:count, :count], noise_model, min(dof, default=np.inf)
        )


class _Estimate(NamedTuple):
    """Estimate of [Re H, Im H] (12,), and whether the readings contradict the stated limit."""

    mean: FloatArray
    covariance: FloatArray
    gain: FloatArray
    contradicts: bool


def _estimate(read: _Readings, shape: FloatArray, main: int, stated: float | None) -> _Estimate:
    """Return the best linear estimate of H from readings y = rows·H + noise.

    H has the covariance S = shape·diag(s²)·shapeᵀ in either part. The mean is S·Dᵀ·(D·S·Dᵀ + N)⁻¹·y, with the remaining
    covariance (Henderson 1975, Biometrics 31, 423). `stated`: the standard deviation s of every translation.

    If none is stated, or the readings contradict it, s is one of `SHARES` for the translation along the `main` axis,
    and times one of `RATIOS` for the others; rotations have the mean square. The prior of s is uniform in its square
    root, between uniform in the logarithm, which favours rest, and uniform in s. The estimate is the mean over s
    weighted by the probability density of the readings (Student's t, because N is estimated), and the covariance
    includes the spread over s. Readings far above their noise are used fully, readings within it hardly.
    """
    rows, values, count = read.rows, read.values, len(read.values)
    contradicts, spreads, likely = False, np.full((1, 3), stated or 0.0), np.zeros(1)
    if stated is not None and count:
        whole = rows @ _prior(shape, spreads)[0] @ rows.T + read.noise
        weights = np.linalg.inv(whole)
        contradicts = read.estimated_noise.p_value(float(values @ weights @ values), count, weights) < CONTRADICTED
    if stated is None or contradicts:
        ratios = np.insert(np.array(list(product(RATIOS, repeat=2))), main, 1.0, axis=1)
        spreads = (SHARES[:, None, None] * ratios).reshape(-1, 3)
        likely = 0.5 * np.log(spreads[:, main])
    prior = _prior(shape, spreads)
    across = prior @ rows.T
    total = rows @ across + read.noise
    weights = np.linalg.inv(total)
    gains = across @ weights
    means = gains @ values
    squares = weights @ values @ values
    heavy = squares if np.isinf(read.dof) else (read.dof + 1.0) * np.log1p(squares / read.dof)
    density = likely - 0.5 * (heavy + np.linalg.slogdet(total)[1])
    share = np.exp(density - density.max())
    share /= share.sum()
    mean, gain = share @ means, np.einsum("g,gij->ij", share, gains)
    remainder = np.eye(12) - gains @ rows  # in squares, so that rounding leaves no negative variance
    left = remainder @ prior @ remainder.swapaxes(1, 2) + gains @ read.noise @ gains.swapaxes(1, 2)
    off = means - mean
    covariance = np.einsum("g,gij->ij", share, left) + np.einsum("g,gi,gj->ij", share, off, off)
    lost = read.estimated_noise.estimation_covariance(
        np.einsum("g,gij->ij", share, weights), gain[None], np.arange(count)
    )[0]
    return _Estimate(mean, covariance + lost, gain, contradicts)


def _prior(shape: FloatArray, spreads: FloatArray) -> FloatArray:
    """Return covariances (G, 12, 12) of [Re H, Im H] for standard deviations `spreads`."""
    rotation = np.sqrt(np.mean(spreads**2, axis=1, keepdims=True))
    scaled = shape * np.concatenate([spreads, np.repeat(rotation, 3, axis=1)], axis=1)[:, None, :]
    return np.asarray(np.kron(np.eye(2), scaled @ scaled.swapaxes(1, 2)))


# Uncertainty of a support's motion, and its effect on the instruments.


def _remaining_errors(moved: SupportMotion) -> Iterator[CommonError]:
    """Yield the remaining uncertainty of H at each line as independent unknowns."""
    phasors, label = moved.phasors, f"motion of {moved.name}"
    for line in np.flatnonzero(np.isfinite(phasors.value).all(axis=1)):
        for part, step in enumerate(principal_components(phasors.covariance[line])[::-1], 1):
            name = f"{label} at {number_text(phasors.frequency_hz[line], 9)} Hz, part {part}"
            offset = np.zeros_like(phasors.value)
            offset[line] = as_complex(step)
            dof = float(phasors.dof[line])
            kind: Kind = "A" if np.isfinite(dof) else "B"
            yield CommonError(name, label, 1.0, "1", "recording", _none(offset), offset, kind, dof)


def _none(offset: ComplexArray) -> ComplexArray:
    """Return the zero slope of effects that do not depend on a body's motion."""
    return np.zeros((*offset.shape, 6), dtype=np.complex128)


def _reference_errors(
    moved: SupportMotion, references: Sequence[_SupportReading], gains: Sequence[FloatArray | None]
) -> Iterator[CommonError]:
    """Yield the effects on H of errors of the references' chains and positions, by name."""
    names = dict.fromkeys(error.name for seen in references for error in seen.observation.common)
    informed = [line for line, gain in enumerate(gains) if gain is not None and np.any(gain)]
    for name in names:
        offset, model, size = np.zeros_like(moved.phasors.value), None, 0.0
        for line in informed:
            read = list[FloatArray]()
            for seen in references:
                error = next((e for e in seen.observation.common if e.name == name), None)
                effect = np.zeros(len(seen.columns), dtype=np.complex128)
                if error is not None:
                    model, motion = error, seen.sign * np.nan_to_num(moved.phasors.value)
                    effect = np.nan_to_num(error.effect(motion)[line, seen.columns])
                read.append(real_stack(effect[np.isfinite(seen.values(line))]))
            gain = gains[line]
            assert gain is not None
            change = gain @ np.concatenate(read)
            spread = np.sqrt(np.diagonal(moved.phasors.covariance[line]))
            size = max(size, float(np.max(np.abs(change)[spread > 0.0] / spread[spread > 0.0], initial=0.0)))
            offset[line] = as_complex(change)
        if model is not None and size > SMALL:
            yield replace(model, slope=_none(offset), offset=offset)


def _corrected(
    observation: Observation, on_it: Sequence[bool], moved: SupportMotion, errors: Sequence[CommonError]
) -> Observation:
    """Return an observation of the body's motion, corrected for its support and with that uncertainty."""
    mine: BoolArray = np.array(on_it, dtype=np.bool_)
    if not mine.any():
        return observation

    def read(motion: ComplexArray) -> ComplexArray:
        return np.where(mine, np.einsum("kmj,kj->km", observation.design, np.nan_to_num(motion)), 0.0)

    common: dict[str, CommonError] = {error.name: error for error in observation.common}
    for error in errors:  # an error added to a reading is subtracted from its body
        changed = replace(error, slope=np.zeros_like(observation.design), offset=read(error.offset))
        before = common.get(error.name)
        if before is not None:
            changed = replace(before, offset=before.offset + changed.offset)
        common[error.name] = changed
    phasors = replace(observation.phasors, value=observation.phasors.value + read(moved.phasors.value))
    return replace(observation, phasors=phasors, common=tuple(common.values()))


def _notices(moved: SupportMotion) -> Iterator[Notice]:
    """Yield notes on a support's significant or uncertain motion at the strongest line."""
    line = int(np.argmax(moved.measured_mps2))
    value, size = moved.phasors.value[line], float(moved.measured_mps2[line])
    if not (np.isfinite(value).all() and size > 0.0):
        return
    u = np.maximum(moved.phasors.u_re, moved.phasors.u_im)[line]
    seen = np.flatnonzero(moved.observed[line, :3])
    values = {"frequency_hz": moved.phasors.frequency_hz[line], "references": ", ".join(moved.references)}
    shaken = [c for c in seen.tolist() if abs(value[c]) > max(SURE * u[c], NOTED * size)]
    if shaken:
        c = max(shaken, key=lambda c: float(abs(value[c])))
        found = polar(complex(value[c]), element_covariance(moved.phasors.covariance[line], c))
        share = round_to_uncertainty(100.0 * found.magnitude / size, 200.0 * found.u_magnitude / size, 0)
        yield Notice(SUPPORT_CORRECTED, moved.name, axis="xyz"[c], share=share.value, expanded=share.expanded, **values)
    if len(seen) and float(u[seen].max()) > WEAK * size:
        yield Notice(SUPPORT_UNCERTAIN, moved.name, u_relative=float(u[seen].max()) / size, **values)


def carried_by(supports: Sequence[SupportMotion]) -> frozenset[str]:
    """Return the names of instrument rows with a measured support motion."""
    measured = [moved for moved in supports if np.isfinite(moved.phasors.value).any()]
    return frozenset(member for moved in measured for member in moved.carried)
