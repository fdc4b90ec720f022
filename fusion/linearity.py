"""Linearity: whether the ratio of outputs over load changes with the amplitude of the load."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.coverage import region
from fusion.drive import Drive
from fusion.repeats import alike, common_outputs, drive_ratio, plain_mean, relative_uncertainty, stack_values
from fusion.sensitivity import driven_component
from fusion.system import real_design
from shaker._checks import BoolArray, ComplexArray, FloatArray

SERIES = 1.2
"""Least ratio of the largest to the smallest amplitude of a series."""


@dataclass(frozen=True)
class Linearity:
    """How the ratio changes with amplitude in N recordings of one frequency and direction.

    `amplitude` (N,) of the driven load; `slope` (C,): relative change of the ratio per N or N·m, complex; `change`
    (C,): from the smallest to the largest amplitude, with `covariance` (C, 2, 2) of (Re, Im) and `dof`; `linear` (C,):
    whether its 95 % region holds zero.
    """

    frequency_hz: float
    direction: tuple[float, ...]
    component: int
    channels: tuple[str, ...]
    recordings: tuple[str, ...]
    amplitude: FloatArray
    slope: ComplexArray
    change: ComplexArray
    covariance: FloatArray
    dof: float
    linear: BoolArray


def find_linearity(drives: Iterable[Drive], capacity: Sequence[float] | None = None) -> tuple[Linearity, ...]:
    """Return how the ratio changes with amplitude wherever one excitation was recorded at amplitudes 1.2 apart."""
    found = []
    for group in alike(drives, capacity, amplitudes_apart=False):
        component = driven_component(group[0].direction, capacity)
        amplitude = [abs(drive.load[component]) for drive in group]
        if max(amplitude) >= SERIES * min(amplitude):
            found.append(linearity(group, component))
    return tuple(found)


def linearity(drives: Sequence[Drive], component: int) -> Linearity:
    """Return the slope of the ratio over amplitude by generalised least squares.

    S_n/S̄ = a + b·(A_n - Ā), slope b/a; scales common to all recordings cancel, since their covariance is kept. Scatter
    beyond what is stated enlarges the covariance by chi-square per degree of freedom (Birge 1932, Phys. Rev. 40, 207).
    Only outputs with a reading other than zero in all recordings have a slope.
    """
    channels = [
        name
        for name in common_outputs(drives)
        if all(drive.outputs[drive.channels.index(name)] != 0.0 for drive in drives)
    ]
    found = [drive_ratio(drive, component, channels) for drive in drives]
    plain = plain_mean([value for value, _ in found])
    readings, stated = stack_values(
        [(value / plain, relative_uncertainty(uncertainty, plain)) for value, uncertainty in found]
    )
    amplitude = np.array([abs(drive.load[component]) for drive in drives])
    width = float(np.ptp(amplitude))
    dof = 2 * (len(drives) - 2)
    fits = [_slope(readings, stated, (amplitude - amplitude.mean()) / width, c) for c in range(len(channels))]
    change = np.array([fit[0] for fit in fits])
    covariance = np.array([fit[1] * (max(1.0, fit[2] / dof) if dof else 1.0) for fit in fits])
    freedom = float(dof) if dof and any(fit[2] > dof for fit in fits) else np.inf
    linear = np.array([region(complex(v), c, freedom).holds_zero for v, c in zip(change, covariance, strict=True)])
    return Linearity(
        frequency_hz=float(np.mean([drive.frequency_hz for drive in drives])),
        direction=drives[0].direction,
        component=component,
        channels=tuple(channels),
        recordings=tuple(drive.recording for drive in drives),
        amplitude=amplitude,
        slope=np.asarray(change / width, dtype=np.complex128),
        change=change,
        covariance=covariance,
        dof=freedom,
        linear=linear,
    )


def _slope(
    readings: FloatArray, stated: FloatArray, places: FloatArray, channel: int
) -> tuple[complex, FloatArray, float]:
    """Relative slope of one channel over places (N,), its covariance (2, 2), and chi-square."""
    both = np.array([channel, channel + readings.shape[1] // 2])
    count = len(readings)
    values = readings[:, both].ravel()
    spread = stated[:, both][:, :, :, both].reshape(2 * count, 2 * count)
    spread = spread + np.eye(2 * count) * 1e-12 * np.trace(spread) / (2 * count)
    design = np.concatenate([np.kron(np.ones((count, 1)), np.eye(2)), np.kron(places[:, None], np.eye(2))], axis=1)
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, np.column_stack([design, values]))
    unknowns = np.linalg.lstsq(white[:, :4], white[:, 4], rcond=None)[0]
    covariance = np.linalg.inv(white[:, :4].T @ white[:, :4])
    residual = white[:, 4] - white[:, :4] @ unknowns
    middle, step = complex(unknowns[0], unknowns[1]), complex(unknowns[2], unknowns[3])
    slope = step / middle
    jacobian = np.concatenate([real_design(np.array([[-slope / middle]])), real_design(np.array([[1.0 / middle]]))], 1)
    return slope, jacobian @ covariance @ jacobian.T, float(residual @ residual)
