"""A calibration with known truth: how a session of a bent target would end, its rig drawn within its covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from photogram.calibration.calibration_notices import LOW_COVERAGE, TARGET_DEVIATION
from photogram.calibration.calibration_result import (
    CalibratedImage,
    CalibratedView,
    Calibration,
    CalibrationParameter,
    ParameterState,
    Rejection,
)
from photogram.camera import RIG_PARAMETERS, Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.scene import session_covariance
from photogram.targets.target_view import Target
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

SIZE_PX = np.array([2448, 2048])
SPACING_M = 3.5e-3
UNITS = (*(("px",) * 4 + ("1",) * 5) * 2, *("rad",) * 3, *("m",) * 3)
LATTICE = np.stack(np.meshgrid(np.arange(-13, 14), np.arange(-10, 11), indexing="ij"), axis=-1).reshape(-1, 2)
LEFT = np.array([3512.4, 3514.1, 1236.7, 1009.2, -0.1213, 0.1544, 3.1e-4, -5.2e-4, 0.021])
RIGHT = np.array([3498.9, 3500.8, 1201.3, 1031.5, -0.1187, 0.1391, -2.2e-4, 4.1e-4, 0.034])
CENTRE_M = np.array([0.004, 0.002, 0.41])


@dataclass(frozen=True)
class Session:
    """What the session was like: views, noise, bow of the target, a lens that the model does not describe."""

    views: int = 14
    noise_px: float = 0.12
    bow_m: float = 60e-6
    unmodelled_px: float = 0.1
    scale_u: float = 2.9e-5
    missing_right: tuple[int, ...] = (5,)
    names: tuple[str, str] = ("left", "right")


def true_rig() -> StereoRig:
    """Return the rig that saw the target: 172 mm baseline, axes converging at 0.42 rad."""
    turn = rotation_from_vector(np.array([0.011, 0.42, 0.006]))
    left, right = (Camera.from_parameters(parameters, SIZE_PX) for parameters in (LEFT, RIGHT))
    return StereoRig(left, right, RigidTransform(turn, -turn @ np.array([0.168, -0.003, 0.036])))


def make_calibration(session: Session = Session()) -> Calibration:
    """Return the calibration of a session, with dropped pictures, outliers and a view without a right picture."""
    rng = np.random.default_rng(0)
    rig = true_rig()
    scale = session.scale_u * np.concatenate([np.zeros(21), rig.right_from_left.translation_m])
    covariance = session_covariance(rig, CENTRE_M, 0.16, session.noise_px, session.views, rng) + np.outer(scale, scale)
    u = np.sqrt(np.diagonal(covariance))
    drawn = u * (np.linalg.cholesky(covariance / np.outer(u, u)) @ rng.normal(size=24))
    shape = np.column_stack([SPACING_M * LATTICE, np.zeros(len(LATTICE))])
    across = LATTICE[:, 0] / 13
    shape[:, 2] += session.bow_m * (1 - across**2)
    shape[:, 1] += 0.05 * session.bow_m * across
    views = tuple(_view(place, rig, shape, session, rng) for place in range(session.views))
    return _calibration(replace(rig.perturbed(drawn), covariance=covariance), views, shape, session)


def _view(place: int, rig: StereoRig, shape: FloatArray, session: Session, rng: np.random.Generator) -> CalibratedView:
    """A target about the crossing of the axes, tilted up to 0.5 rad and turned, with the picture of either camera."""
    direction, tilt = 2.4 * place, 0.5 * np.sqrt((place + 0.5) / session.views)
    tilted = rotation_from_vector(tilt * np.array([np.cos(direction), np.sin(direction), 0.0]))
    facing = rotation_from_vector(np.array([0.0, -0.2, 0.0])) @ np.diag([1.0, -1.0, -1.0])
    turned = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-0.6, 0.6)]))
    pose = RigidTransform(tilted @ facing @ turned, CENTRE_M + rng.uniform(-1, 1, 3) * [0.06, 0.06, 0.05])
    pictures: list[CalibratedImage | None] = []
    for name, pixel in zip(session.names, rig.project(pose.apply(shape)), strict=True):
        if len(pictures) == 1 and place in session.missing_right:
            pictures.append(None)
            continue
        phase = 2 * np.pi * pixel / 900.0  # a distortion of short wavelength that the lens model cannot follow
        off = session.unmodelled_px * np.stack([np.sin(phase[:, 1]), np.cos(phase[:, 0])], axis=-1)
        off += rng.normal(0.0, session.noise_px, off.shape)
        wrong = rng.random(len(off)) < 0.004
        off[wrong] += rng.normal(0.0, 2.5, (int(wrong.sum()), 2))
        seen = ((pixel > 12) & (pixel < SIZE_PX - 12)).all(axis=1)
        normalised = np.linalg.norm(off, axis=1) / np.hypot(session.noise_px, session.unmodelled_px / 2)
        arrays = (LATTICE[seen], (pixel + off)[seen], off[seen], normalised[seen], ~wrong[seen])
        pictures.append(CalibratedImage(f"{name}-{place + 1:02d}.tif", *arrays))
    root = np.diag([2e-6] * 3 + [2e-5] * 3) @ (np.eye(6) + 0.2 * rng.normal(size=(6, 6)))
    return CalibratedView(pose, root @ root.T, *pictures)


def _calibration(rig: StereoRig, views: tuple[CalibratedView, ...], shape: FloatArray, session: Session) -> Calibration:
    """The result around the views."""
    sides = [[p for view in views if (p := getattr(view, side)) is not None] for side in ("left", "right")]
    residuals = [np.concatenate([picture.residual_px[picture.used] for picture in side]) for side in sides]
    rms = [float(np.sqrt((each**2).sum(axis=1).mean())) for each in (*residuals, np.concatenate(residuals))]
    reason = "residual more than 4 times its uncertainty"
    left_out = [Rejection(p.name, int((~p.used).sum()), reason) for side in sides for p in side if not p.used.all()]
    return Calibration(
        rig=rig,
        target=Target("dots", SPACING_M),
        views=views,
        parameters=_parameters(rig),
        rms_px=rms[2],
        rms_sides_px=(rms[0], rms[1]),
        added_px=(session.unmodelled_px / 2, session.unmodelled_px / 2),
        sigma_factor=1.0,
        dof=2 * sum(map(len, residuals)) - 24 - 6 * len(views),
        shape_index=LATTICE,
        shape_m=shape,
        scale_u=session.scale_u,
        image_coverage=(_covered(sides[0]), _covered(sides[1])),
        rejections=(
            Rejection(f"{session.names[0]}-15.tif", 0, "blurred: edges of 6.1 px, sharp ones have 1.2 px"),
            Rejection(f"{session.names[1]}-06.tif", 0, "no ring markers found"),
            *left_out,
        ),
        notices=(
            Notice(TARGET_DEVIATION, "target", x_um=1.2, y_um=0.9, z_um=60.0, digits=1),
            Notice(LOW_COVERAGE, "right", share_percent=58.0, side="right", corners=2),
        ),
    )


def _covered(pictures: list[CalibratedImage]) -> float:
    """Share of the 8 x 6 cells of the picture in which there is a point."""
    points = np.concatenate([picture.position_px[picture.used] for picture in pictures])
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=(8, 6), range=[[-0.5, n - 0.5] for n in SIZE_PX])
    return float((counts > 0).mean())


def _parameters(rig: StereoRig) -> tuple[CalibrationParameter, ...]:
    """All 24 with the state that their value and uncertainty give."""
    value, variance = rig.values[:24], np.diagonal(rig.covariance)[:24]
    parameters = []
    for name, size, u, unit in zip(RIG_PARAMETERS[:24], value, np.sqrt(variance), UNITS, strict=True):
        state: ParameterState = "indistinct" if unit == "1" and abs(size) < 2 * u else "determined"
        parameters.append(
            CalibrationParameter(name, float(size), float(u), unit, "undetermined" if unit == "1" and u > 1 else state)
        )
    return tuple(parameters)
