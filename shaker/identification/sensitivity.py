"""Influence of damper and measuring chain on the sensitivity over frequency, with model selection."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker.identification.measured_curves import (
    MeasuredSensitivity,
    NamedUnknown,
    ParameterEstimate,
    whitening_matrices,
)
from shaker.identification.sensor import CHAIN_PARAMETERS, ChainKind, ChainModel, SensorModel
from shaker.mechanics import laplace
from shaker.model_notices import FIT_NOT_CONVERGED, OUTPUT_LEADS, STATED_ERROR_TOO_SMALL
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, check_shape
from shakercal._common.fitting import LMOptions, WhitenedResiduals, levenberg_marquardt
from shakercal._common.notices import Notice


@dataclass(frozen=True)
class SpringPrior:
    """Stiffness and damping of a resonance, standard uncertainties and correlation, SI units."""

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
    def time_s(self) -> float:
        """τ = b/k in s, the time constant of the damper's lag."""
        return self.b / self.k

    @property
    def u_time_s(self) -> float:
        """Standard uncertainty of b/k in s."""
        mixed = self.r_kb * self.u_k * self.u_b
        slope = np.array([-self.b / self.k**2, 1.0 / self.k])
        return float(np.sqrt(slope @ np.array([[self.u_k**2, mixed], [mixed, self.u_b**2]]) @ slope))


# The sensor's damper and one shape of the chain fitted to a measured sensitivity.

LABELS = {
    "sensitivity": "static sensitivity",
    "spring_time_s": "b/k of the sensor",
    "delay_s": "delay of the chain",
    "lag_s": "lag of the chain",
    "square_s2": "square term of the chain",
    "corner_hz": "corner frequency of the chain",
    "damping_ratio": "damping ratio of the chain",
}
"""The parameters of a `SensitivityFit` in words."""
_RULES = LMOptions(predicted_decrease=1e-12, predicted_decrease_share=1e-12, max_steps=200)
_SMALLEST_TURN = 0.01  # rad at the highest line: start of a lag that differs from a delay


@dataclass(frozen=True, repr=False)
class SensitivityFit(Arrays, shapes="parameters P; covariance P P"):
    """Lag and chain fitted to a measured sensitivity.

    S(f) = S₀ / (1 + jωτ) · chain(f) with τ = b/k. `sensitivity` S₀ in `unit`; `spring_time_s` τ. `parameters` (P,):
    names in the order of `covariance` (P, P): `sensitivity`, `spring_time_s` (if it is unknown), then those of the
    chain. `residual` (K,): measured minus model with all common errors as estimated. `chi_squared`: of residuals,
    common errors and the priors of τ and S₀, with `dof` and the `probability` of a χ² at least as large. If χ²/dof is
    above one, the noise is enlarged to it in the covariance. `converged` is False if the readings do not determine the
    parameters or do not follow the model.
    """

    sensitivity: float
    spring_time_s: float
    chain: ChainModel
    unit: str
    parameters: tuple[str, ...]
    covariance: FloatArray
    unknowns: tuple[NamedUnknown, ...]
    residual: ComplexArray
    chi_squared: float
    dof: int
    probability: float
    converged: bool

    def model(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return S(f) (K,) of the fitted parameters, without common errors."""
        lag = 1.0 + laplace(frequency_hz) * self.spring_time_s
        return np.asarray(self.sensitivity / lag * self.chain.response(frequency_hz))

    def u(self, parameter: str) -> float:
        """Return the standard uncertainty of a parameter, 0 if it was not fitted."""
        if parameter not in self.parameters:
            return 0.0
        index = self.parameters.index(parameter)
        return float(np.sqrt(self.covariance[index, index]))

    @property
    def estimates(self) -> tuple[ParameterEstimate, ...]:
        """Parameters in the order of `covariance`, then corner frequency and damping ratio of a low-pass."""
        values = {"sensitivity": self.sensitivity, "spring_time_s": self.spring_time_s}
        values |= dict(zip(self.chain.names, self.chain.parameters.tolist(), strict=True))
        units = {"sensitivity": self.unit, "square_s2": "s²"}
        estimates = [
            ParameterEstimate(name, LABELS[name], values[name], self.u(name), units.get(name, "s"))
            for name in self.parameters
        ]
        count = len(self.chain.names)
        corner = self.chain.corner(self.covariance[-count:, -count:]) if count else None
        if corner is not None:
            estimates.append(ParameterEstimate("corner_hz", LABELS["corner_hz"], *corner[0], "Hz"))
            if self.chain.kind == "second_order":
                estimates.append(ParameterEstimate("damping_ratio", LABELS["damping_ratio"], *corner[1], "1"))
        return tuple(estimates)


def fit_chain(
    measured: MeasuredSensitivity, kind: ChainKind, spring: SpringPrior | None, *, spring_free: bool = False
) -> SensitivityFit:
    """Fit S₀, τ = b/k and a chain of one kind to a sensitivity.

    The measured value is S₀ / (1 + jωτ) · chain · exp(Σ z r) with relative errors r by name and unknowns z ~ N(0, 1).
    `spring` is the prior of τ; `spring_free` makes τ free. Without either τ is 0, because a lag of the chain and one of
    the spring have the same curve. A stated static sensitivity is one more reading of S₀.
    """
    from scipy.special import chdtrc

    lines = len(measured.frequency_hz)
    if lines < 4:
        raise ValueError(f"frequency_hz: expected at least 4 lines, found {lines}")
    problem = _ChainProblem.of(measured, kind, spring, spring_free)
    search = levenberg_marquardt(problem.point, problem.point(problem.start()), _RULES)
    point, count = search.point, len(problem.names)
    chi_squared, dof = point.loss, len(point.residual) - len(point.parameters)
    jacobian = point.jacobian.copy()
    jacobian[: 2 * lines] /= np.sqrt(max(1.0, chi_squared / dof))
    size = np.linalg.norm(jacobian, axis=0)
    root = np.linalg.inv(np.linalg.qr(jacobian / size, mode="r"))
    covariance = np.asarray(root @ root.T / np.multiply.outer(size, size))
    remaining = np.sqrt(covariance.diagonal()[count:])
    scale, tau, chain = problem.split(point.parameters)
    return SensitivityFit(
        sensitivity=scale,
        spring_time_s=tau,
        chain=chain,
        unit=measured.unit,
        parameters=problem.names,
        covariance=covariance[:count, :count],
        unknowns=tuple(
            NamedUnknown(error.name, float(z), float(left))
            for error, z, left in zip(measured.errors, point.parameters[count:], remaining, strict=True)
        ),
        residual=np.asarray(measured.value - problem.curve(point.parameters)),
        chi_squared=chi_squared,
        dof=dof,
        probability=float(chdtrc(dof, chi_squared)),
        converged=search.converged,
    )


@dataclass(frozen=True)
class _ChainProblem:
    """A measured sensitivity with its unknowns x = [S₀, τ if unknown, chain, z].

    `names`: the unknowns except z of common errors. `time_s`: τ if it is fixed, else its start. `priors`: (index,
    value, u) of unknowns with a prior. `relative` (K, E). `whitening` (K, 2, 2).
    """

    measured: MeasuredSensitivity
    kind: ChainKind
    names: tuple[str, ...]
    time_s: float
    priors: tuple[tuple[int, float, float], ...]
    relative: ComplexArray
    whitening: FloatArray

    @staticmethod
    def of(
        measured: MeasuredSensitivity, kind: ChainKind, spring: SpringPrior | None, spring_free: bool
    ) -> _ChainProblem:
        priors: list[tuple[int, float, float]] = []
        if measured.static is not None:
            if not measured.u_static > 0.0:
                raise ValueError(f"u_static: expected a value above 0, found {measured.u_static:g}")
            priors.append((0, measured.static, measured.u_static))
        has_prior = spring is not None and not spring_free and spring.u_time_s > 0.0
        if has_prior and spring is not None:
            priors.append((1, spring.time_s, spring.u_time_s))
        names = ("sensitivity", *(("spring_time_s",) if has_prior or spring_free else ()), *CHAIN_PARAMETERS[kind])
        priors += [(len(names) + number, 0.0, 1.0) for number in range(len(measured.errors))]
        relative = [np.empty((len(measured.value), 0)), *(error.relative for error in measured.errors)]
        time_s = 0.0 if spring is None else spring.time_s
        whitening = whitening_matrices(measured.covariance)
        return _ChainProblem(measured, kind, names, time_s, tuple(priors), np.concatenate(relative, axis=1), whitening)

    def split(self, x: FloatArray) -> tuple[float, float, ChainModel]:
        """Return S₀, τ and the chain of the unknowns."""
        time = float(x[1]) if "spring_time_s" in self.names else self.time_s
        end = len(self.names)
        return float(x[0]), time, ChainModel(self.kind, np.array(x[end - len(CHAIN_PARAMETERS[self.kind]) : end]))

    def curve(self, x: FloatArray) -> ComplexArray:
        """Return the sensitivity (K,) with common errors."""
        scale, time, chain = self.split(x)
        hertz, errors = self.measured.frequency_hz, np.exp(self.relative @ x[len(self.names) :])
        return np.asarray(scale / (1.0 + laplace(hertz) * time) * chain.response(hertz) * errors)

    def point(self, x: FloatArray) -> WhitenedResiduals:
        """Return whitened residuals and then those of the priors; the sum of squares is χ²."""
        _, time, chain = self.split(x)
        s, curve = laplace(self.measured.frequency_hz), self.curve(x)
        slopes = [np.full((len(s), 1), 1.0 / x[0])]
        slopes += [(-s / (1.0 + s * time))[:, None]] if "spring_time_s" in self.names else []
        slopes += [chain.log_slopes(self.measured.frequency_hz), self.relative]
        columns = np.column_stack([self.measured.value - curve, -curve[:, None] * np.concatenate(slopes, axis=1)])
        lines = (self.whitening @ np.stack([columns.real, columns.imag], axis=1)).reshape(-1, 1 + len(x))
        unit = np.eye(len(x))
        rows = [np.append(x[index] - value, unit[index]) / u for index, value, u in self.priors]
        both = np.vstack([lines, *rows])
        return WhitenedResiduals(x, both[:, 0], both[:, 1:])

    def start(self) -> FloatArray:
        """Return start values: sign and delay from phases, the rest from magnitudes.

        1/|chain|² = 1 + (a₁² - 2a₂)ω² + a₂²ω⁴: its slope over ω² distinguishes a lag from a delay.
        """
        angular, value = 2.0 * np.pi * self.measured.frequency_hz, self.measured.value
        left = []
        for sign in (1.0, -1.0):  # sign and delay of the smallest remaining phases
            phase = np.unwrap(np.angle(sign * value))
            for delay in (0.0, -float(angular @ phase / (angular @ angular))):
                rotated = np.angle(sign * value * np.exp(1j * angular * delay))
                left.append((float(np.sum(np.abs(rotated))), sign, delay))
        _, sign, delay = min(left, key=lambda one: one[0])
        smallest = _SMALLEST_TURN / float(angular.max())
        slope, static = np.polyfit(angular**2, np.abs(value) ** -2.0, 1)
        static = static if static > 0.0 else float(np.median(np.abs(value) ** -2.0))
        bend = float(slope / static)
        lag = max(np.sqrt(max(bend, 0.0)), smallest)
        one = np.copysign(max(abs(delay), smallest), delay)
        shapes = {"none": (), "delay_lag": (delay - lag, lag), "second_order": (one, 0.5 * (one * one - bend))}
        time = () if "spring_time_s" not in self.names else (self.time_s or lag,)
        return np.array([sign * static**-0.5, *time, *shapes.get(self.kind, (one,)), *np.zeros(self.relative.shape[1])])


def sensor_model(fit: SensitivityFit, mechanics: FloatArray, covariance: FloatArray) -> SensorModel:
    """Join a sensitivity with `mechanics` (3,) [k, b, m_i] of an identification and their `covariance`.

    The fit must have used the same k and b in its `SpringPrior`. Its information on τ = b/k changes k, b and m_i along
    C·g, with g = ∂τ/∂[k, b, m_i] and their covariance C (3, 3).
    """
    check_shape("mechanics", mechanics, (3,))
    check_shape("covariance", covariance, (3, 3))
    k, b = float(mechanics[0]), float(mechanics[1])
    slope = np.array([-b / k**2, 1.0 / k, 0.0])
    variance = float(slope @ covariance @ slope)
    fitted = "spring_time_s" in fit.parameters
    if fitted != (variance > 0.0) or (not fitted and fit.spring_time_s != b / k):
        raise ValueError("fit: expected one with b/k of these k and b, found another")
    others = [index for index, name in enumerate(fit.parameters) if name != "spring_time_s"]
    joined = np.zeros((3 + len(others), 3 + len(others)))
    joined[:3, :3] = covariance
    joined[3:, 3:] = fit.covariance[np.ix_(others, others)]
    moved = np.asarray(mechanics, dtype=np.float64)
    if fitted:
        gain = covariance @ slope / variance
        moved = moved + gain * (fit.spring_time_s - b / k)
        joined[:3, :3] -= np.multiply.outer(gain, gain) * (variance - fit.covariance[1, 1])
        joined[:3, 3:] = np.multiply.outer(gain, fit.covariance[1, others])
        joined[3:, :3] = joined[:3, 3:].T
    order = [3, 0, 1, 2, *range(4, len(joined))]
    stiffness, damping, mass = moved.tolist()
    covariance = joined[np.ix_(order, order)]
    return SensorModel(fit.sensitivity, stiffness, damping, mass, fit.chain, covariance, fit.unit)


# Causes of a frequency-dependent sensitivity: the sensor's damper, or the measuring chain.

Verdict = Literal["supported", "more than needed", "refuted"]

SIGNIFICANCE = 0.01
"""Probability below which a test rejects, 1 % by convention."""
SMALLEST_WEIGHT = 0.05
"""Akaike weight, relative to the best, below which an explanation is refuted by a better one (Δ AICc of 6)."""
FARTHEST_ERROR = 3.0
"""Standard uncertainties of a common error above which its statement is doubtful, 3 σ."""
CHAIN_WORDS: dict[ChainKind, str] = {
    "none": "the sensor's damper alone",
    "delay": "a delay",
    "lag": "a first-order lag",
    "butterworth": "a Butterworth low-pass",
    "second_order": "a low-pass of second order",
    "delay_lag": "a delay with a first-order lag",
}
"""Each explanation in words, if the resonance determines the damping of the sensor."""
WORDS_WITHOUT_RESONANCE = CHAIN_WORDS | {"none": "a constant sensitivity"}
"""Each explanation in words without a resonance: the lag is that of chain and damper together."""
_PART_OF: dict[ChainKind, tuple[ChainKind, ...]] = {
    "none": (),
    "delay": ("none",),
    "lag": ("none",),
    "butterworth": ("none",),
    "second_order": ("none", "lag", "butterworth"),
    "delay_lag": ("none", "delay", "lag"),
}


@dataclass(frozen=True)
class DampingTest:
    """Comparison of b/k from the sensitivity and from the resonance width.

    In s; the sensitivity is fitted without a chain. `deviation`: √Δχ² with the sign of the difference. Δχ² is the
    growth of χ² if b/k has the prior of the resonance, divided by χ²/dof if that is above one. Small differences give
    the difference over its standard uncertainty. The test is also right if the magnitude depends on (b/k)².
    `probability` of a deviation at least as large.
    """

    needed_s: float
    u_needed_s: float
    resonance_s: float
    u_resonance_s: float
    deviation: float
    probability: float
    text: str

    @property
    def contradicts(self) -> bool:
        """Whether the two values contradict each other."""
        return self.probability < SIGNIFICANCE


@dataclass(frozen=True, repr=False)
class SensitivityComparison(Arrays, shapes="fits E; weight E"):
    """Explanations of one sensitivity: `fits` (E), Akaike `weight` (E,) with sum 1, `verdict` (E).

    `spring`: k and b of the resonance, None without one. `damping`: test whether S(f) without a chain agrees with it.
    `text`: a sentence on the explanations that the data support or refute.
    """

    fits: tuple[SensitivityFit, ...]
    weight: FloatArray
    verdict: tuple[Verdict, ...]
    spring: SpringPrior | None
    damping: DampingTest | None
    text: str
    notices: tuple[Notice, ...]

    @property
    def best(self) -> SensitivityFit:
        """The supported explanation of largest weight; without a supported one, that of largest weight."""
        supported = [i for i, verdict in enumerate(self.verdict) if verdict == "supported"] or range(len(self.fits))
        return self.fits[max(supported, key=lambda i: float(self.weight[i]))]

    def __getitem__(self, kind: ChainKind) -> SensitivityFit:
        """Return the fit of one kind of chain."""
        return next(fit for fit in self.fits if fit.chain.kind == kind)


def fit_sensitivity(measured: MeasuredSensitivity, spring: SpringPrior | None = None) -> SensitivityComparison:
    """Fit every explanation of a sensitivity, compare them, and test the damping against the resonance.

    With `spring` every explanation contains the lag 1/(1 + jωb/k) of the sensor, with the prior of b/k. Without it this
    lag and that of the chain have the same curve and are one lag. Weights: AICc = χ²/ĉ + 2p + 2p(p + 1)/(n - p - 1) for
    p free parameters and n real readings. ĉ = χ²/dof of the best explanation if it is above one (Burnham and Anderson,
    Model selection, 2002, 2.5). An explanation is refuted if χ² is too large (`SIGNIFICANCE`), the filter is unstable,
    or its weight is too small and no part of it is supported. It is more than needed if a part of it is supported too.
    """
    fits = tuple(fit_chain(measured, kind, spring) for kind in CHAIN_PARAMETERS)
    readings = 2 * len(measured.value) + (measured.static is not None)
    enlarged = max(1.0, min(fit.chi_squared / fit.dof for fit in fits))
    free = np.array([1.0 + len(fit.chain.names) for fit in fits])
    criterion = np.array([fit.chi_squared for fit in fits]) / enlarged
    criterion += 2.0 * free + 2.0 * free * (free + 1.0) / (readings - free - 1.0)
    weight = np.exp(-0.5 * (criterion - criterion.min()))
    weight /= weight.sum()
    verdict = _verdicts(fits, weight)
    damping = None if spring is None else _damping_test(measured, fits[0], spring)
    compared = SensitivityComparison(
        fits, weight, verdict, spring, damping, _sentence(fits, verdict, spring is None), ()
    )
    return replace(compared, notices=tuple(_notices(compared.best, measured.channel)))


def _verdicts(fits: tuple[SensitivityFit, ...], weight: FloatArray) -> tuple[Verdict, ...]:
    """Return the verdict of the data on each explanation."""
    acceptable = {fit.chain.kind for fit in fits if fit.probability >= SIGNIFICANCE}
    supported = set()
    for fit, share in zip(fits, weight / weight.max(), strict=True):
        # A stable filter: a₁ and a₂ are not significantly negative (2 u).
        stable = all(getattr(fit.chain, name) >= -2.0 * fit.u(name) for name in fit.chain.names if name != "delay_s")
        if fit.chain.kind in acceptable and share >= SMALLEST_WEIGHT and stable:
            supported.add(fit.chain.kind)

    def verdict(kind: ChainKind) -> Verdict:
        if kind in acceptable and supported.intersection(_PART_OF[kind]):
            return "more than needed"
        return "supported" if kind in supported else "refuted"

    return tuple(verdict(fit.chain.kind) for fit in fits)


def _damping_test(measured: MeasuredSensitivity, restricted: SensitivityFit, spring: SpringPrior) -> DampingTest:
    """Compare b/k fitted to S(f) without a chain with b/k of the resonance."""
    from scipy import special

    needed = fit_chain(measured, "none", None, spring_free=True)
    growth = max(0.0, restricted.chi_squared - needed.chi_squared) / max(1.0, needed.chi_squared / needed.dof)
    deviation = float(np.copysign(np.sqrt(growth), needed.spring_time_s - spring.time_s))
    probability = float(special.erfc(abs(deviation) / np.sqrt(2.0)))
    u_needed = needed.u("spring_time_s")
    from_curve = _microseconds(needed.spring_time_s, u_needed)
    from_width = _microseconds(spring.time_s, spring.u_time_s)
    conclusion = "they contradict each other" if probability < SIGNIFICANCE else "they agree"
    text = (
        f"Without a chain the sensitivity requires b/k = {from_curve}, the width of the resonance gives {from_width}: "
        f"{conclusion} (normalised deviation {deviation:.1f})"
    )
    if needed.probability < SIGNIFICANCE:
        text += f", and the curve does not fit (χ²/dof = {needed.chi_squared / needed.dof:.1f})"
    seen = needed.spring_time_s, u_needed, spring.time_s, spring.u_time_s
    return DampingTest(*seen, deviation, probability, f"{text}.")


def _sentence(fits: tuple[SensitivityFit, ...], verdict: tuple[Verdict, ...], alone: bool) -> str:
    """Return a sentence on the explanations that the data support and refute."""
    words = WORDS_WITHOUT_RESONANCE if alone else CHAIN_WORDS
    named: dict[Verdict, list[str]] = {"supported": [], "more than needed": [], "refuted": []}
    for fit, kind in zip(fits, verdict, strict=True):
        named[kind].append(_explained(fit, alone) if kind == "supported" else words[fit.chain.kind])
    if not named["supported"]:
        best = min(fits, key=lambda fit: fit.chi_squared / fit.dof)
        text = f"The data support none of these explanations: even {_explained(best, alone)} leaves χ²/dof = "
        return f"{text}{best.chi_squared / best.dof:.1f}; a cause is missing, or uncertainties are stated too small."

    def listed(kind: Verdict, last: str) -> str:
        *first, end = named[kind]
        return f"{', '.join(first)} {last} {end}" if first else end

    parts = [f"The data support {listed('supported', 'or')}"]
    parts += [f"do not need {listed('more than needed', 'or')}"] if named["more than needed"] else []
    parts += [f"refute {listed('refuted', 'and')}"] if named["refuted"] else []
    return "; they ".join(parts) + "."


def _explained(fit: SensitivityFit, alone: bool) -> str:
    chain = fit.chain
    numbers = {name: _microseconds(getattr(chain, name), fit.u(name)) for name in ("delay_s", "lag_s")}
    for estimate in fit.estimates:
        numbers.setdefault(estimate.name, _with_u(estimate.value, estimate.u, estimate.unit))
    corner = f" with f_c = {numbers['corner_hz']}" if "corner_hz" in numbers else f" delaying by {numbers['lag_s']}"
    damping = f" and ζ = {numbers['damping_ratio']}" if "damping_ratio" in numbers else ""
    where = " in the chain or the sensor's damper" if alone and "lag_s" in chain.names else " in the chain"
    text: dict[ChainKind, str] = {
        "none": (WORDS_WITHOUT_RESONANCE if alone else CHAIN_WORDS)["none"],
        "delay": f"a delay of {numbers['delay_s']} in the chain",
        "lag": f"a first-order lag of {numbers['lag_s']}{where}",
        "butterworth": f"a Butterworth low-pass{corner} in the chain",
        "second_order": f"a low-pass of second order{corner}{damping}{where}",
        "delay_lag": f"a delay of {numbers['delay_s']} with a first-order lag of {numbers['lag_s']}{where}",
    }
    return text[chain.kind]


def _notices(fit: SensitivityFit, channel: str) -> Iterator[Notice]:
    """Yield doubts about the explanation in use."""
    if fit.chain.delay_s < -2.0 * fit.u("delay_s"):
        yield Notice(OUTPUT_LEADS, channel, lead_us=-1e6 * fit.chain.delay_s, expanded_us=2e6 * fit.u("delay_s"))
    if not fit.converged:
        yield Notice(FIT_NOT_CONVERGED, channel, model="the measuring chain")
    for error in fit.unknowns:
        if abs(error.estimate) > FARTHEST_ERROR:
            yield Notice(STATED_ERROR_TOO_SMALL, channel, cause=error.name, deviation=abs(error.estimate))


def _microseconds(value_s: float, u_s: float) -> str:
    """Return a time in µs with its expanded uncertainty, k = 2."""
    return _with_u(1e6 * value_s, 1e6 * u_s, "µs")


def _with_u(value: float, u: float, unit: str) -> str:
    """Return a number with its expanded uncertainty (k = 2, two digits)."""
    if not u > 0.0:
        return f"{value:.4g} {unit}"
    digits = max(0, 1 - int(np.floor(np.log10(2.0 * u))))
    text = f"{value:.{digits}f} ± {2.0 * u:.{digits}f}"
    return text if unit == "1" else f"({text}) {unit}"
