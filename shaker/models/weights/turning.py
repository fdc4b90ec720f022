"""A sensor that is turned about a horizontal axis: how its outputs answer, what they read, what a weight does."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray, check_shape

ArrayOf = TypeVar("ArrayOf", FloatArray, ComplexArray)
FORCES = 3
OWN = 7
"""Unknowns of a recording: weight N, first moment N·m (3), zero angle rad, tilt of the axis rad (2)."""
LEAST_SHARE = 0.3
"""Share of the weight that a force component must feel at some angle for a weight of its own."""
DETERMINED = 1e-6


@dataclass(frozen=True)
class SensorOutputs:
    """How C outputs answer the load: `sensitivity` (C, 6) output per Fx … Mz, `u` (C, 6) of every element, independent.

    `sense`: +1 where outputs are positive for the load on the sensor, -1 for that of the sensor on what it carries.
    """

    sensitivity: FloatArray
    u: FloatArray
    sense: Literal[1, -1] = 1

    def __post_init__(self) -> None:
        check_shape("sensitivity", self.sensitivity, (None, 6))
        check_shape("u", self.u, self.sensitivity.shape)

    @cached_property
    def inverse(self) -> FloatArray:
        """Return the calibration matrix (6, C), load per output: the pseudo-inverse, columns scaled to one size."""
        size = np.linalg.norm(self.sensitivity, axis=0)
        scale = np.where(size > 0.0, size, 1.0)
        return np.asarray(np.linalg.pinv(self.sensitivity / scale, rcond=1e-9) / scale[:, None])

    @cached_property
    def determined(self) -> BoolArray:
        """Return (6,): which load components the outputs tell from all others."""
        identity = self.inverse @ self.sensitivity
        return np.asarray(np.all(np.abs(identity - np.eye(6)) < DETERMINED, axis=1))


@dataclass(frozen=True)
class Turned:
    """One recording: first harmonics of the C outputs and how the head stood.

    `amplitude` (C,): output = Re{amplitude exp(+jθ)}, θ counted as the sensor turns, right-handed about `axis` (3,);
    `covariance` (2C, 2C) of [all Re, all Im], of noise with `dof` degrees of freedom; `down` (3,): direction of gravity
    at θ = 0, both unit vectors in sensor axes.
    """

    name: str
    amplitude: ComplexArray
    covariance: FloatArray
    dof: float
    axis: FloatArray
    down: FloatArray

    def __post_init__(self) -> None:
        check_shape("covariance", self.covariance, (2 * len(self.amplitude), 2 * len(self.amplitude)))
        check_shape("axis", self.axis, (3,))
        check_shape("down", self.down, (3,))
        if np.linalg.norm(np.cross(self.axis, self.down)) < 0.5:
            raise ValueError("axis: expected one across gravity, found one within 30 degrees of it")

    @cached_property
    def frame(self) -> tuple[float, FloatArray, FloatArray]:
        """Return the share of gravity that turns, its direction at θ = 0, and that across it: axis × direction."""
        across = self.down - self.axis * float(self.axis @ self.down)
        share = float(np.linalg.norm(across))
        return share, across / share, _skew(self.axis) @ across / share


def weight_load(record: Turned, own: FloatArray, sense: int) -> tuple[ComplexArray, ComplexArray]:
    """Return the load (6,) phasor of a recording's unknowns `own` (7,), and its derivatives (6, 7)."""
    share, _, _ = record.frame
    turn = sense * np.exp(1j * own[4])
    phasor = turn * turning_phasor(record, own[5:])
    tilts = turn * share * np.outer(record.axis, [-1.0, -1j])
    columns = np.zeros((6, OWN), np.complex128)
    columns[:3, 0] = phasor
    columns[3:, 1:4] = -_skew(phasor)
    load = columns[:, :4] @ own[:4]
    columns[:, 4] = 1j * load
    columns[:3, 5:] = own[0] * tilts
    columns[3:, 5:] = _skew(own[1:4]) @ tilts
    return np.asarray(load), columns


def start_values(record: Turned, outputs: SensorOutputs) -> FloatArray:
    """Return the unknowns (7,) of a recording from the forces alone; refuses readings that turn the other way round."""
    phasor = outputs.sense * turning_phasor(record, np.zeros(2))
    seen = outputs.determined[:FORCES] & (np.abs(phasor) > LEAST_SHARE)
    if not seen.any():
        raise ValueError("sensitivity: expected an output for a force across the axis, found none")
    force, size = (outputs.inverse @ record.amplitude)[:FORCES][seen], np.sum(np.abs(phasor[seen]) ** 2)
    with_axis = np.sum(force * np.conj(phasor[seen])) / size
    against = np.sum(force * phasor[seen]) / size
    if abs(against) > 1.5 * abs(with_axis):
        raise ValueError(
            "axis: expected the sense of turning for which gravity turns backwards in the sensor, found readings that "
            "turn the other way round; reverse the axis"
        )
    if abs(with_axis) == 0.0:
        raise ValueError("amplitude: expected forces that change with the angle, found none")
    return np.array([abs(with_axis), 0.0, 0.0, 0.0, float(np.angle(with_axis)), 0.0, 0.0])


def _skew(vector: ArrayOf) -> ArrayOf:
    """Return the matrix (3, 3) whose product with w is vector × w."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=vector.dtype)


def turning_phasor(record: Turned, tilt: FloatArray) -> ComplexArray:
    """Return U (3,), gravity's direction in sensor axes as a phasor, the axis tilted along and across it at zero."""
    share, along, across = record.frame
    turn = tilt[0] * across - tilt[1] * along
    angle = float(np.linalg.norm(turn))
    phasor = along + 1j * across
    if angle > 0.0:
        k = turn / angle
        turned = np.cos(angle) * phasor + np.sin(angle) * (_skew(k) @ phasor)
        phasor = turned + (1.0 - np.cos(angle)) * (k @ phasor) * k
    return np.asarray(share * phasor)
