"""Measured curves with named errors, their poles and circles, and the noise of lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.frf.result import TransferFunction
from shaker.mechanics import laplace
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, check_shape

REFERENCE_INDEX = -1
"""Index of the reference among the transducers of a recording; responses count from 0."""


@dataclass(frozen=True, repr=False)
class Placement(Arrays, shapes="point_m 3; direction 3"):
    """Position and direction of a transducer: `point_m` (3,) and unit `direction` (3,), sensor axes.

    `turning`: the transducer measures the rotation about the direction, which does not depend on the point.
    """

    point_m: FloatArray
    direction: FloatArray
    turning: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(float(np.linalg.norm(self.direction)) - 1.0) > 1e-6:
            raise ValueError(f"direction: expected a unit vector, found {self.direction.tolist()}")

    @property
    def row(self) -> FloatArray:
        """Row [d, r × d], for a rotation [0, d], from origin motion to reading."""
        if self.turning:
            return np.concatenate([np.zeros(3), self.direction])
        return np.concatenate([self.direction, np.cross(self.point_m, self.direction)])


@dataclass(frozen=True, repr=False)
class CurveError(Arrays):
    """One named cause of error of one or several curves.

    `relative` (K, C): relative complex deviation of the curve for one standard deviation.
    """

    name: str
    relative: ComplexArray


@dataclass(frozen=True, repr=False)
class InertiaError(Arrays, shapes="change 6 6"):
    """One uncertain number of a load, or of a part of several loads.

    `change` (6, 6) of its mass matrix for one standard deviation.
    """

    name: str
    change: FloatArray


@dataclass(frozen=True, repr=False)
class PlacementError(Arrays, shapes="change 6"):
    """One uncertain position or direction of a transducer.

    `change` (6,) of its row for one standard deviation. `response_index`: number of the response, or `REFERENCE_INDEX`.
    Equal names, in one recording or several, are the same unknown.
    """

    name: str
    response_index: int
    change: FloatArray


@dataclass(frozen=True, repr=False)
class Bending(Arrays):
    """Elastic behaviour of a load at K lines.

    All terms are per motion A (6,) of the body on the springs. `inertia` (1+V, K, 6, 6): inertial load in addition to
    the mass matrix, per A. `stretch` (1+V, K, C, 6): reading of C responses in addition to their rows, per A. The first
    element is the stated one; the others are the changes for one standard deviation of each unknown in `names` (V,).
    """

    names: tuple[str, ...]
    inertia: ComplexArray
    stretch: ComplexArray

    def __post_init__(self) -> None:
        terms, lines, responses = self.stretch.shape[:3]
        check_shape("inertia", self.inertia, (terms, lines, 6, 6))
        check_shape("stretch", self.stretch, (1 + len(self.names), lines, responses, 6))


@dataclass(frozen=True, repr=False)
class MeasuredTransfer(Arrays, shapes="drive 6; mass_matrix 6 6"):
    """Ratios of load motion to base motion in one recording, with the stated load.

    `ratio`: C ratios (K, C) at K lines; its `covariance` (K, 2C, 2C) of [all Re, all Im] contains the noise only.
    `tops`: placement of the C responses on the load; `base`: placement of the reference. `drive` (6,): direction of the
    rigid base motion, [x y z rx ry rz] about the sensor origin. `mass_matrix` (6, 6): load and parts about the sensor
    origin, without the internal mass of the sensor. `line_correlation` (D,) as in `TransferFunction`. `clock`,
    `u_clock`: name and relative standard uncertainty of the clock, which applies to all frequencies.
    `placement_errors`: uncertain positions and directions of the transducers. `bending`: None for a rigid load.
    `level`: amplitude of the recording among others, from -1/2 to 1/2.
    """

    name: str
    ratio: Phasors
    tops: tuple[Placement, ...]
    base: Placement
    drive: FloatArray
    mass_matrix: FloatArray
    errors: tuple[CurveError, ...] = ()
    inertia_errors: tuple[InertiaError, ...] = ()
    line_correlation: ComplexArray | None = None
    added_decay_per_s: float = 0.0
    clock: str = "clock"
    u_clock: float = 0.0
    placement_errors: tuple[PlacementError, ...] = ()
    bending: Bending | None = None
    level: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = self.ratio.value.shape
        if self.bending is not None:
            check_shape("bending: stretch", self.bending.stretch, (None, *shape, 6))
        if len(self.tops) != shape[1]:
            raise ValueError(f"tops: expected one for each of {shape[1]} ratios, found {len(self.tops)}")
        for error in self.errors:
            check_shape(f"errors: {error.name}", error.relative, shape)
        for placement in self.placement_errors:
            if not REFERENCE_INDEX <= placement.response_index < shape[1]:
                expected = f"a response index of {REFERENCE_INDEX} to {shape[1] - 1}"
                raise ValueError(f"placement_errors: expected {expected}, found {placement.response_index}")

    @property
    def s(self) -> ComplexArray:
        """Laplace variable s = a + jω (K,) in 1/s."""
        return laplace(self.ratio.frequency_hz, self.added_decay_per_s)

    @property
    def noise(self) -> FloatArray:
        """Standard uncertainty (K, C) of each ratio, rms of Re and Im."""
        return np.asarray(np.sqrt(0.5 * (self.ratio.u_re**2 + self.ratio.u_im**2)))

    def at_lines(self, lines: BoolArray) -> MeasuredTransfer:
        """Return the curves at the lines of a mask (K,)."""
        bending = self.bending
        if bending is not None:
            bending = replace(bending, inertia=bending.inertia[:, lines], stretch=bending.stretch[:, lines])
        errors = tuple(replace(error, relative=error.relative[lines]) for error in self.errors)
        return replace(self, ratio=self.ratio.at_lines(lines), errors=errors, bending=bending)

    def poles(self, count: int) -> ComplexArray:
        """Return the common poles (count,) of all ratios by `rational_poles`."""
        return rational_poles(self.s, self.ratio.value, self.noise, count)


@dataclass(frozen=True, repr=False)
class MeasuredSensitivity(Arrays, shapes="frequency_hz K; value K; covariance K 2 2"):
    """Complex sensitivity of one output for one load component over frequency.

    `frequency_hz` (K,) ascending. `value` (K,) in `unit`, e.g. "(V/V)/N". `covariance` (K, 2, 2) of [Re, Im]: the part
    that is independent between lines. `errors`: relative deviations (K, 1) by cause. `static`, `u_static`: static
    sensitivity in the same unit, None if it is not stated.
    """

    channel: str
    component: str
    frequency_hz: FloatArray
    value: ComplexArray
    covariance: FloatArray
    unit: str
    errors: tuple[CurveError, ...] = ()
    static: float | None = None
    u_static: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for error in self.errors:
            check_shape(f"errors: {error.name}", error.relative, (len(self.value), 1))


@dataclass(frozen=True)
class ParameterEstimate:
    """One fitted or derived number, `name` in files, `label` on pages.

    `value` and standard uncertainty `u` in `unit`.
    """

    name: str
    label: str
    value: float
    u: float
    unit: str


@dataclass(frozen=True)
class NamedUnknown:
    """A named error as the recordings determine it, in its standard deviations."""

    name: str
    estimate: float
    remaining: float


@dataclass(frozen=True, repr=False)
class MeasuredCurve(Arrays, shapes="frequency_hz K; value K; covariance K 2 2; dof K"):
    """One complex frequency response with the noise of each line.

    Attributes
    ----------
    frequency_hz : (K,), Hz, positive and ascending
    value : (K,) complex, not zero
    covariance : (K, 2, 2) of [Re, Im], noise of each line
    line_correlation : (D,) correlation of the errors of lines 0, 1, 2 … lines apart, as in `TransferFunction`; default
        None
    added_decay_per_s : the decay a of an exponential window in s = a + jω, 1/s, default 0
    dof : (K,) degrees of freedom of an estimated covariance, default None for a known one

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import MeasuredCurve
    >>> hertz = np.array([100.0, 200.0])
    >>> MeasuredCurve(hertz, 1.0 / (1.0 + 1j * hertz / 300.0), np.tile(1e-6 * np.eye(2), (2, 1, 1))).dof is None
    True
    """

    frequency_hz: FloatArray
    value: ComplexArray
    covariance: FloatArray
    line_correlation: ComplexArray | None = None
    added_decay_per_s: float = 0.0
    dof: FloatArray | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.frequency_hz[0] > 0.0 and np.all(np.diff(self.frequency_hz) > 0.0)):
            raise ValueError("frequency_hz: expected ascending positive frequencies, found others")
        if not (np.all(np.isfinite(self.value)) and np.all(np.abs(self.value) > 0.0)):
            raise ValueError("value: expected finite numbers other than zero, found others")
        c = self.covariance
        if not (np.all(c[:, 0, 0] > 0.0) and np.all(c[:, 0, 0] * c[:, 1, 1] > c[:, 0, 1] * c[:, 1, 0])):
            raise ValueError("covariance: expected positive definite matrices (K, 2, 2), found others")

    @staticmethod
    def of(transfer: TransferFunction, channel: str, band_hz: tuple[float, float]) -> MeasuredCurve:
        """Return one response of a transfer function between two frequencies."""
        part = transfer.between(band_hz)
        ratio = part.ratio.select([channel])
        seen = (ratio.frequency_hz, ratio.value[:, 0], ratio.covariance)
        return MeasuredCurve(*seen, part.line_correlation, part.added_decay_per_s, ratio.dof)

    def at_lines(self, lines: BoolArray) -> MeasuredCurve:
        """Return the curve at the lines of a mask (K,)."""
        return replace(
            self,
            frequency_hz=self.frequency_hz[lines],
            value=self.value[lines],
            covariance=self.covariance[lines],
            dof=None if self.dof is None else self.dof[lines],
        )

    @property
    def spacing_hz(self) -> float:
        """Smallest distance between neighbouring lines."""
        return float(np.min(np.diff(self.frequency_hz)))

    def variance_along(self, direction: ComplexArray) -> FloatArray:
        """Return the variance (K,) of Re{conj(d)·δH} for a direction d (K,) in the complex plane."""
        re, im, c = direction.real, direction.imag, self.covariance
        return np.asarray(re * re * c[:, 0, 0] + 2.0 * re * im * c[:, 0, 1] + im * im * c[:, 1, 1])

    def propagated(self, gradient: ComplexArray) -> FloatArray:
        """Return the covariance (P, P) of Σₖ Re{conj(g)·δH} with g (P, K)."""
        first = np.sqrt(self.covariance[:, 0, 0])
        second = self.covariance[:, 0, 1] / first
        rest = np.sqrt(self.covariance[:, 1, 1] - second**2)
        white = gradient.real * first + gradient.imag * (second + 1j * rest)
        spread = (white.conj() @ white.T).real
        return np.asarray(spread + line_correlation_term(self.frequency_hz, white.T, self.line_correlation))


# Poles of measured curves from a linear rational fit, as start values of an identification.

_ROUNDS = 8  # of reweighting, at most
_SETTLED = 1e-4  # change of the denominator's coefficients without effect on start values


def rational_poles(
    s: ComplexArray, value: ComplexArray, noise: FloatArray, count: int, lowest: int = 0
) -> ComplexArray:
    """Return the common poles (count,) of curves (K, C), Im λ > 0, ascending.

    `noise` (K, C). Curves are fitted by Nᶜ(s)/D(s), D of degree 2·count, N with complex coefficients for the powers
    from `lowest` to 2·count, linearised (Levy, IRE Trans. Autom. Control 4, 1959) and reweighted (Sanathanan and
    Koerner, IEEE Trans. Autom. Control 8, 1963). Unstable poles are mirrored; real ones are replaced by poles above the
    band.
    """
    middle = float(np.sqrt(np.abs(s).min() * np.abs(s).max()))
    q = (s / middle)[:, None]
    highest, power, above = q ** (2 * count), q ** np.arange(2 * count), q ** np.arange(lowest, 2 * count + 1)
    numerator = np.concatenate([above, 1j * above], axis=1)

    def denominator_of(weight: FloatArray) -> FloatArray:
        """Return the denominator of one weighted linear fit, with the numerators projected out."""
        rows = []
        for column, scale in zip(value.T[:, :, None], weight.T[:, :, None], strict=True):
            both = np.concatenate([numerator, column * power, column * highest], axis=1) * scale
            triangle = np.asarray(np.linalg.qr(np.concatenate([both.real, both.imag]), mode="r"))
            rows.append(triangle[numerator.shape[1] :, numerator.shape[1] :])
        below = np.concatenate(rows)
        return np.asarray(np.linalg.lstsq(-below[:, :-1], below[:, -1], rcond=None)[0])

    weight, denominator = 1.0 / noise, np.zeros(2 * count)
    for _ in range(_ROUNDS):
        before, denominator = denominator, denominator_of(weight)
        if np.abs(denominator - before).max() < _SETTLED:
            break
        at = np.abs(highest[:, 0] + power @ denominator)
        weight = 1.0 / (noise * np.maximum(at, 1e-9 * at.max())[:, None])
    roots = np.roots([1.0, *denominator[::-1]])
    roots = -np.abs(roots.real) + 1j * roots.imag
    oscillating = roots[roots.imag > 1e-9 * np.abs(roots)] * middle
    beyond = float(np.abs(s).max()) * 2.0 ** np.arange(1, count - len(oscillating) + 1) * (-0.02 + 1j)
    return np.concatenate([oscillating[np.argsort(np.abs(oscillating))], beyond])


# Noise of measured lines: whitening, correlation between lines, estimate from residuals.


def whitening_matrices(covariance: FloatArray, name: str = "covariance") -> FloatArray:
    """Return the matrices (K, p, p) that whiten errors of the given covariances."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{name}: expected positive definite matrices, found others") from error


def line_correlation_term(
    frequency_hz: FloatArray, columns: ComplexArray, correlation: ComplexArray | None
) -> FloatArray:
    """Return Re Tᴴ(R - 1)T (N, N) of whitened columns T (K, …, N).

    R is given by `correlation` (D,), that of the errors of lines 0, 1, 2 … lines apart, as in `TransferFunction`.
    """
    count = columns.shape[-1]
    total = np.zeros((count, count))
    if correlation is None or len(correlation) < 2:
        return total
    index = np.round((frequency_hz - frequency_hz.min()) / np.min(np.diff(np.sort(frequency_hz)))).astype(np.int64)
    length = int(index.max()) + 1
    grid = np.zeros((length + len(correlation), *columns.shape[1:]), dtype=np.complex128)
    grid[index] = columns
    first = grid[:length].reshape(-1, count)
    for lag, value in enumerate(correlation[1:], start=1):
        pair = value * (grid[lag : lag + length].reshape(-1, count).conj().T @ first)
        total += (pair + pair.conj().T).real
    return total


_FEWEST_DOF, _MOST_DOF = 3.0, 1e9  # limits of the degrees of freedom: variances exist above 2


@dataclass(frozen=True, repr=False)
class CurveResidual(Arrays, shapes="length K; dof K"):
    """Residuals of one curve with K lines and p real numbers per line.

    `length` (K,): T² = rᵀS⁻¹r over the stated covariance S. `dof` (K,): degrees of freedom ν of S, infinite for a known
    S. `size`: p.
    """

    length: FloatArray
    dof: FloatArray
    size: int


@dataclass(frozen=True, repr=False)
class ResidualNoise(Arrays):
    """Factors on the stated covariances of all lines, estimated from residuals.

    `lines` (K,) per curve are used as weights; `common` λ ≥ 1 applies to all of them. `chi_squared`: of the residuals
    over the stated covariances; `dof`: its expectation for noise alone and exact covariances. `expected`: mean of
    χ²/dof for covariances with few degrees of freedom. `chance`: relative standard deviation of χ²/dof for noise alone.
    """

    lines: tuple[FloatArray, ...]
    common: float
    chi_squared: float
    dof: float
    expected: float
    chance: float


def estimate_residual_noise(curves: Sequence[CurveResidual], unknowns: float) -> ResidualNoise:
    """Return the noise that the residuals of a fit with a number of `unknowns` show.

    T² and the covariance S of ν degrees of freedom both estimate the noise of a line. Its weight is therefore (ν +
    p)/(ν + T²), as in Student's likelihood (Lange, Little and Taylor, J. Am. Stat. Assoc. 84, 1989). With n = ν + p, νS
    + rrᵀ ~ χ²ₙ: the weights are on average too large by n/(n - 2). The estimate has n/(n - 2) times the variance of one
    with known S. Both factors are contained in `lines`. λ = χ²/dof over its expectation ν/(ν - 2), at least 1.
    """
    freedoms = [np.clip(curve.dof, _FEWEST_DOF, _MOST_DOF) for curve in curves]
    pairs = list(zip(curves, freedoms, strict=True))
    real = sum(curve.size * len(curve.length) for curve in curves)
    chi_squared = float(sum(curve.length.sum() for curve in curves))
    # By the F distribution T² of p real numbers varies more than χ².
    spread = sum(c.size * np.sum((v + c.size - 2.0) / np.maximum(v - 4.0, 1.0)) for c, v in pairs) / real
    expected = float(sum(curve.size * np.sum(v / (v - 2.0)) for curve, v in pairs) / real)
    dof = max(1.0, real - unknowns)
    common = max(1.0, chi_squared / dof / expected)
    factors = tuple((common * v + curve.length) * (v + curve.size) / (v + curve.size - 2.0) ** 2 for curve, v in pairs)
    return ResidualNoise(factors, common, chi_squared, dof, expected, float(np.sqrt(2.0 * spread / dof)))


# Circle of a resonance in the complex plane, with frequency and damping.

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
    """Return the circle (3,) of least weighted distances and its derivatives (3, K)."""
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
    """Return f₀ and ζ from the angles about the centre, and derivatives (2, K)."""
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
    """Return 2 atan((1/r - r)/(2ζ)) (K,), derivatives (K, 3) by ln(f₀)/ζ, ln ζ, α."""
    r = frequency_hz / f0
    tangent = (1.0 / r - r) / (2.0 * zeta)
    by_tangent = 2.0 / (1.0 + tangent**2)
    columns = [by_tangent * (1.0 / r + r) / 2.0, -by_tangent * tangent, np.ones(len(r))]
    return np.asarray(2.0 * np.arctan(tangent)), np.stack(columns, axis=1)
