"""The equations of an alignment, and the motion of turned sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photogram.alignment.evidence import Evidence, Residuals, across
from photogram.arrays import BoolArray, ComplexArray, FloatArray, IntArray, check_shape
from photogram.geometry import RigidTransform, rotation_from_vector, rotation_vector_rate, skew
from photogram.motion import RigidMotion

# The whitened linear system of all evidence about a trial pose.


_RANK = 1e-10  # singular values below this share of the largest count as zero


@dataclass(frozen=True, eq=False)
class System:
    """Rows (M, 6 + Q) and residuals (M,) in units of their standard deviations.

    Unknown are the displacement of the pose and Q common errors, whose priors are the last Q rows. `piece` (M,): number
    of each row's piece among `names`, −1 for priors of common errors. `columns`: first column and number of each common
    error's unknowns. `information` (6, 6): what the evidence says about the components that it may determine,
    common errors and all.
    """

    rows: FloatArray
    residual: FloatArray
    piece: IntArray
    names: tuple[str, ...]
    columns: dict[str, tuple[int, int]]
    information: FloatArray

    def covariance(self, known: str = "") -> FloatArray:
        """Return the covariance (6, 6) of the pose, on condition that the common errors of one name are known."""
        first, count = self.columns.get(known, (0, 0))
        rows = np.delete(self.rows, np.s_[first : first + count], axis=1)
        covariance = np.linalg.inv(rows.T @ rows)[:6, :6]
        return np.asarray((covariance + covariance.T) / 2)

    def response(self, known: str) -> FloatArray:
        """Return how the pose (6, Q) answers one standard uncertainty of each common error of a name."""
        first, count = self.columns.get(known, (0, 0))
        chosen = self.rows[:, first : first + count]
        others = np.delete(self.rows, np.s_[first : first + count], axis=1)
        return np.asarray(-np.linalg.solve(others.T @ others, others.T @ chosen)[:6])


def assemble(evidence: Sequence[Evidence], pose: RigidTransform) -> System:
    """Return the system of all evidence at a trial pose."""
    parts = [item.residuals(pose) for item in evidence]
    columns = _columns(parts)
    total = sum(count for _, count in columns.values())
    names = tuple(dict.fromkeys(name for part in parts for name in part.piece))
    blocks = [_rows(part, columns, total) for part in parts]
    piece = [np.repeat([names.index(name) for name in part.piece], part.residual.shape[1]) for part in parts]
    prior = np.eye(6 + total)[6:]
    rows = np.concatenate([*(rows for rows, _, _ in blocks), prior])
    claimed = np.concatenate([*(rows * _mask(mask, total) for rows, _, mask in blocks), prior])
    return System(
        rows,
        np.concatenate([*(residual for _, residual, _ in blocks), np.zeros(total)]),
        np.concatenate([*piece, np.full(total, -1)]).astype(np.int64),
        names,
        columns,
        _about_pose(claimed.T @ claimed),
    )


def sum_of_squares(rows: FloatArray, residual: FloatArray) -> tuple[float, int]:
    """Return the least sum of squares of residual + rows·x and its degrees of freedom."""
    if not len(rows):
        return 0.0, 0
    scale = np.linalg.norm(rows, axis=0)
    u, singular, _ = np.linalg.svd(rows / np.where(scale > 0.0, scale, 1.0), full_matrices=False)
    fitted = u[:, singular > _RANK * singular[0]]
    left = residual - fitted @ (fitted.T @ residual)
    return float(left @ left), len(rows) - fitted.shape[1]


def _columns(parts: Sequence[Residuals]) -> dict[str, tuple[int, int]]:
    """Return first column and number of the unknowns of every common error."""
    columns: dict[str, tuple[int, int]] = {}
    place = 6
    for part in parts:
        for name, changes in part.common.items():
            if not len(changes):
                continue
            if columns.setdefault(name, (place, len(changes)))[1] != len(changes):
                raise ValueError(f"{name}: expected {columns[name][1]} common errors as before, found {len(changes)}")
            place = max(place, sum(columns[name]))
    return columns


def _rows(part: Residuals, columns: dict[str, tuple[int, int]], total: int) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return one evidence's whitened rows (m, 6 + Q) and residuals (m,), and which components it may determine."""
    groups, size = part.residual.shape
    full = np.zeros((groups, size, 6 + total))
    full[..., :6] = part.jacobian
    for name, changes in part.common.items():
        if len(changes):
            first, count = columns[name]
            full[..., first : first + count] += np.moveaxis(changes, 0, -1)
    try:
        root = np.linalg.cholesky(part.covariance)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{part.piece[0]}: expected a positive definite covariance") from error
    white = np.linalg.solve(root, np.concatenate([full, part.residual[..., None]], axis=-1))
    white = white.reshape(groups * size, 7 + total)
    return white[:, :-1], white[:, -1], part.determines


def _mask(determines: BoolArray, total: int) -> FloatArray:
    """Return factors (6 + Q,) that leave what an evidence may determine."""
    return np.concatenate([determines, np.ones(total)]).astype(np.float64)


def _about_pose(normal: FloatArray) -> FloatArray:
    """Return the information (6, 6) about the pose when the common errors are unknown: the Schur complement."""
    pose, mixed, common = normal[:6, :6], normal[:6, 6:], normal[6:, 6:]
    return np.asarray(pose - mixed @ np.linalg.solve(common, mixed.T))


# What a measured motion says: the direction in which a body moves, and the axis about which it turns.


_STEPS = 30
_CONVERGED = 1e-12
_LEAST_TURN = 5.0  # turn of the body in standard uncertainties below which it has no axis


def linear_motion(
    phasor: ComplexArray, covariance: FloatArray, effects: ComplexArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the motion (6,) along the major axis of the translation's ellipse, from displacement phasors (6,).

    `covariance` (12, 12) of [all Re, all Im], `effects` (P, 6) changes of the phasors. Turned by the phase φ of
    Σ u² = |·|·e^{2jφ} over the translations u, the real part of phasors times e^{−jφ} is the motion at its largest
    translation, and the imaginary part the minor axis. Returned are motion, covariance (6, 6), effects (P, 6), and the
    ratio of minor to major axis: the angle (rad) by which the body's translation departs from a line.
    """
    phase = 0.5 * np.angle(np.sum(phasor[:3] ** 2))
    turned = phasor * np.exp(-1j * phase)
    real_part = np.concatenate([np.cos(phase) * np.eye(6), np.sin(phase) * np.eye(6)], axis=1)
    minor = float(np.linalg.norm(turned[:3].imag) / np.linalg.norm(turned[:3].real))
    changes = (effects * np.exp(-1j * phase)).real
    return turned.real, real_part @ covariance @ real_part.T, changes, minor


@dataclass(frozen=True, eq=False)
class Axis:
    """A fixed axis about which a body turned: `line` (6,) a point (m) and the direction (unit vector), `covariance`.

    The point is the one nearest to the motion's origin. `chi2`, `dof`: of the motion against a rotation about that
    axis; the covariance is enlarged by χ²/dof where that is above 1, since then the axis was not as fixed as the frames
    are exact. `turn_rad`: range of the angles.
    """

    line: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int
    turn_rad: float

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        check_shape("line", self.line, (6,))
        check_shape("covariance", self.covariance, (6, 6))


def fit_axis(motion: RigidMotion) -> Axis:
    """Return the axis about which a body turns, from its poses against the first frame.

    Least squares over the rotation vectors and the displacements of the axis' points across the axis; those along it
    are left free. The noise of the first frame, against which all poses count, is a common unknown whose covariance is
    that of frame 0. Angles may be large, and their sequence is of no account.
    """
    used = np.isfinite(motion.pose).all(axis=1) & motion.pose.any(axis=1)
    pose, covariance = motion.pose[used], motion.covariance[used]
    if len(pose) < 3:
        raise ValueError(f"motion: expected at least 3 frames after the first, found {len(pose)}")
    line = _start(pose)
    spread = _turns(pose, line[3:])
    noise = float(np.sqrt(np.median(covariance[:, 3:, 3:] @ line[3:] @ line[3:])))
    if not np.ptp(spread) > _LEAST_TURN * noise:
        raise ValueError(
            f"motion: expected a body that turns, found {np.ptp(spread):.2g} rad with a noise of {noise:.2g}"
        )
    reference = motion.covariance[0] if np.isfinite(motion.covariance[0]).all() else covariance[0]
    for _ in range(_STEPS):
        rows, residual, tangents = _equations(pose, covariance, reference, line)
        step = np.linalg.lstsq(rows, -residual, rcond=None)[0]
        line = _stepped(line, tangents @ step[:4])
        if np.abs(step[:4]).max() <= _CONVERGED * max(1.0, float(np.abs(line).max())):
            break
    rows, residual, tangents = _equations(pose, covariance, reference, line)
    chi2, dof = sum_of_squares(rows, residual)
    free = tangents @ np.linalg.inv(rows.T @ rows)[:4, :4] @ tangents.T
    origin = np.concatenate([motion.origin_m, np.zeros(3)])
    return Axis(line + origin, free * max(1.0, chi2 / dof), chi2, dof, float(np.ptp(spread)))


def _turns(pose: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the angles (F,) about a direction."""
    return np.asarray(pose[:, 3:] @ direction)


def _start(pose: FloatArray) -> FloatArray:
    """Return a first axis: principal direction of the rotation vectors, and the point that moves least."""
    direction = np.linalg.svd(pose[:, 3:], full_matrices=False)[2][0]
    tilt = across(direction)
    held = tilt @ (np.eye(3) - rotation_from_vector(pose[:, 3:])) @ tilt.T
    point = np.linalg.lstsq(held.reshape(-1, 2), (pose[:, :3] @ tilt.T).ravel(), rcond=None)[0]
    return np.concatenate([point @ tilt, direction])


def _stepped(line: FloatArray, step: FloatArray) -> FloatArray:
    """Return the axis after a step, its direction a unit vector and its point nearest to the origin."""
    point, direction = line[:3] + step[:3], line[3:] + step[3:]
    direction = direction / np.linalg.norm(direction)
    return np.concatenate([point - (point @ direction) * direction, direction])


def _equations(
    pose: FloatArray, covariance: FloatArray, reference: FloatArray, line: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return whitened rows (4F + 6, 10), residuals and the tangents (6, 4) of the axis.

    Residuals of a frame: its rotation vector and the displacement of the axis' point, both across the axis. Unknown are
    two components of the point, two of the direction, and six of the first frame's noise. With the point held nearest
    to the origin, a change of direction moves it along the axis, which the fourth block of the tangents says.
    """
    point, direction = line[:3], line[3:]
    tilt = across(direction)
    rotation = rotation_from_vector(pose[:, 3:])
    moved = rotation @ point + pose[:, :3] - point
    residual = np.concatenate([pose[:, 3:] @ tilt.T, moved @ tilt.T], axis=1)
    left = np.linalg.inv(rotation_vector_rate(pose[:, 3:]))
    by_pose = np.zeros((len(pose), 4, 6))
    by_pose[:, :2, 3:] = tilt
    by_pose[:, 2:, :3] = tilt
    by_pose[:, 2:, 3:] = -tilt @ skew(rotation @ point) @ left
    by_axis = np.zeros((len(pose), 4, 4))
    by_axis[:, 2:, :2] = tilt @ (rotation - np.eye(3)) @ tilt.T
    by_axis[:, :2, 2:] = -_turns(pose, direction)[:, None, None] * np.eye(2)
    by_axis[:, 2:, 2:] = -(moved @ direction)[:, None, None] * np.eye(2)
    first = np.zeros((len(pose), 6, 6))  # T·exp(n): the first frame's noise moves every pose from the right
    first[:, :3, :3] = rotation
    first[:, 3:, 3:] = rotation_vector_rate(-pose[:, 3:])
    by_first = by_pose @ first
    white = np.linalg.cholesky(by_pose @ covariance @ np.swapaxes(by_pose, 1, 2))
    stacked = np.concatenate([by_axis, by_first @ np.linalg.cholesky(reference), residual[..., None]], axis=2)
    stacked = np.linalg.solve(white, stacked).reshape(-1, 11)
    rows = np.concatenate([stacked[:, :10], np.eye(10)[4:]])
    tangents = np.zeros((6, 4))
    tangents[:3, :2] = tilt.T
    tangents[3:, 2:] = tilt.T
    tangents[:3, 2:] = -np.outer(direction, tilt @ point)
    return rows, np.concatenate([stacked[:, 10], np.zeros(6)]), tangents
