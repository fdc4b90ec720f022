"""What damper and measuring chain do to the sensitivity over frequency, and which of them the data support."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, check_shape
from shaker.identification.measured import MeasuredSensitivity, NamedUnknown, ParameterEstimate


@dataclass(frozen=True)
class SpringPrior:
    """Stiffness and damping as a resonance gives them, with their standard uncertainties and correlation.

    k in N/m, b in kg/s; of a rotation N·m/rad and N·m·s/rad.
    """

    k: float
    u_k: float
    b: float
    u_b: float
    r_kb: float = 0.0

    def __post_init__(self) -> None:
        if not (self.k > 0.0 and self.u_k >= 0.0 and self.u_b >= 0.0):
            raise ValueError(f"k, u_k, u_b: expected k > 0 and u >= 0, found {self.k:g}, {self.u_k:g} and {self.u_b:g}")
        if not abs(self.r_kb) <= 1.0:
            raise ValueError(f"r_kb: expected a correlation of -1 to 1, found {self.r_kb:g}")

    @property
    def covariance(self) -> FloatArray:
        """Covariance (2, 2) of [k, b]."""
        mixed = self.r_kb * self.u_k * self.u_b
        return np.array([[self.u_k**2, mixed], [mixed, self.u_b**2]])

    @property
    def time_s(self) -> float:
        """τ = b/k in s, the time constant of the lag that the damper makes."""
        return self.b / self.k

    @property
    def time_slope(self) -> FloatArray:
        """Derivatives (2,) of b/k by [k, b]."""
        return np.array([-self.b / self.k**2, 1.0 / self.k])

    @property
    def u_time_s(self) -> float:
        """Standard uncertainty of b/k in s."""
        return float(np.sqrt(self.time_slope @ self.covariance @ self.time_slope))


# Shapes that a measuring chain can give the sensitivity: delay, lag, low-pass of second order.


ChainKind = Literal["none", "delay", "lag", "butterworth", "second_order", "delay_lag"]

CHAIN_PARAMETERS: dict[ChainKind, tuple[str, ...]] = {
    "none": (),
    "delay": ("delay_s",),
    "lag": ("lag_s",),
    "butterworth": ("lag_s",),
    "second_order": ("lag_s", "square_s2"),
    "delay_lag": ("delay_s", "lag_s"),
}
"""Names of the parameters of each shape, in their order."""


@dataclass(frozen=True)
class Chain:
    """exp(−sD) / (1 + a₁s + a₂s²), s = jω, with the terms that `kind` has.

    `parameters` (P,) in the order of `CHAIN_PARAMETERS`: D `delay_s`, a₁ `lag_s`, a₂ `square_s2`. A low-pass of
    second order has a₁ = 2ζ/ω_c and a₂ = 1/ω_c²; a Butterworth filter a₂ = a₁²/2.
    """

    kind: ChainKind
    parameters: FloatArray

    def __post_init__(self) -> None:
        check_shape("parameters", self.parameters, (len(self.names),))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return CHAIN_PARAMETERS[self.kind]

    @property
    def delay_s(self) -> float:
        """Pure delay D."""
        return self._value("delay_s")

    @property
    def lag_s(self) -> float:
        """a₁ = 2ζ/ω_c: the delay of the low-pass at low frequencies."""
        return self._value("lag_s")

    @property
    def square_s2(self) -> float:
        """a₂ = 1/ω_c²."""
        return 0.5 * self.lag_s**2 if self.kind == "butterworth" else self._value("square_s2")

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the response (K,) at frequencies in Hz."""
        s = laplace(frequency_hz)
        return np.asarray(np.exp(-s * self.delay_s) / self._divisor(s))

    def log_slopes(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the derivatives (K, P) of the logarithm of the response by the parameters."""
        s = laplace(frequency_hz)
        divisor = self._divisor(s)
        by_lag = -s * (1.0 + s * self.lag_s) if self.kind == "butterworth" else -s
        columns = {"delay_s": -s, "lag_s": by_lag / divisor, "square_s2": -s * s / divisor}
        slopes = np.empty((len(s), len(self.names)), dtype=np.complex128)
        for place, name in enumerate(self.names):
            slopes[:, place] = columns[name]
        return slopes

    def log_frequency_slope(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the derivative (K,) of the logarithm of the response by the frequency, in 1/Hz."""
        s = laplace(frequency_hz)
        by_s = -self.delay_s - (self.lag_s + 2.0 * self.square_s2 * s) / self._divisor(s)
        return np.asarray(2j * np.pi * by_s)

    def corner(self, covariance: FloatArray) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Return (f_c, u) in Hz and (ζ, u) of a low-pass from the covariance (P, P) of its parameters.

        f_c = 1/(2π√a₂), ζ = a₁/(2√a₂); None where the chain has no low-pass of second order (a₂ ≤ 0).
        """
        if self.kind not in {"butterworth", "second_order"} or not self.square_s2 > 0.0:
            return None
        root = float(np.sqrt(self.square_s2))
        frequency, damping = 1.0 / (2.0 * np.pi * root), 0.5 * self.lag_s / root
        if self.kind == "butterworth":
            slopes = np.array([[-frequency / self.lag_s], [0.0]])
        else:
            slopes = np.array([[0.0, -0.5 * frequency], [0.5 * self.square_s2 / root, -0.5 * damping]]) / self.square_s2
        u = np.sqrt(np.maximum((slopes @ covariance @ slopes.T).diagonal(), 0.0)).tolist()
        return (frequency, u[0]), (damping, u[1])

    def _value(self, name: str) -> float:
        """Return a parameter, 0 where the shape has none of this name."""
        return float(self.parameters[self.names.index(name)]) if name in self.names else 0.0

    def _divisor(self, s: ComplexArray) -> ComplexArray:
        """Return 1 + a₁s + a₂s²."""
        return np.asarray(1.0 + self.lag_s * s + self.square_s2 * s * s)


def laplace(frequency_hz: FloatArray) -> ComplexArray:
    """Return s = jω (K,) of frequencies in Hz."""
    return np.asarray(2j * np.pi * np.asarray(frequency_hz, dtype=np.float64), dtype=np.complex128)


NO_CHAIN = Chain("none", np.empty(0))
"""A chain that passes everything as it is."""


# The sensor's damper and one shape of the chain fitted to a measured sensitivity.


LABELS = {"spring_time_s": "b/k of the sensor", "delay_s": "delay of the chain", "lag_s": "lag of the chain"}
_TOLERANCE, _EVALUATIONS = 1e-10, 200
_SMALLEST_TURN = 0.01  # rad at the highest line with which a lag starts, lest it be the same as a delay


@dataclass(frozen=True)
class SensitivityFit:
    """S(f) = S₀ / (1 + jωτ) · chain(f), τ = b/k, fitted to a measured sensitivity under one shape of the chain.

    `sensitivity` S₀ in `unit`; `spring_time_s` τ. `parameters` (P,) names what was fitted, in the order of
    `covariance` (P, P): `sensitivity`, `spring_time_s` (where it is unknown), then those of the chain. `residual` (K,):
    measured less the model with all common errors found. `chi_squared` holds residuals, common errors and what is known
    beforehand of τ and S₀; `dof`, and the `probability` of a χ² as large by chance. The noise is enlarged to χ²/dof in
    the covariance where that exceeds one. `converged`: whether the fit settled; it does not where the readings leave
    parameters open, or are nothing like the model.
    """

    sensitivity: float
    spring_time_s: float
    chain: Chain
    unit: str
    parameters: tuple[str, ...]
    covariance: FloatArray
    unknowns: tuple[NamedUnknown, ...]
    residual: ComplexArray
    chi_squared: float
    dof: int
    probability: float
    converged: bool

    def __post_init__(self) -> None:
        check_shape("covariance", self.covariance, (len(self.parameters), len(self.parameters)))

    def model(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return S(f) (K,) of the fitted parameters, without common errors."""
        lag = 1.0 + laplace(frequency_hz) * self.spring_time_s
        return np.asarray(self.sensitivity / lag * self.chain.response(frequency_hz))

    def u(self, parameter: str) -> float:
        """Return the standard uncertainty of a parameter, 0 of one that was not fitted."""
        if parameter not in self.parameters:
            return 0.0
        place = self.parameters.index(parameter)
        return float(np.sqrt(self.covariance[place, place]))

    @property
    def estimates(self) -> tuple[ParameterEstimate, ...]:
        """Parameters in the order of `covariance`, then corner frequency and damping ratio of a low-pass."""
        values = {"sensitivity": self.sensitivity, "spring_time_s": self.spring_time_s}
        values |= dict(zip(self.chain.names, self.chain.parameters.tolist(), strict=True))
        found = [
            ParameterEstimate("sensitivity", "static sensitivity", self.sensitivity, self.u("sensitivity"), self.unit)
        ]
        for name in self.parameters[1:]:
            label, unit = LABELS.get(name, "square term of the chain"), "s²" if name == "square_s2" else "s"
            found.append(ParameterEstimate(name, label, values[name], self.u(name), unit))
        count = len(self.chain.names)
        corner = self.chain.corner(self.covariance[-count:, -count:]) if count else None
        if corner is not None:
            (frequency, u_frequency), (damping, u_damping) = corner
            found.append(ParameterEstimate("corner_hz", "corner frequency of the chain", frequency, u_frequency, "Hz"))
            if self.chain.kind == "second_order":
                found.append(ParameterEstimate("damping_ratio", "damping ratio of the chain", damping, u_damping, "1"))
        return tuple(found)


def fit_chain(
    measured: MeasuredSensitivity, kind: ChainKind, spring: SpringPrior | None, *, spring_free: bool = False
) -> SensitivityFit:
    """Fit S₀, τ = b/k and a chain of one kind to a measured sensitivity (K lines).

    Measured is S₀ / (1 + jωτ) · chain · exp(Σ z r): r are the relative errors by name, z ~ N(0, 1) unknown, so that no
    covariance is made of the readings. τ is held by `spring` within its uncertainty; `spring_free` lets it be any;
    without either it is 0, since a lag of the chain and one of the spring are the same curve. A static sensitivity
    that is stated is one more reading of S₀. Levenberg-Marquardt (MINPACK) on whitened residuals.
    """
    from scipy import optimize, special

    lines = len(measured.frequency_hz)
    if lines < 4:
        raise ValueError(f"frequency_hz: expected at least 4 lines, found {lines}")
    problem = _problem(measured, kind, spring, spring_free)
    solution = optimize.least_squares(
        problem.residual,
        problem.start(),
        problem.jacobian,
        method="lm",
        x_scale="jac",
        ftol=_TOLERANCE,
        xtol=_TOLERANCE,
        max_nfev=_EVALUATIONS,
    )
    chi_squared, dof = float(2.0 * solution.cost), len(solution.fun) - len(solution.x)
    jacobian = problem.jacobian(solution.x)
    jacobian[: 2 * lines] /= np.sqrt(max(1.0, chi_squared / dof))
    covariance = _inverse_normal(jacobian)
    count = len(problem.names)
    remaining = np.sqrt(covariance.diagonal()[count:])
    scale, tau, chain = problem.split(solution.x)
    return SensitivityFit(
        sensitivity=scale,
        spring_time_s=tau,
        chain=chain,
        unit=measured.unit,
        parameters=problem.names,
        covariance=covariance[:count, :count],
        unknowns=tuple(
            NamedUnknown(error.name, float(z), float(left))
            for error, z, left in zip(measured.errors, solution.x[count:], remaining, strict=True)
        ),
        residual=np.asarray(measured.value - problem.curve(solution.x)),
        chi_squared=chi_squared,
        dof=dof,
        probability=float(special.chdtrc(dof, chi_squared)),
        converged=bool(solution.success),
    )


@dataclass(frozen=True)
class _Problem:
    """Residuals of a measured sensitivity over unknowns x = [S₀, τ where unknown, chain, z of each common error].

    `names`: the unknowns but for z; `time_s`: τ where it is none of them, else where to start; `known`: (place, value,
    u) of unknowns known beforehand; `relative` (K, E); `whitening` (K, 2, 2) turns noise into that of variance one.
    """

    frequency_hz: FloatArray
    value: ComplexArray
    whitening: FloatArray
    relative: ComplexArray
    kind: ChainKind
    names: tuple[str, ...]
    time_s: float
    known: tuple[tuple[int, float, float], ...]

    def split(self, x: FloatArray) -> tuple[float, float, Chain]:
        """Return S₀, τ and the chain of the unknowns."""
        time = float(x[1]) if "spring_time_s" in self.names else self.time_s
        end = len(self.names)
        return float(x[0]), time, Chain(self.kind, np.array(x[end - len(CHAIN_PARAMETERS[self.kind]) : end]))

    def curve(self, x: FloatArray) -> ComplexArray:
        """Return the sensitivity (K,) with common errors."""
        scale, time, chain = self.split(x)
        errors = np.exp(self.relative @ x[len(self.names) :])
        return np.asarray(scale / (1.0 + self._s * time) * chain.response(self.frequency_hz) * errors)

    def residual(self, x: FloatArray) -> FloatArray:
        """Return measured less curve, whitened, then what is known beforehand and z: the sum of their squares is χ²."""
        known = np.array([(x[place] - value) / u for place, value, u in self.known])
        away = self._whitened((self.value - self.curve(x))[:, None])[:, 0]
        return np.concatenate([away, known, x[len(self.names) :]])

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Return the derivatives of `residual` by the unknowns."""
        _, time, chain = self.split(x)
        slopes = [np.full((len(self.value), 1), 1.0 / x[0])]
        slopes += [(-self._s / (1.0 + self._s * time))[:, None]] if "spring_time_s" in self.names else []
        slopes += [chain.log_slopes(self.frequency_hz), self.relative]
        unit = np.eye(len(x))
        known = [unit[place] / u for place, _, u in self.known]
        lines = -self._whitened(self.curve(x)[:, None] * np.concatenate(slopes, axis=1))
        return np.vstack([lines, *known, unit[len(self.names) :]])

    def start(self) -> FloatArray:
        """Return starting values: sign and delay from the phases, the rest from the magnitudes.

        1/|chain|² = 1 + (a₁² - 2a₂)ω² + a₂²ω⁴, so that its slope over ω² tells a lag from a delay.
        """
        sign, delay = _sign_and_delay(self.frequency_hz, self.value)
        smallest = _SMALLEST_TURN / float(np.abs(self._s).max())
        slope, static = np.polyfit(np.abs(self._s) ** 2, np.abs(self.value) ** -2.0, 1)
        static = static if static > 0.0 else float(np.median(np.abs(self.value) ** -2.0))
        bend = float(slope / static)
        lag = max(np.sqrt(max(bend, 0.0)), smallest)
        one = np.copysign(max(abs(delay), smallest), delay)
        shapes = {"none": (), "delay_lag": (delay - lag, lag), "second_order": (one, 0.5 * (one * one - bend))}
        time = () if "spring_time_s" not in self.names else (self.time_s or lag,)
        return np.array([sign * static**-0.5, *time, *shapes.get(self.kind, (one,)), *np.zeros(self.relative.shape[1])])

    @property
    def _s(self) -> ComplexArray:
        """Laplace variable jω (K,)."""
        return laplace(self.frequency_hz)

    def _whitened(self, columns: ComplexArray) -> FloatArray:
        """Return complex columns (K, P) as real ones (2K, P) in units of the noise."""
        both = np.stack([columns.real, columns.imag], axis=1)
        return np.asarray((self.whitening @ both).reshape(-1, columns.shape[1]))


def _problem(measured: MeasuredSensitivity, kind: ChainKind, spring: SpringPrior | None, spring_free: bool) -> _Problem:
    """Return the least-squares problem of a measured sensitivity."""
    known: list[tuple[int, float, float]] = []
    if measured.static is not None:
        if not measured.u_static > 0.0:
            raise ValueError(f"u_static: expected a value above 0, found {measured.u_static:g}")
        known.append((0, measured.static, measured.u_static))
    held = spring is not None and not spring_free and spring.u_time_s > 0.0
    if held and spring is not None:
        known.append((1, spring.time_s, spring.u_time_s))
    try:
        whitening = np.linalg.inv(np.linalg.cholesky(measured.covariance))
    except np.linalg.LinAlgError as error:
        raise ValueError("covariance: expected positive definite matrices (K, 2, 2), found others") from error
    lines = len(measured.frequency_hz)
    return _Problem(
        frequency_hz=np.asarray(measured.frequency_hz, dtype=np.float64),
        value=measured.value,
        whitening=np.asarray(whitening),
        relative=np.concatenate([np.empty((lines, 0)), *(error.relative for error in measured.errors)], axis=1),
        kind=kind,
        names=("sensitivity", *(("spring_time_s",) if held or spring_free else ()), *CHAIN_PARAMETERS[kind]),
        time_s=spring.time_s if spring is not None else 0.0,
        known=tuple(known),
    )


def _sign_and_delay(frequency_hz: FloatArray, value: ComplexArray) -> tuple[float, float]:
    """Return the sign of S₀ and the delay that together leave the smallest phases."""
    angular = 2.0 * np.pi * frequency_hz
    best = (np.inf, 1.0, 0.0)
    for sign in (1.0, -1.0):
        phase = np.unwrap(np.angle(sign * value))
        for delay in (0.0, -float(angular @ phase / (angular @ angular))):
            left = float(np.sum(np.abs(np.angle(sign * value * np.exp(1j * angular * delay)))))
            best = min(best, (left, sign, delay))
    return best[1], best[2]


def _inverse_normal(jacobian: FloatArray) -> FloatArray:
    """Return (JᵀJ)⁻¹ by QR of scaled columns."""
    scale = np.linalg.norm(jacobian, axis=0)
    root = np.linalg.inv(np.linalg.qr(jacobian / scale, mode="r"))
    return np.asarray(root @ root.T / np.multiply.outer(scale, scale))
