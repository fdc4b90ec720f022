"""Outputs of a sensor per direction of gravity, and their model by a weight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, check_shape

FORCES = 3
CROSS = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(2, 0, 1)
"""Tensor (3, 3, 3) of the vector product: (a × b)_i = Σ CROSS_ijk·a_j·b_k."""
UNKNOWNS_PER_RECORD = 7
"""Unknowns of a recording: weight N, first moment N·m (3), zero angle rad, tilt of the axis rad (2)."""
MIN_FORCE_SHARE = 0.3
"""Smallest share of the weight in a force component, at some angle, for a separate weight."""
DETERMINED = 1e-6  # tolerance of the unit matrix
TILT_RAD = 0.1  # standard deviation of the prior of a tilt without a statement
LOOP_SHOWN = 2.5
"""Square of a loop over its variance from which it is in U: two outputs without any exceed it once in 17."""
LOOP_CERTAIN = 8.0
"""That from which it is reported."""
USUAL_LEVER_M = 0.1
"""Lever at which forces and moments have equal weight in the classification of outputs."""


@dataclass(frozen=True, repr=False)
class SensorOutputs(Arrays, shapes="sensitivity C 6; u C 6"):
    """Response of C outputs to the load.

    `sensitivity` (C, 6): output per Fx … Mz; `u` (C, 6) of every element, independent. `sense`: +1 for outputs that are
    positive for the load on the sensor, -1 for the force of the sensor on its load.
    """

    sensitivity: FloatArray
    u: FloatArray
    sense: Literal[1, -1] = 1

    @cached_property
    def inverse(self) -> FloatArray:
        """Calibration matrix (6, C), load per output: pseudo-inverse with columns scaled to one size."""
        size = np.linalg.norm(self.sensitivity, axis=0)
        scale = np.where(size > 0.0, size, 1.0)
        return np.asarray(np.linalg.pinv(self.sensitivity / scale, rcond=1e-9) / scale[:, None])

    @cached_property
    def determined(self) -> BoolArray:
        """Mask (6,) of the load components that the outputs separate from all others."""
        identity = self.inverse @ self.sensitivity
        return np.asarray(np.all(np.abs(identity - np.eye(6)) < DETERMINED, axis=1))

    @cached_property
    def forces(self) -> BoolArray:
        """Mask (C,) of outputs that respond to forces rather than moments."""
        size = np.abs(self.sensitivity)
        return np.asarray(size[:, :FORCES].sum(axis=1) > USUAL_LEVER_M * size[:, FORCES:].sum(axis=1))


class OutputEffect(NamedTuple):
    """Errors of one name: `effect` (T, r) of r unit deviations on T terms."""

    name: str
    effect: FloatArray


@dataclass(frozen=True, repr=False)
class RotationRecord(Arrays, shapes="response K C; direction K 3; axis 3; down 3; constant O; mean 3; loop 2 C"):
    """One recording as outputs per direction of gravity.

    Output = constant + Σ f_k·`response`_k (K, C), where gravity in sensor axes is `mean` + Σ f_k·`direction`_k (K, 3).
    Of an indexing head the functions f are cos θ and -sin θ, and `response` the real and imaginary part of the first
    harmonic; `head` tells so. `covariance`, `dof`: of noise, in the order of `response`, then of `constant` (C,) where
    there is one. `stated`: further errors of these terms. `axis`, `down` (3,): unit vectors about which the sensor's
    axes may deviate from the stated ones. `u_frame` (3,): standard uncertainty of this rotation about the axis and of
    its two tilts, rad, infinite where unknown; `frame_stated`: they are a statement. `u_length`: relative
    standard uncertainty of `direction`, common to all recordings. `loop` (2, C): square of
    the difference between the senses of a rotation, and its variance of noise.
    """

    name: str
    response: FloatArray
    covariance: FloatArray
    dof: float
    direction: FloatArray
    axis: FloatArray
    down: FloatArray
    constant: FloatArray
    mean: FloatArray
    loop: FloatArray
    u_frame: tuple[float, float, float]
    u_length: float = 0.0
    frame_stated: bool = False
    head: bool = True
    stated: tuple[OutputEffect, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_shape("covariance", self.covariance, (self.response.size + len(self.constant),) * 2)
        if np.linalg.norm(np.cross(self.axis, self.down)) < 0.5:
            raise ValueError("axis: expected one across gravity, found one within 30 degrees of it")

    @cached_property
    def frame(self) -> tuple[FloatArray, FloatArray]:
        """Direction of `down` across the axis, and axis × direction."""
        along = self.down - self.axis * float(self.axis @ self.down)
        along = along / np.linalg.norm(along)
        return along, np.cross(self.axis, along)

    def loop_share(self, outputs: BoolArray, shown: float = LOOP_SHOWN) -> float:
        """Return the loop over the output, of some outputs together, 0 within noise."""
        square, variance, size = self.loop[0, outputs], self.loop[1, outputs], np.sum(self.response**2, axis=0)[outputs]
        weight = np.divide(size, variance, out=np.zeros(len(size)), where=variance > 0.0)
        ratio = np.divide(square, variance, out=np.zeros(len(size)), where=variance > 0.0)
        if not weight.any() or weight @ ratio < shown * weight.sum():
            return 0.0
        share = np.divide(square - variance, size, out=np.zeros(len(size)), where=weight > 0.0)
        return float(np.sqrt(max(weight**2 @ share / np.sum(weight**2), 0.0)))

    @cached_property
    def variance(self) -> FloatArray:
        """Variance of every element of `response`, in its order, of all causes."""
        size = self.response.size
        stated = sum((np.sum(each.effect[:size] ** 2, axis=1) for each in self.stated), np.zeros(size))
        return np.asarray(np.diag(self.covariance)[:size] + stated)


def head_record(
    name: str, amplitude: ComplexArray, covariance: FloatArray, dof: float, axis: FloatArray, down: FloatArray
) -> RotationRecord:
    """Return the record of an indexing head from first harmonics.

    `amplitude` (C,): output = Re{amplitude exp(+jθ)}, θ is the rotation of the sensor, right-handed about `axis` (3,).
    `covariance` (2C, 2C) of [all Re, all Im]. `down` (3,): direction of gravity at θ = 0. Unit vectors in sensor axes.
    """
    across = down - axis * float(axis @ down)
    direction = np.stack([across, np.cross(axis, across)])
    response, free = np.stack([amplitude.real, amplitude.imag]), (np.inf, TILT_RAD, TILT_RAD)
    none = np.zeros(0)
    return RotationRecord(
        name, response, covariance, dof, direction, axis, down, none, down - across, np.zeros((2, len(amplitude))), free
    )


def weight_load(
    record: RotationRecord, unknowns: FloatArray, sense: int, direction: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return loads (K, 6) of a recording's unknowns (7,), and their derivatives (K, 6, 7).

    `direction` (K, 3): of gravity in the stated axes, by default that of the record.
    """
    along, across = record.frame
    seen = sense * true_direction(record, unknowns[4:], record.direction if direction is None else direction)
    columns = np.zeros((len(seen), 6, UNKNOWNS_PER_RECORD))
    columns[:, :3, 0] = seen
    columns[:, 3:, 1:4] = np.tensordot(seen, CROSS, (1, 2))
    load = columns[:, :, :4] @ unknowns[:4]
    rotated = np.tensordot(seen, CROSS, (1, 2)) @ np.stack([-record.axis, across, -along], axis=1)
    columns[:, :3, 4:] = unknowns[0] * rotated
    columns[:, 3:, 4:] = np.tensordot(unknowns[1:4], CROSS, (0, 1)) @ rotated
    return np.asarray(load), columns


def start_values(record: RotationRecord, outputs: SensorOutputs) -> FloatArray:
    """Return start values (7,) of a recording; the opposite sense of rotation is refused."""
    expected = outputs.sense * record.direction.T
    seen = outputs.determined[:FORCES] & (np.linalg.norm(expected, axis=1) > MIN_FORCE_SHARE)
    if not seen.any():
        raise ValueError("sensitivity: expected an output for a force across the axis, found none")
    force, expected = (outputs.inverse @ record.response.T)[:FORCES][seen], expected[seen]
    size = np.sum(expected**2)
    if not record.head:
        weight = float(np.sum(force * expected) / size)
        if weight <= 0.0:
            raise ValueError("orientation: expected forces along gravity, found opposite or no forces")
        return np.array([weight, *np.zeros(UNKNOWNS_PER_RECORD - 1)])
    turning, phasor = force @ (1.0, 1.0j), expected @ (1.0, 1.0j)
    with_axis, against = np.sum(turning * np.conj(phasor)) / size, np.sum(turning * phasor) / size
    if abs(against) > 1.5 * abs(with_axis):
        raise ValueError(
            "axis: expected a rotation for which gravity rotates backwards in the sensor, found the opposite sense; "
            "reverse the axis"
        )
    if abs(with_axis) == 0.0:
        raise ValueError("amplitude: expected forces that change with the angle, found none")
    return np.array([abs(with_axis), 0.0, 0.0, 0.0, float(np.angle(with_axis)), 0.0, 0.0])


def true_direction(record: RotationRecord, rotation: FloatArray, direction: FloatArray) -> FloatArray:
    """Return directions (K, 3) of gravity in the true axes of the sensor.

    `rotation` (3,): from the stated axes, about the axis and two tilts.
    """
    from scipy.spatial.transform import Rotation

    along, across = record.frame
    turn = Rotation.from_rotvec(rotation[1] * across - rotation[2] * along) * Rotation.from_rotvec(
        -rotation[0] * record.axis
    )
    return np.asarray(direction @ turn.as_matrix().T)


def rotation_vector(record: RotationRecord, unknowns: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) from the stated to the true axes, small tilts."""
    along, across = record.frame
    return np.asarray(unknowns[5] * across - unknowns[6] * along - unknowns[4] * record.axis)


def hysteresis_share(records: Sequence[RotationRecord], record: RotationRecord, outputs: BoolArray) -> float:
    """Return the loop over the output, of a recording or one with larger output.

    The mean of both senses may be off by up to the loop: what its middle deviates from the line of the calibration
    depends on the range of that.
    """
    size = [float(np.linalg.norm(each.response[:, outputs])) for each in (record, *records)]
    return max(each.loop_share(outputs) for each, other in zip(records, size[1:], strict=True) if other >= size[0])
