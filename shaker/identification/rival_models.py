"""Rival models of the same curves, and the choice between them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker.identification.measured_curves import CurveError, MeasuredTransfer, ParameterEstimate
from shaker.identification.structure_fit import Identification, ModeEstimate
from shaker.identification.structures import CHANGE
from shakercal._common.arrays import FloatArray

StructureName = Literal["translation", "pitching", "adapter"]

_SIGNIFICANT = 6.0  # difference of the criterion from which a rival is refuted: Akaike weights in the ratio 1 : 20
_ONE_SIDED = 0.82  # half of 1.645: 95 % of a normal distribution lies on one side
_MOST_ADDED = 3  # features added to a model
_WORTH_MORE = 0.5  # share of the misfit that a feature must leave at most, so that another one is tried
_FILTER_TERMS = ((1, 1.0), (2, 0.5), (3, 0.3), (4, 0.2), (5, 0.1))
"""Powers n of (jf/f_max) in the logarithm of an unstated filter, with the standard deviation of each coefficient: wide
enough for a corner at the highest line."""
_FEATURE_WORDS = {
    "loss_factor": "a loss factor in place of a damper",
    "each": "a separate damping of each recording",
    "by_amplitude": "stiffness and damping that change with the amplitude",
}
UNSTATED_FILTER = "unstated filter"
"""Part of the names of the unknowns of an unstated filter."""
UNDECIDED_MODELS = "models that the data do not decide between"
"""Cause in the budget."""


@dataclass(frozen=True)
class RivalModel:
    """One hypothesis on joints, damping and chains.

    `loss_factor`: damping that does not depend on frequency. `each`: one damping per recording. `by_amplitude`:
    stiffness and damping change with the amplitude of the recording. `filtered`: channels whose chain has a filter or
    delay that is not stated.
    """

    structure: StructureName = "translation"
    loss_factor: bool = False
    each: bool = False
    by_amplitude: bool = False
    filtered: tuple[str, ...] = ()

    def __str__(self) -> str:
        added = [words for name, words in _FEATURE_WORDS.items() if getattr(self, name)]
        added += [f"an unstated filter of {channel}" for channel in self.filtered]
        return " with ".join([self.structure, " and ".join(added)]) if added else self.structure

    def contains(self, other: RivalModel) -> bool:
        """Return whether this is the other model with something added."""
        if self == other or not set(other.filtered) <= set(self.filtered):
            return False
        same = self.structure == other.structure or (self.structure, other.structure) == ("adapter", "translation")
        law = self.loss_factor == other.loss_factor or (self.each and other.each)
        # One damping per recording contains both laws of damping, as far as each curve has one resonance.
        more = (self.each or not other.each) and (self.by_amplitude or not other.by_amplitude)
        return same and (law or self.each) and more


@dataclass(frozen=True)
class FittedRival:
    """A rival model with its fit."""

    model: RivalModel
    identification: Identification

    @property
    def free(self) -> int:
        """Number of parameters, those of unstated filters included."""
        return self.identification.free + len(_FILTER_TERMS) * len(self.model.filtered)

    def criterion(self, excess: float) -> float:
        """Return Akaike's criterion, χ² divided by the excess of the best rival."""
        found = self.identification
        expected = found.chi_squared / found.dof / found.excess if found.excess > 1.0 else 1.0
        return (found.chi_squared / max(expected, 1.0) / excess + found.penalty) + 2.0 * self.free


@dataclass(frozen=True)
class ModelChoice:
    """The model that the data call for.

    `tried`: all models that were fitted; `undecided`: those that the data do not refute.
    """

    best: FittedRival
    tried: tuple[FittedRival, ...]
    undecided: tuple[FittedRival, ...]

    def difference(self, rival: FittedRival) -> float:
        """Return by how much the criterion of a rival exceeds that of the best."""
        excess = self.best.identification.excess
        return rival.criterion(excess) - self.best.criterion(excess)


def choose_model(
    start: Sequence[RivalModel],
    richer: Callable[[FittedRival], Sequence[RivalModel]],
    fitted: Callable[[RivalModel], Identification | None],
) -> ModelChoice:
    """Return the rival that the data call for.

    The rivals of `start` are fitted first. While residuals or stated errors contradict the best, `richer` names models
    with one more feature, and the best of them follows where Akaike's criterion is lower by 6 or more. Where the data
    refute all of them, it is the best one of `start`. `fitted` returns None for a model that cannot be fitted.
    """
    tried: dict[RivalModel, FittedRival] = {}
    known: set[RivalModel] = set()

    def best_of(models: Sequence[RivalModel]) -> FittedRival:
        for model in models:
            if model not in known and (found := fitted(model)) is not None:
                tried[model] = FittedRival(model, found)
            known.add(model)
        excess = min((rival.identification.excess for rival in tried.values()), default=1.0)
        return min(tried.values(), key=lambda rival: rival.criterion(excess))

    simplest = best = best_of(start)
    for _ in range(_MOST_ADDED):
        others = richer(best)
        if not others:
            break
        before, best = best, best_of(others)
        excess = best.identification.excess
        if best is before or before.criterion(excess) - best.criterion(excess) < _SIGNIFICANT:
            best = before
            break
        if best.identification.misfit > _WORTH_MORE * before.identification.misfit:
            break
    if best.identification.is_rejected:  # added features would be arbitrary
        best = simplest
    choice = ModelChoice(best, tuple(tried.values()), ())
    if best.identification.is_rejected:
        return choice
    undecided = [
        rival
        for rival in choice.tried
        if rival is not best and choice.difference(rival) < _SIGNIFICANT and not rival.model.contains(best.model)
    ]
    return replace(choice, undecided=tuple(undecided))


def with_unstated_filters(
    records: Sequence[MeasuredTransfer], references: Sequence[str], filtered: Sequence[str]
) -> list[MeasuredTransfer]:
    """Return curves with unknown filters of some channels; `references` (R): reference of each recording.

    The logarithm of a stable filter above the band is a series of (jω)ⁿ with real coefficients: delay and lag are its
    first term, the loss of magnitude its second.
    """
    highest = max(float(record.ratio.frequency_hz.max()) for record in records)

    def errors(record: MeasuredTransfer, reference: str) -> Iterator[CurveError]:
        power = 1j * record.ratio.frequency_hz / highest
        for channel in filtered:
            acts = np.array([float(name == channel) for name in record.ratio.channels]) - float(reference == channel)
            if np.any(acts):
                for n, size in _FILTER_TERMS:
                    name = f"{channel}: {UNSTATED_FILTER}, term {n}"
                    yield CurveError(name, np.multiply.outer(size * power**n, acts))

    return [
        replace(record, errors=(*record.errors, *errors(record, reference)))
        for record, reference in zip(records, references, strict=True)
    ]


def unstated_lag_s(found: Identification, channel: str, highest_hz: float) -> tuple[float, float]:
    """Return lag in s and relative loss of magnitude of an unstated filter.

    The change of magnitude is that at `highest_hz`, the highest line.
    """
    values = {
        n: size * unknown.estimate
        for n, size in _FILTER_TERMS
        for unknown in found.unknowns
        if unknown.name == f"{channel}: {UNSTATED_FILTER}, term {n}"
    }
    lag = -values.get(1, 0.0) / (2.0 * np.pi * highest_hz)
    return float(lag), float(np.expm1(values.get(4, 0.0) - values.get(2, 0.0)))


def covering(choice: ModelChoice) -> Identification:
    """Return the best fit, whose uncertainty includes the rivals that the data leave open.

    U (k = 2) of a number covers the difference to its value in each of these models.
    """
    best = choice.best.identification
    others = [rival.identification for rival in choice.undecided]
    if choice.best.model.by_amplitude:
        others += [_at_amplitude(best, side) for side in (-0.5, 0.5)]
    if not others:
        return best

    def added(item: ParameterEstimate) -> list[float]:
        """Return the standard uncertainty of a number by each of the other models."""
        return [added_uncertainty(item.value, item.u, *_found_in(other, item)) for other in others]

    def wider(item: ParameterEstimate) -> ParameterEstimate:
        return replace(item, u=float(np.linalg.norm([item.u, *added(item)])))

    def wider_mode(mode: ModeEstimate) -> ModeEstimate:
        frequency, damping = [mode.u_frequency_hz], [mode.u_damping_ratio]
        for one in (one for other in others for one in other.modes):
            if (one.record, one.number) == (mode.record, mode.number):
                found = one.frequency_hz, one.u_frequency_hz, one.damping_ratio, one.u_damping_ratio
                frequency.append(added_uncertainty(mode.frequency_hz, mode.u_frequency_hz, *found[:2]))
                damping.append(added_uncertainty(mode.damping_ratio, mode.u_damping_ratio, *found[2:]))
        u_frequency_hz, u_damping_ratio = float(np.linalg.norm(frequency)), float(np.linalg.norm(damping))
        return replace(mode, u_frequency_hz=u_frequency_hz, u_damping_ratio=u_damping_ratio)

    changes: FloatArray = np.array([added(item) for item in best.estimates]).T
    return replace(
        best,
        estimates=tuple(map(wider, best.estimates)),
        covariance=best.covariance + changes.T @ changes,
        derived=tuple(map(wider, best.derived)),
        modes=tuple(map(wider_mode, best.modes)),
        budget={**best.budget, UNDECIDED_MODELS: np.linalg.norm(changes, axis=0)},
    )


def _at_amplitude(found: Identification, level: float) -> Identification:
    """Return a fit with stiffness and damping at another amplitude."""
    changes = {item.name.removeprefix(CHANGE): item.value for item in found.estimates if item.name.startswith(CHANGE)}
    moved = tuple(replace(item, value=item.value + level * changes.get(item.name, 0.0)) for item in found.estimates)
    return replace(found, estimates=moved)


def added_uncertainty(value: float, u: float, other: float, u_other: float) -> float:
    """Return what another model adds to u, signed as its difference.

    2u then covers its value with 95 %.
    """
    reach = max(u_other, 0.5 * abs(other - value) + _ONE_SIDED * u_other)
    return float(np.copysign(np.sqrt(max(0.0, reach**2 - u**2)), other - value))


def _found_in(found: Identification, item: ParameterEstimate) -> tuple[float, float]:
    """Return value and u of a number in another fit.

    Of one damping per recording it is their mean; a number that the fit lacks is unchanged.
    """
    numbers, name = (*found.estimates, *found.derived), item.name.partition(": ")[0]
    same = [one for one in numbers if one.name == item.name] or [
        one for one in numbers if one.name.partition(": ")[0] == name
    ]
    if not same or not np.all(np.isfinite([one.u for one in same])):
        return item.value, item.u
    return float(np.mean([one.value for one in same])), float(np.max([one.u for one in same]))


def without_uncertainty(found: Identification) -> Identification:
    """Return the values of a model that its data refute, which have no uncertainty."""
    return replace(
        found,
        estimates=tuple(replace(item, u=np.nan) for item in found.estimates),
        covariance=np.full_like(found.covariance, np.nan),
        derived=tuple(replace(item, u=np.nan) for item in found.derived),
        modes=tuple(replace(mode, u_frequency_hz=np.nan, u_damping_ratio=np.nan) for mode in found.modes),
        budget={},
    )
