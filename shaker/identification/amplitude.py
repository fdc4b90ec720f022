"""Stiffness and damping of a resonance that change with its amplitude, from one periodic record."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker.identification.measured_curves import MeasuredCurve, whitening_matrices
from shaker.identification.oscillator import Resonance
from shaker.mechanics import laplace
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray

_OVERSAMPLING = 8  # samples per period of the highest line, for powers of the motion
_SIGNIFICANT = 20.0  # decrease of χ², over its excess, by two parameters; by chance in 5 of 100 000 fits
_EXPLAINED, _MOST_LEFT = 1.5, 0.2  # χ² per degree of freedom, or share of it, that both forces must not exceed
_OFF_GRID = 0.05  # distance from a harmonic of the line spacing, in spacings, that rounding explains
_STEP = 1e-6  # relative step of differences


@dataclass(frozen=True, repr=False)
class AmplitudeEffect(Arrays):
    """Deviation from a linear spring and damper over the amplitudes of a record.

    `stiffening`: force of a cubic spring, `friction`: of dry friction, both at the largest deflection and relative to
    the linear spring. `frequency_change`, `damping_change`: of a linear fit, relative to vanishing amplitude.
    `excess`: χ² per degree of freedom that both forces leave. `contribution` (K,): theirs to the ratios at all lines.
    """

    stiffening: float
    friction: float
    frequency_change: float
    damping_change: float
    excess: float
    contribution: ComplexArray


@dataclass(frozen=True, repr=False)
class ExcitedLines(Arrays):
    """All excited lines of a periodic record.

    `frequency_hz`, `ratio` and acceleration of the `base`, each (K,).
    """

    frequency_hz: FloatArray
    ratio: ComplexArray
    base: ComplexArray


def amplitude_effect(curve: MeasuredCurve, fit: Resonance, excited: ExcitedLines) -> AmplitudeEffect | None:
    """Return how a base-excited resonance deviates from a linear one, None where noise explains it.

    `curve`: lines of the fit. Deflection y(t) and velocity follow from all excited lines; the forces y³ and sign(ẏ) act
    as further inputs of the linear oscillator (Adams and Allemang, Mech. Syst. Signal Process. 14, 2000), so that their
    sizes are linear parameters. A delay and the contribution of other modes are left free.
    """
    forces = _restoring_forces(excited)
    if forces is None:
        return None
    s, w0 = laplace(excited.frequency_hz), 2.0 * np.pi * fit.frequency_hz
    by_force = -forces * w0 * w0 * s * s / (s * s + 2.0 * fit.damping_ratio * w0 * s + w0 * w0)
    chosen = np.searchsorted(excited.frequency_hz, curve.frequency_hz)
    columns = list(by_force[:, chosen])
    names = ("frequency_hz", "damping_ratio", "gain", "gain", *("terms",) * 4)
    columns += [_slope(fit, curve.frequency_hz, name, number) for number, name in enumerate(names)]
    columns.append(-laplace(curve.frequency_hz) * curve.value)  # a delay of a chain
    left = curve.value - fit.model(curve.frequency_hz)
    white = whitening_matrices(curve.covariance)
    rows = (white @ np.stack([np.real(both := np.column_stack([left, *columns])), np.imag(both)], axis=1)).reshape(
        -1, 1 + len(columns)
    )
    residual, design = rows[:, 0], rows[:, 1:]
    before = _chi_squared(design[:, 2:], residual)
    solution = np.linalg.lstsq(design / np.linalg.norm(design, axis=0), residual, rcond=None)[0]
    solution = solution / np.linalg.norm(design, axis=0)
    after = float(np.sum((residual - design @ solution) ** 2))
    excess = after / (len(residual) - design.shape[1])
    if (before - after) / max(1.0, excess) < _SIGNIFICANT:
        return None
    if excess > max(_EXPLAINED, _MOST_LEFT * before / (len(residual) - design.shape[1])):
        return None  # another cause, such as a second mode
    frequency, damping = fit.frequency_hz + solution[2], fit.damping_ratio + solution[3]
    changes = fit.frequency_hz / frequency - 1.0, fit.damping_ratio / damping - 1.0
    found = float(solution[0]), float(solution[1]), float(changes[0]), float(changes[1])
    return AmplitudeEffect(*found, excess, np.asarray(solution[:2] @ by_force))


def _chi_squared(design: FloatArray, residual: FloatArray) -> float:
    """Return χ² of a linear fit."""
    basis = np.linalg.qr(design)[0]
    return float(np.sum((residual - basis @ (basis.T @ residual)) ** 2))


def _restoring_forces(excited: ExcitedLines) -> ComplexArray | None:
    """Return spectra (2, K) of y³ and sign(ẏ) over the base acceleration.

    The largest deflection y is 1.
    """
    frequency_hz = excited.frequency_hz
    spacing = float(np.min(np.diff(frequency_hz)))
    harmonic = np.rint(frequency_hz / spacing).astype(np.int64)
    if np.abs(harmonic * spacing - frequency_hz).max() > _OFF_GRID * spacing:
        return None
    s = laplace(frequency_hz)
    deflection = (excited.ratio - 1.0) * excited.base / s**2
    count = _OVERSAMPLING * int(harmonic.max())
    spectrum = np.zeros((2, count // 2 + 1), dtype=np.complex128)
    spectrum[:, harmonic] = deflection, deflection * s
    motion, velocity = 0.5 * count * np.fft.irfft(spectrum, count)
    largest = float(np.abs(motion).max())
    forces = np.fft.rfft([largest * (motion / largest) ** 3, largest * np.sign(velocity)])
    return np.asarray(2.0 / count * forces[:, harmonic] / excited.base)


def _slope(fit: Resonance, frequency_hz: FloatArray, name: str, number: int) -> ComplexArray:
    """Return the derivative (L,) of the model by one parameter.

    Gain and residual terms count by real and imaginary part.
    """
    if name in ("frequency_hz", "damping_ratio"):
        step = _STEP * getattr(fit, name)
        moved = [replace(fit, **{name: getattr(fit, name) + sign * step}).model(frequency_hz) for sign in (1.0, -1.0)]
        return np.asarray((moved[0] - moved[1]) / (2.0 * step))
    part = 1j if number % 2 else 1.0
    empty = replace(fit, gain=0j, residual_terms=np.zeros(2, dtype=np.complex128))
    if name == "gain":
        return replace(empty, gain=1.0 + 0j).model(frequency_hz) * part
    terms = np.zeros(2, dtype=np.complex128)
    terms[(number - 4) // 2] = part
    return replace(empty, residual_terms=terms).model(frequency_hz)
