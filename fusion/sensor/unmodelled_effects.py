"""What the records behind a model cannot show, as the rig states it: mounting, load, temperature, model structure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fusion.base import PERCENT
from fusion.recording.rig import Rig
from fusion.report.table import Table, capitalise, small
from shaker.arrays import FloatArray
from shaker.decoupling.model import MultiModel
from shaker.release.load_model import LoadModel

CAUSE_LABELS = {
    "mounting": "mounting anew",
    "load": "another load",
    "temperature": "another temperature",
    "structure": "a model of another structure",
}
"""What changes a model, by its key in `[model]` of rig.toml."""
NOT_ASSESSED = "not assessed"
"""What a budget says of a cause that nobody states."""
RELATIVE_STEP = 1e-4
"""Relative change of a model's numbers over which derivatives are taken."""


class UnmodelledEffect(NamedTuple):
    """An unknown of a cause: relative changes of frequencies, damping ratios and gain by one standard uncertainty."""

    cause: str
    frequency: float = 0.0
    damping_ratio: float = 0.0
    gain: float = 0.0


@dataclass(frozen=True)
class ModelInfluences:
    """What is known of a model beside its records: `causes` that are stated, their unknowns, and those `missing`.

    `records` in words; `single`: there is but one, which does not show by what records scatter.
    """

    causes: tuple[str, ...] = ()
    unknowns: tuple[UnmodelledEffect, ...] = ()
    missing: tuple[str, ...] = ()
    records: str = ""
    single: bool = False

    @property
    def outside(self) -> str:
        """Return what U leaves out, in words, empty where all is stated."""
        scatter = ["what releases scatter by"] if self.single else []
        return ", ".join([*scatter, *(CAUSE_LABELS[cause] for cause in self.missing)])

    @property
    def scope(self) -> str:
        """Return over what U of the model holds, in words."""
        told = [CAUSE_LABELS[cause] for cause in self.causes]
        words = " and ".join(filter(None, [", ".join(told[:-1]), *told[-1:]]))
        return f"{self.records}, with {words} as stated" if told else self.records

    def effects(self, numbers: Callable[[float, float, float], FloatArray]) -> FloatArray:
        """Return how numbers (P,) of changed models move with each unknown, (E, P), by central differences."""

        def slope(one: UnmodelledEffect) -> FloatArray:
            size = max(map(abs, one[1:]))
            if size == 0.0:
                return np.zeros_like(numbers(0.0, 0.0, 0.0))
            up, down = (numbers(*(sign * RELATIVE_STEP / size * part for part in one[1:])) for sign in (1.0, -1.0))
            return np.asarray((up - down) * size / (2.0 * RELATIVE_STEP))

        none = np.zeros((0, len(numbers(0.0, 0.0, 0.0))))
        return np.stack([slope(one) for one in self.unknowns]) if self.unknowns else none

    def by_cause(self, part: Callable[[list[int]], FloatArray]) -> dict[str, FloatArray]:
        """Return what the unknowns of each stated cause contribute, by its words; `part`: of some by their numbers."""
        places = {cause: [n for n, one in enumerate(self.unknowns) if one.cause == cause] for cause in self.causes}
        return {CAUSE_LABELS[cause]: part(own) for cause, own in places.items()}

    @property
    def relative(self) -> dict[str, tuple[float, float]]:
        """Return relative standard uncertainties of a frequency and of a damping ratio by cause."""
        parts = np.array([(one.frequency, one.damping_ratio) for one in self.unknowns]).reshape(-1, 2)
        norms = self.by_cause(lambda places: np.linalg.norm(parts[places], axis=0))
        return {cause: (float(both[0]), float(both[1])) for cause, both in norms.items()}

    def budget(self, whole: FloatArray, effects: FloatArray, remainder: str) -> dict[str, FloatArray]:
        """Return standard uncertainties (P,) by cause of numbers of variances `whole` (P,), of which `own` is the rest.

        `effects` (E, P): how they move with each unknown.
        """
        rest = np.sqrt(np.maximum(whole - np.sum(effects**2, axis=0), 0.0))
        return {remainder: rest, **self.by_cause(lambda places: np.linalg.norm(effects[places], axis=0))}

    def on_loads(self, model: LoadModel) -> LoadModel:
        """Return a model over the load with these unknowns in its covariances, where it has any."""
        if model.total_covariance is None or model.covariance is None or not self.unknowns:
            return model
        effects = self.effects(lambda *part: model.altered(*part).numbers)
        added, size = effects.T @ effects, len(model.vector)
        gain = model.sensitivity * np.array([one.gain for one in self.unknowns])
        return replace(
            model,
            covariance=model.covariance + added[:size, :size],
            covariance_with_mass=model.total_covariance + added,
            u_sensitivity=float(np.linalg.norm([model.u_sensitivity, *gain])),
        )

    def on_outputs(self, model: MultiModel) -> MultiModel:
        """Return a model of several outputs with these unknowns in its covariance."""
        if model.covariance is None or not self.unknowns:
            return model
        effects = self.effects(lambda *part: model.altered(*part).vector)
        return replace(model, covariance=model.covariance + effects.T @ effects)


NO_INFLUENCES = ModelInfluences()


def stated_influences(
    rig: Rig, mountings: Sequence[str], excluded: Sequence[str] = (), *, mounting_scatter: bool = True
) -> ModelInfluences:
    """Return what the rig states beside records of some `mountings`, one each, and what nobody states.

    `scattering`: what several mountings differ by is in U as the scatter of their records, so that a stated one is left
    out. `without`: causes that do not apply.
    """
    told, several = rig.model, mounting_scatter and len(set(mountings)) > 1
    by_scatter = ("mounting",) if several else ()
    causes, unknowns = list[str](), list[UnmodelledEffect]()
    for cause in CAUSE_LABELS:
        stated = None if told is None or cause in (*excluded, *by_scatter) else getattr(told, cause)
        if stated is None:
            continue
        causes.append(cause)
        if cause == "temperature":
            own = None if rig.sensor is None else rig.sensor.temperature_coefficient
            of_gain = stated.gain_coefficient if stated.gain_coefficient is not None else own or 0.0
            parts = (stated.frequency_coefficient, stated.damping_ratio_coefficient, of_gain)
            unknowns.append(UnmodelledEffect(cause, *(stated.difference_uncertainty * part for part in parts)))
        else:
            alone = (stated.frequency_uncertainty, stated.damping_ratio_uncertainty, stated.gain_uncertainty)
            unknowns += [UnmodelledEffect(cause, *row) for row in np.diag(alone).tolist() if any(row)]
    missing = tuple(cause for cause in CAUSE_LABELS if cause not in (*causes, *by_scatter, *excluded))
    return ModelInfluences(tuple(causes), tuple(unknowns), missing, describe_records(mountings), len(mountings) == 1)


def budget_table(
    caption: str, numbers: Mapping[str, float], u: Mapping[str, FloatArray], influences: ModelInfluences
) -> Table:
    """Return a budget: relative standard uncertainties, %, of `numbers` by label; `u`: of each (Q,) by cause.

    What nobody states has a line that says so.
    """
    size = np.abs(list(numbers.values()))
    share = PERCENT * np.divide(1.0, size, out=np.zeros(len(size)), where=size > 0)
    rows = [(capitalise(cause), *map(small, (share * part).tolist())) for cause, part in u.items()]
    rows += [(capitalise(CAUSE_LABELS[cause]), *[NOT_ASSESSED] * len(size)) for cause in influences.missing]
    return Table(
        f"{caption}: relative standard uncertainties, %", ("cause", *numbers), "l" + "r" * len(size), tuple(rows)
    )


def describe_records(mountings: Sequence[str]) -> str:
    """Return over what the U of a model holds: how many releases, of how many mountings, it rests on.

    >>> scope_of(["1", "1", "1"])
    'within these 3 releases of one mounting'
    """
    count, places = len(mountings), len(set(mountings))
    if count == 1:
        return "within this record of one release"
    return f"within these {count} releases of {'one mounting' if places == 1 else f'{places} mountings'}"


def describe_coverage(scope: str, outside: str) -> str:
    """Return what is told of U of a model: over what it holds, and what it leaves out."""
    return f"U of the model holds {scope}" + (f"; not in it: {outside}" if outside else "")
