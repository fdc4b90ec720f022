"""Pose of the camera in the sensor frame from all evidence, and axes of motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photogram.alignment.alignment_evidence import (
    CALIBRATION_ERROR,
    KnownFace,
    KnownPixels,
    KnownPoints,
    KnownPoses,
    PoseEvidence,
    perpendicular_directions,
)
from photogram.calibration.calibration_notices import CONTRADICTORY_EVIDENCE
from photogram.geometry import (
    RigidTransform,
    fit_rigid,
    fixes_rotation,
    nearest_rotation,
    rotation_from_vector,
    rotation_vector_rate,
    skew,
)
from photogram.motion import RigidMotion
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, IntArray
from shakercal._common.notices import Notice


def starting_pose(evidence: Sequence[PoseEvidence]) -> RigidTransform | None:
    """Return a first `sensor_from_camera` from the evidence, or None.

    Sufficient are one known pose, three points, four points of one camera, or two faces. Directions and axes of motion
    have an unknown sign and cannot start the search.
    """
    for item in evidence:
        if isinstance(item, KnownPoses):
            return item.sensor_from_body[0] @ item.left_from_body[0].inverse()
        if isinstance(item, KnownPixels) and (start := item.perspective_pose) is not None:
            return start
    points = [item for item in evidence if isinstance(item, KnownPoints)]
    if sum(len(item.names) for item in points) >= 3:
        camera, sensor = (np.concatenate([getattr(p, name) for p in points]) for name in ("camera_m", "sensor_m"))
        try:
            return fit_rigid(camera, sensor)
        except ValueError:
            pass  # points that do not determine the rotation
    return _pose_from_faces([item for item in evidence if isinstance(item, KnownFace)])


def _pose_from_faces(faces: Sequence[KnownFace]) -> RigidTransform | None:
    """Return the pose that fits planes to two or more faces, or None."""
    flat, centres, scatter = [], [], np.zeros((3, 3))
    for face in (face for face in faces if len(face.camera_m) >= 3):
        centre = face.camera_m.mean(axis=0)
        _, singular, rows = np.linalg.svd(face.camera_m - centre, full_matrices=False)
        if singular[1] < 1e-6 * max(singular[0], 1e-300):
            continue  # on a line
        flat.append(face)
        centres.append(centre)
        scatter += np.outer(face.normal, rows[2] if rows[2] @ centre < 0.0 else -rows[2])  # towards the camera
    if len(flat) < 2 or not fixes_rotation(scatter):
        return None
    rotation = nearest_rotation(scatter)
    offset = [face.normal @ (face.point_m - rotation @ centre) for face, centre in zip(flat, centres, strict=True)]
    return RigidTransform(rotation, np.linalg.lstsq([face.normal for face in flat], offset, rcond=1e-9)[0])


# Names of undetermined components of a pose.

LIMIT = 0.1
"""Standard uncertainty (m, rad) of an undetermined component; such a pose is useless."""
_SAME = 0.02  # sine of the angle below which a direction has the name of an axis
_PURE = 1e-2  # share of rotation below which a displacement is a pure shift


class UndeterminedPose(ValueError):
    """The evidence does not determine all components of the pose; `components` names the others."""

    def __init__(self, components: tuple[str, ...]) -> None:
        self.components = components
        turns = any(name.startswith("rotation") for name in components)
        shifts = any(name.startswith("position") for name in components)
        cures = ["three points or faces, or a target at a known pose"]
        cures += ["a motion in another direction"] if turns else []
        cures += ["a rotation axis that is not parallel to others"] if shifts else []
        verb = "is" if len(components) == 1 and " and " not in components[0] else "are"
        text = f"{' and '.join(components)} {verb} undetermined: add {', '.join(cures)}, or a prior pose"
        super().__init__(text)


def undetermined_components(information: FloatArray) -> tuple[str, ...]:
    """Return the names of the components that an information matrix (6, 6) does not determine.

    These are the eigenvectors of the information, in units of `LIMIT`, with an eigenvalue below 1: a standard
    uncertainty above `LIMIT`. Pure shifts and rotations are named separately.
    """
    values, vectors = np.linalg.eigh(information * LIMIT**2)
    basis = vectors[:, values < 1.0]
    if not basis.shape[1]:
        return ()
    left, singular, right = np.linalg.svd(basis[3:])
    turning = int(np.count_nonzero(singular > _PURE))
    shifts = (basis @ right[turning:].T)[:3]
    names = [f"rotation about {_axes(left[:, :turning])}"] if turning else []
    if shifts.shape[1]:
        names.append(f"position along {_axes(np.linalg.svd(shifts, full_matrices=False)[0])}")
    return tuple(names)


def _axes(basis: FloatArray) -> str:
    """Return the name of the directions that orthonormal columns (3, d) span."""
    reach = np.linalg.norm(basis, axis=1)
    inside = [axis for axis, length in zip("xyz", reach, strict=True) if length > 1.0 - _SAME**2]
    if len(inside) == basis.shape[1]:
        return " and ".join([", ".join(inside[:-1]), inside[-1]] if len(inside) > 1 else inside)
    if basis.shape[1] == 1:
        return f"({', '.join(f'{x:.3g}' for x in _upright(basis[:, 0]))})"
    normal = np.linalg.svd(basis)[0][:, 2]
    return f"every direction across ({', '.join(f'{x:.3g}' for x in _upright(normal))})"


def _upright(direction: FloatArray) -> FloatArray:
    """Return a direction with its largest component positive and rounding removed."""
    positive = direction * np.sign(direction[np.argmax(np.abs(direction))])
    return np.asarray(np.where(np.abs(positive) < _SAME, 0.0, positive))


# Weighted least squares over all evidence: pose, covariance, and tests of each piece.

TEST_LEVEL = 0.99  # of the χ² test: one consistent alignment in a hundred is enlarged
_STEPS = 50  # limit of the Gauss–Newton steps; some ten are usual
_CONVERGED = 1e-10  # step (m, rad) that ends the iteration


@dataclass(frozen=True)
class EvidenceTest:
    """Test of one piece of evidence against all the others.

    `chi2` is the increase of χ² by this piece and `dof` that of the degrees of freedom. With `dof` 0 the other evidence
    does not determine this piece.
    """

    name: str
    chi2: float
    dof: int

    @property
    def normalised(self) -> float:
        """Root of χ² per degree of freedom: expected 1, NaN without a comparison."""
        return float(np.sqrt(self.chi2 / self.dof)) if self.dof else float("nan")


@dataclass(frozen=True, eq=False, repr=False)
class Alignment(Arrays, shapes="covariance 6 6; conditional_covariance 6 6; by_calibration 6 P"):
    """Pose of the left camera in the sensor frame: x_sensor = R·x_camera + t.

    Attributes
    ----------
    sensor_from_camera : The pose.
    covariance : (6, 6), of the small displacement (shift, rotation about the sensor origin; m and rad, sensor axes)
        that leads from this pose to the true one, multiplied from the left. It includes the calibration and the
        enlargement.
    conditional_covariance : (6, 6), the same with an exact calibration.
    by_calibration : (6, P), displacement for one standard uncertainty of each of the calibration's P errors.
    chi2, dof : Of the fit.
    enlargement : Factor of the standard uncertainties, above 1 if χ² exceeds its 99 % quantile.
    tests : Each piece of evidence against the others.
    notices : Of the fit.
    """

    sensor_from_camera: RigidTransform
    covariance: FloatArray
    conditional_covariance: FloatArray
    by_calibration: FloatArray
    chi2: float
    dof: int
    enlargement: float
    tests: tuple[EvidenceTest, ...]
    notices: tuple[Notice, ...]

    @property
    def u(self) -> FloatArray:
        """Standard uncertainties (6,) of the sensor origin (m) and of the rotation about it (rad)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))


def align(evidence: Sequence[PoseEvidence], start: RigidTransform | None = None) -> Alignment:
    """Estimate the pose of the left camera in the sensor frame from all evidence.

    Parameters
    ----------
    evidence
        Pieces of evidence; at least those that determine all six components.
    start
        First pose; default None, a pose from the evidence.

    Returns
    -------
    The pose with covariance, tests and notices.

    Raises
    ------
    UndeterminedPose : The evidence does not determine a component, which is named.
    ValueError : No first pose is available, or the iteration does not converge.

    Notes
    -----
    Minimises Σ (e + G·c)ᵀ·C⁻¹·(e + G·c) + cᵀ·c over the pose and the common errors c by Gauss–Newton steps. Common
    errors are principal components of the calibration, stated directions, faces and frames, in units of their standard
    uncertainty. Each is an unknown with a prior, so that it counts once (GUM, JCGM 100:2008, F.1.2.3 and H.2).

    Examples
    --------
    >>> seen = np.array([[0.0, 0, 0.5], [0.1, 0, 0.5], [0, 0.1, 0.5]])
    >>> known, variance = seen - [0, 0, 0.5], np.broadcast_to(1e-12 * np.eye(3), (3, 3, 3))
    >>> points = KnownPoints(("a", "b", "c"), seen, variance, known, variance, calibration_effects=np.zeros((0, 3, 3)))
    >>> align([points]).sensor_from_camera.translation_m.round(9) + 0.0
    array([ 0. ,  0. , -0.5])
    """
    pose = starting_pose(evidence) if start is None else start
    if pose is None:
        raise ValueError(
            "start: expected a first pose, which this evidence does not determine: state an approximate one"
        )
    for _ in range(_STEPS):
        system = assemble(evidence, pose)
        if components := undetermined_components(system.information):
            raise UndeterminedPose(components)
        step = np.asarray(np.linalg.lstsq(system.rows, -system.residual, rcond=None)[0][:6], dtype=np.float64)
        turn = rotation_from_vector(step[3:])
        pose = RigidTransform(nearest_rotation(turn @ pose.rotation), turn @ pose.translation_m + step[:3])
        if np.abs(step).max() <= _CONVERGED:
            return _judged(pose, assemble(evidence, pose))
    raise ValueError(
        "evidence: expected evidence of a single pose, found that the iteration does not converge; "
        "check names, positions and directions"
    )


def _judged(pose: RigidTransform, system: AlignmentSystem) -> Alignment:
    """Return the alignment with its tests."""
    from scipy.stats import chi2 as chi_square

    chi2, dof = sum_of_squares(system.rows, system.residual)
    pieces = []
    for number, name in enumerate(system.names):  # the linear fit without a piece, compared with the whole fit
        others = system.piece != number
        without, freedom = sum_of_squares(system.rows[others], system.residual[others])
        pieces.append(EvidenceTest(name, max(chi2 - without, 0.0), dof - freedom))
    fits = dof == 0 or chi2 <= chi_square.ppf(TEST_LEVEL, dof)
    enlargement, notices = 1.0, list[Notice]()
    if not fits:
        enlargement = float(np.sqrt(chi2 / dof))
        compared = [piece for piece in pieces if piece.dof]
        worst = min(compared, key=lambda piece: float(chi_square.logsf(piece.chi2, piece.dof)))
        values = {"chi2": chi2, "dof": dof, "ratio": worst.normalised, "enlargement": enlargement}
        notices.append(Notice(CONTRADICTORY_EVIDENCE, worst.name, piece=worst.name, **values))
    return Alignment(
        pose,
        enlargement**2 * system.covariance(),
        enlargement**2 * system.covariance(fixed_errors=CALIBRATION_ERROR),
        system.response(CALIBRATION_ERROR),
        chi2,
        dof,
        enlargement,
        tuple(pieces),
        tuple(notices),
    )


# The whitened linear system of all evidence about a trial pose.


@dataclass(frozen=True, eq=False)
class AlignmentSystem:
    """Whitened linear system: rows (M, 6 + Q) and residuals (M,) in standard deviations.

    Unknown are the displacement of the pose and Q common errors, whose priors are the last Q rows. `piece` (M,): number
    of each row's piece among `names`, −1 for priors. `columns`: first column and number of each common error's
    unknowns. `information` (6, 6): information about the components that each piece may determine, with unknown common
    errors.
    """

    rows: FloatArray
    residual: FloatArray
    piece: IntArray
    names: tuple[str, ...]
    columns: dict[str, tuple[int, int]]
    information: FloatArray

    def covariance(self, fixed_errors: str = "") -> FloatArray:
        """Return the covariance (6, 6) of the pose, without the common errors of one name."""
        first, count = self.columns.get(fixed_errors, (0, 0))
        rows = np.delete(self.rows, np.s_[first : first + count], axis=1)
        covariance = np.linalg.inv(rows.T @ rows)[:6, :6]
        return np.asarray((covariance + covariance.T) / 2)

    def response(self, common_error: str) -> FloatArray:
        """Return the change (6, Q) of the pose per standard uncertainty of a common error."""
        first, count = self.columns.get(common_error, (0, 0))
        chosen = self.rows[:, first : first + count]
        others = np.delete(self.rows, np.s_[first : first + count], axis=1)
        return np.asarray(-np.linalg.solve(others.T @ others, others.T @ chosen)[:6])


def assemble(evidence: Sequence[PoseEvidence], pose: RigidTransform) -> AlignmentSystem:
    """Return the system of all evidence at a trial pose."""
    parts = [item.residuals(pose) for item in evidence]
    columns: dict[str, tuple[int, int]] = {}
    width = 6
    for name, changes in [pair for part in parts for pair in part.common.items() if len(pair[1])]:
        first, count = columns.setdefault(name, (width, len(changes)))
        if count != len(changes):
            raise ValueError(f"{name}: expected {count} common errors as before, found {len(changes)}")
        width = max(width, first + count)
    names = tuple(dict.fromkeys(name for part in parts for name in part.piece_name))
    prior = np.eye(width)[6:]
    blocks, determining, pieces = [], [], []
    for part in parts:
        groups, size = part.residual.shape
        full = np.zeros((groups, size, width + 1))
        full[..., :6], full[..., width] = part.jacobian, part.residual
        for name, changes in part.common.items():
            if len(changes):
                first, count = columns[name]
                full[..., first : first + count] += np.moveaxis(changes, 0, -1)
        try:
            white = np.linalg.solve(np.linalg.cholesky(part.covariance), full).reshape(-1, width + 1)
        except np.linalg.LinAlgError as error:
            raise ValueError(f"{part.piece_name[0]}: expected a positive definite covariance") from error
        blocks.append(white)
        determining.append(white[:, :-1] * np.concatenate([part.determines, np.ones(width - 6)]))
        pieces.append(np.repeat([names.index(name) for name in part.piece_name], size))
    blocks.append(np.column_stack([prior, np.zeros(width - 6)]))
    system, determined = np.concatenate(blocks), np.concatenate([*determining, prior])
    normal = determined.T @ determined
    return AlignmentSystem(
        system[:, :-1],
        system[:, -1],
        np.concatenate([*pieces, np.full(width - 6, -1)]).astype(np.int64),
        names,
        columns,
        # information about the pose with unknown common errors: the Schur complement
        normal[:6, :6] - normal[:6, 6:] @ np.linalg.solve(normal[6:, 6:], normal[6:, :6]),
    )


# Direction of a body's motion, and the axis about which it turns.

_RANK = 1e-10  # singular values below this share of the largest count as zero
_AXIS_STEPS = 30  # limit of the Gauss–Newton steps; some five are usual
_AXIS_CONVERGED = 1e-12  # relative step that ends the iteration, near rounding
_LEAST_TURN = 5.0  # least rotation of a body in standard uncertainties


def linear_motion(
    phasor: ComplexArray, covariance: FloatArray, effects: ComplexArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the motion (6,) along the major axis of the translation's ellipse.

    Input are displacement phasors (6,), their `covariance` (12, 12) of [all Re, all Im] and `effects` (P, 6).
    Multiplied by e^{−jφ}, with the phase φ of Σ u² = |·|·e^{2jφ} over the translations u, the phasors have the motion
    at its largest translation as real part and the minor axis as imaginary part. Returned are motion, covariance (6,
    6), effects (P, 6) and the ratio of minor to major axis. The ratio is the angle (rad) between the translation and a
    line.
    """
    phase = 0.5 * np.angle(np.sum(phasor[:3] ** 2))
    rotated = phasor * np.exp(-1j * phase)
    real_part = np.concatenate([np.cos(phase) * np.eye(6), np.sin(phase) * np.eye(6)], axis=1)
    minor = float(np.linalg.norm(rotated[:3].imag) / np.linalg.norm(rotated[:3].real))
    changes = (effects * np.exp(-1j * phase)).real
    return rotated.real, real_part @ covariance @ real_part.T, changes, minor


@dataclass(frozen=True, eq=False, repr=False)
class RotationAxis(Arrays, shapes="line 6; covariance 6 6"):
    """A fixed axis about which a body turned, with covariance and goodness of fit.

    `line` (6,): the point (m) nearest to the motion's origin and the direction (unit vector), with `covariance` (6, 6).
    `chi2` and `dof` test the motion against a rotation about that axis. Above 1, χ²/dof multiplies the covariance: the
    axis then moved more than the noise of the frames.
    """

    line: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int


def fit_axis(motion: RigidMotion) -> RotationAxis:
    """Return the axis about which a body turns, from its poses relative to frame 0.

    Least squares over the rotation vectors and the displacements of the axis points across the axis; displacements
    along the axis are free. The noise of frame 0 is a common unknown with that frame's covariance. Angles may be large;
    their sequence has no influence.
    """
    used = np.isfinite(motion.pose).all(axis=1) & motion.pose.any(axis=1)
    pose, covariance = motion.pose[used], motion.covariance[used]
    if len(pose) < 3:
        raise ValueError(f"motion: expected at least 3 frames after the first, found {len(pose)}")
    direction = np.linalg.svd(pose[:, 3:], full_matrices=False)[2][0]
    tilt = perpendicular_directions(direction)
    projected = tilt @ (np.eye(3) - rotation_from_vector(pose[:, 3:])) @ tilt.T
    point = np.linalg.lstsq(projected.reshape(-1, 2), (pose[:, :3] @ tilt.T).ravel(), rcond=None)[0]
    line = np.concatenate([point @ tilt, direction])  # the point with the least motion
    angle = np.ptp(pose[:, 3:] @ direction)
    noise = float(np.sqrt(np.median(covariance[:, 3:, 3:] @ line[3:] @ line[3:])))
    if not angle > _LEAST_TURN * noise:
        raise ValueError(f"motion: expected a body that turns, found {angle:.2g} rad with a noise of {noise:.2g}")
    reference = motion.covariance[0] if np.isfinite(motion.covariance[0]).all() else covariance[0]
    for _ in range(_AXIS_STEPS):
        rows, residual, tangents = _equations(pose, covariance, reference, line)
        step = np.linalg.lstsq(rows, -residual, rcond=None)[0]
        point, direction = np.split(line + tangents @ step[:4], 2)
        direction = direction / np.linalg.norm(direction)
        line = np.concatenate([point - (point @ direction) * direction, direction])  # the point nearest to the origin
        if np.abs(step[:4]).max() <= _AXIS_CONVERGED * max(1.0, float(np.abs(line).max())):
            break
    rows, residual, tangents = _equations(pose, covariance, reference, line)
    chi2, dof = sum_of_squares(rows, residual)
    free = tangents @ np.linalg.inv(rows.T @ rows)[:4, :4] @ tangents.T
    origin = np.concatenate([motion.origin_m, np.zeros(3)])
    return RotationAxis(line + origin, free * max(1.0, chi2 / dof), chi2, dof)


def _equations(
    pose: FloatArray, covariance: FloatArray, reference: FloatArray, line: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return whitened rows (4F + 6, 10), residuals and tangents (6, 4) of an axis.

    Residuals of a frame are its rotation vector and the displacement of the axis point, both across the axis. Unknown
    are two components of the point, two of the direction, and six of the noise of frame 0. The point stays the one
    nearest to the origin, so a change of direction moves it along the axis: the fourth block of the tangents.
    """
    point, direction = line[:3], line[3:]
    tilt = perpendicular_directions(direction)
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
    by_axis[:, :2, 2:] = -(pose[:, 3:] @ direction)[:, None, None] * np.eye(2)
    by_axis[:, 2:, 2:] = -(moved @ direction)[:, None, None] * np.eye(2)
    first = np.zeros((len(pose), 6, 6))  # T·exp(n): the noise of frame 0 multiplies every pose from the right
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


def sum_of_squares(rows: FloatArray, residual: FloatArray) -> tuple[float, int]:
    """Return the least sum of squares of residual + rows·x and its degrees of freedom."""
    if not len(rows):
        return 0.0, 0
    scale = np.linalg.norm(rows, axis=0)
    u, singular, _ = np.linalg.svd(rows / np.where(scale > 0.0, scale, 1.0), full_matrices=False)
    fitted = u[:, singular > _RANK * singular[0]]
    left = residual - fitted @ (fitted.T @ residual)
    return float(left @ left), len(rows) - fitted.shape[1]
