"""One resonance of a transfer function, fitted with covariance or read without a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from shaker.identification.measured_curves import (
    FEWEST_LINES,
    CurveResidual,
    MeasuredCurve,
    ResidualNoise,
    estimate_residual_noise,
    fit_circle,
    line_correlation_term,
    rational_poles,
    whitening_matrices,
)
from shaker.mechanics import laplace
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray
from shakercal._common.fitting import BlockJacobian, LinearBlock, LMOptions, SeparablePoint, levenberg_marquardt

ResonanceKind = Literal["transmissibility", "receptance", "mobility", "accelerance"]
DampingLaw = Literal["viscous", "loss factor"]

_OSCILLATOR_PARAMETERS = ("frequency_hz", "damping_ratio", "gain_re", "gain_im")
_FILTER_PARAMETERS = ("loss_s2", "dispersion_s3")
_RESIDUAL_PARAMETERS = ("mass_line_re", "mass_line_im", "constant_re", "constant_im")
_POWER_OF_S: dict[str, int] = {"transmissibility": 0, "receptance": 0, "mobility": 1, "accelerance": 2}
_LM_OPTIONS = LMOptions(
    predicted_decrease=1e-13, predicted_decrease_share=0.0, max_steps=60, max_dampings=13, initial_damping=1e-6
)
"""A fit converges if the whitened model would change by less than 3e-7, or if no damping up to 1e6 helps."""
_MAX_REWEIGHTINGS = 5  # by the residuals
_WEIGHT_TOLERANCE = 0.01  # range over the lines of the relative change of their covariances at which reweighting ends


@dataclass(frozen=True, repr=False)
class Resonance(Arrays, shapes="residual_terms 2; filter_terms 2; parameters P; covariance P P"):
    """A resonance with its uncertainty.

    `frequency_hz`: f₀ of the undamped oscillator. `damping_ratio` ζ; complex `gain` G; `delay_s`. `residual_terms` (2,)
    complex: contribution of all other modes, mass line R₋/s² and constant R₊. `filter_terms` (2,): factors of s² and
    s³ in the logarithm of a filter, in s² and s³. Delay, residual and filter terms are zero if they were not fitted.
    `parameters` (P,): names of the fitted parameters in the order of `covariance` (P, P), which is
    enlarged by χ²/dof if that is above one. `chi_squared`: of the residuals over the given uncertainties, divided by
    ν/(ν - 2) for ν degrees of freedom. Its mean is `dof` for noise alone. `law`: of a loss factor η = 2ζ.
    """

    kind: ResonanceKind
    frequency_hz: float
    damping_ratio: float
    gain: complex
    delay_s: float
    residual_terms: ComplexArray
    parameters: tuple[str, ...]
    covariance: FloatArray
    chi_squared: float
    dof: float
    law: DampingLaw = "viscous"
    filter_terms: FloatArray = field(default_factory=lambda: np.zeros(2))

    def model(self, frequency_hz: FloatArray, added_decay_per_s: float = 0.0) -> ComplexArray:
        """Return H(s) (K,) at s = a + jω, with the added decay a."""
        vector = [self.frequency_hz, self.damping_ratio, self.gain.real, self.gain.imag, self.delay_s]
        vector += self.filter_terms.tolist()
        vector += [part for term in self.residual_terms for part in (term.real, term.imag)]
        return _evaluate(
            _Shape(self.kind, self.law),
            (*_OSCILLATOR_PARAMETERS, "delay_s", *_FILTER_PARAMETERS, *_RESIDUAL_PARAMETERS),
            laplace(frequency_hz, added_decay_per_s),
            np.array(vector),
        )[0]

    def u(self, parameter: str) -> float:
        """Return the standard uncertainty of a fitted parameter."""
        if parameter not in self.parameters:
            raise ValueError(f"parameter: expected one of {', '.join(self.parameters)}, found {parameter}")
        index = self.parameters.index(parameter)
        return float(np.sqrt(self.covariance[index, index]))

    @property
    def quality(self) -> float:
        """Return the quality factor Q = 1/(2ζ)."""
        return 0.5 / self.damping_ratio


@dataclass(frozen=True)
class _Shape:
    """Form of an oscillator's response: its excitation and its law of damping."""

    kind: ResonanceKind
    law: DampingLaw

    @property
    def power(self) -> int:
        """Power of s before the shape."""
        return _POWER_OF_S[self.kind]


def fit_resonance(
    curve: MeasuredCurve,
    kind: ResonanceKind,
    *,
    delay: bool = False,
    unstated_filter: bool = False,
    residual_terms: bool = False,
    law: DampingLaw = "viscous",
) -> Resonance:
    """Fit one resonance to a measured curve (K lines).

    Parameters
    ----------
    curve
        measured frequency response
    kind
        "transmissibility", "receptance", "mobility" or "accelerance"
    delay
        fit a factor exp(-sτ), default False
    unstated_filter
        fit a factor exp(-sτ + Ls² + Ds³), any stable filter well above the band, default False
    residual_terms
        fit the contribution of other modes R₋/s² + R₊, added to the shape, default False
    law
        "viscous" (default) or "loss factor": damping that does not depend on frequency

    Raises
    ------
    ValueError : too few lines, or no resonance inside the band

    Notes
    -----
    With p = s/ω₀, s = a + jω and D = 1 + 2ζp + p²: transmissibility G·(1 + 2ζp)/D (base excitation), receptance G/D,
    mobility G·s/D, accelerance G·s²/D. G = 1/k for an oscillator driven by a force. With a loss factor η = 2ζ the
    term 2ζp is jη; the same peak then has f₀ lower by the share ζ². The residuals are whitened by their
    covariance; the fit starts at `rational_poles`. If the covariance has few degrees of freedom, the weights follow
    from it and the residuals (`estimate_residual_noise`). The correlation between lines enters the covariance of the
    result.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import MeasuredCurve, fit_resonance
    >>> hertz = np.arange(250.0, 350.0, 2.0)
    >>> p = 1j * hertz / 300.0
    >>> curve = MeasuredCurve(hertz, (1 + 0.04 * p) / (1 + 0.04 * p + p**2), np.tile(1e-6 * np.eye(2), (50, 1, 1)))
    >>> found = fit_resonance(curve, "transmissibility")
    >>> print(f"{found.frequency_hz:.1f} Hz, damping ratio {found.damping_ratio:.3f}")
    300.0 Hz, damping ratio 0.020
    """
    names = (
        *_OSCILLATOR_PARAMETERS,
        *(("delay_s",) if delay or unstated_filter else ()),
        *(_FILTER_PARAMETERS if unstated_filter else ()),
        *(_RESIDUAL_PARAMETERS if residual_terms else ()),
    )
    if 2 * len(curve.frequency_hz) <= len(names):
        raise ValueError(f"frequency_hz: expected more than {len(names) // 2} lines, found {len(curve.frequency_hz)}")
    vector, jacobian, noise = _fit_reweighted(curve, _Shape(kind, law), names)
    flat = jacobian.reshape(-1, len(names))
    scale = np.linalg.norm(flat, axis=0)
    root = np.linalg.inv(np.linalg.qr(flat / scale, mode="r"))
    inverse = root @ root.T
    columns = (jacobian[:, 0] + 1j * jacobian[:, 1]) / scale
    inverse = inverse + inverse @ line_correlation_term(curve.frequency_hz, columns, curve.line_correlation) @ inverse
    fitted = dict(zip(names, vector.tolist(), strict=True))
    low, high = (complex(fitted.get(f"{n}_re", 0.0), fitted.get(f"{n}_im", 0.0)) for n in ("mass_line", "constant"))
    return Resonance(
        kind=kind,
        frequency_hz=fitted["frequency_hz"],
        damping_ratio=fitted["damping_ratio"],
        gain=complex(fitted["gain_re"], fitted["gain_im"]),
        delay_s=fitted.get("delay_s", 0.0),
        residual_terms=np.array([low, high]),
        parameters=names,
        covariance=np.asarray(0.5 * (inverse + inverse.T) / np.multiply.outer(scale, scale)),
        chi_squared=noise.chi_squared / noise.expected,
        dof=noise.dof,
        law=law,
        filter_terms=np.array([fitted.get(name, 0.0) for name in _FILTER_PARAMETERS]),
    )


def _evaluate(
    form: _Shape, names: tuple[str, ...], s: ComplexArray, vector: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return H (K,) and its derivatives (K, P) with respect to the named parameters."""
    fitted = dict(zip(names, vector, strict=True))
    zeta, delay = fitted["damping_ratio"], fitted.get("delay_s", 0.0)
    gain = complex(fitted["gain_re"], fitted["gain_im"])
    base_excited, viscous = float(form.kind == "transmissibility"), float(form.law == "viscous")
    p = s / (2.0 * np.pi * fitted["frequency_hz"])
    damper = p if form.law == "viscous" else np.full_like(p, 1j)
    pole = 1.0 + 2.0 * zeta * damper + p * p
    shape = (1.0 + base_excited * 2.0 * zeta * damper) / pole
    loss, dispersion = (fitted.get(name, 0.0) for name in _FILTER_PARAMETERS)
    before = s**form.power * np.exp(-s * delay + s**2 * loss + s**3 * dispersion)
    by_p = (base_excited * viscous * 2.0 * zeta - shape * (viscous * 2.0 * zeta + 2.0 * p)) / pole
    columns = {
        "frequency_hz": before * gain * by_p * (-p / fitted["frequency_hz"]),
        "damping_ratio": before * gain * (base_excited - shape) * 2.0 * damper / pole,
        "gain": before * shape,
        "mass_line": before / s**2,
        "constant": before,
    }
    value = gain * columns["gain"]
    for name in ("mass_line", "constant"):
        value = value + complex(fitted.get(f"{name}_re", 0.0), fitted.get(f"{name}_im", 0.0)) * columns[name]
    for name in ("gain", "mass_line", "constant"):
        columns[f"{name}_re"], columns[f"{name}_im"] = columns[name], 1j * columns[name]
    columns |= {"delay_s": -s * value, "loss_s2": s**2 * value, "dispersion_s3": s**3 * value}
    return np.asarray(value), np.stack([columns[name] for name in names], axis=1)


def _whiten_columns(whitening: FloatArray, columns: ComplexArray) -> FloatArray:
    """Return whitened real columns (K, 2, P) of complex ones (K, P)."""
    return np.asarray(whitening @ np.stack([columns.real, columns.imag], axis=1))


def _fit_reweighted(
    curve: MeasuredCurve, form: _Shape, names: tuple[str, ...]
) -> tuple[FloatArray, FloatArray, ResidualNoise]:
    """Fit with weights from covariance and residuals; return parameters, whitened derivatives, noise."""
    s, whitening = laplace(curve.frequency_hz, curve.added_decay_per_s), whitening_matrices(curve.covariance)
    dof = np.full(len(s), np.inf) if curve.dof is None else curve.dof
    size, noise = np.abs(s**form.power), np.sqrt(0.5 * np.trace(curve.covariance, axis1=1, axis2=2))
    response, lowest = curve.value / s**form.power, -2 if "mass_line_re" in names else 0
    (pole,) = rational_poles(s, response[:, None], (noise / size)[:, None], 1, lowest)
    if abs(pole) > np.abs(s).max():
        pole = np.abs(s[np.argmax(np.abs(response))]) * (-0.01 + 1j)
    vector, factor = np.zeros(len(names)), np.ones(len(s))
    vector[:2] = abs(pole) / (2.0 * np.pi), -pole.real / abs(pole)
    for _ in range(1 + _MAX_REWEIGHTINGS):
        weighed = whitening / np.sqrt(factor)[:, None, None]
        vector, residual, jacobian = _fit_weighted(form, names, s, curve.value, weighed, vector)
        length = np.sum(residual**2, axis=1) * factor
        seen = estimate_residual_noise([CurveResidual(length, dof, residual.shape[1])], float(len(names)))
        before, factor = factor, seen.lines[0]
        if np.ptp(factor / before) <= _WEIGHT_TOLERANCE * np.max(factor / before):
            break
    return vector, jacobian * np.sqrt(before / factor)[:, None, None], seen


def _fit_weighted(
    form: _Shape,
    names: tuple[str, ...],
    s: ComplexArray,
    value: ComplexArray,
    whitening: FloatArray,
    start: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit with given weights; return parameters, whitened residuals (K, 2) and derivatives (K, 2, P)."""
    linear = np.array([name.endswith(("_re", "_im")) for name in names])
    measured = _whiten_columns(whitening, value[:, None]).reshape(-1, 1)

    def point(parameters: FloatArray) -> SeparablePoint | None:
        """Return the linear least-squares problem for gain and residual terms at given nonlinear parameters."""
        if min(parameters[:2]) <= 0.0:
            return None
        vector = np.zeros(len(names))
        vector[~linear] = parameters
        design = _whiten_columns(whitening, _evaluate(form, names, s, vector)[1][:, linear]).reshape(len(measured), -1)

        def changes(coefficients: FloatArray) -> BlockJacobian:
            vector[linear] = coefficients[:, 0]
            slopes = _whiten_columns(whitening, _evaluate(form, names, s, vector)[1][:, ~linear])
            return BlockJacobian(np.arange(len(parameters)), slopes.reshape(len(measured), -1, 1))

        return SeparablePoint(parameters, [LinearBlock(design, measured, changes)])

    first = point(start[~linear])
    assert first is not None
    search = levenberg_marquardt(point, first, _LM_OPTIONS)
    if not search.converged:
        raise ValueError("value: expected a transfer function with a resonance inside its band, found none")
    vector = start.copy()
    vector[~linear], vector[linear] = search.point.parameters, search.point.coefficients[0][:, 0]
    model, derivative = _evaluate(form, names, s, vector)
    return vector, _whiten_columns(whitening, (value - model)[:, None])[:, :, 0], _whiten_columns(whitening, derivative)


# The maximum of |H| and the points at a given share of it, between the lines.

PeakWidth = Literal["half_power", "half_amplitude"]
_SEARCH_PASSES = 3  # refinements of the maximum and the width, chosen
INVERSE_POWER_LEVELS: dict[PeakWidth, float] = {
    "half_power": 2.0,
    "half_amplitude": 4.0,
}  # of 1/|H|², relative to the maximum


@dataclass(frozen=True, repr=False)
class PeakPoint(Arrays):
    """A frequency read from a curve and `inverse`, 1/|H|² at it.

    `by_line`, `inverse_by_line` (K,): gradients of both with respect to 1/|H|² of every line. All are NaN if the point
    was not found.
    """

    frequency_hz: float
    inverse: float
    by_line: FloatArray
    inverse_by_line: FloatArray


def _missing_point(curve: MeasuredCurve) -> PeakPoint:
    """Return a point of NaN: the curve has no such point."""
    missing = np.full(len(curve.frequency_hz), np.nan)
    return PeakPoint(np.nan, np.nan, missing, missing)


def read_peak(curve: MeasuredCurve) -> tuple[PeakPoint, dict[PeakWidth, tuple[PeakPoint, PeakPoint]]]:
    """Return the maximum of a curve and the crossings on both sides for both widths.

    For one base-excited oscillator 1/|H|² is a parabola over f², except for a factor 1 + 4ζ²f²/f₀². The maximum is the
    vertex through the lines above half power, a crossing is read from the lines within a quarter width around it. The
    search starts at the line of the maximum and the nearest lines whose |H| is below 1/√2 of it; a missing side is
    mirrored. To find these lines, |H|² is averaged until its noise at the maximum is 3 %, over at most a twentieth of
    the lines.
    """
    magnitude = np.abs(curve.value)
    largest = int(np.argmax(magnitude))
    noise = 2.0 * np.sqrt(np.trace(curve.covariance[largest]) / 2.0) / magnitude[largest]
    window = np.ones(int(np.clip(np.ceil((noise / 0.03) ** 2), 1, max(1, len(magnitude) // 20))))
    counted = np.convolve(np.ones(len(magnitude)), window, mode="same")
    power = np.convolve(magnitude**2, window, mode="same") / counted
    largest = int(np.argmax(power))
    frequency, below = float(curve.frequency_hz[largest]), np.flatnonzero(power < 0.5 * power[largest])
    ends = [*below[below < largest][-1:], *below[below > largest][:1]]
    reach = float(np.min(np.abs(curve.frequency_hz[ends] - frequency))) if ends else float(np.ptp(curve.frequency_hz))
    low, high = frequency - reach, frequency + reach
    top = _missing_point(curve)
    crossings: dict[PeakWidth, tuple[PeakPoint, PeakPoint]] = {}
    for _ in range(_SEARCH_PASSES):
        width = high - low
        top = _read_maximum(curve, frequency, 0.5 * width)
        if not np.isfinite(top.frequency_hz):
            return top, dict.fromkeys(INVERSE_POWER_LEVELS, (top, top))
        for name, level in INVERSE_POWER_LEVELS.items():
            offset = 0.5 * width * np.sqrt(level - 1.0)
            pair = [
                _read_crossing(curve, top, level, top.frequency_hz + side * offset, 0.25 * width) for side in (-1, 1)
            ]
            crossings[name] = pair[0], pair[1]
        found = [point.frequency_hz for point in crossings["half_power"]]
        if not np.all(np.isfinite(found)):
            break
        frequency, (low, high) = top.frequency_hz, found
    return top, crossings


def _fit_parabola(
    curve: MeasuredCurve, frequency_hz: float, reach_hz: float, fewest: int
) -> tuple[FloatArray, FloatArray, Callable[[float, FloatArray], tuple[float, FloatArray]]]:
    """Fit 1/|H|² = c₀ + c₁u + c₂u² near a frequency.

    Returned are c (3,), its derivatives (3, K) by 1/|H|² of every line, and the frequency with its gradient (K,) as a
    function of u and its gradient. u is proportional to f² - `frequency_hz`². The lines within `reach_hz` are used, at
    least the `fewest` nearest ones. Noise of variances σᵣ², σₜ² along and across H makes 1/|H|² too large by (3σᵣ² -
    σₜ²)/|H|⁴ on average.
    """
    distance = np.abs(curve.frequency_hz - frequency_hz)
    reach = max(reach_hz, float(np.sort(distance)[fewest - 1]))
    chosen: BoolArray = distance <= reach
    centre, scale = frequency_hz**2, 2.0 * frequency_hz * reach
    u = (curve.frequency_hz[chosen] ** 2 - centre) / scale
    powers = np.stack([np.ones(len(u)), u, u * u], axis=1)
    unit = curve.value / np.abs(curve.value)
    radial, tangential = (curve.variance_along(direction)[chosen] for direction in (unit, 1j * unit))
    smooth = np.abs(curve.value[chosen]) ** -2.0
    inverse = smooth - (3.0 * radial - tangential) * smooth**2
    for _ in range(2):
        weighted = powers / (smooth**3 * radial)[:, None]
        solve = np.linalg.solve(weighted.T @ powers, weighted.T)
        coefficients = solve @ inverse
        smooth = np.maximum(powers @ coefficients, 0.1 * smooth)
    by_line = np.zeros((3, len(distance)))
    by_line[:, chosen] = solve

    def frequency_at(u: float, u_by_line: FloatArray) -> tuple[float, FloatArray]:
        frequency = float(np.sqrt(centre + scale * u))
        return frequency, u_by_line * scale / (2.0 * frequency)

    return coefficients, by_line, frequency_at


def _read_maximum(curve: MeasuredCurve, frequency_hz: float, reach_hz: float) -> PeakPoint:
    """Return the vertex of the parabola through the lines around a maximum."""
    (c0, c1, c2), by_line, frequency_at = _fit_parabola(curve, frequency_hz, reach_hz, 3)
    u = -0.5 * c1 / c2 if c2 > 0.0 else np.nan
    inverse = c0 + 0.5 * c1 * u
    if not (abs(u) < 2.0 and inverse > 0.0):
        return _missing_point(curve)
    frequency, frequency_by_line = frequency_at(u, (c1 / c2 * by_line[2] - by_line[1]) / (2.0 * c2))
    return PeakPoint(frequency, float(inverse), frequency_by_line, np.array([1.0, u, u * u]) @ by_line)


def _read_crossing(
    curve: MeasuredCurve, top: PeakPoint, level: float, frequency_hz: float, reach_hz: float
) -> PeakPoint:
    """Return the point of a flank where 1/|H|² is `level` times that of the maximum."""
    if not curve.frequency_hz[0] <= frequency_hz <= curve.frequency_hz[-1]:
        return _missing_point(curve)
    (c0, c1, c2), by_line, frequency_at = _fit_parabola(curve, frequency_hz, reach_hz, 4)
    target, by_target = level * top.inverse, level * top.inverse_by_line
    root = c1 * c1 - 4.0 * c2 * (c0 - target)
    slope = np.sign(frequency_hz - top.frequency_hz) * np.sqrt(max(root, 0.0))
    u = 2.0 * (target - c0) / (slope + c1) if root > 0.0 else np.nan
    if not abs(u) < 3.0:
        return _missing_point(curve)
    frequency, frequency_by_line = frequency_at(u, (by_target - np.array([1.0, u, u * u]) @ by_line) / slope)
    return PeakPoint(frequency, target, frequency_by_line, by_target)


def propagate_noise(curve: MeasuredCurve, *by_inverse: FloatArray) -> FloatArray:
    """Return standard uncertainties (P,) of values from their gradients (K,) by 1/|H|²."""
    square = np.abs(curve.value) ** 2
    gradient = np.stack(by_inverse) * (-2.0 * curve.value / square**2)
    return np.asarray(np.sqrt(np.diag(curve.propagated(gradient))))


def peak_line_variance_hz2(curve: MeasuredCurve, top: PeakPoint, width_hz: float) -> float:
    """Return the variance (Hz²) of the highest line's frequency by noise.

    The lines above half power are equally spaced, with independent normal noise about |H| of the oscillator. Each is
    the largest with the probability ∫ φₖ(a) Πⱼ Φⱼ(a) da.
    """
    from scipy.special import log_ndtr

    near = np.abs(curve.frequency_hz - top.frequency_hz) <= max(0.5 * width_hz, curve.spacing_hz)
    frequency = curve.frequency_hz[near]
    detuned = 2.0 * (frequency - top.frequency_hz) / width_hz
    expected = 1.0 / np.sqrt(top.inverse * (1.0 + detuned**2))
    u = np.sqrt(curve.variance_along(curve.value / np.abs(curve.value)))[near]
    level = np.linspace(expected.max() - 4.0 * u.max(), expected.max() + 6.0 * u.max(), 400)
    score = (level[:, None] - expected) / u
    log_below = log_ndtr(score)
    wins = np.exp(log_below.sum(axis=1, keepdims=True) - log_below - 0.5 * score**2) / u
    chance = wins.sum(axis=0) / wins.sum()
    return float(chance @ (frequency - chance @ frequency) ** 2)


_RESOLVED_LINES = 4.0  # least number in the half-power width for a reliable width


@dataclass(frozen=True)
class PeakReading:
    """One reading of a resonance: frequency, width and damping ratio with standard uncertainties.

    Missing numbers are NaN. `note`: a restriction of these numbers, usually empty.
    """

    method: str
    frequency_hz: float = np.nan
    u_frequency_hz: float = np.nan
    width_hz: float = np.nan
    u_width_hz: float = np.nan
    damping_ratio: float = np.nan
    u_damping_ratio: float = np.nan
    note: str = ""


@dataclass(frozen=True)
class PeakReadings:
    """All readings of one resonance of a base-excited mass.

    `maximum_bin`: the spectral line of the largest |H|. `maximum`: the maximum between the lines. Both are the
    frequency of the maximum, ζ²f₀ below f₀. `half_power`: f₀ and ζ from the two frequencies with |H| at 1/√2 of its
    maximum. `half_amplitude`: equation 10 of Nitsche et al. (J. Sens. Sens. Syst. 7, 2018) as printed, with the width
    at half the maximum; the damping is √3 times too large. `circle`: f₀ and ζ from the angles of the Nyquist circle.
    `lines_in_width`: half-power width over line spacing.
    """

    maximum_bin: PeakReading
    maximum: PeakReading
    half_power: PeakReading
    half_amplitude: PeakReading
    circle: PeakReading
    lines_in_width: float

    @property
    def all(self) -> tuple[PeakReading, ...]:
        """Return all readings in the order of the attributes."""
        return self.maximum_bin, self.maximum, self.half_power, self.half_amplitude, self.circle


def peak_readings(curve: MeasuredCurve) -> PeakReadings:
    """Read the highest resonance of load over base motion by every method."""
    if len(curve.frequency_hz) < FEWEST_LINES:
        raise ValueError(f"frequency_hz: expected at least {FEWEST_LINES} lines, found {len(curve.frequency_hz)}")
    top, crossings = read_peak(curve)
    width = crossings["half_power"][1].frequency_hz - crossings["half_power"][0].frequency_hz
    lines, note = width / curve.spacing_hz, ""
    if lines < _RESOLVED_LINES:
        note = f"{lines:.1f} lines in the half-power width, fewer than {_RESOLVED_LINES:.0f}: "
        note += "the curve between the lines is assumed to be that of one oscillator"
    # The line of the maximum is uncertain by half a spacing and by the effect of noise on its selection.
    line_hz = float(curve.frequency_hz[np.argmax(np.abs(curve.value))])
    by_noise = peak_line_variance_hz2(curve, top, width) if np.isfinite(width) else np.nan
    u_line = float(np.sqrt(curve.spacing_hz**2 / 12.0 + by_noise))
    between = "" if np.isfinite(top.frequency_hz) else "no maximum of the curve inside this band"
    half_power, half_amplitude = (
        _read_width(name, curve, top, *crossings[name], note) for name in INVERSE_POWER_LEVELS
    )
    fit, circle = None, PeakReading("circle", note="no circle found in the complex plane")
    if np.isfinite(half_power.damping_ratio):
        fit = fit_circle(curve, half_power.frequency_hz, half_power.damping_ratio)
    if fit is not None:
        f0, zeta = fit.frequency_hz, fit.damping_ratio
        (u_f0, u_zeta), by_width = np.sqrt(np.diag(fit.covariance)).tolist(), np.array([2.0 * zeta, 2.0 * f0])
        u_width = float(np.sqrt(by_width @ fit.covariance @ by_width))
        circle = PeakReading("circle", f0, u_f0, 2.0 * zeta * f0, u_width, zeta, u_zeta)
    return PeakReadings(
        maximum_bin=PeakReading("maximum_bin", line_hz, u_line),
        maximum=PeakReading("maximum", top.frequency_hz, float(propagate_noise(curve, top.by_line)[0]), note=between),
        half_power=half_power,
        half_amplitude=half_amplitude,
        circle=circle,
        lines_in_width=float(lines),
    )


def transmissibility_levels(damping_ratio: float) -> tuple[float, float, float]:
    """Return r = f/f₀ of the maximum, the lower and upper point at half power.

    The transmissibility H is (1 + 2jζr)/(1 - r² + 2jζr). At half power, r² solves y² - (2 - 4ζ² +
    4ζ²c)y + 1 - c = 0, c = 2/|H|²max. The lower r is zero if half power is not reached.
    """
    square = 4.0 * damping_ratio**2
    highest = 2.0 / (np.sqrt(1.0 + 2.0 * square) + 1.0)
    at_level = 2.0 * ((1.0 - highest) ** 2 + square * highest) / (1.0 + square * highest)
    middle = 1.0 - 0.5 * square * (1.0 - at_level)
    root = np.sqrt(middle**2 - 1.0 + at_level)
    return float(np.sqrt(highest)), float(np.sqrt(max(0.0, middle - root))), float(np.sqrt(middle + root))


def _read_width(
    method: PeakWidth, curve: MeasuredCurve, top: PeakPoint, low: PeakPoint, high: PeakPoint, note: str
) -> PeakReading:
    """Return the reading from the width between two crossings of a level.

    Half power: f₀ and ζ of the oscillator that has the same width, relative to its maximum, and the same crossings.
    Half amplitude: equation 10 with the width at half the maximum, uncorrected for its factor √3.
    """
    width = high.frequency_hz - low.frequency_hz
    if not np.isfinite(width):
        share = "1/√2" if method == "half_power" else "1/2"
        return PeakReading(method, note=f"|H| does not fall to {share} of its maximum on both sides inside the band")
    f0, by_f0, by_width = top.frequency_hz, top.by_line, high.by_line - low.by_line
    zeta = 0.5 * width / f0
    if method == "half_power":
        for _ in range(20):
            highest, below, above = transmissibility_levels(zeta)
            zeta *= width / top.frequency_hz * highest / (above - below)
        f0 = float(np.sqrt(low.frequency_hz * high.frequency_hz / (below * above)))
        by_f0 = 0.5 * f0 * (low.by_line / low.frequency_hz + high.by_line / high.frequency_hz)
    else:
        note = "damping overstated by √3" + (f"; {note}" if note else "")
    by_zeta = zeta * (by_width / width - top.by_line / top.frequency_hz)
    u_f0, u_width, u_zeta = propagate_noise(curve, by_f0, by_width, by_zeta).tolist()
    return PeakReading(method, f0, u_f0, width, u_width, float(zeta), u_zeta, note)
