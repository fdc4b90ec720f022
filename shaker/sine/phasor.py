"""Complex amplitudes of several channels at several lines, with their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, check_shape


@dataclass(frozen=True)
class Phasors(Arrays, shapes="frequency_hz K; channels C; value K C; unit C; dof K"):
    """Peak phasors X of x(t) = Re{X exp(+jωt)} with covariance.

    X = a - jb for a·cos ωt + b·sin ωt.

    Attributes
    ----------
    frequency_hz : (K,), frequencies of the lines in Hz.
    value : (K, C), complex amplitudes.
    covariance : (K, 2C, 2C), of [all Re, all Im].
    channels, unit : C names and units.
    dof : (K,), degrees of freedom of the covariance.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import Phasors
    >>> position = Phasors(np.array([80.0]), np.array([[1e-6 + 0j]]), np.zeros((1, 2, 2)), ("z",), ("m",), np.ones(1))
    >>> position.differentiated(2, ["m/s^2"])
    Phasors(1 line from 80 to 80 Hz: z [m/s^2])
    """

    frequency_hz: FloatArray
    value: ComplexArray
    covariance: FloatArray
    channels: tuple[str, ...]
    unit: tuple[str, ...]
    dof: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        lines, channels = self.value.shape
        check_shape("covariance", self.covariance, (lines, 2 * channels, 2 * channels))

    def __repr__(self) -> str:
        lines, names = self.frequency_hz, [f"{c} [{u}]" for c, u in zip(self.channels, self.unit, strict=True)]
        span = f" from {lines.min():.6g} to {lines.max():.6g} Hz" if len(lines) else ""
        return f"Phasors({len(lines)} line{'s' * (len(lines) != 1)}{span}: {', '.join(names)})"

    @property
    def u_re(self) -> FloatArray:
        """Standard uncertainty of the real parts, (K, C)."""
        return np.sqrt(self.covariance.diagonal(axis1=1, axis2=2)[:, : len(self.channels)])

    @property
    def u_im(self) -> FloatArray:
        """Standard uncertainty of the imaginary parts, (K, C)."""
        return np.sqrt(self.covariance.diagonal(axis1=1, axis2=2)[:, len(self.channels) :])

    def select(self, channels: Sequence[str]) -> Phasors:
        """Return the named channels in the given order."""
        unknown = [name for name in channels if name not in self.channels]
        if unknown:
            raise ValueError(f"channels: expected some of {', '.join(self.channels)}, found {', '.join(unknown)}")
        index = np.array([self.channels.index(name) for name in channels], dtype=np.int64)
        both = np.concatenate([index, index + len(self.channels)])
        return replace(
            self,
            value=self.value[:, index],
            covariance=self.covariance[:, both[:, None], both],
            channels=tuple(channels),
            unit=tuple(self.unit[i] for i in index),
        )

    def at_lines(self, lines: NDArray[Any]) -> Phasors:
        """Return the lines chosen by a mask (K,) or by indices."""
        return replace(
            self,
            frequency_hz=self.frequency_hz[lines],
            value=self.value[lines],
            covariance=self.covariance[lines],
            dof=self.dof[lines],
        )

    def scaled(self, factor: ComplexArray | FloatArray | complex, unit: Sequence[str] | None = None) -> Phasors:
        """Return the phasors times `factor`, broadcast to (K, C), with propagated covariance."""
        complex_factor = np.broadcast_to(np.asarray(factor, dtype=np.complex128), self.value.shape)
        jacobian = real_stacked_diagonal(complex_factor)
        return replace(
            self,
            value=self.value * complex_factor,
            covariance=jacobian @ self.covariance @ jacobian.swapaxes(1, 2),
            unit=self.unit if unit is None else tuple(unit),
        )

    def combined(self, matrix: ComplexArray, channels: Sequence[str], unit: Sequence[str]) -> Phasors:
        """Return D `channels` by complex matrices (K, D, C), with propagated covariance."""
        jacobian = real_stacked(matrix)
        return replace(
            self,
            value=(matrix @ self.value[..., None])[..., 0],
            covariance=jacobian @ self.covariance @ jacobian.swapaxes(1, 2),
            channels=tuple(channels),
            unit=tuple(unit),
        )

    def differentiated(self, order: int, unit: Sequence[str]) -> Phasors:
        """Return the phasors of the `order`-th time derivative (negative: integral), in given units."""
        return self.scaled(derivative_factor(self.frequency_hz, order)[:, None], unit)


def derivative_factor(frequency_hz: FloatArray, order: int) -> ComplexArray:
    """Return (jω)^order for frequencies in Hz: 2 from displacement to acceleration, -1 integrates."""
    # These powers of j are exact; complex powers would leave 1e-16 in the part that is zero.
    turn = np.array([1.0, 1.0j, -1.0, -1.0j])[order % 4]
    return np.asarray(turn * (2.0 * np.pi * np.asarray(frequency_hz, dtype=np.float64)) ** float(order))


def real_stacked(matrix: ComplexArray) -> FloatArray:
    """Return the real form (…, 2D, 2C) of complex matrices, for [all Re, all Im]."""
    return np.asarray(np.block([[matrix.real, -matrix.imag], [matrix.imag, matrix.real]]))


def real_stacked_diagonal(factor: ComplexArray) -> FloatArray:
    """Return the matrices (K, 2C, 2C) that multiply [all Re, all Im] by `factor`."""
    lines, channels = factor.shape
    matrix = np.zeros((lines, channels, channels), dtype=np.complex128)
    matrix[:, np.arange(channels), np.arange(channels)] = factor
    return real_stacked(matrix)


def stack_phasors(parts: Sequence[Phasors]) -> Phasors:
    """Join phasors of independent channels at the same lines, with a block-diagonal covariance."""
    first = parts[0]
    for part in parts[1:]:
        if not np.array_equal(part.frequency_hz, first.frequency_hz):
            raise ValueError("parts: expected the same lines in all, found different frequencies")
    total = sum(len(part.channels) for part in parts)
    covariance = np.zeros((len(first.frequency_hz), 2 * total, 2 * total))
    start = 0
    for part in parts:
        index = np.arange(start, start + len(part.channels))
        both = np.concatenate([index, index + total])
        covariance[:, both[:, None], both] = part.covariance
        start += len(part.channels)
    return Phasors(
        frequency_hz=first.frequency_hz,
        value=np.concatenate([part.value for part in parts], axis=1),
        covariance=covariance,
        channels=tuple(name for part in parts for name in part.channels),
        unit=tuple(unit for part in parts for unit in part.unit),
        dof=np.min([part.dof for part in parts], axis=0),
    )
