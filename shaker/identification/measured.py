"""Measured curves with their errors by name: what the models of a sensor are fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, check_shape
from shaker.phasor import Phasors

AT_THE_BASE = -1
"""Place of the reference among the transducers of a recording, whose responses count from 0."""


@dataclass(frozen=True)
class Sight:
    """Where and along which unit direction a transducer measures: `point_m` (3,), `direction` (3,), sensor axes.

    `turning`: it measures how the body turns about the direction, which is the same everywhere.
    """

    point_m: FloatArray
    direction: FloatArray
    turning: bool = False

    def __post_init__(self) -> None:
        check_shape("point_m", self.point_m, (3,))
        check_shape("direction", self.direction, (3,))
        if abs(float(np.linalg.norm(self.direction)) - 1.0) > 1e-6:
            raise ValueError(f"direction: expected a unit vector, found {self.direction.tolist()}")

    @property
    def row(self) -> FloatArray:
        """Row (6,) that turns the motion of the sensor origin into the reading: [d, r × d], of a turn [0, d]."""
        if self.turning:
            return np.concatenate([np.zeros(3), self.direction])
        (x, y, z), (dx, dy, dz) = self.point_m, self.direction
        return np.array([dx, dy, dz, y * dz - z * dy, z * dx - x * dz, x * dy - y * dx])


@dataclass(frozen=True)
class RelativeError:
    """One named cause of error: `relative` (K, C), relative complex deviation of a curve for one standard deviation.

    Causes of one name in several curves are the same unknown.
    """

    name: str
    relative: ComplexArray


@dataclass(frozen=True)
class InertiaError:
    """One uncertain number of the load: `change` (6, 6) of its mass matrix for one standard deviation.

    Equal names in several recordings are the same unknown (a part that stands on both).
    """

    name: str
    change: FloatArray

    def __post_init__(self) -> None:
        check_shape("change", self.change, (6, 6))


@dataclass(frozen=True)
class SightError:
    """One uncertain number of where or along what a transducer measures: `change` (6,) of its row for one standard
    deviation.

    `place`: which response it is, or `AT_THE_BASE` for the reference. Equal names, in one recording or several, are the
    same unknown.
    """

    name: str
    place: int
    change: FloatArray

    def __post_init__(self) -> None:
        check_shape("change", self.change, (6,))


@dataclass(frozen=True)
class MeasuredTransfer:
    """Motion of the load over motion of the base in one recording, with what is known of the load.

    `ratio`: C ratios (K, C) at K lines, `covariance` (K, 2C, 2C) of [all Re, all Im] the noise alone; `tops`: where the
    C responses measure on the load, `base`: where the reference measures; `drive` (6,): direction in which the base
    moves as a rigid body, [x y z rx ry rz] about the sensor origin. `mass_matrix` (6, 6): load and parts about the
    sensor origin, without what moves inside the sensor. `line_correlation` (D,) as in `TransferFunction`.
    `clock`, `u_clock`: name and relative standard uncertainty of the clock, and so of all frequencies. `sight_errors`:
    what is uncertain of places and directions of the transducers.
    """

    name: str
    ratio: Phasors
    tops: tuple[Sight, ...]
    base: Sight
    drive: FloatArray
    mass_matrix: FloatArray
    errors: tuple[RelativeError, ...] = ()
    inertia_errors: tuple[InertiaError, ...] = ()
    line_correlation: ComplexArray | None = None
    added_decay_per_s: float = 0.0
    clock: str = "clock"
    u_clock: float = 0.0
    sight_errors: tuple[SightError, ...] = ()

    def __post_init__(self) -> None:
        shape = self.ratio.value.shape
        if len(self.tops) != shape[1]:
            raise ValueError(f"tops: expected one for each of {shape[1]} ratios, found {len(self.tops)}")
        check_shape("drive", self.drive, (6,))
        check_shape("mass_matrix", self.mass_matrix, (6, 6))
        for error in self.errors:
            check_shape(f"errors: {error.name}", error.relative, shape)
        for sight in self.sight_errors:
            if not AT_THE_BASE <= sight.place < shape[1]:
                raise ValueError(
                    f"sight_errors: expected a place of {AT_THE_BASE} to {shape[1] - 1}, found {sight.place}"
                )

    @property
    def s(self) -> ComplexArray:
        """Return s = a + jω (K,) in 1/s."""
        return np.asarray(self.added_decay_per_s + 2j * np.pi * self.ratio.frequency_hz)


@dataclass(frozen=True)
class MeasuredSensitivity:
    """Complex sensitivity of one output for one load component over frequency.

    `frequency_hz` (K,) ascending; `value` (K,) in `unit`, e.g. "(V/V)/N"; `covariance` (K, 2, 2) of [Re, Im], the part
    that is independent from line to line; `errors`: relative deviations (K, 1) by cause; `static`, `u_static`: static
    sensitivity in the same unit, None where it is not known.
    """

    channel: str
    component: str
    frequency_hz: FloatArray
    value: ComplexArray
    covariance: FloatArray
    unit: str
    errors: tuple[RelativeError, ...] = ()
    static: float | None = None
    u_static: float = 0.0

    def __post_init__(self) -> None:
        lines = len(self.frequency_hz)
        check_shape("frequency_hz", self.frequency_hz, (None,))
        check_shape("value", self.value, (lines,))
        check_shape("covariance", self.covariance, (lines, 2, 2))
        for error in self.errors:
            check_shape(f"errors: {error.name}", error.relative, (lines, 1))


@dataclass(frozen=True)
class ParameterEstimate:
    """One fitted or derived number: `name` for files, `label` for readers, `value` and standard `u` in `unit`."""

    name: str
    label: str
    value: float
    u: float
    unit: str
