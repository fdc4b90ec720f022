"""One resonance fitted to a transfer function, with covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker.arrays import Brief, ComplexArray, FloatArray, IntArray, check_shape
from shaker.fitting import Block, Rules, Separable, levenberg_marquardt
from shaker.identification.measured import (
    CurveResidual,
    MeasuredCurve,
    SeenNoise,
    between_lines,
    rational_poles,
    seen_noise,
    whitening_of,
)
from shaker.mechanics import laplace

Kind = Literal["transmissibility", "receptance", "mobility", "accelerance"]

_ORDER: dict[str, int] = {"transmissibility": 0, "receptance": 0, "mobility": 1, "accelerance": 2}
_RULES = Rules(foretold=1e-13, foretold_share=0.0, steps=60, tries=13, first=1e-6)
"""A fit has converged where the whitened model would change by 3e-7, or where no damping up to 1e6 helps."""
_NOISE_ROUNDS = 5
_EVEN = 0.01  # relative spread over the lines of what their covariances change by, at which weights have settled


@dataclass(frozen=True, repr=False)
class Resonance(Brief):
    """A resonance with its uncertainty.

    `frequency_hz`: f₀ of the undamped oscillator; `damping_ratio` ζ; complex `gain` G; `delay_s`; `residual` (2,)
    complex: the mass line R₋/s² and the constant R₊ of all other modes; delay and residual are zero where not fitted.
    `parameters` (P,) names what was fitted, in the order of `covariance` (P, P); `chi_squared` is that of the residuals
    over the uncertainties given, divided by ν/(ν - 2) where these have ν degrees of freedom, so that noise alone gives
    `dof` in the mean. The covariance is enlarged by χ²/dof where that exceeds one.
    """

    kind: Kind
    frequency_hz: float
    damping_ratio: float
    gain: complex
    delay_s: float
    residual: ComplexArray
    parameters: tuple[str, ...]
    covariance: FloatArray
    chi_squared: float
    dof: float

    def __post_init__(self) -> None:
        check_shape("residual", self.residual, (2,))
        check_shape("covariance", self.covariance, (len(self.parameters), len(self.parameters)))

    def model(self, frequency_hz: FloatArray, added_decay_per_s: float = 0.0) -> ComplexArray:
        """Return H(s) (K,) at s = a + jω."""
        vector = [self.frequency_hz, self.damping_ratio, self.gain.real, self.gain.imag, self.delay_s]
        vector += [part for term in self.residual for part in (term.real, term.imag)]
        return _evaluate(self.kind, _names(True, True), laplace(frequency_hz, added_decay_per_s), np.array(vector))[0]

    def u(self, parameter: str) -> float:
        """Return the standard uncertainty of a fitted parameter."""
        if parameter not in self.parameters:
            raise ValueError(f"parameter: expected one of {', '.join(self.parameters)}, found {parameter}")
        place = self.parameters.index(parameter)
        return float(np.sqrt(self.covariance[place, place]))

    @property
    def quality(self) -> float:
        """Quality factor Q = 1/(2ζ)."""
        return 0.5 / self.damping_ratio


def fit_resonance(curve: MeasuredCurve, kind: Kind, *, delay: bool = False, residual_terms: bool = False) -> Resonance:
    """Fit one resonance to a measured curve (K lines).

    With p = s/ω₀, s = a + jω and D = 1 + 2ζp + p²: transmissibility G·(1 + 2ζp)/D (base excitation), receptance G/D,
    mobility G·s/D, accelerance G·s²/D, so that G = 1/k of an oscillator driven by a force; `residual_terms` adds
    R₋/s² + R₊ to 1/D's place, `delay` a factor exp(-sτ). Least squares of the residuals whitened by their covariance,
    started by `rational_poles`; where the covariance has few degrees of freedom, lines weigh by it and by their
    residuals together (see `seen_noise`). Correlation between lines enters the covariance of the result.

    >>> import numpy as np
    >>> from shaker import MeasuredCurve, fit_resonance
    >>> hertz = np.arange(250.0, 350.0, 2.0)
    >>> p = 1j * hertz / 300.0
    >>> curve = MeasuredCurve(hertz, (1 + 0.04 * p) / (1 + 0.04 * p + p**2), np.tile(1e-6 * np.eye(2), (50, 1, 1)))
    >>> found = fit_resonance(curve, "transmissibility")
    >>> print(f"{found.frequency_hz:.1f} Hz, damping ratio {found.damping_ratio:.3f}")
    300.0 Hz, damping ratio 0.020
    """
    names = _names(delay, residual_terms)
    if 2 * len(curve.frequency_hz) <= len(names):
        raise ValueError(f"frequency_hz: expected more than {len(names) // 2} lines, found {len(curve.frequency_hz)}")
    vector, jacobian, noise = _weighed(curve, kind, names)
    flat = jacobian.reshape(-1, len(names))
    scale = np.linalg.norm(flat, axis=0)
    root = np.linalg.inv(np.linalg.qr(flat / scale, mode="r"))
    inverse = root @ root.T
    columns = (jacobian[:, 0] + 1j * jacobian[:, 1]) / scale
    inverse = inverse + inverse @ between_lines(curve.frequency_hz, columns, curve.line_correlation) @ inverse
    fitted = dict(zip(names, vector.tolist(), strict=True))
    low, high = (complex(fitted.get(f"{n}_re", 0.0), fitted.get(f"{n}_im", 0.0)) for n in ("mass_line", "constant"))
    return Resonance(
        kind=kind,
        frequency_hz=fitted["frequency_hz"],
        damping_ratio=fitted["damping_ratio"],
        gain=complex(fitted["gain_re"], fitted["gain_im"]),
        delay_s=fitted.get("delay_s", 0.0),
        residual=np.array([low, high]),
        parameters=names,
        covariance=np.asarray(0.5 * (inverse + inverse.T) / np.multiply.outer(scale, scale)),
        chi_squared=noise.chi_squared / noise.expected,
        dof=noise.dof,
    )


def _names(delay: bool, residual_terms: bool) -> tuple[str, ...]:
    names = ["frequency_hz", "damping_ratio", "gain_re", "gain_im"]
    names += ["delay_s"] if delay else []
    names += ["mass_line_re", "mass_line_im", "constant_re", "constant_im"] if residual_terms else []
    return tuple(names)


def _evaluate(
    kind: Kind, names: tuple[str, ...], s: ComplexArray, vector: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return H (K,) and its derivatives (K, P) by the parameters named."""
    fitted = dict(zip(names, vector, strict=True))
    zeta, delay = fitted["damping_ratio"], fitted.get("delay_s", 0.0)
    gain = complex(fitted["gain_re"], fitted["gain_im"])
    base_excited = float(kind == "transmissibility")
    p = s / (2.0 * np.pi * fitted["frequency_hz"])
    pole = 1.0 + 2.0 * zeta * p + p * p
    shape = (1.0 + base_excited * 2.0 * zeta * p) / pole
    before = s ** _ORDER[kind] * np.exp(-s * delay)
    by_p = (base_excited * 2.0 * zeta - shape * (2.0 * zeta + 2.0 * p)) / pole
    columns = {
        "frequency_hz": before * gain * by_p * (-p / fitted["frequency_hz"]),
        "damping_ratio": before * gain * (base_excited - shape) * 2.0 * p / pole,
        "gain": before * shape,
        "mass_line": before / s**2,
        "constant": before,
    }
    value = gain * columns["gain"]
    for name in ("mass_line", "constant"):
        value = value + complex(fitted.get(f"{name}_re", 0.0), fitted.get(f"{name}_im", 0.0)) * columns[name]
    for name in ("gain", "mass_line", "constant"):
        columns[f"{name}_re"], columns[f"{name}_im"] = columns[name], 1j * columns[name]
    columns["delay_s"] = -s * value
    return np.asarray(value), np.stack([columns[name] for name in names], axis=1)


def _real(whitening: FloatArray, columns: ComplexArray) -> FloatArray:
    """Return complex columns (K, P) as whitened real ones (K, 2, P)."""
    return np.asarray(whitening @ np.stack([columns.real, columns.imag], axis=1))


def _weighed(curve: MeasuredCurve, kind: Kind, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray, SeenNoise]:
    """Return the parameters, the derivatives (K, 2, P) whitened by the noise seen in the lines, and that noise."""
    s, whitening = laplace(curve.frequency_hz, curve.added_decay_per_s), whitening_of(curve.covariance)
    dof = np.full(len(s), np.inf) if curve.dof is None else curve.dof
    size, noise = np.abs(s ** _ORDER[kind]), np.sqrt(0.5 * np.trace(curve.covariance, axis1=1, axis2=2))
    response, lowest = curve.value / s ** _ORDER[kind], -2 if "mass_line_re" in names else 0
    (pole,) = rational_poles(s, response[:, None], (noise / size)[:, None], 1, lowest)
    if abs(pole) > np.abs(s).max():
        pole = np.abs(s[np.argmax(np.abs(response))]) * (-0.01 + 1j)
    vector, factor = np.zeros(len(names)), np.ones(len(s))
    vector[:2] = abs(pole) / (2.0 * np.pi), -pole.real / abs(pole)
    for _ in range(1 + _NOISE_ROUNDS):
        weighed = whitening / np.sqrt(factor)[:, None, None]
        vector, residual, jacobian = _adjusted(kind, names, s, curve.value, weighed, vector)
        length = np.sum(residual**2, axis=1) * factor
        seen = seen_noise([CurveResidual(length, dof, residual.shape[1])], float(len(names)))
        before, factor = factor, seen.lines[0]
        if np.ptp(factor / before) <= _EVEN * np.max(factor / before):
            break
    return vector, jacobian * np.sqrt(before / factor)[:, None, None], seen


def _adjusted(
    kind: Kind, names: tuple[str, ...], s: ComplexArray, value: ComplexArray, whitening: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the parameters of least squares, the whitened residuals (K, 2) and derivatives (K, 2, P) there."""
    linear = np.array([name.endswith(("_re", "_im")) for name in names])
    measured = _real(whitening, value[:, None]).reshape(-1, 1)

    def point(parameters: FloatArray) -> Separable | None:
        """Gain and residual terms are linear and follow frequency, damping and delay."""
        if min(parameters[:2]) <= 0.0:
            return None
        vector = np.zeros(len(names))
        vector[~linear] = parameters
        design = _real(whitening, _evaluate(kind, names, s, vector)[1][:, linear]).reshape(len(measured), -1)

        def changes(coefficients: FloatArray) -> tuple[IntArray, FloatArray]:
            vector[linear] = coefficients[:, 0]
            slopes = _real(whitening, _evaluate(kind, names, s, vector)[1][:, ~linear])
            return np.arange(len(parameters)), slopes.reshape(len(measured), -1, 1)

        return Separable(parameters, [Block(design, measured, changes)])

    first = point(start[~linear])
    assert first is not None
    search = levenberg_marquardt(point, first, _RULES)
    if not search.converged:
        raise ValueError(
            "value: expected a transfer function with a resonance inside its band, found none that a fit meets"
        )
    vector = start.copy()
    vector[~linear], vector[linear] = search.point.parameters, search.point.coefficients[0][:, 0]
    model, derivative = _evaluate(kind, names, s, vector)
    return vector, _real(whitening, (value - model)[:, None])[:, :, 0], _real(whitening, derivative)
