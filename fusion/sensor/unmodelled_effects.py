"""Influences on a model that its records cannot show, as the rig states them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fusion.base import PERCENT
from fusion.recording.rig import Rig
from fusion.report.table import Table, capitalise
from fusion.sensor.model_notices import MODEL_COVERAGE, MODEL_INFLUENCES_NOT_ASSESSED
from shaker.decoupling.model import MultiModel
from shaker.release.load_model import LoadModel
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import small
from shakercal._common.notices import Notice

CAUSE_LABELS = {
    "mounting": "mounting anew",
    "load": "another load",
    "temperature": "another temperature",
    "structure": "a model of another structure",
}
"""Causes of changes of a model, by their key in `[model]` of rig.toml."""
NOT_ASSESSED = "not assessed"
"""Entry of a budget for a cause that is not stated."""
RELATIVE_STEP = 1e-4
"""Relative change of a model's numbers in central differences: far above rounding, far below their curvature."""


class UnmodelledEffect(NamedTuple):
    """Relative changes of frequencies, damping ratios and gain by one standard uncertainty of a cause."""

    cause: str
    frequency: float = 0.0
    damping_ratio: float = 0.0
    gain: float = 0.0


@dataclass(frozen=True)
class ModelInfluences:
    """Influences on a model that its records do not show.

    Attributes
    ----------
    causes : causes that the rig states, keys of `CAUSE_LABELS`.
    unknowns : their unknowns.
    missing : causes that are not stated.
    records : the records behind the model, in words.
    single : whether there is only one record, which shows no scatter.
    """

    causes: tuple[str, ...] = ()
    unknowns: tuple[UnmodelledEffect, ...] = ()
    missing: tuple[str, ...] = ()
    records: str = ""
    single: bool = False

    @property
    def outside(self) -> str:
        """Return the influences that U does not include, in words; empty if all are stated."""
        scatter = ["scatter between releases"] if self.single else []
        return ", ".join([*scatter, *(CAUSE_LABELS[cause] for cause in self.missing)])

    @property
    def scope(self) -> str:
        """Return the use that U of the model covers, in words."""
        labels = [CAUSE_LABELS[cause] for cause in self.causes]
        text = " and ".join(filter(None, [", ".join(labels[:-1]), *labels[-1:]]))
        return f"{self.records}, with {text} as stated" if labels else self.records

    def effects(self, numbers: Callable[[float, float, float], FloatArray]) -> FloatArray:
        """Return the changes (E, P) of P numbers by each unknown, by central differences."""

        def slope(one: UnmodelledEffect) -> FloatArray:
            size = max(map(abs, one[1:]))
            if size == 0.0:
                return np.zeros_like(numbers(0.0, 0.0, 0.0))
            up, down = (numbers(*(sign * RELATIVE_STEP / size * part for part in one[1:])) for sign in (1.0, -1.0))
            return np.asarray((up - down) * size / (2.0 * RELATIVE_STEP))

        none = np.zeros((0, len(numbers(0.0, 0.0, 0.0))))
        return np.stack([slope(one) for one in self.unknowns]) if self.unknowns else none

    def by_cause(self, part: Callable[[list[int]], FloatArray]) -> dict[str, FloatArray]:
        """Return the contribution of each stated cause by its label; `part` evaluates unknowns by index."""
        indices = {cause: [n for n, one in enumerate(self.unknowns) if one.cause == cause] for cause in self.causes}
        return {CAUSE_LABELS[cause]: part(of_cause) for cause, of_cause in indices.items()}

    @property
    def relative(self) -> dict[str, tuple[float, float]]:
        """Return relative standard uncertainties of a frequency and of a damping ratio by cause."""
        parts = np.array([(one.frequency, one.damping_ratio) for one in self.unknowns]).reshape(-1, 2)
        norms = self.by_cause(lambda indices: np.linalg.norm(parts[indices], axis=0))
        return {cause: (float(both[0]), float(both[1])) for cause, both in norms.items()}

    def budget(self, whole: FloatArray, effects: FloatArray, remainder: str) -> dict[str, FloatArray]:
        """Return standard uncertainties (P,) by cause of numbers with variances `whole` (P,).

        `effects` (E, P) are the changes by each unknown; `remainder` labels the remaining uncertainty.
        """
        rest = np.sqrt(np.maximum(whole - np.sum(effects**2, axis=0), 0.0))
        return {remainder: rest, **self.by_cause(lambda indices: np.linalg.norm(effects[indices], axis=0))}

    def on_loads(self, model: LoadModel) -> LoadModel:
        """Return a model over the load whose covariances include these unknowns."""
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
        """Return a model of several outputs whose covariance includes these unknowns."""
        if model.covariance is None or not self.unknowns:
            return model
        effects = self.effects(lambda *part: model.altered(*part).vector)
        return replace(model, covariance=model.covariance + effects.T @ effects)


NO_INFLUENCES = ModelInfluences()


def stated_influences(
    rig: Rig, mountings: Sequence[str], excluded: Sequence[str] = (), *, mounting_scatter: bool = True
) -> ModelInfluences:
    """Return the influences that the rig states for a model, and missing ones.

    `mountings`: the mounting of each record. `excluded`: causes that do not apply. `mounting_scatter`: the scatter of
    several mountings is in U already, so that a stated one is not added.
    """
    model, several = rig.model, mounting_scatter and len(set(mountings)) > 1
    by_scatter = ("mounting",) if several else ()
    causes, unknowns = list[str](), list[UnmodelledEffect]()
    for cause in CAUSE_LABELS:
        stated = None if model is None or cause in (*excluded, *by_scatter) else getattr(model, cause)
        if stated is None:
            continue
        causes.append(cause)
        if cause == "temperature":
            of_sensor = None if rig.sensor is None else rig.sensor.temperature_coefficient
            of_gain = stated.gain_coefficient if stated.gain_coefficient is not None else of_sensor or 0.0
            parts = (stated.frequency_coefficient, stated.damping_ratio_coefficient, of_gain)
            unknowns.append(UnmodelledEffect(cause, *(stated.difference_uncertainty * part for part in parts)))
        else:
            independent = (stated.frequency_uncertainty, stated.damping_ratio_uncertainty, stated.gain_uncertainty)
            unknowns += [UnmodelledEffect(cause, *row) for row in np.diag(independent).tolist() if any(row)]
    missing = tuple(cause for cause in CAUSE_LABELS if cause not in (*causes, *by_scatter, *excluded))
    return ModelInfluences(tuple(causes), tuple(unknowns), missing, describe_records(mountings), len(mountings) == 1)


def budget_table(
    caption: str, numbers: Mapping[str, float], u: Mapping[str, FloatArray], influences: ModelInfluences
) -> Table:
    """Return a budget of relative standard uncertainties in % of `numbers` by label.

    `u` (Q,) by cause. Each cause that is not stated has a line "not assessed".
    """
    size = np.abs(list(numbers.values()))
    share = PERCENT * np.divide(1.0, size, out=np.zeros(len(size)), where=size > 0)
    rows = [(capitalise(cause), *map(small, (share * part).tolist())) for cause, part in u.items()]
    rows += [(capitalise(CAUSE_LABELS[cause]), *[NOT_ASSESSED] * len(size)) for cause in influences.missing]
    return Table(
        f"{caption}: relative standard uncertainties, %", ("cause", *numbers), "l" + "r" * len(size), tuple(rows)
    )


def describe_records(mountings: Sequence[str]) -> str:
    """Return the use that U of a model covers, by the mountings of its releases.

    >>> describe_records(["1", "1", "1"])
    'for these 3 releases in one mounting'
    """
    count, different = len(mountings), len(set(mountings))
    if count == 1:
        return "within this record of one release"
    return f"for these {count} releases in {'one mounting' if different == 1 else f'{different} mountings'}"


def coverage_notice(scope: str, outside: str, where: str) -> Notice:
    """Return the notice of the conditions under which U of a model applies."""
    if outside:
        return Notice(MODEL_INFLUENCES_NOT_ASSESSED, where, scope=scope, outside=outside)
    return Notice(MODEL_COVERAGE, where, scope=scope)
