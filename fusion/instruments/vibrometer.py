"""Parallel vibrometer points on one body: their spread, and the part explained by rocking."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty, added_up, real_stack
from fusion.instruments.instrument_notices import PARALLEL_BEAMS, PARALLEL_BEAMS_WITHOUT_HEAD
from fusion.recording.manifest import ChannelEntry
from fusion.recording.placement import LaserBeams, chain_name
from shaker.sine.phasor import real_stacked
from shakercal._common.arrays import ComplexArray, FloatArray, check_shape, check_shapes
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.estimation.fuse import Acceleration
    from fusion.estimation.measurement_model import Observation

PARALLEL = 1e-3
"""Largest angle in rad between equal directions."""
FEWEST_POINTS = 3  # of a plane
RANK_TOLERANCE = 1e-3  # width over length of points that are not in one line


@dataclass(frozen=True)
class PointRatios:
    """Sensor output over mass times acceleration per point.

    S_i = U/(m a_i) (Nitsche et al. 2018, (11)).

    `value` (K, N) of `channel` per `component`; `unit` of the output; `uncertainty` of the N ratios; `fused` (K,):
    output over the load of the fused motion, NaN if there is none.
    """

    channel: str
    component: str
    unit: str
    value: ComplexArray
    uncertainty: Uncertainty
    fused: ComplexArray

    @property
    def mean_magnitude(self) -> FloatArray:
        """Mean of the magnitudes (K,), as published."""
        return np.asarray(np.mean(np.abs(self.value), axis=1))

    @property
    def magnitude_spread(self) -> FloatArray:
        """Standard deviation (K,) of the magnitudes over the points: the published error bar."""
        return np.asarray(np.std(np.abs(self.value), axis=1, ddof=1))

    @property
    def mean_phase_rad(self) -> FloatArray:
        """Mean of the phases (K,), rad."""
        return np.asarray(np.angle(np.mean(self.value / np.abs(self.value), axis=1)))

    @property
    def phase_spread_rad(self) -> FloatArray:
        """Standard deviation (K,) of the phases over the points, rad: the published error bar."""
        return phase_spread(self.value)


@dataclass(frozen=True)
class PointSpread:
    """N parallel vibrometer points on one body, their mean and the best rigid plane.

    `direction` (3,): common to all. `axes` (2, 3): across it, axes[0] × axes[1] = direction. `place_m` (N, 2): lever
    arms along them from the sensor origin. `value` (K, N): acceleration phasors along the direction, m/s², with their
    `uncertainty`. `plane` (K, 3): mean and angular accelerations (rad/s²) about the two axes, by least squares with
    equal weights, with `plane_uncertainty`. `residual` (K, N): deviations from the plane.
    """

    instrument: str
    body: str
    frequency_hz: FloatArray
    channels: tuple[str, ...]
    direction: FloatArray
    axes: FloatArray
    place_m: FloatArray
    value: ComplexArray
    uncertainty: Uncertainty
    plane: ComplexArray
    plane_uncertainty: Uncertainty
    residual: ComplexArray
    residual_uncertainty: Uncertainty
    ratios: PointRatios | None = None

    def __post_init__(self) -> None:
        lines, count = len(self.frequency_hz), len(self.channels)
        check_shape("place_m", self.place_m, (count, 2))
        check_shapes(self, (lines, count), "value", "residual")
        check_shape("plane", self.plane, (lines, 3))

    @property
    def mean(self) -> ComplexArray:
        """Mean (K,) of the points, m/s²."""
        return self.plane[:, 0]

    @property
    def amplitude_spread(self) -> FloatArray:
        """Standard deviation (K,) of the amplitudes over the points, relative to that of the mean."""
        return np.asarray(np.std(np.abs(self.value), axis=1, ddof=1) / np.abs(self.mean))

    @property
    def phase_spread_rad(self) -> FloatArray:
        """Standard deviation (K,) of the phases over the points, rad."""
        return phase_spread(self.value)

    @property
    def left_relative(self) -> FloatArray:
        """Root mean square (K,) of the residual, relative to the amplitude of the mean."""
        return np.asarray(np.sqrt(np.mean(np.abs(self.residual) ** 2, axis=1)) / np.abs(self.mean))

    @property
    def left_expected(self) -> FloatArray:
        """Expected `left_relative` (K,) from the stated uncertainties."""
        trace = np.trace(self.residual_uncertainty.covariance, axis1=1, axis2=2)
        return np.asarray(np.sqrt(trace / len(self.channels)) / np.abs(self.mean))


def beam_notices(entries: Sequence[ChannelEntry]) -> tuple[Notice, ...]:
    """Return a note for every vibrometer with several points of exactly one direction."""
    beams, notices = LaserBeams.of(entries), []
    tilted = {chain_name(entry) for entry in entries if entry.direction_uncertainty > 0.0 and beams.shares_tilt(entry)}
    for name in dict.fromkeys(name for name, _ in beams.parallel):
        counts = [(axis_name(np.asarray(d)), count) for (title, d), count in beams.parallel.items() if title == name]
        declared = PARALLEL_BEAMS_WITHOUT_HEAD if name in tilted else PARALLEL_BEAMS
        notices.append(Notice(declared, name, beams=", ".join(f"{count} along {axis}" for axis, count in counts)))
    return tuple(notices)


def axis_name(direction: FloatArray) -> str:
    """Return x, y or z for a direction along an axis, else its three numbers."""
    index = int(np.argmax(np.abs(direction)))
    if abs(direction[index]) > 1.0 - 1e-6:
        return ("" if direction[index] > 0.0 else "\N{MINUS SIGN}") + "xyz"[index]
    return "(" + ", ".join(f"{component:.3g}" for component in direction) + ")"


def phase_spread(value: ComplexArray) -> FloatArray:
    """Return the standard deviation (K,) of the phases of phasors (K, N), rad."""
    mean = np.mean(value / np.abs(value), axis=1, keepdims=True)
    return np.asarray(np.std(np.angle(value / mean), axis=1, ddof=1))


def point_spreads(
    observations: Sequence[Observation], accelerations: Sequence[Acceleration]
) -> tuple[PointSpread, ...]:
    """Return one spread per body and direction of three or more points.

    Common errors of the points (scale, delay, placement) act as on the fused motion of their body.
    """
    fused = {a.body: np.nan_to_num(a.phasors.value) for a in accelerations if a.source == "fused"}
    groups: list[list[_Point]] = []
    for body in dict.fromkeys(o.body for o in observations if o.kind == "vibrometer"):
        seen = [o for o in observations if o.kind == "vibrometer" and o.body == body]
        first = len(groups)
        for point in [point for observation in seen for point in _points(observation, fused[body])]:
            group = next(
                (g for g in groups[first:] if np.linalg.norm(g[0].direction - point.direction) < PARALLEL), None
            )
            if group is None:
                groups.append([point])
            else:
                group.append(point)
    spreads = [_spread(group) for group in groups if len(group) >= FEWEST_POINTS]
    return tuple(spread for spread in spreads if spread is not None)


@dataclass(frozen=True)
class _Point:
    """One vibrometer point as acceleration: `direction`, lever r × d (3,), column of its observation."""

    name: str
    observation: Observation
    column: int
    direction: FloatArray
    lever_m: FloatArray
    factor: ComplexArray
    acceleration: ComplexArray


def _points(observation: Observation, acceleration: ComplexArray) -> list[_Point]:
    """Return the channels of a vibrometer as accelerations, with positive largest components of directions."""
    points = []
    for column, name in enumerate(observation.members):
        row = observation.design[:, column]
        size = np.linalg.norm(row[:, :3], axis=1)
        largest = row[:, np.argmax(np.abs(row[0, :3]))]
        factor = size * largest / np.abs(largest)
        unit = np.asarray((row[0] / factor[0]).real) + 0.0
        points.append(_Point(name, observation, column, unit[:3], unit[3:], factor, acceleration))
    return points


def _spread(points: Sequence[_Point]) -> PointSpread | None:
    """Return mean, plane and residual of parallel points; None if they are in one line.

    A point at (p, q) moves by mean + α₀·(q − q̄) − α₁·(p − p̄).
    """
    direction = points[0].direction
    nearest = np.eye(3)[(int(np.argmax(np.abs(direction))) + 1) % 3]
    first = nearest - direction * (nearest @ direction)
    first = first / np.linalg.norm(first)
    axes = np.stack([first, np.cross(direction, first)])
    position = np.cross(direction, np.stack([point.lever_m for point in points])) @ axes.T
    centred = position - position.mean(axis=0)
    columns = np.stack([np.ones(len(position)), centred[:, 1], -centred[:, 0]], axis=1)
    singular = np.linalg.svd(columns[:, 1:], compute_uv=False)
    if singular[-1] <= RANK_TOLERANCE * singular[0]:
        return None
    value = np.stack([p.observation.phasors.value[:, p.column] / p.factor for p in points], axis=1)
    uncertainty = _uncertainty(points)
    solve: FloatArray = np.linalg.pinv(columns).astype(np.float64)
    leave = np.eye(len(points)) - columns @ solve
    plane_u, residual_u = (uncertainty.transformed(real_stacked(m.astype(np.complex128))[None]) for m in (solve, leave))
    return PointSpread(
        instrument=", ".join(dict.fromkeys(point.observation.name for point in points)),
        body=points[0].observation.body,
        frequency_hz=points[0].observation.phasors.frequency_hz,
        channels=tuple(point.name for point in points),
        direction=direction,
        axes=axes,
        place_m=position,
        value=value,
        uncertainty=uncertainty,
        plane=value @ solve.T,
        plane_uncertainty=plane_u,
        residual=value @ leave.T,
        residual_uncertainty=residual_u,
    )


def _uncertainty(points: Sequence[_Point]) -> Uncertainty:
    """Return noise and common errors of the points' accelerations, jointly per instrument."""
    lines, count = len(points[0].factor), len(points)
    covariance, dof = np.zeros((lines, 2 * count, 2 * count)), np.full(lines, np.inf)
    influences = []
    for observation in {id(p.observation): p.observation for p in points}.values():
        members = [(index, point) for index, point in enumerate(points) if point.observation is observation]
        rows, columns = [index for index, _ in members], [point.column for _, point in members]
        back = np.stack([1.0 / point.factor for _, point in members], axis=1)
        both = np.concatenate([rows, np.array(rows) + count])
        noise = Uncertainty((Contribution("noise", "A", observation.phasors.covariance),)).at(columns).scaled(back)
        covariance[:, both[:, None], both] = noise.covariance
        dof = np.minimum(dof, observation.phasors.dof)
        for error in observation.common:
            change = np.zeros((lines, count), dtype=np.complex128)
            change[:, rows] = error.effect(members[0][1].acceleration)[:, columns] * back
            if np.any(change):
                effect = real_stack(change)
                influences.append(
                    Influence(error.name, error.label, error.u, error.unit, effect, error.scope, error.type, error.dof)
                )
    return Uncertainty((Contribution("noise", "A", covariance, dof),), added_up(influences))
