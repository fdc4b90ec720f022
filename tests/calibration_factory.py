"""A calibration with known truth: a rig sees a bent target with noise, and one linear adjustment estimates the rig."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from photogram.arrays import BoolArray, FloatArray, Notice
from photogram.calibration.result import CalibratedPicture, CalibratedView, Calibration, Determined, Dropped, Parameter
from photogram.camera import RIG_PARAMETERS, Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.targets.view import Target

SIZE_PX = np.array([2448, 2048])
SPACING_M = 3.5e-3
UNITS = (*(("px",) * 4 + ("1",) * 5) * 2, *("rad",) * 3, *("m",) * 3)
STEP = np.array([*([1e-2] * 4 + [1e-5, 1e-5, 1e-6, 1e-6, 1e-4]) * 2, *[1e-6] * 3, *[1e-6] * 3])
LATTICE = np.stack(np.meshgrid(np.arange(-13, 14), np.arange(-10, 11), indexing="ij"), axis=-1).reshape(-1, 2)
LEFT = np.array([3512.4, 3514.1, 1236.7, 1009.2, -0.1213, 0.1544, 3.1e-4, -5.2e-4, 0.021])
RIGHT = np.array([3498.9, 3500.8, 1201.3, 1031.5, -0.1187, 0.1391, -2.2e-4, 4.1e-4, 0.034])


@dataclass(frozen=True)
class Session:
    """What the session was like: views, noise, bow of the target, a lens that the model does not describe."""

    views: int = 14
    noise_px: float = 0.12
    bow_m: float = 60e-6
    unmodelled_px: float = 0.15
    scale_u: float = 2.9e-5
    missing_right: tuple[int, ...] = (5,)
    names: tuple[str, str] = ("left", "right")


def true_rig() -> StereoRig:
    """Return the rig that saw the target: 172 mm baseline, axes converging at 0.42 rad."""
    turn = RigidTransform.from_pose(np.array([0.0, 0.0, 0.0, 0.011, 0.42, 0.006]))
    centre = np.array([0.168, -0.003, 0.036])
    right_from_left = RigidTransform(turn.rotation, -turn.rotation @ centre)
    left, right = (Camera.from_parameters(parameters, SIZE_PX) for parameters in (LEFT, RIGHT))
    return StereoRig(left, right, right_from_left)


def make_calibration(session: Session | None = None, seed: int = 0) -> Calibration:
    """Return the calibration of a session, with dropped pictures, outliers and a view without a right picture."""
    session = Session() if session is None else session
    rng = np.random.default_rng(seed)
    rig, poses = true_rig(), _poses(session.views, rng)
    shape = _shape(session.bow_m)
    seen = [_look(rig, pose, shape, session, rng, place in session.missing_right) for place, pose in enumerate(poses)]
    outlier = [rng.random(mask.shape) < 0.004 for _, mask in seen]
    for (error, _), wrong in zip(seen, outlier, strict=True):
        error[wrong] += rng.normal(0.0, 2.5, (int(wrong.sum()), 2))
    used = [mask & ~wrong for (_, mask), wrong in zip(seen, outlier, strict=True)]
    jacobians = [_jacobian(rig, pose, shape) for pose in poses]
    factor = float(np.hypot(session.noise_px, session.unmodelled_px / 2) / session.noise_px)
    delta, covariance, residuals = _adjust(jacobians, [error for error, _ in seen], used)
    covariance *= (session.noise_px * factor) ** 2
    covariance[21:24, 21:24] += session.scale_u**2 * np.outer(
        rig.right_from_left.translation_m, rig.right_from_left.translation_m
    )
    views = tuple(
        _view(place, poses[place], rig, shape, residuals[place], seen[place][1], used[place], covariance, session)
        for place in range(session.views)
    )
    return _calibration(replace(rig.perturbed(delta[:24]), covariance=covariance[:24, :24]), views, shape, session)


def _poses(count: int, rng: np.random.Generator) -> list[RigidTransform]:
    """Targets about the crossing of the axes, tilted up to 0.5 rad in all directions and turned in their plane."""
    poses = []
    for place in range(count):
        direction, tilt = 2.4 * place, 0.5 * np.sqrt((place + 0.5) / count)
        tilted = rotation_from_vector(tilt * np.array([np.cos(direction), np.sin(direction), 0.0]))
        facing = rotation_from_vector(np.array([0.0, -0.2, 0.0])) @ rotation_from_vector(np.array([np.pi, 0.0, 0.0]))
        turned = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-0.6, 0.6)]))
        centre = np.array([0.004, 0.002, 0.41]) + rng.uniform(-1, 1, 3) * [0.06, 0.06, 0.05]
        poses.append(RigidTransform(tilted @ facing @ turned, centre))
    return poses


def _shape(bow_m: float) -> FloatArray:
    """Points of the target: the lattice with a bow and a little shear in its plane."""
    flat = np.zeros((len(LATTICE), 3))
    flat[:, :2] = SPACING_M * LATTICE
    across = flat[:, 0] / np.abs(flat[:, 0]).max()
    flat[:, 2] += bow_m * (1 - across**2)
    flat[:, 1] += 0.05 * bow_m * across
    return flat


def _look(
    rig: StereoRig, pose: RigidTransform, shape: FloatArray, session: Session, rng: np.random.Generator, alone: bool
) -> tuple[FloatArray, BoolArray]:
    """Errors (2, N, 2) of what is found in both pictures, and which points (2, N) are inside them."""
    pixel = np.stack(rig.project(pose.apply(shape)))
    inside = np.asarray(((pixel > 12) & (pixel < SIZE_PX - 12)).all(axis=-1))
    if alone:
        inside[1] = False
    phase = 2 * np.pi * pixel / 900.0  # a distortion of short wavelength that the lens model cannot follow
    unmodelled = session.unmodelled_px * np.stack([np.sin(phase[..., 1]), np.cos(phase[..., 0])], axis=-1)
    return rng.normal(0.0, session.noise_px, pixel.shape) + unmodelled, inside


def _jacobian(rig: StereoRig, pose: RigidTransform, shape: FloatArray) -> FloatArray:
    """Derivative (2, N, 2, 30) of both pictures by the rig's 24 parameters and the pose's 6, central differences."""
    columns = []
    for change in np.diag(STEP):
        pair = [np.stack(rig.perturbed(sign * change).project(pose.apply(shape))) for sign in (1.0, -1.0)]
        columns.append((pair[0] - pair[1]) / (2 * change.max()))
    for change in 1e-6 * np.eye(6):
        pair = [np.stack(rig.project(_moved(pose, sign * change).apply(shape))) for sign in (1.0, -1.0)]
        columns.append((pair[0] - pair[1]) / 2e-6)
    return np.stack(columns, axis=-1)


def _moved(pose: RigidTransform, change: FloatArray) -> RigidTransform:
    return RigidTransform(rotation_from_vector(change[3:]) @ pose.rotation, pose.translation_m + change[:3])


def _adjust(
    jacobians: list[FloatArray], errors: list[FloatArray], used: list[BoolArray]
) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    """Least squares: parameters (24 + 6·V,), their cofactors, and the residuals (2, N, 2) of every view."""
    size = 24 + 6 * len(jacobians)
    normal, right = np.zeros((size, size)), np.zeros(size)
    for place, (jacobian, error, mask) in enumerate(zip(jacobians, errors, used, strict=True)):
        columns = _columns(place)
        rows = jacobian[mask].reshape(-1, 30)
        normal[np.ix_(columns, columns)] += rows.T @ rows
        right[columns] += rows.T @ error[mask].reshape(-1)
    scale = np.sqrt(np.diagonal(normal))
    inverse = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    inverse = 0.5 * (inverse + inverse.T)
    delta = inverse @ right
    residuals = [
        error - jacobian @ delta[_columns(place)]
        for place, (jacobian, error) in enumerate(zip(jacobians, errors, strict=True))
    ]
    return delta, inverse, residuals


def _columns(place: int) -> list[int]:
    return [*range(24), *range(24 + 6 * place, 30 + 6 * place)]


def _view(
    place: int,
    pose: RigidTransform,
    rig: StereoRig,
    shape: FloatArray,
    residual: FloatArray,
    inside: BoolArray,
    used: BoolArray,
    covariance: FloatArray,
    session: Session,
) -> CalibratedView:
    """One view with the picture of either camera, none where no point was inside."""
    modelled = rig.project(pose.apply(shape))
    pictures = []
    for side, name in enumerate(session.names):
        seen = inside[side]
        place_px, off_px = (modelled[side] + residual[side])[seen], residual[side][seen]
        normalised = np.linalg.norm(off_px, axis=1) / np.hypot(session.noise_px, session.unmodelled_px / 2)
        file = f"{name}-{place + 1:02d}.tif"
        picture = CalibratedPicture(file, LATTICE[seen], place_px, off_px, normalised, used[side][seen])
        pictures.append(picture if seen.any() else None)
    own = slice(24 + 6 * place, 30 + 6 * place)
    return CalibratedView(pose, covariance[own, own], *pictures)


def _calibration(rig: StereoRig, views: tuple[CalibratedView, ...], shape: FloatArray, session: Session) -> Calibration:
    """The result around the adjustment."""
    sides = tuple(
        np.concatenate([p.residual_px[p.used] for p in pictures if p is not None])
        for pictures in ([view.left for view in views], [view.right for view in views])
    )
    rms = [_rms(side) for side in sides]
    left_out = tuple(
        Dropped(picture.name, int((~picture.used).sum()), "residual more than 4 times its uncertainty")
        for view in views
        for picture in (view.left, view.right)
        if picture is not None and not picture.used.all()
    )
    return Calibration(
        rig=rig,
        target=Target("dots", SPACING_M),
        views=views,
        parameters=_parameters(rig),
        rms_px=_rms(np.concatenate(sides)),
        rms_sides_px=(rms[0], rms[1]),
        added_px=(session.unmodelled_px / 2, session.unmodelled_px / 2),
        sigma_factor=1.0,
        dof=2 * sum(map(len, sides)) - 24 - 6 * len(views),
        shape_index=LATTICE,
        shape_m=shape,
        scale_u=session.scale_u,
        covered=(_covered([view.left for view in views]), _covered([view.right for view in views])),
        dropped=(
            Dropped(f"{session.names[0]}-15.tif", 0, "blurred: edges of 6.1 px, sharp ones have 1.2 px"),
            Dropped(f"{session.names[1]}-06.tif", 0, "no ring markers found"),
            *left_out,
        ),
        notices=(
            Notice("info", "the target is bent by 60 µm; its shape was estimated", "target"),
            Notice("warning", "the lower left corner of the right picture is empty; add views there", "coverage"),
        ),
    )


def _covered(pictures: list[CalibratedPicture | None]) -> float:
    """Share of the 8 x 6 cells of the picture in which there is a point."""
    points = np.concatenate([picture.position_px[picture.used] for picture in pictures if picture is not None])
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=(8, 6), range=[[-0.5, n - 0.5] for n in SIZE_PX])
    return float((counts > 0).mean())


def _rms(residual: FloatArray) -> float:
    """Rms length of residuals (M, 2)."""
    return float(np.sqrt((residual**2).sum(axis=1).mean()))


def _parameters(rig: StereoRig) -> tuple[Parameter, ...]:
    """All 24 with the state that their value and uncertainty give."""
    assert rig.covariance is not None
    turn = np.zeros(3)  # the rotation's parameters are a small turn beside the rotation itself
    value = np.concatenate([rig.left.parameters, rig.right.parameters, turn, rig.right_from_left.translation_m])
    found = []
    for name, size, u, unit in zip(RIG_PARAMETERS, value, np.sqrt(np.diagonal(rig.covariance)), UNITS, strict=True):
        state: Determined = "indistinct" if unit == "1" and abs(size) < 2 * u else "determined"
        found.append(Parameter(name, float(size), float(u), unit, "open" if unit == "1" and u > 1 else state))
    return tuple(found)
