"""Circle of a resonance in the complex plane, with frequency and damping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker.identification.measured_curves import MeasuredCurve
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray

_PASSES = 3  # alternating fits of circle and angles, chosen
FEWEST_LINES = 5
"""Lines for three parameters of a circle with some redundancy."""


@dataclass(frozen=True, repr=False)
class CircleFit(Arrays):
    """Frequency f₀ and damping ratio ζ with their `covariance` (2, 2).

    `centre`, `radius`: the circle in the plane of H·(jf/f₀)/(1 + 2jζf/f₀).
    """

    frequency_hz: float
    damping_ratio: float
    covariance: FloatArray
    centre: complex
    radius: float


def fit_circle(curve: MeasuredCurve, frequency_hz: float, damping_ratio: float) -> CircleFit | None:
    """Return f₀ and ζ from the circle of a base-excited oscillator, None without a circle.

    G·(1 + 2jζr)/(1 - r² + 2jζr) with r = f/f₀, multiplied by jr/(1 + 2jζr), is G/(2ζ + j(r - 1/r)). This is a circle.
    The angle about its centre is θ = α + 2 atan((1/r - r)/(2ζ)), and f·tan((θ - α)/2) is a straight line over f². The
    circle is fitted algebraically (Taubin, IEEE Trans. PAMI 13, 1991), then by least weighted distances. f₀, ζ and α
    follow from the angles by weighted least squares (Kennedy and Pancoast, J. Aeronaut. Sci. 14, 1947; Ewins, Modal
    Testing, 2000, 4.3). The constant contribution of other modes moves the circle but not the angles. `frequency_hz`
    and `damping_ratio` are the start. They also select the lines: those above half the maximum, at least five.
    """
    f0, zeta = frequency_hz, damping_ratio
    for _ in range(_PASSES):
        distance = np.abs(curve.frequency_hz - f0)
        nearest = float(np.sort(distance)[min(FEWEST_LINES, len(distance)) - 1])
        part = curve.at_lines(distance <= max(np.sqrt(3.0) * zeta * f0, nearest))
        r = part.frequency_hz / f0
        factor = 1j * r / (1.0 + 2j * zeta * r)
        points = part.value * factor
        circle = _geometric(points, part, factor)
        angles = _angles(points, part, factor, circle[0], (f0, zeta)) if circle is not None else None
        if circle is None or angles is None:
            return None
        (x, y, radius), by_point = circle
        (f0, zeta), by_angle = angles
    # f₀ and ζ depend on the angle of every point, and on the centre, which depends on all points.
    out = points - complex(x, y)
    tangent, normal = 1j * out / np.abs(out) ** 2, out / np.abs(out)
    by_centre = np.stack([by_angle @ tangent.real, by_angle @ tangent.imag], axis=1)
    gradient = (by_angle * tangent - (by_centre @ by_point[:2]) * normal) * factor.conj()
    return CircleFit(f0, zeta, part.propagated(gradient), complex(x, y), float(radius))


def _geometric(
    points: ComplexArray, curve: MeasuredCurve, factor: ComplexArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return the circle (3,) of least weighted distances and its derivatives (3, K).

    The fit starts at the algebraic circle with Taubin's normalisation. Derivatives are by the distance of each point.
    """
    middle = points.mean()
    around = points - middle
    square = np.abs(around) ** 2
    scale = 2.0 * np.sqrt(square.mean())
    columns = np.stack([(square - square.mean()) / scale, around.real, around.imag], axis=1)
    a, b, c = np.linalg.svd(columns, full_matrices=False)[2][2]
    with np.errstate(all="ignore"):
        shift = -complex(b, c) / (2.0 * a / scale)
        centre = middle + shift
    circle = np.array([centre.real, centre.imag, np.sqrt(abs(shift) ** 2 + square.mean())])
    for _ in range(20):
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
    points: ComplexArray, curve: MeasuredCurve, factor: ComplexArray, circle: FloatArray, start: tuple[float, float]
) -> tuple[tuple[float, float], FloatArray] | None:
    """Return f₀ and ζ from the angles about the centre, with derivatives.

    The derivatives (2, K) are by the angles.
    """
    frequency = curve.frequency_hz
    out = points - complex(circle[0], circle[1])
    tangent = 1j * out / np.abs(out) ** 2
    root = 1.0 / np.sqrt(curve.variance_along(tangent * factor.conj()))
    f0, zeta = start
    alpha = float(np.angle(np.sum(out * np.exp(-1j * _angle_model(frequency, f0, zeta)[0]))))
    for _ in range(30):
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
    """Return the angle 2 atan((1/r - r)/(2ζ)) (K,) and its derivatives.

    The derivatives (K, 3) are by ln(f₀)/ζ, ln ζ and α.
    """
    r = frequency_hz / f0
    tangent = (1.0 / r - r) / (2.0 * zeta)
    by_tangent = 2.0 / (1.0 + tangent**2)
    columns = [by_tangent * (1.0 / r + r) / 2.0, -by_tangent * tangent, np.ones(len(r))]
    return np.asarray(2.0 * np.arctan(tangent)), np.stack(columns, axis=1)
