"""Faults of a calibration that explain how a translated plate departs from a rigid translation.

Each fault changes some parameters of the rig. The parameters that make the points move most rigidly, and put them on
their epipolar lines, are estimated for one fault at a time. The fault with the best fit is the most likely cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.cameras.accept.apparent_field import local_noise, plate_axes, rate_design
from photogram.camera import (
    LEFT,
    RIG_PARAMETERS,
    RIGHT,
    ROTATION,
    TRANSLATION,
    StereoRig,
    epipolar_residual,
    principal_components,
    triangulate,
)
from shakercal._common.arrays import Arrays, FloatArray, IntArray
from shakercal._common.digits import quantity_text

FX, FY, CX, CY, K1 = range(5)
"""Places of a camera's parameters among `photogram.camera.CAMERA_PARAMETERS`."""
ROUNDS = 4
"""Gauss-Newton steps: faults of some pixels are not linear in the positions."""
CLEAR = 30.0
"""Decrease of χ² beyond the parameters' share from which a fault is significant."""
EXPLAINS = 0.9
"""Share of the deviations, by χ², that a single fault has to explain to be the likely cause."""
CHI2_SIGMAS = 5.0
"""Standard deviations of χ² by which noise exceeds its expectation at most."""
ALTERNATIVE_CHI2, SIMILAR = 10.0, 0.1
"""By how much, absolutely and relative to the best χ², that of another fault may be larger and not exclude it."""
FREE_SCALE = 1.0
"""Prior of the scale where no positions of the stage are stated."""


@dataclass(frozen=True, eq=False, repr=False)
class MovedPlate(Arrays, shapes="left_px 2 N 2; right_px 2 N 2; noise 4"):
    """A plate at both ends of a translation.

    Attributes
    ----------
    left_px, right_px : (2, N, 2), pixels at the first and last position.
    travel_m : between them.
    u_scale : relative, of the travel; None without stated positions.
    u_rotation_rad : of the stage over the travel.
    noise : (4,), of the epipolar residual (px) and of the displacement per travel along the axes of the plate.
    """

    left_px: FloatArray
    right_px: FloatArray
    travel_m: float
    u_scale: float | None
    u_rotation_rad: float
    noise: FloatArray

    def observed(self, rig: StereoRig) -> tuple[FloatArray, FloatArray]:
        """Return epipolar residuals (N,), and displacements per travel (N, 3), by a rig."""
        residual, *_ = epipolar_residual(rig, self.left_px, self.right_px)
        first, last = triangulate(rig, self.left_px, self.right_px).position_m
        return residual.mean(axis=0), (last - first) / self.travel_m


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    `columns`: changes (32, m) of `RIG_PARAMETERS` per unit of its m parameters; `shown`: their text; `remedy`.
    """

    name: str
    label: str
    columns: Callable[[StereoRig], FloatArray]
    shown: Callable[[FloatArray, FloatArray], str]
    remedy: str


@dataclass(frozen=True, eq=False, repr=False)
class FaultFit(Arrays, shapes="value M; u M"):
    """The estimate of one fault: parameters with standard uncertainty, and χ² before and after."""

    kind: FaultKind
    value: FloatArray
    u: FloatArray
    chi2: float
    chi2_without: float
    count: int

    @property
    def gain(self) -> float:
        """Decrease of χ², less the penalty of the parameters (BIC)."""
        return self.chi2_without - self.chi2 - len(self.value) * float(np.log(self.count))

    @property
    def share(self) -> float:
        """Share of the excess of χ² over its expectation that the fault explains."""
        excess = self.chi2_without - self.count
        return 0.0 if excess <= 0.0 else min(1.0, (self.chi2_without - self.chi2) / excess)

    @property
    def size_text(self) -> str:
        """The parameters with U."""
        return self.kind.shown(self.value, 2.0 * self.u)


@dataclass(frozen=True)
class Diagnosis:
    """Fits of all faults: the most likely one, similar ones, and the rest."""

    best: FaultFit
    similar: tuple[FaultFit, ...]
    others: tuple[FaultFit, ...]

    @property
    def is_significant(self) -> bool:
        """Whether the most likely fault explains more than chance."""
        return self.best.gain > CLEAR

    @property
    def explains(self) -> bool:
        """Whether it leaves noise, or only a small share of the deviations."""
        best = self.best
        noise = best.count + CHI2_SIGMAS * float(np.sqrt(2.0 * best.count))
        return best.chi2 < noise or best.share >= EXPLAINS


def _unit(*places: int) -> FloatArray:
    columns = np.zeros((len(RIG_PARAMETERS), len(places)))
    columns[list(places), range(len(places))] = 1.0
    return columns


def _turn(rig: StereoRig) -> FloatArray:
    """Return changes by a rotation of the right camera about its centre (rad)."""
    columns = _unit(*range(ROTATION.start, ROTATION.stop))
    columns[TRANSLATION] = np.cross(np.eye(3), rig.right_from_left.translation_m).T
    return columns


def _focal(rig: StereoRig) -> FloatArray:
    """Return changes of both focal lengths by 1 = 100 %, the aspect ratio unchanged."""
    columns = np.zeros((len(RIG_PARAMETERS), 2))
    for side, (places, camera) in enumerate(((LEFT, rig.left), (RIGHT, rig.right))):
        columns[places[[FX, FY]], side] = camera.parameters[[FX, FY]]
    return columns


def _scale(rig: StereoRig) -> FloatArray:
    columns = np.zeros((len(RIG_PARAMETERS), 1))
    columns[TRANSLATION, 0] = rig.right_from_left.translation_m
    return columns


def _named(names: Sequence[str], unit: str, factor: float = 1.0) -> Callable[[FloatArray, FloatArray], str]:
    """Return the text of named parameters in a unit."""

    def shown(value: FloatArray, expanded: FloatArray) -> str:
        return ", ".join(
            f"{name} {quantity_text(factor * float(one), factor * float(width), unit)}"
            for name, one, width in zip(names, value, expanded, strict=True)
        )

    return shown


def _principal_point(side: str, places: IntArray) -> FaultKind:
    return FaultKind(
        f"principal_{side}",
        f"a wrong principal point of the {side} camera",
        lambda _: _unit(*places[[CX, CY]]),
        _named(("x", "y"), "px"),
        "Calibrate again, with views that are tilted and rotated and reach all corners.",
    )


CALIBRATE = "Fix the cameras and calibrate again."
FAULTS = (  # the more frequent first
    FaultKind(
        "pose",
        "a rotation of the right camera against the left one since the calibration",
        _turn,
        _named(("about x", "about y", "about z"), "mrad", 1e3),
        CALIBRATE,
    ),
    FaultKind(
        "focal",
        "wrong focal lengths (focus, zoom or temperature changed)",
        _focal,
        _named(("left", "right"), "%", 1e2),
        "Lock focus and aperture, let the cameras warm up, and calibrate again.",
    ),
    FaultKind(
        "distortion",
        "a wrong lens distortion, or refraction by a window",
        lambda _: _unit(LEFT[K1], RIGHT[K1]),
        _named(("k1 left", "k1 right"), ""),
        "Estimate the distortion, with target views in all corners, and calibrate through the window if there is one.",
    ),
    FaultKind(
        "scale",
        "a wrong scale (spacing of the calibration target, or stated steps of the stage)",
        _scale,
        _named(("true over measured length, less 1:",), "%", 1e2),
        "Measure the spacing of the target, and check the steps of the stage and their unit.",
    ),
    _principal_point("left", LEFT),
    _principal_point("right", RIGHT),
)


def plate_noise(rig: StereoRig, left_px: FloatArray, right_px: FloatArray, travel_m: float) -> FloatArray:
    """Return the `noise` of a plate, the scatter of its points about smooth fields."""
    plate = MovedPlate(left_px, right_px, travel_m, None, 0.0, np.ones(4))
    residual, slope = plate.observed(rig)
    start = triangulate(rig, left_px, right_px).position_m[0]
    offset = start - start.mean(axis=0)
    axes = plate_axes(offset)
    values = np.column_stack([residual, slope @ axes])
    return local_noise((offset @ axes)[:, :2], values)


class _RigidityProblem:
    """Deviations of plates from rigid translation, whitened, and their derivatives."""

    def __init__(self, rig: StereoRig, plates: Sequence[MovedPlate]) -> None:
        self.rig, self.plates = rig, plates
        self.nuisance, self.target = self._nuisances()
        steps = np.zeros((0, len(RIG_PARAMETERS)))
        if rig.covariance is not None:
            steps = principal_components(rig.covariance)
        base = self.values(rig)
        stated = [(self.values(rig.perturbed(0.1 * step)) - base) / 0.1 for step in steps]
        self.calibration = np.array(stated).reshape(len(steps), len(base)).T

    def values(self, rig: StereoRig) -> FloatArray:
        """Return the whitened epipolar residuals and displacements of all plates by a rig."""
        parts = []
        for plate, axes in zip(self.plates, self.axes, strict=True):
            residual, slope = plate.observed(rig)
            parts += [residual / plate.noise[0], ((slope @ axes) / plate.noise[1:]).ravel()]
        return np.concatenate(parts)

    def _nuisances(self) -> tuple[FloatArray, FloatArray]:
        """Return whitened columns of unknown motion, and the values of a rigid translation."""
        self.axes, columns, target = list[FloatArray](), list[FloatArray](), list[FloatArray]()
        sizes = [plate.left_px.shape[1] for plate in self.plates]
        total, start = 4 * sum(sizes), 0
        for plate, size in zip(self.plates, sizes, strict=True):
            place = triangulate(self.rig, plate.left_px, plate.right_px).position_m[0]
            offset = place - place.mean(axis=0)
            axes = plate_axes(offset)
            self.axes.append(axes)
            mean = (plate.observed(self.rig)[1] @ axes).mean(axis=0)
            direction = mean / np.linalg.norm(mean)
            design = rate_design(offset @ axes)[:, :, :6]
            u_scale = FREE_SCALE if plate.u_scale is None else max(plate.u_scale, 1e-7)
            along = np.zeros((6, 6))
            along[:3, 0] = u_scale * direction
            along[:3, 1:3] = np.linalg.svd(direction[None])[2][1:].T  # the direction of the stage is not known
            along[3:, 3:] = max(plate.u_rotation_rad, 1e-9) / plate.travel_m * np.eye(3)
            white = (design @ along / plate.noise[1:, None]).reshape(3 * size, 6)
            block = np.zeros((total, 6))
            block[start + size : start + 4 * size] = white
            columns.append(block)
            target += [np.zeros(size), (np.tile(direction, (size, 1)) / plate.noise[1:]).ravel()]
            start += 4 * size
        return np.concatenate(columns, axis=1), np.concatenate(target)

    def fit(self, kind: FaultKind | None) -> tuple[FloatArray, FloatArray, float]:
        """Return parameters, u and χ² with one fault, or without any."""
        columns = np.zeros((len(RIG_PARAMETERS), 0)) if kind is None else kind.columns(self.rig)
        value = np.zeros(columns.shape[1])
        common = np.concatenate([-self.nuisance, self.calibration], axis=1)
        penalty = np.eye(common.shape[1])
        step = self._steps(columns)
        for _ in range(1 if kind is None else ROUNDS):
            base = self.values(self.rig.perturbed(columns @ value))
            by_fault = [
                (self.values(self.rig.perturbed(columns @ (value + s))) - base) / s[k]
                for k, s in enumerate(np.diag(step))
            ]
            slope = np.concatenate([common, np.array(by_fault).reshape(len(value), len(base)).T], axis=1)
            whole = np.concatenate([slope, np.concatenate([penalty, np.zeros((len(penalty), len(value)))], axis=1)])
            wanted = np.concatenate([self.target - base, np.zeros(len(penalty))])
            found, *_ = np.linalg.lstsq(whole, wanted, rcond=None)
            value = value + found[len(penalty) :]
        left_over = wanted - whole @ found
        covariance = np.linalg.pinv(whole.T @ whole)
        u = np.sqrt(np.diagonal(covariance)[len(penalty) :])
        return value, u, float(left_over @ left_over)

    def _steps(self, columns: FloatArray) -> FloatArray:
        """Return steps of the parameters that move pixels by some hundredths."""
        base = self.values(self.rig)
        small = np.full(columns.shape[1], 1e-6)
        slope = [
            np.abs(self.values(self.rig.perturbed(columns @ s)) - base).mean() / s[k]
            for k, s in enumerate(np.diag(small))
        ]
        return np.array([5.0 / max(one, 1e-12) for one in slope])


def diagnose(rig: StereoRig, plates: Sequence[MovedPlate]) -> Diagnosis:
    """Return the fits of all faults to translated plates.

    Of faults that fit equally, the first of `FAULTS` is the most likely one: it is more frequent.
    """
    problem = _RigidityProblem(rig, plates)
    count = len(problem.target)
    *_, without = problem.fit(None)
    fits = [FaultFit(kind, *problem.fit(kind), without, count) for kind in FAULTS]
    best = max(fits, key=lambda fit: fit.gain)
    limit = best.gain - max(ALTERNATIVE_CHI2, SIMILAR * best.chi2)
    first, *similar = [fit for fit in fits if fit.gain >= limit]
    others = sorted((fit for fit in fits if fit.gain < limit), key=lambda fit: -fit.gain)
    return Diagnosis(first, tuple(similar), tuple(others))
