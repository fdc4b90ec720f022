"""The complex ratio of the sensor's outputs to the load that was driven, with its budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.load import LOAD_COMPONENTS, LoadResult, load_phasors
from fusion.notices import AnyNotice, Notice
from fusion.observe import Reading, RelativeError, chain_errors, chain_name
from shaker.signals.phasor import Phasors, stack_phasors

__all__ = ["LOAD_COMPONENTS", "BudgetEntry", "LoadResult", "Sensitivity", "load_phasors", "sensitivity_ratio"]

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

Kind = Literal["ratio", "matrix", "harmonic"]


@dataclass(frozen=True)
class BudgetEntry:
    """One contribution to the driven component's ratio: relative standard uncertainty of the magnitude, and phase.

    `u_relative`, `u_phase_rad`: (K, C).
    """

    label: str
    type: Literal["A", "B"]
    u_relative: FloatArray
    u_phase_rad: FloatArray


@dataclass(frozen=True)
class Sensitivity:
    """Complex ratios of C sensor outputs to six load components at K lines.

    `value` (K, C, 6), NaN where not determined; `observed` (C, 6); `covariance` (K, C, 6, 2, 2) of (Re, Im);
    `dof` (K,); `unit` of the outputs ("V/V"), so that an element's unit is (unit)/N or (unit)/(N.m); `kind` per line;
    `budget` of the driven component.
    """

    frequency_hz: FloatArray
    value: ComplexArray
    observed: BoolArray
    covariance: FloatArray
    dof: FloatArray
    channels: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    kind: tuple[Kind, ...]
    budget: tuple[BudgetEntry, ...]
    notices: tuple[AnyNotice, ...]


def driven_component(direction: Sequence[float], capacity: Sequence[float] | None = None) -> int:
    """Return which load component (0..5) the excitation drives: the largest of 3 or 6 numbers.

    Forces and moments of a 6-vector are compared in shares of the rated `capacity` (6,) where it is known.
    """
    size = np.abs(np.asarray(direction, dtype=np.float64))
    if size.shape not in ((3,), (6,)) or not np.any(size > 0.0):
        raise ValueError(f"direction: expected 3 or 6 numbers, not all zero, found {list(direction)}")
    if capacity is not None and len(size) == 6:
        size = size / np.asarray(capacity, dtype=np.float64)
    return int(np.argmax(size))


def sensitivity_ratio(
    outputs: Sequence[Reading],
    load: LoadResult,
    direction: Sequence[float],
    multiple: ArrayLike,
    unit: str,
    capacity: Sequence[float] | None = None,
) -> Sensitivity:
    """Return output / load of the driven component for every output channel of one recording.

    S = U/L; dS = dU/L - S dL/L. `outputs`: C channels with quantity "output", in the order wanted; `multiple` (K,): 1
    at a fundamental ("ratio"), else "harmonic". Outputs and load are taken as independent; errors of a chain (scale,
    delay, response) enter once per `common` name.
    """
    if not outputs:
        raise ValueError("outputs: expected at least one output channel, found none")
    component = driven_component(direction, capacity)
    signals = stack_phasors([reading.phasors for reading in outputs])
    driven = load.phasors.value[:, component]
    ratio = _quotient(signals.value, driven[:, None])
    parts = _output_parts(outputs, signals, ratio, driven) + _load_parts(load, component, ratio, driven)
    covariance = np.sum([part for _, _, part in parts], axis=0)
    lines, channels = ratio.shape
    value = np.full((lines, channels, 6), complex(np.nan, np.nan))
    value[:, :, component] = ratio
    spread = np.full((lines, channels, 6, 2, 2), np.nan)
    spread[:, :, component] = covariance
    names = tuple(str(reading.entry.channel or reading.entry.name) for reading in outputs)
    return Sensitivity(
        frequency_hz=signals.frequency_hz,
        value=value,
        observed=np.any(np.isfinite(value), axis=0),
        covariance=spread,
        dof=_dof(parts, signals.dof, load.phasors.dof, covariance),
        channels=names,
        components=LOAD_COMPONENTS,
        unit=unit,
        kind=tuple("ratio" if m == 1 else "harmonic" for m in np.asarray(multiple).tolist()),
        budget=tuple(_budget_entry(label, kind, part, ratio) for label, kind, part in parts),
        notices=_notices(load, component, ratio, capacity),
    )


Part = tuple[str, Literal["A", "B"], FloatArray]
NOISE = "output noise"


def _multiply(factor: ComplexArray) -> FloatArray:
    """Real matrices (..., 2, 2) of multiplication by complex numbers (...)."""
    return np.stack([np.stack([factor.real, -factor.imag], -1), np.stack([factor.imag, factor.real], -1)], -2)


def _quotient(numerator: ComplexArray | float, denominator: ComplexArray) -> ComplexArray:
    """Complex quotient, NaN where the denominator is zero or not known."""
    shape = np.broadcast_shapes(np.shape(numerator), denominator.shape)
    usable = np.isfinite(denominator) & (denominator != 0.0)
    empty = np.full(shape, complex(np.nan, np.nan))
    return np.asarray(np.divide(numerator, denominator, out=empty, where=usable))


def _output_parts(
    outputs: Sequence[Reading], signals: Phasors, ratio: ComplexArray, driven: ComplexArray
) -> list[Part]:
    """Covariances (K, C, 2, 2) of the ratios from the outputs' noise and chain errors."""
    count = len(outputs)
    pair = np.stack([np.arange(count), np.arange(count) + count], axis=1)
    noise = signals.covariance[:, pair[:, :, None], pair[:, None, :]]
    jacobian = np.broadcast_to(_multiply(_quotient(1.0, driven))[:, None], (*ratio.shape, 2, 2))
    found: list[Part] = [(NOISE, "A", jacobian @ noise @ jacobian.swapaxes(-1, -2))]
    chains: dict[str, list[int]] = {}
    for place, reading in enumerate(outputs):
        chains.setdefault(chain_name(reading), []).append(place)
    merged: dict[str, FloatArray] = {}
    for places in chains.values():
        for error in chain_errors([outputs[place] for place in places]):
            label = "output " + error.label.rpartition(": ")[2]
            own = np.zeros((*ratio.shape, 2, 2))
            own[:, places] = _outer(error, ratio[:, places])
            merged[label] = merged.get(label, 0.0) + own
    return found + [(label, "B", covariance) for label, covariance in merged.items()]


def _outer(error: RelativeError, ratio: ComplexArray) -> FloatArray:
    """Covariance (K, C, 2, 2) from one relative error of the outputs."""
    change = error.relative * ratio
    column = np.stack([change.real, change.imag], axis=-1)
    return column[..., :, None] * column[..., None, :]


def _load_parts(load: LoadResult, component: int, ratio: ComplexArray, driven: ComplexArray) -> list[Part]:
    """Covariances (K, C, 2, 2) of the ratios from every contribution of the load."""
    jacobian = _multiply(_quotient(-ratio, driven[:, None]))
    pair = np.array([component, component + 6])
    found: list[Part] = []
    for entry in load.contributions:
        own = entry.covariance[:, pair[:, None], pair][:, None]
        found.append((entry.label, entry.type, jacobian @ own @ jacobian.swapaxes(-1, -2)))
    return found


def _budget_entry(label: str, kind: Literal["A", "B"], part: FloatArray, ratio: ComplexArray) -> BudgetEntry:
    """Relative standard uncertainties along (magnitude) and across (phase) the ratio."""
    turn = _multiply(_quotient(1.0, ratio))
    relative = turn @ part @ turn.swapaxes(-1, -2)
    return BudgetEntry(
        label, kind, np.sqrt(np.maximum(relative[..., 0, 0], 0.0)), np.sqrt(np.maximum(relative[..., 1, 1], 0.0))
    )


def _dof(parts: Sequence[Part], output_dof: FloatArray, load_dof: FloatArray, covariance: FloatArray) -> FloatArray:
    """Welch-Satterthwaite degrees of freedom (K,), the least of all channels: output noise, and the load as a whole."""
    trace = np.trace(covariance, axis1=-2, axis2=-1)
    noise = np.trace(next(part for label, _, part in parts if label == NOISE), axis1=-2, axis2=-1)
    output = np.sum([np.trace(p, axis1=-2, axis2=-1) for name, _, p in parts if name.startswith("output ")], axis=0)
    weighted = noise**2 / np.maximum(output_dof, 1.0)[:, None]
    weighted = weighted + (trace - output) ** 2 / np.maximum(np.nan_to_num(load_dof, nan=np.inf), 1.0)[:, None]
    dof = np.divide(trace**2, weighted, out=np.full(trace.shape, np.inf), where=weighted > 0.0)
    return np.asarray(np.min(dof, axis=1))


def _notices(
    load: LoadResult, component: int, ratio: ComplexArray, capacity: Sequence[float] | None
) -> tuple[Notice, ...]:
    """Say where the driven component is missing, and what else acted on the sensor."""
    name, found = LOAD_COMPONENTS[component], []
    if not np.any(np.isfinite(ratio)):
        return (Notice("warning", f"{name} could not be determined: no sensitivity", "sensitivity"),)
    line = int(np.nanargmax(np.abs(load.phasors.value[:, component])))
    rated = np.ones(6) if capacity is None else np.asarray(capacity, dtype=np.float64)
    comparable = np.arange(6) // 3 == component // 3 if capacity is None else np.ones(6, dtype=np.bool_)
    share = np.abs(load.phasors.value[line] / rated)
    share = share / share[component]
    others = [
        f"{LOAD_COMPONENTS[i]} {share[i]:.2%}"
        for i in range(6)
        if i != component and comparable[i] and np.isfinite(share[i])
    ]
    if others:
        basis = "" if capacity is None else " (in shares of the rated loads)"
        text = f"beside {name} = 100 % the sensor carried {', '.join(others)}{basis}; the ratio contains their part"
        found.append(Notice("info", text, "sensitivity"))
    return tuple(found)
