"""The circle that a resonance draws in the complex plane, and the frequency and damping that its angles tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.resonance.noisy_curve import NoisyCurve

_CIRCLE_STEPS = 20
_ANGLE_STEPS = 30
_PASSES = 3
_FEWEST_LINES = 5


@dataclass(frozen=True)
class CircleFit:
    """Natural frequency f₀ of the undamped oscillator and damping ratio ζ with `covariance` (2, 2) of both.

    `centre`, `radius`: the circle in the plane of H·(jf/f₀)/(1 + 2jζf/f₀).
    """

    frequency_hz: float
    damping_ratio: float
    covariance: FloatArray
    centre: complex
    radius: float


def fit_circle(curve: NoisyCurve, frequency_hz: float, damping_ratio: float) -> CircleFit | None:
    """Return f₀ and ζ of a base-excited oscillator from the angles of its circle, None where no circle is found.

    G·(1 + 2jζr)/(1 - r² + 2jζr) times jr/(1 + 2jζr), r = f/f₀, is G/(2ζ + j(r - 1/r)): a circle, whose angle about its
    centre is θ = α + 2 atan((1/r - r)/(2ζ)), so that f·tan((θ - α)/2) is a straight line over f². The circle: algebraic
    (Taubin, IEEE Trans. PAMI 13, 1991), then of least weighted distances; the angles: f₀, ζ and α by weighted least
    squares (Kennedy and Pancoast, J. Aeronaut. Sci. 14, 1947; Ewins, Modal Testing, 2000, 4.3). A constant that other
    modes add moves the circle and not the angles. `frequency_hz`, `damping_ratio`: start, also of which lines are used:
    those above half the maximum, at least five.
    """
    fit = None
    for _ in range(_PASSES):
        fit = _fit_once(curve, frequency_hz, damping_ratio)
        if fit is None:
            return None
        frequency_hz, damping_ratio = fit.frequency_hz, fit.damping_ratio
    return fit


def _fit_once(curve: NoisyCurve, f0: float, zeta: float) -> CircleFit | None:
    """Return the circle of the lines above half amplitude of a resonance known from before."""
    part = _around(curve, f0, np.sqrt(3.0) * zeta * f0)
    r = part.frequency_hz / f0
    factor = 1j * r / (1.0 + 2j * zeta * r)
    points = part.value * factor
    circle = _geometric(points, part, factor)
    angles = _angles(points, part, factor, circle[0], (f0, zeta)) if circle is not None else None
    if circle is None or angles is None:
        return None
    gradient = _gradient(points, circle, angles[1]) * factor.conj()
    centre = complex(circle[0][0], circle[0][1])
    return CircleFit(*angles[0], part.propagated(gradient), centre, float(circle[0][2]))


def _around(curve: NoisyCurve, frequency_hz: float, reach_hz: float) -> NoisyCurve:
    """Return the lines nearer to a frequency than `reach_hz`, the nearest five at least."""
    distance = np.abs(curve.frequency_hz - frequency_hz)
    reach = max(reach_hz, float(np.sort(distance)[min(_FEWEST_LINES, len(distance)) - 1]))
    keep = distance <= reach
    return NoisyCurve(curve.frequency_hz[keep], curve.value[keep], curve.covariance[keep], curve.line_correlation)


def _taubin(points: ComplexArray) -> FloatArray:
    """Return centre and radius (3,) of the algebraic circle through points, Taubin's normalisation."""
    middle = points.mean()
    around = points - middle
    square = np.abs(around) ** 2
    scale = 2.0 * np.sqrt(square.mean())
    columns = np.stack([(square - square.mean()) / scale, around.real, around.imag], axis=1)
    a, b, c = np.linalg.svd(columns, full_matrices=False)[2][2]
    a = a / scale
    shift = -complex(b, c) / (2.0 * a)
    centre = middle + shift
    return np.array([centre.real, centre.imag, np.sqrt(abs(shift) ** 2 + square.mean())])


def _geometric(points: ComplexArray, curve: NoisyCurve, factor: ComplexArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the circle (3,) of least weighted distances, and its change (3, K) with the distance of each point."""
    with np.errstate(all="ignore"):
        circle = _taubin(points)
    for _ in range(_CIRCLE_STEPS):
        if not np.all(np.isfinite(circle)):
            return None
        out = points - complex(circle[0], circle[1])
        normal = out / np.maximum(np.abs(out), np.finfo(np.float64).tiny)
        root = 1.0 / np.sqrt(curve.variance_along(normal * factor.conj()))
        columns = np.stack([normal.real, normal.imag, np.ones(len(points))], axis=1)
        change = np.linalg.pinv(columns * root[:, None]) * root
        step = change @ (np.abs(out) - circle[2])
        circle = circle + step
        if np.abs(step).max() < 1e-12 * circle[2]:
            break
    return circle, change


def _angles(
    points: ComplexArray, curve: NoisyCurve, factor: ComplexArray, circle: FloatArray, start: tuple[float, float]
) -> tuple[tuple[float, float], FloatArray] | None:
    """Return f₀ and ζ of the angles about the centre, and their change (2, K) with the angle of each point."""
    frequency = curve.frequency_hz
    out = points - complex(circle[0], circle[1])
    tangent = 1j * out / np.abs(out) ** 2
    root = 1.0 / np.sqrt(curve.variance_along(tangent * factor.conj()))
    f0, zeta = start
    alpha = float(np.angle(np.sum(out * np.exp(-1j * _angle_model(frequency, f0, zeta)[0]))))
    for _ in range(_ANGLE_STEPS):
        model, columns = _angle_model(frequency, f0, zeta)
        change = np.linalg.pinv(columns * root[:, None]) * root
        step = change @ np.angle(out * np.exp(-1j * (model + alpha)))
        step *= min(1.0, 0.5 / max(abs(step[0]), abs(step[1])))
        f0, zeta, alpha = f0 * np.exp(step[0] * zeta), zeta * np.exp(step[1]), alpha + step[2]
        if not (np.isfinite(f0) and 1e-9 < zeta < 1.0):
            return None
        if np.abs(step).max() < 1e-12:
            break
    if np.abs(step).max() > 1e-6:
        return None
    return (float(f0), float(zeta)), change[:2] * np.array([[zeta * f0], [zeta]])


def _angle_model(frequency_hz: FloatArray, f0: float, zeta: float) -> tuple[FloatArray, FloatArray]:
    """Return 2 atan((1/r - r)/(2ζ)) (K,) and its derivatives (K, 3) by ln(f₀)/ζ, ln ζ and the angle α."""
    r = frequency_hz / f0
    tangent = (1.0 / r - r) / (2.0 * zeta)
    by_tangent = 2.0 / (1.0 + tangent**2)
    columns = [by_tangent * (1.0 / r + r) / 2.0, -by_tangent * tangent, np.ones(len(r))]
    return np.asarray(2.0 * np.arctan(tangent)), np.stack(columns, axis=1)


def _gradient(points: ComplexArray, circle: tuple[FloatArray, FloatArray], by_angle: FloatArray) -> ComplexArray:
    """Return the change (2, K) of f₀ and ζ with every point, by its own angle and by the centre that all points set."""
    out = points - complex(circle[0][0], circle[0][1])
    tangent, normal = 1j * out / np.abs(out) ** 2, out / np.abs(out)
    by_centre = np.stack([by_angle @ tangent.real, by_angle @ tangent.imag], axis=1)
    return np.asarray(by_angle * tangent - (by_centre @ circle[1][:2]) * normal)
