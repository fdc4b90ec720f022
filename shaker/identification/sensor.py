"""The sensor as a model: output over force with a load."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, Notice, check_shape
from shaker.frf.chain import ChainResponse
from shaker.identification.measured import MeasuredSensitivity
from shaker.identification.sensitivity import (
    CHAIN_PARAMETERS,
    Chain,
    ChainKind,
    SensitivityFit,
    SpringPrior,
    fit_chain,
    laplace,
)

# What makes the sensitivity change with frequency: the sensor's damper, or the measuring chain behind it.


Verdict = Literal["supported", "more than needed", "refuted"]

SIGNIFICANCE = 0.01
"""Probability below which a test refutes."""
SMALLEST_WEIGHT = 0.05
"""Akaike weight, relative to the best, below which an explanation is refuted by a better one."""
FARTHEST_ERROR = 3.0
"""Standard uncertainties of a common error beyond which the fit stretches it."""
CHAIN_WORDS: dict[ChainKind, str] = {
    "none": "the sensor's damper alone",
    "delay": "a delay",
    "lag": "a first-order lag",
    "butterworth": "a Butterworth low-pass",
    "second_order": "a low-pass of second order",
    "delay_lag": "a delay with a first-order lag",
}
"""What each explanation says of the chain, where the resonance tells the sensor's own damping."""
WORDS_WITHOUT_RESONANCE = CHAIN_WORDS | {"none": "a constant sensitivity"}
"""What each says where nothing does: its lag is that of the chain and of the sensor's damper together."""
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
    """b/k that the sensitivity would need with no chain against that of the resonance's width, with u in s.

    `deviation`: √Δχ² with the sign of their difference, Δχ² what χ² grows by when b/k is held by the resonance (over
    χ²/dof where that exceeds one): for small differences the difference over its standard uncertainty, but right as
    well where the magnitude hangs on (b/k)². `probability` of a deviation as large by chance.
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
        """Whether the two cannot both be right."""
        return self.probability < SIGNIFICANCE


@dataclass(frozen=True)
class SensitivityComparison:
    """Explanations of one sensitivity: `fits` (E), Akaike `weight` (E,), sum 1, and `verdict` (E).

    `spring`: what the resonance says of k and b, None where nothing does; `damping`: whether S(f) with no chain agrees
    with it, None without it. `text`: in one sentence, which explanations the data support and which they refute.
    """

    fits: tuple[SensitivityFit, ...]
    weight: FloatArray
    verdict: tuple[Verdict, ...]
    spring: SpringPrior | None
    damping: DampingTest | None
    text: str
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        check_shape("weight", self.weight, (len(self.fits),))

    @property
    def best(self) -> SensitivityFit:
        """The explanation to use: the supported one of the largest weight; with none supported, of all."""
        supported = [i for i, verdict in enumerate(self.verdict) if verdict == "supported"] or range(len(self.fits))
        return self.fits[max(supported, key=lambda i: float(self.weight[i]))]

    def __getitem__(self, kind: ChainKind) -> SensitivityFit:
        """Return the fit of one kind of chain."""
        return next(fit for fit in self.fits if fit.chain.kind == kind)

    @property
    def labels(self) -> tuple[str, ...]:
        """What each explanation says, in words."""
        words = WORDS_WITHOUT_RESONANCE if self.spring is None else CHAIN_WORDS
        return tuple(words[fit.chain.kind] for fit in self.fits)


def fit_sensitivity(measured: MeasuredSensitivity, spring: SpringPrior | None = None) -> SensitivityComparison:
    """Fit every explanation of a sensitivity over frequency, compare them, and test the damping against the resonance.

    With `spring` every explanation has the sensor's own lag 1/(1 + jωb/k), b/k held within its uncertainty. Without it
    nothing tells that lag from one of the chain, they being the same curve: the fits then have one lag for both.
    Weights: AICc = χ²/ĉ + 2p + 2p(p + 1)/(n - p - 1) of p free parameters and n real readings, ĉ = χ²/dof of the
    explanation that fits best, where that exceeds one (Burnham and Anderson, Model selection, 2002, 2.5). Refuted is
    what leaves a χ² too large (`SIGNIFICANCE`), needs a filter that is not stable, or has too small a weight and no
    part that is supported; more than needed is an explanation of which a part is supported as well.
    """
    fits = tuple(fit_chain(measured, kind, spring) for kind in CHAIN_PARAMETERS)
    weight = _weights(fits, 2 * len(measured.value) + (measured.static is not None))
    verdict = _verdicts(fits, weight)
    damping = None if spring is None else _damping_test(measured, fits[0], spring)
    text = _sentence(fits, verdict, spring is None)
    compared = SensitivityComparison(fits, weight, verdict, spring, damping, text, ())
    return replace(compared, notices=_notices(compared.best, measured.channel))


def _weights(fits: tuple[SensitivityFit, ...], readings: int) -> FloatArray:
    """Return the Akaike weights of the fits."""
    enlarged = max(1.0, min(fit.chi_squared / fit.dof for fit in fits))
    free = np.array([1.0 + len(fit.chain.names) for fit in fits])
    chi_squared = np.array([fit.chi_squared for fit in fits])
    criterion = chi_squared / enlarged + 2.0 * free + 2.0 * free * (free + 1.0) / (readings - free - 1.0)
    weight = np.exp(-0.5 * (criterion - criterion.min()))
    return np.asarray(weight / weight.sum())


def _verdicts(fits: tuple[SensitivityFit, ...], weight: FloatArray) -> tuple[Verdict, ...]:
    """Return what the data say of each explanation."""
    acceptable = {fit.chain.kind for fit in fits if fit.probability >= SIGNIFICANCE}
    likely = {
        fit.chain.kind for fit, share in zip(fits, weight / weight.max(), strict=True) if share >= SMALLEST_WEIGHT
    }
    supported = acceptable & likely & {fit.chain.kind for fit in fits if _stable(fit)}
    found: list[Verdict] = []
    for kind in (fit.chain.kind for fit in fits):
        if kind in acceptable and supported.intersection(_PART_OF[kind]):
            found.append("more than needed")
        else:
            found.append("supported" if kind in supported else "refuted")
    return tuple(found)


def _stable(fit: SensitivityFit) -> bool:
    """Whether a chain's poles may lie on the left: a₁ and a₂ are not below 0 beyond twice their uncertainty."""
    values = {"lag_s": fit.chain.lag_s, "square_s2": fit.chain.square_s2}
    return all(values[name] >= -2.0 * fit.u(name) for name in fit.chain.names if name in values)


def _damping_test(measured: MeasuredSensitivity, held: SensitivityFit, spring: SpringPrior) -> DampingTest:
    """Compare b/k fitted to S(f) with no chain with that of the resonance, by which the other fit is held."""
    from scipy import special

    needed = fit_chain(measured, "none", None, spring_free=True)
    growth = max(0.0, held.chi_squared - needed.chi_squared) / max(1.0, needed.chi_squared / needed.dof)
    deviation = float(np.copysign(np.sqrt(growth), needed.spring_time_s - spring.time_s))
    probability = float(special.erfc(abs(deviation) / np.sqrt(2.0)))
    from_curve = _microseconds(needed.spring_time_s, needed.u("spring_time_s"))
    from_width = _microseconds(spring.time_s, spring.u_time_s)
    says = "they contradict each other" if probability < SIGNIFICANCE else "they agree"
    text = (
        f"With no chain the sensitivity needs b/k = {from_curve}, the width of the resonance gives {from_width}: {says}"
    )
    text += f" (normalised deviation {deviation:.1f})"
    if needed.probability < SIGNIFICANCE:
        text += f", and even so the curve does not fit (χ²/dof = {needed.chi_squared / needed.dof:.1f})"
    return DampingTest(
        needed_s=needed.spring_time_s,
        u_needed_s=needed.u("spring_time_s"),
        resonance_s=spring.time_s,
        u_resonance_s=spring.u_time_s,
        deviation=deviation,
        probability=probability,
        text=f"{text}.",
    )


def _sentence(fits: tuple[SensitivityFit, ...], verdict: tuple[Verdict, ...], alone: bool) -> str:
    """Say in one sentence which explanations the data support and which they refute."""
    words = WORDS_WITHOUT_RESONANCE if alone else CHAIN_WORDS
    told: dict[Verdict, list[str]] = {"supported": [], "more than needed": [], "refuted": []}
    for fit, found in zip(fits, verdict, strict=True):
        told[found].append(_told(fit, alone) if found == "supported" else words[fit.chain.kind])
    if not told["supported"]:
        best = min(fits, key=lambda fit: fit.chi_squared / fit.dof)
        text = f"The data support none of these explanations: even {_told(best, alone)} leaves χ²/dof = "
        return f"{text}{best.chi_squared / best.dof:.1f}; a cause is missing, or uncertainties are stated too small."
    parts = [f"The data support {_listed(told['supported'], 'or')}"]
    parts += [f"do not need {_listed(told['more than needed'], 'or')}"] if told["more than needed"] else []
    parts += [f"refute {_listed(told['refuted'], 'and')}"] if told["refuted"] else []
    return "; they ".join(parts) + "."


def _told(fit: SensitivityFit, alone: bool) -> str:
    """Return an explanation with its numbers."""
    kind, chain = fit.chain.kind, fit.chain
    times = {"delay_s": chain.delay_s, "lag_s": chain.lag_s}
    told = {name: _microseconds(time, fit.u(name)) for name, time in times.items()}
    for estimate in fit.estimates:
        told.setdefault(estimate.name, _with_u(estimate.value, estimate.u, estimate.unit))
    corner = f" with f_c = {told['corner_hz']}" if "corner_hz" in told else f" delaying by {told['lag_s']}"
    damping = f" and ζ = {told['damping_ratio']}" if "damping_ratio" in told else ""
    where = " in the chain or the sensor's damper" if alone and "lag_s" in chain.names else " in the chain"
    text: dict[ChainKind, str] = {
        "none": (WORDS_WITHOUT_RESONANCE if alone else CHAIN_WORDS)["none"],
        "delay": f"a delay of {told['delay_s']} in the chain",
        "lag": f"a first-order lag of {told['lag_s']}{where}",
        "butterworth": f"a Butterworth low-pass{corner} in the chain",
        "second_order": f"a low-pass of second order{corner}{damping}{where}",
        "delay_lag": f"a delay of {told['delay_s']} with a first-order lag of {told['lag_s']}{where}",
    }
    return text[kind]


def _listed(words: list[str], last: str) -> str:
    """Return words as a list in prose."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def _notices(fit: SensitivityFit, channel: str) -> tuple[Notice, ...]:
    """Say of the explanation to use what a reader should doubt."""
    found = []
    if fit.chain.delay_s < -2.0 * fit.u("delay_s"):
        lead = _microseconds(-fit.chain.delay_s, fit.u("delay_s"))
        found.append(Notice("warning", f"the output leads by {lead}: no chain does, the reference is late", channel))
    if not fit.converged:
        found.append(Notice("warning", "the fit of the chain did not settle: the readings leave it open", channel))
    for error in fit.unknowns:
        if abs(error.estimate) > FARTHEST_ERROR:
            text = f"{error.name} is found {error.estimate:.1f} of its standard uncertainties away: stated too small"
            found.append(Notice("warning", text, channel))
    return tuple(found)


def _microseconds(value_s: float, u_s: float) -> str:
    """Return a time with its expanded uncertainty, k = 2, in µs."""
    return _with_u(1e6 * value_s, 1e6 * u_s, "µs")


def _with_u(value: float, u: float, unit: str) -> str:
    """Return a number with its expanded uncertainty, k = 2, to two digits of the latter."""
    if not u > 0.0:
        return f"{value:.4g} {unit}"
    digits = max(0, 1 - int(np.floor(np.log10(2.0 * u))))
    text = f"{value:.{digits}f} ± {2.0 * u:.{digits}f}"
    return text if unit == "1" else f"({text}) {unit}"


# The sensor as a whole: what it puts out for the force on its load.


Drive = Literal["base", "force"]

SENSOR_PARAMETERS = ("sensitivity", "stiffness", "damping", "internal_mass")


@dataclass(frozen=True)
class Load:
    """A mass on the sensor and how it is driven: `base` moves under the sensor, or a `force` acts on the load.

    `mass` ± `u_mass` in kg; of a rotation the moment of inertia in kg·m².
    """

    mass: float
    drive: Drive
    u_mass: float = 0.0

    def __post_init__(self) -> None:
        if not (self.mass > 0.0 and self.u_mass >= 0.0):
            raise ValueError(
                f"mass, u_mass: expected mass > 0 and u_mass >= 0, found {self.mass:g} and {self.u_mass:g}"
            )


@dataclass(frozen=True)
class SensorModel:
    """Static `sensitivity` S₀ in `unit`, `stiffness` k, `damping` b, `internal_mass` m_i (as estimated, by
    chance below 0) and the chain behind them.

    `covariance` (4 + P, 4 + P) of [S₀, k, b, m_i, parameters of the chain]. N/m, kg/s and kg; of a rotation N·m/rad,
    N·m·s/rad and kg·m².
    """

    sensitivity: float
    stiffness: float
    damping: float
    internal_mass: float
    chain: Chain
    covariance: FloatArray
    unit: str

    def __post_init__(self) -> None:
        count = len(SENSOR_PARAMETERS) + len(self.chain.names)
        check_shape("covariance", self.covariance, (count, count))
        if not self.stiffness > 0.0:
            raise ValueError(f"stiffness: expected k > 0, found {self.stiffness:g}")

    def resonance_hz(self, load: Load) -> float:
        """Return √(k/(m + m_i))/2π, the undamped resonance with a load."""
        total = load.mass + self.internal_mass
        if not total > 0.0:
            raise ValueError(f"load: expected a mass that with the internal one is above 0, found {total:g}")
        return float(np.sqrt(self.stiffness / total) / (2.0 * np.pi))

    def output_factor(self, frequency_hz: FloatArray, load: Load) -> ComplexArray:
        """Return the output per force on the load (K,), in `unit`, at frequencies in Hz.

        `force`: S₀·k/(k − (m + m_i)ω² + jωb)·chain. `base`, where m·a is the force on the load and (m + m_i)·a that in
        the spring: S₀·(1 + m_i/m)/(1 + jωb/k)·chain.
        """
        gain = self.sensitivity * (1.0 + self.internal_mass / load.mass if load.drive == "base" else 1.0)
        return np.asarray(gain / self._divisor(laplace(frequency_hz), load) * self.chain.response(frequency_hz))

    def log_slopes(self, frequency_hz: FloatArray, load: Load) -> ComplexArray:
        """Return the derivatives (K, 4 + P + 1) of ln `output_factor` by the parameters and by the load's mass."""
        s, total = laplace(frequency_hz), load.mass + self.internal_mass
        divisor = self._divisor(s, load)
        by_force = np.asarray(-s * s / self.stiffness / divisor)
        mass = by_force if load.drive == "force" else np.full(len(s), 1.0 / total + 0j)
        own = mass if load.drive == "force" else mass - 1.0 / load.mass
        stretch = self._divisor(s, load) - 1.0
        columns = [
            np.full(len(s), 1.0 / self.sensitivity + 0j),
            stretch / self.stiffness / divisor,
            -s / self.stiffness / divisor,
            mass,
            *self.chain.log_slopes(frequency_hz).T,
            own,
        ]
        return np.stack(columns, axis=1)

    def log_frequency_slope(self, frequency_hz: FloatArray, load: Load) -> ComplexArray:
        """Return the derivative (K,) of ln `output_factor` by the frequency, in 1/Hz."""
        s = laplace(frequency_hz)
        mass = load.mass + self.internal_mass if load.drive == "force" else 0.0
        own = -(self.damping + 2.0 * s * mass) / self.stiffness / self._divisor(s, load)
        return np.asarray(2j * np.pi * own + self.chain.log_frequency_slope(frequency_hz))

    def covariance_root(self, load: Load) -> FloatArray:
        """Return the parameters' deviations (4 + P + 1, E) by E independent causes of variance one."""
        count = len(self.covariance)
        whole = np.zeros((count + 1, count + 1))
        whole[:count, :count], whole[count, count] = self.covariance, load.u_mass**2
        size = np.sqrt(whole.diagonal())
        scale = np.where(size > 0.0, size, 1.0)
        value, vector = np.linalg.eigh(whole / np.multiply.outer(scale, scale))
        kept = value > 1e-12
        return np.asarray(scale[:, None] * vector[:, kept] * np.sqrt(value[kept]))

    def response(self, frequency_hz: FloatArray, load: Load) -> ChainResponse:
        """Return `output_factor` with the relative deviations that the parameters' covariance makes at all lines."""
        errors = (self.log_slopes(frequency_hz, load) @ self.covariance_root(load)).T
        causes = tuple(f"sensor model {number}" for number in range(1, len(errors) + 1))
        return ChainResponse(self.output_factor(frequency_hz, load), np.asarray(errors), causes)

    def _divisor(self, s: ComplexArray, load: Load) -> ComplexArray:
        """Return (k + bs)/k of a moving base, (k + bs + Ms²)/k of a force on the load."""
        mass = load.mass + self.internal_mass if load.drive == "force" else 0.0
        return np.asarray(1.0 + (self.damping + s * mass) * s / self.stiffness)


def sensor_model(fit: SensitivityFit, mechanics: FloatArray, covariance: FloatArray) -> SensorModel:
    """Join a sensitivity with `mechanics` (3,) [k, b, m_i] of an identification and their `covariance` (3, 3).

    The fit must have had the same k and b as its `SpringPrior`. What it added to the knowledge of τ = b/k moves k, b
    and m_i along C·g, g = ∂τ/∂[k, b, m_i], C their covariance.
    """
    check_shape("mechanics", mechanics, (3,))
    check_shape("covariance", covariance, (3, 3))
    k, b = float(mechanics[0]), float(mechanics[1])
    slope = np.array([-b / k**2, 1.0 / k, 0.0])
    variance = float(slope @ covariance @ slope)
    known = "spring_time_s" in fit.parameters
    if known != (variance > 0.0) or (not known and fit.spring_time_s != b / k):
        raise ValueError("fit: expected one that holds b/k by these k and b, found another")
    others = [place for place, name in enumerate(fit.parameters) if name != "spring_time_s"]
    joined = np.zeros((3 + len(others), 3 + len(others)))
    joined[:3, :3] = covariance
    joined[3:, 3:] = fit.covariance[np.ix_(others, others)]
    moved = np.asarray(mechanics, dtype=np.float64)
    if known:
        gain = covariance @ slope / variance
        moved = moved + gain * (fit.spring_time_s - b / k)
        joined[:3, :3] -= np.multiply.outer(gain, gain) * (variance - fit.covariance[1, 1])
        joined[:3, 3:] = np.multiply.outer(gain, fit.covariance[1, others])
        joined[3:, :3] = joined[:3, 3:].T
    order = [3, 0, 1, 2, *range(4, len(joined))]
    return SensorModel(
        fit.sensitivity,
        float(moved[0]),
        float(moved[1]),
        float(moved[2]),
        fit.chain,
        joined[np.ix_(order, order)],
        fit.unit,
    )
