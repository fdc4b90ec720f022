"""A calibrated stereo pair with its views, tests, notices and scale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from photogram.calibration.calibration_notices import (
    ASPECT_RATIO,
    COPIED_IMAGES,
    EXCESS_NOISE,
    FEW_VIEWS,
    FOCAL_DRIFT,
    KNOWN_LENGTH_CONTRADICTED,
    KNOWN_LENGTH_USED,
    LITTLE_TILT,
    LOW_COVERAGE,
    MODEL_DIFFERENCE,
    PARAMETERS_INDISTINCT,
    PARAMETERS_UNDETERMINED,
    REPEATED_POSES,
    SPACING_UNCERTAINTY_UNSTATED,
    TARGET_DEVIATION,
    UNCERTAIN_FOCAL_LENGTH,
)
from photogram.camera import LEFT, RIG_PARAMETERS, RIGHT, TRANSLATION, StereoRig
from photogram.geometry import RigidTransform, skew
from photogram.targets.target_view import Target
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray
from shakercal._common.notices import Notice, Value

ParameterState = Literal["determined", "indistinct", "undetermined"]
"""Whether the views determine a parameter."""


@dataclass(frozen=True)
class CalibrationParameter:
    """One parameter of the rig: value, standard uncertainty (k = 1) and unit.

    The unit is "px", "1", "rad" or "m". `state` is "determined"; "indistinct", a distortion that is not significantly
    different from zero; or "undetermined", as uncertain as the prior: its value is that of the prior.
    """

    name: str
    value: float
    u: float
    unit: str
    state: ParameterState


@dataclass(frozen=True, eq=False, repr=False)
class CalibratedImage(Arrays, shapes="index N 2; position_px N 2; residual_px N 2; normalised N; used N"):
    """One image in the fit with its points (N,), of which `used` were fitted.

    `index` (N, 2) are lattice indices, `position_px` (N, 2) the positions found, `residual_px` (N, 2) found − modelled.
    `normalised` (N,) is the length of the residual over its standard uncertainty.
    """

    name: str
    index: IntArray
    position_px: FloatArray
    residual_px: FloatArray
    normalised: FloatArray
    used: BoolArray

    @property
    def rms_px(self) -> float:
        """Rms length of the used points' residuals (OpenCV's definition of the reprojection error)."""
        squares = (self.residual_px[self.used] ** 2).sum(axis=1)
        return float(squares.mean() ** 0.5) if self.used.any() else float("nan")


@dataclass(frozen=True, eq=False, repr=False)
class CalibratedView(Arrays, shapes="covariance 6 6"):
    """One pose of the target, `left_from_target`, with covariance and the images of both cameras.

    The covariance (6, 6) is that of translation (m) and left-multiplied rotation (rad), in the order x y z rx ry rz.
    `pose` is the number of the pose, the same for views of nearly one pose; None if every view has its own.
    """

    left_from_target: RigidTransform
    covariance: FloatArray
    left: CalibratedImage | None
    right: CalibratedImage | None
    pose: int | None = None


@dataclass(frozen=True)
class Rejection:
    """An image, or points of one, rejected from the fit, with the reason.

    `points` is 0 for a whole image; `copy`: it is a copy of another.
    """

    name: str
    points: int
    reason: str
    copy: bool = False


@dataclass(frozen=True, eq=False)
class AlternativeModel:
    """The result of another target geometry or lens model for the same images.

    `shape` is "flat" or "free", `lens` "polynomial" or "rational". `predicted_px`: rms length of the residuals of a
    view that the other views predict, with its pose fitted.
    """

    shape: str
    lens: str
    rig: StereoRig
    predicted_px: float


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Consistency of a session's views, and alternative models.

    Attributes
    ----------
    shape, lens : Model used.
    predicted_px : As in `AlternativeModel`.
    u_fit : (32,), standard uncertainties by the residuals alone.
    halves : Rigs of every second view and of the others; None for few views.
    alternatives : Models that were tried and not used.
    drift : (2, 2), relative change of the focal lengths, left and right, from the first view to the last, and its
        standard uncertainty; None if none was found.
    """

    shape: str
    lens: str
    predicted_px: float
    u_fit: FloatArray
    halves: tuple[StereoRig, StereoRig] | None
    alternatives: tuple[AlternativeModel, ...]
    drift: FloatArray | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Arrays, shapes="shape_index P 2; shape_m P 3"):
    """A calibrated stereo pair with its views and quality measures.

    Attributes
    ----------
    rms_px, rms_sides_px : rms length of all residuals, OpenCV's definition of the reprojection error; of (left, right).
    added_px : (left, right), noise per coordinate in addition to that of the points.
    sigma_factor : √(reduced χ²) of `dof` degrees of freedom, a factor of the covariance.
    shape_index, shape_m : (P, 2) lattice indices and (P, 3) estimated positions of the target's points.
    shape_u_m : (P, 3), their standard uncertainties; None without offsets of the points.
    scale_u : Relative standard uncertainty of the target's spacing, included in the rig's covariance.
    image_coverage : (left, right), share of each image's area in cells with points.
    cross_validation : Consistency of the views.
    """

    rig: StereoRig
    target: Target
    views: tuple[CalibratedView, ...]
    parameters: tuple[CalibrationParameter, ...]
    rms_px: float
    rms_sides_px: tuple[float, float]
    added_px: tuple[float, float]
    sigma_factor: float
    dof: float
    shape_index: IntArray
    shape_m: FloatArray
    scale_u: float
    image_coverage: tuple[float, float]
    rejections: tuple[Rejection, ...]
    notices: tuple[Notice, ...]
    cross_validation: CrossValidation | None = None
    shape_u_m: FloatArray | None = None

    @property
    def single(self) -> bool:
        """Whether it is of the left camera alone."""
        return all(view.right is None for view in self.views)

    def pose_count(self, complete: bool = False) -> int:
        """Return the number of different poses; `complete`: of those that both cameras see."""
        views = [view for view in self.views if not complete or (view.left is not None and view.right is not None)]
        alone = sum(view.pose is None for view in views)
        return alone + len({view.pose for view in views if view.pose is not None})


COVERAGE_CELLS = (8, 6)  # columns and rows of the cells for the coverage
_MIN_TILT_RAD = np.radians(2.0)  # rms tilt below which focal lengths are undetermined


def coverage_share(images: Sequence[CalibratedImage], size_px: IntArray) -> float:
    """Return the share of the image's 8 × 6 cells that contain a point."""
    return float(_covered_cells(images, size_px).mean())


def _covered_cells(images: Sequence[CalibratedImage], size_px: IntArray) -> BoolArray:
    """Return which of the image's cells (8, 6), columns first, contain a point."""
    points = np.concatenate([image.position_px[image.used] for image in images])
    cells = np.floor((points + 0.5) / size_px * COVERAGE_CELLS).astype(np.int64)
    inside = np.clip(cells, 0, np.array(COVERAGE_CELLS) - 1)
    covered = np.zeros(COVERAGE_CELLS, np.bool_)
    covered[tuple(inside.T)] = True
    return covered


def tilt_spread(poses: Sequence[RigidTransform]) -> tuple[FloatArray, FloatArray]:
    """Return the target's rms tilts (2,) in rad, ascending, and their axes (2, 2)."""
    normal = np.array([pose.rotation[:, 2] * np.sign(pose.rotation[2, 2]) for pose in poses])
    variance, axes = np.linalg.eigh(np.cov(normal[:, :2].T, bias=True))
    return np.sqrt(np.maximum(variance, 0.0)), axes


def check_view_angles(poses: Sequence[RigidTransform]) -> None:
    """Raise `ValueError` if all views have nearly the same angle to the target."""
    spread, _ = tilt_spread(poses)
    if spread.max() < _MIN_TILT_RAD:
        raise ValueError(
            f"all {len(poses)} views have nearly the same angle to the target ({np.degrees(spread.max()):.1f}° rms), "
            "which does not determine the cameras; add views tilted by 20° or more about both axes of the image"
        )


# Determined parameters, coverage, and notices of a session.

_UNDETERMINED = 0.5  # share of the prior's standard deviation above which a parameter is undetermined
_SIGNIFICANT_DISTORTION_U = 2.0  # standard uncertainties beyond which a distortion differs from zero
_MANY_VIEWS = 8  # views from which leave-one-out tests are useful
_LOW_TILT_RAD = np.radians(5.0)  # rms tilt about one axis for a warning
_MIN_IMAGE_COVERAGE = 0.6  # share of covered cells below which a warning is given
_FOCAL_U = 0.005  # relative standard uncertainty of a focal length for a warning
_MAX_FOCAL_U = 0.05  # relative standard uncertainty above which the calibration is refused
_EXCESS_NOISE_PX = 0.15  # noise in addition to that of the images, per coordinate, for a warning
_UNITS = {"f": "px", "c": "px", "s": "px", "k": "1", "p": "1"}
_ASPECT_TOLERANCE = 1e-3  # relative tolerance of square pixels


def rig_parameters(rig: StereoRig, prior_sigma: FloatArray) -> tuple[CalibrationParameter, ...]:
    """Return the parameters of a rig with covariance and their states.

    These are the 24 of every rig and the lenses' further terms, unless they are known to be zero. Parameters that this
    session fixes are omitted.
    """
    covariance = np.zeros((len(RIG_PARAMETERS),) * 2) if rig.covariance is None else rig.covariance
    parameters = []
    for number, (name, value) in enumerate(zip(RIG_PARAMETERS, rig.values, strict=True)):
        u, kind = float(np.sqrt(covariance[number, number])), name.split(".")[1][0]
        if (name.endswith((".k4", ".k5", ".k6", ".skew")) and u == 0 == value) or prior_sigma[RIGHT[0]] == 0 == u:
            continue
        lens = not name.startswith(("rotation", "translation"))
        unit = _UNITS[kind] if lens else ("rad" if name.startswith("rotation") else "m")
        state: ParameterState = "determined"
        if u > 0 and u > _UNDETERMINED * prior_sigma[number]:
            state = "undetermined"
        elif lens and kind in "kp" and abs(value) < _SIGNIFICANT_DISTORTION_U * u:
            state = "indistinct"
        parameters.append(CalibrationParameter(name, float(value), u, unit, state))
    return tuple(parameters)


def check_focal_lengths(parameters: Sequence[CalibrationParameter]) -> None:
    """Raise `ValueError` if the views do not determine a focal length."""
    for item in parameters:
        if item.name.endswith((".fx", ".fy")) and not item.u < _MAX_FOCAL_U * item.value:
            raise ValueError(
                f"the views do not determine {item.name}: {item.value:.0f} px, standard uncertainty {item.u:.0f} px; "
                "add views tilted by 20° or more about both axes of the image, and at other distances"
            )


def session_notices(calibration: Calibration) -> tuple[Notice, ...]:
    """Return the notices of a calibration."""
    notices = [*_view_notices(calibration), *_parameter_notices(calibration), *_target_notices(calibration)]
    worst = max(calibration.added_px)
    if worst >= _EXCESS_NOISE_PX:
        notices.append(Notice(EXCESS_NOISE, "residuals", added_px=worst))
    if calibration.scale_u == 0 and not calibration.single:
        notices.append(Notice(SPACING_UNCERTAINTY_UNSTATED, "scale"))
    return tuple(notices)


def _view_notices(calibration: Calibration) -> Iterator[Notice]:
    """Yield notices of number, tilt and coverage of the views."""
    copies = [item.name for item in calibration.rejections if item.copy]
    if copies:
        yield Notice(COPIED_IMAGES, "images", count=len(copies), first=copies[0])
    views, poses = len(calibration.views), calibration.pose_count()
    if poses < views:
        yield Notice(REPEATED_POSES, "views", views=views, poses=poses)
    complete = poses if calibration.single else calibration.pose_count(complete=True)
    if complete < _MANY_VIEWS:
        kind = ("views" if calibration.single else "pairs") + (" of different poses" if poses < views else "")
        yield Notice(FEW_VIEWS, "views", count=complete, kind=kind, least=_MANY_VIEWS)
    spread, axes = tilt_spread([view.left_from_target for view in calibration.views])
    if spread[0] < _LOW_TILT_RAD:
        axis = "vertical" if abs(axes[0, 0]) > abs(axes[1, 0]) else "horizontal"
        yield Notice(LITTLE_TILT, "views", spread_deg=float(np.degrees(spread[0])), axis=axis)
    sides = ("left", calibration.rig.left), ("right", calibration.rig.right)
    for share, (side, camera) in zip(calibration.image_coverage, sides, strict=True):
        images = [image for view in calibration.views if (image := getattr(view, side)) is not None]
        if images:
            corners = int(_covered_cells(images, camera.size_px)[::7, ::5].sum())
            if share < _MIN_IMAGE_COVERAGE or not corners:
                yield Notice(LOW_COVERAGE, side, share_percent=100 * share, side=side, corners=corners)


def _parameter_notices(calibration: Calibration) -> Iterator[Notice]:
    """Yield notices of parameters, pixel aspect, drift and alternative models."""
    for item in calibration.parameters:
        if item.name.endswith((".fx", ".fy")) and item.u > _FOCAL_U * item.value:
            yield Notice(UNCERTAIN_FOCAL_LENGTH, item.name, parameter=item.name, u_percent=100 * item.u / item.value)
    yield from (*_aspect_notices(calibration.rig), *_drift_notices(calibration), *_model_notices(calibration))
    for state, declared in (("undetermined", PARAMETERS_UNDETERMINED), ("indistinct", PARAMETERS_INDISTINCT)):
        names = [item.name for item in calibration.parameters if item.state == state]
        if names:
            yield Notice(declared, "distortion", parameters=", ".join(names))


def _target_notices(calibration: Calibration) -> Iterator[Notice]:
    """Yield a notice of the target's deviation from its lattice."""
    off = calibration.shape_m - calibration.target.points_m(calibration.shape_index)
    if off.any():
        rms = 1e6 * np.sqrt((off**2).mean(axis=0))
        digits = max(0, 1 - int(np.floor(np.log10(rms.max()))))  # two digits of the largest
        yield Notice(TARGET_DEVIATION, "target", x_um=rms[0], y_um=rms[1], z_um=rms[2], digits=digits)


def _aspect_notices(rig: StereoRig) -> Iterator[Notice]:
    """Yield a notice of focal lengths whose ratio contradicts square pixels."""
    for side, camera, indices in (("left", rig.left, LEFT), ("right", rig.right, RIGHT)):
        if rig.covariance is None or not rig.covariance[indices[0], indices[0]] > 0:
            continue
        fx, fy = camera.parameters[:2]
        slope = np.array([1 / fy, -fx / fy**2])
        ratio, u = fx / fy, float(np.sqrt(slope @ rig.covariance[np.ix_(indices[:2], indices[:2])] @ slope))
        if abs(ratio - 1) > 2 * np.hypot(u, _ASPECT_TOLERANCE):
            yield Notice(ASPECT_RATIO, side, side=side, ratio=ratio, expanded=2 * u)


def _drift_notices(calibration: Calibration) -> Iterator[Notice]:
    """Yield a notice of focal lengths that changed during the session."""
    if calibration.cross_validation is None or calibration.cross_validation.drift is None:
        return
    drifts = calibration.cross_validation.drift[: 1 if calibration.single else 2]
    for side, (value, u) in zip(("left", "right"), drifts, strict=False):
        yield Notice(FOCAL_DRIFT, side, side=side, change_percent=100 * value, expanded_percent=200 * u)


def _model_notices(calibration: Calibration) -> Iterator[Notice]:
    """Yield a notice of each alternative model that differs beyond the expanded uncertainty."""
    used, sigma = calibration.cross_validation, calibration.rig.covariance
    if used is None or sigma is None:
        return
    values, uncertainties = _main_values(calibration.rig), _main_uncertainties(calibration.rig)
    for other in used.alternatives:
        alternative = _main_values(other.rig)
        differences = [
            f"{name} {alternative[name]:.6g} instead of {value:.6g} (U = {2 * u:.2g})"
            for (name, value), u in zip(values.items(), uncertainties, strict=True)
            if abs(alternative[name] - value) > 2 * u > 0
        ]
        if differences:
            yield Notice(
                MODEL_DIFFERENCE,
                "model",
                shape=other.shape,
                lens=other.lens,
                differences=", ".join(differences),
                used_px=used.predicted_px,
                used_shape=used.shape,
                used_lens=used.lens,
                other_px=other.predicted_px,
            )


def _main_values(rig: StereoRig) -> dict[str, float]:
    """Return both fx in px and the baseline in mm."""
    focal = {f"{side}.fx / px": camera.matrix[0, 0] for side, camera in (("left", rig.left), ("right", rig.right))}
    return {**focal, "baseline / mm": 1e3 * float(np.linalg.norm(rig.right_from_left.translation_m))}


def _main_uncertainties(rig: StereoRig) -> FloatArray:
    """Return the standard uncertainties (3,) of these."""
    assert rig.covariance is not None
    slope = np.zeros((3, len(rig.covariance)))
    slope[0, LEFT[0]] = slope[1, RIGHT[0]] = 1.0
    translation = rig.right_from_left.translation_m
    slope[2, TRANSLATION] = 1e3 * translation / (np.linalg.norm(translation) or 1.0)
    return np.asarray(np.sqrt(np.einsum("ij,jk,ik->i", slope, rig.covariance, slope)))


# Scale of a calibration from an independently known length.

_LIKELY_RATIO = 2.0  # of a known length to the calibration's; prints deviate by some percent, a wrong unit by more
_MAX_DEVIATION = 2.0  # standard uncertainties beyond which spacing and known length contradict each other


@dataclass(frozen=True)
class KnownLength:
    """A distance `length_m` with standard uncertainty `u_m` from an independent measurement.

    It is between two points of the target, `first` and `second` as "column,row" of its lattice, or between two
    positions of its centre, as names of images (the last part of the path is sufficient).
    """

    first: str
    second: str
    length_m: float
    u_m: float

    def __post_init__(self) -> None:
        if not (0 < self.length_m < np.inf and 0 <= self.u_m < self.length_m):
            expected = "a length above 0 m and a smaller uncertainty"
            raise ValueError(f"known length: expected {expected}, found {self.length_m} and {self.u_m}")

    @staticmethod
    def from_words(first: str, second: str, length: str, u: str) -> KnownLength:
        """Return the known length of four words; `ValueError` if the last two are not numbers."""
        try:
            numbers = float(length), float(u)
        except ValueError:
            raise ValueError(f"expected a length and its standard uncertainty in m, found {length!r} {u!r}") from None
        return KnownLength(first, second, *numbers)


def scale_to_length(calibration: Calibration, known_length: KnownLength) -> Calibration:
    """Return the calibration scaled by a known length, weighted by the uncertainties.

    With the ratio r of the known length to that of the calibration and u(r) of both, all lengths grow by the weighted
    mean of r and 1. The other weight is that of the spacing's relative u; without one it is zero. The u of the mean is
    the new relative uncertainty. A contradiction of more than two standard uncertainties multiplies u by its size
    (Birge 1932, Physical Review 40, 207) and makes the notice a warning.
    """
    length, u = _length(calibration, known_length)
    ratio = known_length.length_m / length
    if not 1 / _LIKELY_RATIO <= ratio <= _LIKELY_RATIO:
        expected = f"about {length:.4g} m, the length by the spacing of {calibration.target.spacing_m:g} m"
        raise ValueError(f"known length: expected {expected}, found {known_length.length_m:g} m: is one of them in mm?")
    u_ratio = ratio * float(np.hypot(known_length.u_m / known_length.length_m, u / length))
    spacing = calibration.scale_u
    deviation = abs(ratio - 1) / float(np.hypot(u_ratio, spacing)) if spacing or u_ratio else float("inf")
    weight = spacing**2 / (spacing**2 + u_ratio**2) if spacing > 0 else 1.0
    scale, scale_u = 1 + weight * (ratio - 1), u_ratio * float(np.sqrt(weight))
    values: dict[str, Value] = {
        "stated_mm": 1e3 * known_length.length_m,
        "first": known_length.first,
        "second": known_length.second,
        "measured_mm": 1e3 * length,
        "difference_percent": 100 * (ratio - 1),
        "change_percent": 100 * (scale - 1),
    }
    if spacing > 0 and deviation > _MAX_DEVIATION:
        scale_u *= deviation
        declared, values["deviation"] = KNOWN_LENGTH_CONTRADICTED, deviation
    else:
        declared, values["expanded_percent"] = KNOWN_LENGTH_USED, 200 * u_ratio
    notice = Notice(declared, "scale", **values, scale_expanded_percent=200 * scale_u)
    others = [item for item in calibration.notices if item.where != "scale"]
    return replace(_scaled(calibration, scale, scale_u), notices=(*others, notice))


def _length(calibration: Calibration, known_length: KnownLength) -> tuple[float, float]:
    """Return the length in the calibration and its u, both without the spacing's."""
    rows = {f"{column},{row}": number for number, (column, row) in enumerate(calibration.shape_index.tolist())}
    if known_length.first in rows and known_length.second in rows:
        ends = [rows[known_length.first], rows[known_length.second]]
        separation = calibration.shape_m[ends[1]] - calibration.shape_m[ends[0]]
        variance = np.zeros(3) if calibration.shape_u_m is None else (calibration.shape_u_m[ends] ** 2).sum(axis=0)
        covariance: FloatArray = np.diag(variance)
    else:
        first, second = (_view(calibration, name) for name in (known_length.first, known_length.second))
        middle = calibration.shape_m.mean(axis=0)
        separation = second.left_from_target.apply(middle) - first.left_from_target.apply(middle)
        covariance = np.zeros((3, 3))
        for view in (first, second):
            slope = np.column_stack([np.eye(3), -skew(view.left_from_target.rotation @ middle)])
            covariance = covariance + slope @ view.covariance @ slope.T
    length = float(np.linalg.norm(separation))
    if length == 0:
        raise ValueError(f"known length: expected two different positions, found {known_length.first} twice")
    direction = separation / length
    return length, float(np.sqrt(direction @ covariance @ direction))


def _view(calibration: Calibration, name: str) -> CalibratedView:
    """Return the view with an image of this name."""
    found = [
        view
        for view in calibration.views
        if any(
            side is not None and (side.name == name or side.name.endswith(f"/{name}"))
            for side in (view.left, view.right)
        )
    ]
    if len(found) != 1:
        raise ValueError(
            f"known length: expected column,row of a point of the target, or an image of the calibration, found {name}"
        )
    return found[0]


def _scaled(calibration: Calibration, scale: float, scale_u: float) -> Calibration:
    """Return a calibration with all lengths multiplied by `scale`."""
    rig = calibration.rig
    factor = np.ones(len(rig.values))
    factor[TRANSLATION] = scale
    baseline = np.zeros(len(factor))
    baseline[TRANSLATION] = rig.right_from_left.translation_m
    assert rig.covariance is not None
    covariance = rig.covariance + (scale_u**2 - calibration.scale_u**2) * np.outer(baseline, baseline)
    covariance = covariance * np.outer(factor, factor)

    def longer(pose: RigidTransform) -> RigidTransform:
        return RigidTransform(pose.rotation, scale * pose.translation_m)

    size = np.array([scale, scale, scale, 1.0, 1.0, 1.0])
    views = tuple(
        replace(view, left_from_target=longer(view.left_from_target), covariance=view.covariance * np.outer(size, size))
        for view in calibration.views
    )
    rig = replace(rig, right_from_left=longer(rig.right_from_left), covariance=covariance)
    values, u = dict(zip(rig.parameters, rig.values, strict=True)), np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    spread = dict(zip(rig.parameters, u.tolist(), strict=True))
    return replace(
        calibration,
        rig=rig,
        views=views,
        parameters=tuple(
            replace(item, value=float(values[item.name]), u=spread[item.name]) for item in calibration.parameters
        ),
        shape_m=calibration.shape_m * scale,
        scale_u=scale_u,
    )
