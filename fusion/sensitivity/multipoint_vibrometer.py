"""Parallel vibrometer points on one body: how far they differ, what rocking explains of it, each one's sensitivity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fusion.estimation.consistency import Acceleration
from fusion.estimation.least_squares import real_design, real_stack
from fusion.estimation.measurement_model import Observation
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty
from fusion.sensitivity.body import Body
from fusion.sensitivity.load import Outputs
from fusion.sensitivity.ratio import Sensitivity
from shaker.arrays import ComplexArray, FloatArray, check_shape

PARALLEL = 1e-3
"""Largest angle in rad between directions that count as one."""
FEWEST_POINTS = 3
RANK_TOLERANCE = 1e-3


@dataclass(frozen=True)
class PointRatios:
    """Sensor output over load mass times acceleration, point by point: S_i = U/(m a_i), published as equation (11).

    `value` (K, N) of `channel` per `component`; `unit` of the output; `uncertainty` of the N ratios; `fused` (K,):
    output over the load of the fused motion, NaN where there is none.
    """

    channel: str
    component: str
    unit: str
    value: ComplexArray
    uncertainty: Uncertainty
    fused: ComplexArray

    @property
    def mean_magnitude(self) -> FloatArray:
        """Return the mean of the magnitudes (K,), as it is published."""
        return np.asarray(np.mean(np.abs(self.value), axis=1))

    @property
    def magnitude_spread(self) -> FloatArray:
        """Return the standard deviation (K,) of the magnitudes over the points: the published error bar."""
        return np.asarray(np.std(np.abs(self.value), axis=1, ddof=1))

    @property
    def mean_phase_rad(self) -> FloatArray:
        """Return the mean of the phases (K,), rad."""
        return np.asarray(np.angle(np.mean(self.value / np.abs(self.value), axis=1)))

    @property
    def phase_spread_rad(self) -> FloatArray:
        """Return the standard deviation (K,) of the phases over the points, rad: the published error bar."""
        return phase_spread(self.value)


@dataclass(frozen=True)
class PointSpread:
    """N parallel vibrometer points on one body, their mean and the best rigid plane through them.

    `direction` (3,) common to all; `axes` (2, 3) across it, axes[0] × axes[1] = direction; `place_m` (N, 2): lever arms
    along them from the sensor origin. `value` (K, N): acceleration phasors along the direction, m/s², with their
    `uncertainty`. `plane` (K, 3): mean and angular accelerations (rad/s²) about the two axes, by least squares with
    equal weights, with `plane_uncertainty`. `residual` (K, N): what the plane leaves.
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
        check_shape("value", self.value, (lines, count))
        check_shape("plane", self.plane, (lines, 3))
        check_shape("residual", self.residual, (lines, count))

    @property
    def mean(self) -> ComplexArray:
        """Return the mean (K,) of the points, m/s²."""
        return self.plane[:, 0]

    @property
    def amplitude_spread(self) -> FloatArray:
        """Return the standard deviation (K,) of the amplitudes over the points, relative to the mean's amplitude."""
        return np.asarray(np.std(np.abs(self.value), axis=1, ddof=1) / np.abs(self.mean))

    @property
    def phase_spread_rad(self) -> FloatArray:
        """Return the standard deviation (K,) of the phases over the points, rad."""
        return phase_spread(self.value)

    @property
    def rocking_rad(self) -> ComplexArray:
        """Return the phasors (K, 2) of the rocking angles about the two axes: θ = −α/ω²."""
        return np.asarray(-self.plane[:, 1:] / (2.0 * np.pi * self.frequency_hz[:, None]) ** 2)

    @property
    def left_relative(self) -> FloatArray:
        """Return the root mean square (K,) of what the plane leaves, relative to the mean's amplitude."""
        return np.asarray(np.sqrt(np.mean(np.abs(self.residual) ** 2, axis=1)) / np.abs(self.mean))

    @property
    def left_expected(self) -> FloatArray:
        """Return what `left_relative` (K,) is expected to be from the stated uncertainties."""
        trace = np.trace(self.residual_uncertainty.covariance, axis1=1, axis2=2)
        return np.asarray(np.sqrt(trace / len(self.channels)) / np.abs(self.mean))


def axis_name(direction: FloatArray) -> str:
    """Return x, y or z for a direction along an axis, else its three numbers."""
    place = int(np.argmax(np.abs(direction)))
    if abs(direction[place]) > 1.0 - 1e-6:
        return ("" if direction[place] > 0.0 else "\N{MINUS SIGN}") + "xyz"[place]
    return "(" + ", ".join(f"{component:.3g}" for component in direction) + ")"


def phase_spread(value: ComplexArray) -> FloatArray:
    """Return the standard deviation (K,) of the phases of phasors (K, N) about their mean direction, rad."""
    mean = np.mean(value / np.abs(value), axis=1, keepdims=True)
    return np.asarray(np.std(np.angle(value / mean), axis=1, ddof=1))


def point_spreads(
    observations: Sequence[Observation], accelerations: Sequence[Acceleration]
) -> tuple[PointSpread, ...]:
    """Return one spread per body and direction that at least three vibrometer points, not in one line, look along.

    Common errors of the points (scale, delay, placement) act as they do on the fused motion of their body.
    """
    fused = {a.body: np.nan_to_num(a.phasors.value) for a in accelerations if a.source == "fused"}
    found = []
    for body in dict.fromkeys(o.body for o in observations if o.kind == "vibrometer"):
        seen = [o for o in observations if o.kind == "vibrometer" and o.body == body]
        found += [_spread(group) for group in _parallel(seen, fused[body]) if _is_a_plane(group)]
    return tuple(found)


@dataclass(frozen=True)
class _Point:
    """One vibrometer point as acceleration: value (K,) along `direction`, lever r × d (3,), where it stands."""

    name: str
    observation: Observation
    column: int
    direction: FloatArray
    lever_m: FloatArray
    factor: ComplexArray
    acceleration: ComplexArray


def _points(observation: Observation, acceleration: ComplexArray) -> list[_Point]:
    """The channels of a vibrometer, brought to acceleration, all directions in the half space of their largest axis."""
    found = []
    for column, name in enumerate(observation.members):
        row = observation.design[:, column]
        size = np.linalg.norm(row[:, :3], axis=1)
        largest = row[np.arange(len(row)), np.full(len(row), np.argmax(np.abs(row[0, :3])))]
        factor = size * largest / np.abs(largest)
        unit = np.asarray((row[0] / factor[0]).real) + 0.0
        found.append(_Point(name, observation, column, unit[:3], unit[3:], factor, acceleration))
    return found


def _parallel(observations: Sequence[Observation], acceleration: ComplexArray) -> list[list[_Point]]:
    """Points grouped by their direction."""
    groups: list[list[_Point]] = []
    for point in [point for observation in observations for point in _points(observation, acceleration)]:
        own = next((g for g in groups if np.linalg.norm(g[0].direction - point.direction) < PARALLEL), None)
        if own is None:
            groups.append([point])
        else:
            own.append(point)
    return groups


def _plane_columns(place_m: FloatArray) -> FloatArray:
    """Columns (N, 3) of mean and two rotations: a point at (p, q) moves by mean + α₀·(q − q̄) − α₁·(p − p̄)."""
    centred = place_m - place_m.mean(axis=0)
    return np.stack([np.ones(len(place_m)), centred[:, 1], -centred[:, 0]], axis=1)


def _places(points: Sequence[_Point]) -> tuple[FloatArray, FloatArray]:
    """Two axes (2, 3) across the common direction and the lever arms (N, 2) along them."""
    direction = points[0].direction
    nearest = np.eye(3)[(int(np.argmax(np.abs(direction))) + 1) % 3]
    first = nearest - direction * (nearest @ direction)
    first = first / np.linalg.norm(first)
    axes = np.stack([first, np.cross(direction, first)])
    levers = np.stack([point.lever_m for point in points])
    return axes, np.cross(direction, levers) @ axes.T


def _is_a_plane(points: Sequence[_Point]) -> bool:
    """Whether there are enough points, and not all in one line."""
    if len(points) < FEWEST_POINTS:
        return False
    values = np.linalg.svd(_plane_columns(_places(points)[1])[:, 1:], compute_uv=False)
    return bool(values[-1] > RANK_TOLERANCE * values[0])


def _spread(points: Sequence[_Point]) -> PointSpread:
    """Mean, plane and what it leaves of parallel points."""
    axes, place = _places(points)
    value = np.stack([p.observation.phasors.value[:, p.column] / p.factor for p in points], axis=1)
    uncertainty = _uncertainty(points)
    columns = _plane_columns(place)
    solve: FloatArray = np.linalg.pinv(columns).astype(np.float64)
    leave = np.eye(len(points)) - columns @ solve
    first = points[0].observation
    return PointSpread(
        instrument=", ".join(dict.fromkeys(point.observation.name for point in points)),
        body=first.body,
        frequency_hz=first.phasors.frequency_hz,
        channels=tuple(point.name for point in points),
        direction=points[0].direction,
        axes=axes,
        place_m=place,
        value=value,
        uncertainty=uncertainty,
        plane=value @ solve.T,
        plane_uncertainty=uncertainty.transformed(_every_line(solve, len(value))),
        residual=value @ leave.T,
        residual_uncertainty=uncertainty.transformed(_every_line(leave, len(value))),
    )


def _every_line(matrix: FloatArray, lines: int) -> FloatArray:
    """Real-stacked form (K, 2D, 2N) of one real matrix (D, N) at all lines."""
    return np.broadcast_to(np.kron(np.eye(2), matrix), (lines, 2 * len(matrix), 2 * matrix.shape[1]))


def _uncertainty(points: Sequence[_Point]) -> Uncertainty:
    """Noise and common errors of the points' accelerations; points of one instrument have their joint covariance."""
    lines, count = len(points[0].factor), len(points)
    covariance, dof = np.zeros((lines, 2 * count, 2 * count)), np.full(lines, np.inf)
    effects: dict[str, Influence] = {}
    for observation in {id(p.observation): p.observation for p in points}.values():
        own = [(place, point) for place, point in enumerate(points) if point.observation is observation]
        places, columns = [place for place, _ in own], [point.column for _, point in own]
        back = np.stack([1.0 / point.factor for _, point in own], axis=1)
        both = np.concatenate([places, np.array(places) + count])
        noise = Uncertainty((Contribution("noise", "A", observation.phasors.covariance),)).at(columns).scaled(back)
        covariance[:, both[:, None], both] = noise.covariance
        dof = np.minimum(dof, observation.phasors.dof)
        for error in observation.common:
            change = np.zeros((lines, count), dtype=np.complex128)
            change[:, places] = error.effect(own[0][1].acceleration)[:, columns] * back
            if np.any(change):
                known = effects.get(error.name)
                total = real_stack(change) + (0.0 if known is None else known.effect)
                effects[error.name] = Influence(
                    error.name, error.label, error.u, error.unit, total, error.scope, error.type
                )
    return Uncertainty((Contribution("noise", "A", covariance, dof),), tuple(effects.values()))


def with_ratios(
    spread: PointSpread, outputs: Outputs, sensitivity: Sensitivity, body: Body, sense: Literal["on_load", "on_sensor"]
) -> PointSpread:
    """Return the spread with S_i = U/(m a_i) of the output that answers most to the force along the points.

    m is the mass that moves above the elastic element. dS = S (dU/U - da/a - dm/m), in which an unknown of both sides
    (a clock) is one change. Where the excitation drives another component than that force there is nothing to add.
    """
    axis = int(np.argmax(np.abs(spread.direction)))
    along = abs(spread.direction[axis]) > 1.0 - PARALLEL
    elements = np.abs(sensitivity.value[:, :, axis])
    if spread.body != "load" or not along or not np.isfinite(elements).any():
        return spread
    channel = int(np.argmax(np.nanmax(elements, axis=0)))
    sign = 1.0 if sense == "on_load" else -1.0
    mass = sign * body.load_matrix(spread.frequency_hz, None)[:, axis, axis]
    driven = mass[:, None] * spread.value
    value = outputs.phasors.value[:, channel, None] / driven
    from_output = outputs.uncertainty.at([channel]).transformed(real_design((1.0 / driven)[:, :, None]))
    known = from_output.plus(spread.uncertainty.scaled(-value / spread.value))
    masses = _mass_influences(body, spread.frequency_hz, axis, -sign * value / mass[:, None])
    ratios = PointRatios(
        channel=sensitivity.channels[channel],
        component=sensitivity.components[axis],
        unit=sensitivity.unit,
        value=value,
        uncertainty=Uncertainty(known.random, (*known.influences, *masses)),
        fused=sensitivity.value[:, channel, axis],
    )
    return replace(spread, ratios=ratios)


def _mass_influences(body: Body, frequency_hz: FloatArray, axis: int, slope: ComplexArray) -> tuple[Influence, ...]:
    """What the uncertain masses do to values (K, N) that change by `slope` (K, N) per kilogram."""
    changes = [(c, c.change[:, axis, axis]) for c in body.matrix_changes(frequency_hz, None)]
    return tuple(
        Influence(c.name, c.label, c.u, c.unit, real_stack(slope * mass[:, None]), c.scope)
        for c, mass in changes
        if np.any(mass)
    )
