"""What makes the sensitivity change with frequency: the sensor's damper, or the measuring chain behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.models.chain_shape import CHAIN_PARAMETERS, ChainKind
from shaker.models.measured import MeasuredSensitivity
from shaker.models.sensitivity_fit import SensitivityFit, fit_chain
from shaker.models.spring_damper import SpringPrior

Verdict = Literal["supported", "more than needed", "refuted"]

SIGNIFICANCE = 0.01
"""Probability below which a test refutes."""
SMALLEST_WEIGHT = 0.05
"""Akaike weight, relative to the best, below which an explanation is refuted by a better one."""
CHAIN_WORDS: dict[ChainKind, str] = {
    "none": "the sensor's damper alone",
    "delay": "a delay of the chain",
    "lag": "a first-order lag of the chain",
    "butterworth": "a Butterworth low-pass of second order",
    "second_order": "a low-pass of second order",
    "delay_lag": "a delay and a first-order lag of the chain",
}
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

    `deviation`: their difference over its standard uncertainty; `probability` of a deviation as large by chance.
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


def fit_sensitivity(measured: MeasuredSensitivity, spring: SpringPrior | None = None) -> SensitivityComparison:
    """Fit every explanation of a sensitivity over frequency, compare them, and test the damping against the resonance.

    With `spring` every explanation has the sensor's own lag b/k, held within its uncertainty. Without it nothing tells
    that lag from one of the chain, 1/(1 + jωb/k) being one: it stands in the explanation without a chain only.
    Weights: AICc = χ²/ĉ + 2p + 2p(p + 1)/(n - p - 1) of p free parameters and n real readings, ĉ = χ²/dof of the
    explanation that fits best, where that exceeds one (Burnham and Anderson, Model selection, 2002, 2.5).
    Refuted is what leaves a χ² too large (`SIGNIFICANCE`) or has too small a weight; more than needed is an explanation
    of which a part is supported as well.
    """
    alone = spring is None
    fits = tuple(fit_chain(measured, kind, spring, spring_free=alone and kind == "none") for kind in CHAIN_PARAMETERS)
    weight = _weights(fits, 2 * len(measured.value) + (measured.static is not None), alone)
    verdict = _verdicts(fits, weight)
    damping = None if spring is None else _damping_test(fit_chain(measured, "none", None, spring_free=True), spring)
    return SensitivityComparison(fits, weight, verdict, spring, damping, _sentence(fits, verdict, alone))


def _weights(fits: tuple[SensitivityFit, ...], readings: int, alone: bool) -> FloatArray:
    """Return the Akaike weights of the fits."""
    enlarged = max(1.0, min(fit.chi_squared / fit.dof for fit in fits))
    free = np.array([1 + len(fit.chain.names) + (alone and fit.chain.kind == "none") for fit in fits])
    chi_squared = np.array([fit.chi_squared for fit in fits])
    criterion = chi_squared / enlarged + 2.0 * free + 2.0 * free * (free + 1.0) / (readings - free - 1.0)
    weight = np.exp(-0.5 * (criterion - criterion.min()))
    return np.asarray(weight / weight.sum())


def _verdicts(fits: tuple[SensitivityFit, ...], weight: FloatArray) -> tuple[Verdict, ...]:
    """Return what the data say of each explanation."""
    possible = {
        fit.chain.kind
        for fit, share in zip(fits, weight / weight.max(), strict=True)
        if fit.probability >= SIGNIFICANCE and share >= SMALLEST_WEIGHT
    }
    found: list[Verdict] = []
    for kind in (fit.chain.kind for fit in fits):
        larger = possible.intersection(_PART_OF[kind])
        found.append("refuted" if kind not in possible else "more than needed" if larger else "supported")
    return tuple(found)


def _damping_test(needed: SensitivityFit, spring: SpringPrior) -> DampingTest:
    """Compare b/k fitted to S(f) with no chain with that of the resonance."""
    from scipy import special

    u = float(np.hypot(needed.u("spring_time_s"), spring.u_time_s))
    deviation = (needed.spring_time_s - spring.time_s) / u
    probability = float(special.erfc(abs(deviation) / np.sqrt(2.0)))
    from_curve = _microseconds(needed.spring_time_s, needed.u("spring_time_s"))
    from_width = _microseconds(spring.time_s, spring.u_time_s)
    says = "they contradict each other" if probability < SIGNIFICANCE else "they agree"
    text = (
        f"With no chain the sensitivity needs b/k = {from_curve}, the width of the resonance gives {from_width}: {says}"
    )
    return DampingTest(
        needed_s=needed.spring_time_s,
        u_needed_s=needed.u("spring_time_s"),
        resonance_s=spring.time_s,
        u_resonance_s=spring.u_time_s,
        deviation=deviation,
        probability=probability,
        text=f"{text} (normalised deviation {deviation:.1f}).",
    )


def _sentence(fits: tuple[SensitivityFit, ...], verdict: tuple[Verdict, ...], alone: bool) -> str:
    """Say in one sentence which explanations the data support and which they refute."""
    told: dict[Verdict, list[str]] = {"supported": [], "more than needed": [], "refuted": []}
    for fit, found in zip(fits, verdict, strict=True):
        told[found].append(_told(fit) if found == "supported" else CHAIN_WORDS[fit.chain.kind])
    if not told["supported"]:
        best = min(fits, key=lambda fit: fit.chi_squared / fit.dof)
        return (
            f"The data support none of these explanations: even {_told(best)} leaves χ²/dof = "
            f"{best.chi_squared / best.dof:.1f}, so that a cause is missing or the uncertainties are stated too small."
        )
    parts = [f"The data support {' or '.join(told['supported'])}"]
    parts += [f"they do not need {' or '.join(told['more than needed'])}"] if told["more than needed"] else []
    parts += [f"they refute {', '.join(told['refuted'])}"] if told["refuted"] else []
    parts += ["a lag of the chain and one of the sensor's damper are the same curve"] if alone else []
    return "; ".join(parts) + "."


def _told(fit: SensitivityFit) -> str:
    """Return an explanation with its numbers."""
    names = ("spring_time_s",) if fit.chain.kind == "none" else fit.chain.names
    values = {"spring_time_s": fit.spring_time_s, "delay_s": fit.chain.delay_s, "lag_s": fit.chain.lag_s}
    numbers = [_microseconds(values[name], fit.u(name)) for name in names if name in values]
    corner = [f"f_c = {e.value:.4g} Hz ± {2.0 * e.u:.2g} Hz" for e in fit.estimates if e.name == "corner_hz"]
    return f"{CHAIN_WORDS[fit.chain.kind]} ({', '.join(corner or numbers)})"


def _microseconds(value_s: float, u_s: float) -> str:
    """Return a time with its expanded uncertainty, k = 2, in µs."""
    return f"{1e6 * value_s:.4g} µs ± {2e6 * u_s:.2g} µs"
