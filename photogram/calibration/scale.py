"""Scale of a calibration from an independently known length."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from photogram.calibration.calibration_notices import KNOWN_LENGTH_CONTRADICTED, KNOWN_LENGTH_USED
from photogram.calibration.calibration_result import CalibratedView, Calibration
from photogram.camera import TRANSLATION
from photogram.geometry import RigidTransform, skew
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice, Value

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
