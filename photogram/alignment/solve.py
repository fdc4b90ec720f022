"""All evidence in one weighted least squares: the pose, its covariance, and whether the pieces fit each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photogram._checks import FloatArray, check_shape
from photogram.alignment.evidence import Evidence
from photogram.alignment.openness import OpenPose, open_components
from photogram.alignment.residuals import CALIBRATION
from photogram.alignment.start import starting_pose
from photogram.alignment.system import System, assemble, sum_of_squares
from photogram.notice import Notice
from photogram.rigid import RigidTransform, nearest_rotation, rotation_from_vector

__all__ = ["Alignment", "OpenPose", "Piece", "align"]

TEST_LEVEL = 0.99
_STEPS = 50
_CONVERGED = 1e-10  # a step (m, rad) this small ends the iteration


@dataclass(frozen=True)
class Piece:
    """One piece of evidence against all the others: by how much it raises χ², and on how many degrees of freedom.

    With 0 degrees of freedom nothing else speaks about what this piece says.
    """

    name: str
    chi2: float
    dof: int

    @property
    def normalised(self) -> float:
        """Root of χ² per degree of freedom: 1 is expected, NaN where nothing can be compared."""
        return float(np.sqrt(self.chi2 / self.dof)) if self.dof else float("nan")


@dataclass(frozen=True, eq=False)
class Alignment:
    """The pose of the left camera in the sensor frame: x_sensor = R·x_camera + t.

    `covariance` (6, 6): of the small displacement (shift, rotation about the sensor origin; m and rad, sensor axes)
    that, multiplied from the left, leads from this pose to the true one; it contains the calibration's share and is
    enlarged by `enlargement`² where the evidence does not fit together (χ² beyond its 99 % quantile).
    `held_covariance` (6, 6): the same if the calibration were exact. `by_calibration` (6, P): the displacement for one
    standard uncertainty of each of the calibration's P errors, in the order of the evidence's effects.
    """

    sensor_from_camera: RigidTransform
    covariance: FloatArray
    held_covariance: FloatArray
    by_calibration: FloatArray
    chi2: float
    dof: int
    enlargement: float
    pieces: tuple[Piece, ...]
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        """Refuse other shapes."""
        check_shape("covariance", self.covariance, (6, 6))
        check_shape("held_covariance", self.held_covariance, (6, 6))
        check_shape("by_calibration", self.by_calibration, (6, None))

    @property
    def u(self) -> FloatArray:
        """Standard uncertainties (6,): position of the sensor origin (m), rotation about it (rad), sensor axes."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))


def align(evidence: Sequence[Evidence], start: RigidTransform | None = None) -> Alignment:
    """Return the pose of the left camera in the sensor frame that fits all evidence best.

    Minimises Σ (e + G·c)ᵀ·C⁻¹·(e + G·c) + cᵀ·c over the pose and the errors c that evidence has in common (principal
    components of the calibration, stated directions, faces, frames; in units of their standard uncertainty), by
    Gauss-Newton steps from `start`, by default a pose that the evidence itself gives. What is common is an unknown with
    a prior, so that it enters the weights and is counted once (GUM, JCGM 100:2008, F.1.2.3 and H.2).

    Components of the pose that the evidence leaves open raise `OpenPose`, which names them.
    """
    pose = starting_pose(evidence) if start is None else start
    if pose is None:
        raise ValueError(
            "start: expected a first pose beside this evidence, which is not enough to find one: state what is known"
        )
    for _ in range(_STEPS):
        system = assemble(evidence, pose)
        _refuse_open(system)
        step = np.asarray(np.linalg.lstsq(system.rows, -system.residual, rcond=None)[0][:6], dtype=np.float64)
        pose = _moved(pose, step)
        if np.abs(step).max() <= _CONVERGED:
            return _judged(pose, assemble(evidence, pose))
    raise ValueError("evidence: expected pieces that describe one pose, found that no pose settles; check for mix-ups")


def _moved(pose: RigidTransform, step: FloatArray) -> RigidTransform:
    """Return the pose after a small displacement multiplied from the left."""
    turn = rotation_from_vector(step[3:])
    return RigidTransform(nearest_rotation(turn @ pose.rotation), turn @ pose.translation_m + step[:3])


def _refuse_open(system: System) -> None:
    """Raise `OpenPose` where the evidence leaves components of the pose open."""
    found = open_components(system.information)
    if found:
        raise OpenPose(found)


def _judged(pose: RigidTransform, system: System) -> Alignment:
    """Return the alignment with its tests."""
    from scipy.stats import chi2 as chi_square

    chi2, dof = sum_of_squares(system.rows, system.residual)
    pieces = tuple(_piece(system, name, chi2, dof) for name in system.names)
    fits = dof == 0 or chi2 <= chi_square.ppf(TEST_LEVEL, dof)
    enlargement = 1.0 if fits else float(np.sqrt(chi2 / dof))
    return Alignment(
        pose,
        enlargement**2 * system.covariance(),
        enlargement**2 * system.covariance(known=CALIBRATION),
        system.response(CALIBRATION),
        chi2,
        dof,
        enlargement,
        pieces,
        () if fits else (_misfit(pieces, chi2, dof),),
    )


def _piece(system: System, name: str, chi2: float, dof: int) -> Piece:
    """Return how much a piece raises χ²: the fit without it, linear about the pose, against the fit with it."""
    kept = system.piece != system.names.index(name)
    without, freedom = sum_of_squares(system.rows[kept], system.residual[kept])
    return Piece(name, max(chi2 - without, 0.0), dof - freedom)


def _misfit(pieces: Sequence[Piece], chi2: float, dof: int) -> Notice:
    """Return the remark on evidence that does not fit together, naming the least likely piece."""
    from scipy.stats import chi2 as chi_square

    compared = [piece for piece in pieces if piece.dof]
    worst = min(compared, key=lambda piece: float(chi_square.logsf(piece.chi2, piece.dof)))
    text = (
        f"the evidence does not fit together (chi2 {chi2:.3g} with {dof} degrees of freedom); {worst.name} fits least, "
        f"off by {worst.normalised:.2g} times what is stated; uncertainties are enlarged by {np.sqrt(chi2 / dof):.2g}"
    )
    return Notice("warning", text, worst.name)
