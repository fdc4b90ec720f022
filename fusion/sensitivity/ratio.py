"""The complex sensitivity, and what parasitic loads contribute to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from fusion.base import AnyNotice, rounded
from fusion.estimation.uncertainty import (
    Influence,
    Polar,
    Uncertainty,
    coverage_factor,
    element_covariance,
    polar,
    real_design,
    real_stack,
)
from fusion.instruments.channel import Outputs
from fusion.instruments.vibrometer import PARALLEL, PointRatios, PointSpread
from fusion.sensitivity.body import Body
from fusion.sensitivity.load import BudgetEntry, LoadResult, budget
from shaker.arrays import BoolArray, ComplexArray, FloatArray, Notice, brief, check_shape
from shaker.labels import LOAD_COMPONENTS

# The complex sensitivity: elements by output channel and load component, and the ratio of one recording.


Kind = Literal["ratio", "matrix", "harmonic"]


@dataclass(frozen=True)
class Sensitivity:
    """Complex sensitivities of C sensor outputs to six load components at K lines.

    `value` (K, C, 6), NaN where not determined; `elements`: channel and component of the E elements determined at any
    line, of which `uncertainty` is, NaN at lines without a value; `unit` of the outputs ("V/V"), so that an element's
    unit is (unit)/N or (unit)/(N.m); `kind` per line; `budget` of the E elements.
    """

    frequency_hz: FloatArray
    value: ComplexArray
    elements: tuple[tuple[int, int], ...]
    uncertainty: Uncertainty
    channels: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    kind: tuple[Kind, ...]
    notices: tuple[AnyNotice, ...]
    budget: tuple[BudgetEntry, ...] = field(init=False)

    __repr__ = brief

    def __post_init__(self) -> None:
        lines, count = len(self.frequency_hz), len(self.elements)
        check_shape("value", self.value, (lines, len(self.channels), len(self.components)))
        if len(self.kind) != lines:
            raise ValueError(f"kind: expected {lines} words, one per line, found {len(self.kind)}")
        check_shape("uncertainty", self.uncertainty.random[0].covariance, (lines, 2 * count, 2 * count))
        object.__setattr__(self, "budget", budget(self.uncertainty, self.value[:, *self._places()]))

    @property
    def observed(self) -> BoolArray:
        """Return which elements (C, 6) have a value at any line."""
        return np.asarray(np.any(np.isfinite(self.value), axis=0))

    @cached_property
    def covariance(self) -> FloatArray:
        """Return the covariance (K, C, 6, 2, 2) of (Re, Im) of every element, NaN where there is none."""
        every = np.full((*self.value.shape, 2, 2), np.nan)
        pair = np.arange(len(self.elements))[:, None] + [0, len(self.elements)]
        every[:, *self._places()] = self.uncertainty.covariance[:, pair[:, :, None], pair[:, None, :]]
        return every

    @cached_property
    def dof(self) -> FloatArray:
        """Return the effective degrees of freedom (K, C, 6) of every element, NaN where there is none."""
        every = np.full(self.value.shape, np.nan)
        every[:, *self._places()] = self.uncertainty.dof()
        return every

    @cached_property
    def dof_polar(self) -> FloatArray:
        """Return those of magnitude and phase (2, K, C, 6), NaN where there is no element."""
        every = np.full((2, *self.value.shape), np.nan)
        every[:, :, *self._places()] = self.uncertainty.dof_polar(self.value[:, *self._places()])
        return every

    def _places(self) -> tuple[list[int], list[int]]:
        return [channel for channel, _ in self.elements], [component for _, component in self.elements]


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
    outputs: Outputs,
    load: LoadResult,
    component: int,
    multiple: ArrayLike,
    capacity: Sequence[float] | None = None,
) -> Sensitivity:
    """Return output / load of the driven `component` for every output channel of one recording.

    S = U/L; dS = dU/L - S dL/L, in which an unknown that acts on both (a clock, an amplifier) is one change.
    `multiple` (K,): 1 at a fundamental ("ratio"), else "harmonic".
    """
    channels = outputs.phasors.channels
    driven = np.where(load.observed[:, component], load.value[:, component], np.nan)[:, None]
    ratio = quotient(outputs.phasors.value, driven)
    from_load = load.uncertainty.at([component]).transformed(real_design(quotient(-ratio, driven)[:, :, None]))
    from_outputs = outputs.uncertainty.scaled(np.broadcast_to(quotient(1.0, driven), ratio.shape))
    value = np.full((*ratio.shape, 6), complex(np.nan, np.nan))
    value[:, :, component] = ratio
    name, notices = LOAD_COMPONENTS[component], []
    if not np.any(np.isfinite(ratio)):
        notices.append(Notice("warning", f"{name} could not be determined: no sensitivity", "sensitivity"))
    else:
        # What else acted on the sensor at the strongest line; forces and moments compare in shares of rated loads only.
        rated = np.ones(6) if capacity is None else np.asarray(capacity)
        given = np.abs(np.where(load.observed, load.value, np.nan)) / rated
        line = int(np.nanargmax(given[:, component]))
        share = given[line] / given[line, component]
        others = [
            f"{LOAD_COMPONENTS[i]} {share[i]:.2%}"
            for i in range(6)
            if i != component and (capacity is not None or i // 3 == component // 3) and np.isfinite(share[i])
        ]
        if others:
            basis = "" if capacity is None else " (in shares of the rated loads)"
            text = f"beside {name} = 100 % the sensor carried {', '.join(others)}{basis}; the ratio contains their part"
            notices.append(Notice("info", text, "sensitivity"))
    return Sensitivity(
        frequency_hz=outputs.phasors.frequency_hz,
        value=value,
        elements=tuple((channel, component) for channel in range(len(channels))),
        uncertainty=from_load.plus(from_outputs),
        channels=channels,
        components=LOAD_COMPONENTS,
        unit=outputs.phasors.unit[0],
        kind=tuple("ratio" if m == 1 else "harmonic" for m in np.asarray(multiple).tolist()),
        notices=tuple(notices),
    )


def quotient(numerator: ComplexArray | float, denominator: ComplexArray) -> ComplexArray:
    """Return the complex quotient, NaN where the denominator is zero or not known."""
    shape = np.broadcast_shapes(np.shape(numerator), denominator.shape)
    usable = np.isfinite(denominator) & (denominator != 0.0)
    empty = np.full(shape, complex(np.nan, np.nan))
    return np.asarray(np.divide(numerator, denominator, out=empty, where=usable))


# What load components that were not meant to act contribute to the outputs of one recording, by the static matrix.


@dataclass(frozen=True)
class ParasiticLoads:
    """Share (K, C) of each output that the other load components explain, and its uncertainty.

    `value`: complex, relative to the whole output, NaN where the load is not known; nearly equal to what the ratio of
    output and driven load is wrong by, relative, if it is read as an element of the sensitivity.
    """

    value: ComplexArray
    uncertainty: Uncertainty

    def element(self, line: int, channel: int) -> Polar:
        """Return one share with its uncertainty; its real part enlarges the output, its imaginary part turns it."""
        pair = element_covariance(self.uncertainty.covariance[line], channel)
        return polar(complex(self.value[line, channel]), pair, float(self.uncertainty.dof()[line, channel]))

    def factors(self, line: int, channel: int) -> tuple[float, float]:
        """Return the coverage factors of real and imaginary part of one share."""
        one = self.uncertainty.at([channel]).at_lines([line])
        real, imaginary = (float(one.dof_along(np.array([d]))[0, 0]) for d in (1.0 + 0.0j, 1.0j))
        return coverage_factor(real), coverage_factor(imaginary)

    def notices(self, line: int, channel: int, where: str) -> tuple[Notice, ...]:
        """Return what the output of one channel at one line owes to other loads; `where` names both."""
        if not abs(self.value[line, channel]) > 0.0:
            return ()
        share = self.element(line, channel)
        k_re, k_im = self.factors(line, channel)
        more = rounded(100.0 * share.re, 100.0 * k_re * share.u_re, 0)
        turn = rounded(1e3 * share.im, 1e3 * k_im * share.u_im, 0)
        text = (
            f"by the static sensitivity the other load components make ({more.value} ± {more.expanded}) % of {where} "
            f"and turn it by ({turn.value} ± {turn.expanded}) mrad"
        )
        return (Notice("info", text, "sensitivity"),)


def parasitic_loads(
    outputs: Outputs, load: LoadResult, static: ArrayLike, component: int, u_static: float = 0.0
) -> ParasiticLoads:
    """Return z = Σ_{j≠d} S_cj L_j / U_c over the load components j other than the driven one d.

    `static` (C, 6): static sensitivity of the channels; `u_static`: relative standard uncertainty of each element by
    itself. dz = Σ (S_cj dL_j + dS_cj L_j) / U_c - z dU_c / U_c, with unknowns that act on both load and outputs as one;
    components of the motion that nobody observed are in L at zero with their uncertainty.
    """
    matrix = np.array(static, dtype=np.complex128)
    matrix[:, component] = 0.0
    signal = outputs.phasors.value
    slope = quotient(matrix, np.broadcast_to(signal[:, :, None], (*signal.shape, 6)))
    parts = slope * load.value[:, None, :]
    value = np.sum(parts, axis=2)
    from_load = load.uncertainty.transformed(real_design(slope))
    total = from_load.plus(outputs.uncertainty.scaled(quotient(-value, signal)))
    own = []
    for channel, j in np.argwhere(matrix != 0.0).tolist() if u_static > 0.0 else ():
        change = np.zeros(signal.shape, dtype=np.complex128)
        change[:, channel] = u_static * parts[:, channel, j]
        name = f"static sensitivity {outputs.phasors.channels[channel]} per {LOAD_COMPONENTS[j]}"
        own.append(Influence(name, "static sensitivity", u_static, "1", real_stack(change), "rig"))
    return ParasiticLoads(value, Uncertainty(total.random, (*total.influences, *own)))


# The ratio point by point, where several vibrometer points look along the force that was driven.


def with_ratios(spread: PointSpread, outputs: Outputs, sensitivity: Sensitivity, body: Body) -> PointSpread:
    """Return the spread with S_i = U/(m a_i) of the output that answers most to the force along the points.

    m is the mass that moves above the elastic element. dS = S (dU/U - da/a - dm/m), in which an unknown of both sides
    (a clock) is one change. Where the excitation drives another component than that force there is nothing to add.
    """
    axis = int(np.argmax(np.abs(spread.direction)))
    along = abs(spread.direction[axis]) > 1.0 - PARALLEL
    elements = np.abs(sensitivity.value[:, :, axis])
    if spread.body != "load" or not along or not np.isfinite(elements).any():
        return spread
    channel = int(np.argmax(np.nanmax(elements, axis=0)))
    mass = body.weightless.load_matrix(spread.frequency_hz)[:, axis, axis]
    driven = mass[:, None] * spread.value
    value = outputs.phasors.value[:, channel, None] / driven
    from_output = outputs.uncertainty.at([channel]).transformed(real_design((1.0 / driven)[:, :, None]))
    known = from_output.plus(spread.uncertainty.scaled(-value / spread.value))
    # What one kilogram more changes, times what the uncertain masses may be off by.
    masses = [
        change.acting(real_stack(-value / mass[:, None] * change.effect[:, axis, axis, None]))
        for change in body.weightless.matrix_changes(spread.frequency_hz)
        if np.any(change.effect[:, axis, axis])
    ]
    ratios = PointRatios(
        channel=sensitivity.channels[channel],
        component=sensitivity.components[axis],
        unit=sensitivity.unit,
        value=value,
        uncertainty=Uncertainty(known.random, (*known.influences, *masses)),
        fused=sensitivity.value[:, channel, axis],
    )
    return replace(spread, ratios=ratios)
