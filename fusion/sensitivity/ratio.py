"""Complex sensitivity: ratio of one recording, contributions of parasitic loads, and the sensor's element."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from fusion.estimation.coverage import Polar, coverage_factor, polar
from fusion.estimation.instrument_consistency import OUTPUT_MISTAKES, describe_deviation, likely_mistake
from fusion.estimation.labelled_phasors import LabelledPhasors, TabularResult
from fusion.estimation.measurement_model import BODY_SIZE_M
from fusion.estimation.uncertainty import (
    Contribution,
    Influence,
    Uncertainty,
    Unknown,
    element_covariance,
    element_covariances,
    merge_contributions,
    polar_elements,
    real_stack,
)
from fusion.instruments.channel import Outputs
from fusion.instruments.vibrometer import PARALLEL, PointRatios, PointSpread
from fusion.sensitivity.load_phasors import BudgetEntry, LoadResult, budget
from fusion.sensitivity.moving_body import Body
from fusion.sensitivity.sensitivity_notices import MASS_DOUBTED, OUTPUT_CONTRADICTS
from shaker.labels import LOAD_COMPONENTS, sensitivity_unit
from shaker.sine.phasor import real_stacked
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, check_shape
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.recording.rig import Sensor

# The complex sensitivity: elements by output channel and load component, and the ratio of one recording.


Kind = Literal["ratio", "element", "matrix", "harmonic"]


@dataclass(frozen=True, repr=False)
class Sensitivity(TabularResult):
    """Complex sensitivities of C sensor outputs to six load components at K lines.

    Attributes
    ----------
    frequency_hz : (K,), Hz.
    value : (K, C, 6), NaN where not determined.
    elements : channel and component of the E elements determined at any line.
    uncertainty : of the E elements, NaN at lines without a value.
    channels, components : names of outputs (C) and load components (6).
    unit : unit of the outputs, such as "V/V"; that of an element is (unit)/N or (unit)/(N.m).
    kind : kind of each line.
    notices : notices of the sensitivity.
    budget : uncertainty budget of the E elements.
    """

    frequency_hz: FloatArray
    value: ComplexArray
    elements: tuple[tuple[int, int], ...]
    uncertainty: Uncertainty
    channels: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    kind: tuple[Kind, ...]
    notices: tuple[Notice, ...]
    budget: tuple[BudgetEntry, ...] = field(init=False)

    def __post_init__(self) -> None:
        lines, count = len(self.frequency_hz), len(self.elements)
        check_shape("value", self.value, (lines, len(self.channels), len(self.components)))
        if len(self.kind) != lines:
            raise ValueError(f"kind: expected {lines} words, one per line, found {len(self.kind)}")
        check_shape("uncertainty", self.uncertainty.random[0].covariance, (lines, 2 * count, 2 * count))
        object.__setattr__(self, "budget", budget(self.uncertainty, self.value[:, *self._element_index()]))

    def labelled(self) -> LabelledPhasors:
        """Return the elements with their names and units."""
        rows, columns = self._element_index()
        channels, components = [self.channels[row] for row in rows], [self.components[column] for column in columns]
        units = tuple(sensitivity_unit(self.unit, component) for component in components)
        name = "element" if "element" in self.kind else "sensitivity"
        labels = tuple(channels), tuple(components), units
        value = self.value[:, rows, columns]
        return LabelledPhasors(name, self.frequency_hz, value, *labels, self.uncertainty, self.kind)

    @property
    def observed(self) -> BoolArray:
        """Return which elements (C, 6) have a value at any line."""
        return np.asarray(np.any(np.isfinite(self.value), axis=0))

    @cached_property
    def covariance(self) -> FloatArray:
        """Return the covariance (K, C, 6, 2, 2) of (Re, Im), or NaN."""
        every = np.full((*self.value.shape, 2, 2), np.nan)
        every[:, *self._element_index()] = element_covariances(self.uncertainty.covariance)
        return every

    @cached_property
    def dof(self) -> FloatArray:
        """Return the effective degrees of freedom (K, C, 6) of every element, or NaN."""
        every = np.full(self.value.shape, np.nan)
        every[:, *self._element_index()] = self.uncertainty.dof()
        return every

    @cached_property
    def polar(self) -> list[list[Polar | None]]:
        """Return magnitude and phase (K lines of E), None where one is not known."""
        return polar_elements(self.value[:, *self._element_index()], self.uncertainty)

    def _element_index(self) -> tuple[list[int], list[int]]:
        return [channel for channel, _ in self.elements], [component for _, component in self.elements]


def driven_component(direction: Sequence[float], capacity: Sequence[float] | None = None) -> int:
    """Return the load component (0..5) that the excitation drives.

    The largest of 3 or 6 numbers. Forces and moments of a 6-vector are compared in shares of the rated `capacity` (6,)
    if it is stated.
    """
    size = np.abs(np.asarray(direction, dtype=np.float64))
    if size.shape not in ((3,), (6,)) or not np.any(size > 0.0):
        raise ValueError(f"direction: expected 3 or 6 numbers, not all zero, found {list(direction)}")
    if capacity is not None and len(size) == 6:
        size = size / np.asarray(capacity, dtype=np.float64)
    return int(np.argmax(size))


def sensitivity_ratio(outputs: Outputs, load: LoadResult, component: int, multiple: ArrayLike) -> Sensitivity:
    """Return output / load of the driven `component` for every output of one recording.

    S = U/L; dS = dU/L - S dL/L, in which an unknown of both (a clock, an amplifier) is one change. `multiple` (K,): 1
    at a fundamental ("ratio"), else "harmonic".
    """
    channels = outputs.phasors.channels
    driven = np.where(load.observed[:, component], load.value[:, component], np.nan)[:, None]
    ratio = quotient(outputs.phasors.value, driven)
    from_load = load.uncertainty.at([component]).transformed(real_stacked(quotient(-ratio, driven)[:, :, None]))
    from_outputs = outputs.uncertainty.scaled(np.broadcast_to(quotient(1.0, driven), ratio.shape))
    value = np.full((*ratio.shape, 6), complex(np.nan, np.nan))
    value[:, :, component] = ratio
    return Sensitivity(
        frequency_hz=outputs.phasors.frequency_hz,
        value=value,
        elements=tuple((channel, component) for channel in range(len(channels))),
        uncertainty=from_load.plus(from_outputs),
        channels=channels,
        components=LOAD_COMPONENTS,
        unit=outputs.phasors.unit[0],
        kind=tuple("ratio" if m == 1 else "harmonic" for m in np.asarray(multiple).tolist()),
        notices=(),
    )


def quotient(numerator: ComplexArray | float, denominator: ComplexArray) -> ComplexArray:
    """Return the complex quotient, NaN where the denominator is zero or not known."""
    shape = np.broadcast_shapes(np.shape(numerator), denominator.shape)
    usable = np.isfinite(denominator) & (denominator != 0.0)
    empty = np.full(shape, complex(np.nan, np.nan))
    return np.asarray(np.divide(numerator, denominator, out=empty, where=usable))


# Contributions of other load components to the outputs of one recording, by the static matrix.


@dataclass(frozen=True)
class ParasiticLoads:
    """Share (K, C) of each output that other load components cause.

    `value`: complex, relative to the whole output, NaN where the load is not known. It is nearly the relative error of
    the ratio of output and driven load as an element of the sensitivity.
    """

    value: ComplexArray
    uncertainty: Uncertainty

    def element(self, line: int, channel: int) -> Polar:
        """Return one share: its real part enlarges the output, its imaginary part turns it."""
        pair = element_covariance(self.uncertainty.covariance[line], channel)
        return polar(complex(self.value[line, channel]), pair, float(self.uncertainty.dof()[line, channel]))

    def factors(self, line: int, channel: int) -> tuple[float, float]:
        """Return the coverage factors of real and imaginary part of one share."""
        one = self.uncertainty.at([channel]).at_lines([line])
        real, imaginary = (float(one.dof_along(np.array([d]))[0, 0]) for d in (1.0 + 0.0j, 1.0j))
        return coverage_factor(real), coverage_factor(imaginary)


def parasitic_loads(
    outputs: Outputs,
    load: LoadResult,
    static: ArrayLike,
    component: int,
    unknowns: Iterable[Unknown[ComplexArray]] = (),
) -> ParasiticLoads:
    """Return the share of each output by load components other than the driven one.

    z = Σ_{j≠d} S_cj L_j / U_c with the driven component d. `static` (C, 6): static sensitivity of the channels with the
    `unknowns` of the element (`static_unknowns`). dz = Σ (S_cj dL_j + dS_cj L_j) / U_c - z dU_c / U_c, with unknowns of
    both load and outputs as one. Unobserved components of the motion are zero in L, with their uncertainty.
    """
    matrix = np.array(static, dtype=np.complex128)
    matrix[:, component] = 0.0
    signal = outputs.phasors.value
    slope = quotient(matrix, np.broadcast_to(signal[:, :, None], (*signal.shape, 6)))
    parts = slope * load.value[:, None, :]
    value = np.sum(parts, axis=2)
    from_load = load.uncertainty.transformed(real_stacked(slope))
    total = from_load.plus(outputs.uncertainty.scaled(quotient(-value, signal)))
    static_influences = []
    for unknown in unknowns:
        changed = unknown.effect.copy()
        changed[:, component] = 0.0
        change = quotient(load.value @ changed.T, signal)
        static_influences += [unknown.acting(real_stack(change))] if np.any(changed) else []
    return ParasiticLoads(value, Uncertainty(total.random, (*total.influences, *static_influences)))


# The stated matrix of the sensor, and the element of one recording by it.


U_STATIC = 1e-3
"""Standard uncertainty of a static matrix if none is stated: relative, of main elements; over the rated output at the
rated load, of the others. Most static calibrations of multi-component sensors are not better a year later."""
RATED = "rated cross-talk"


@dataclass(frozen=True)
class StatedMatrix:
    """Statements on the matrix of a sensor with outputs `channels` (C), None if missing.

    `capacity` (6,) in N and N.m. `static` (C, 6) with the relative standard uncertainty `u_static` of every element (0:
    not stated) and `u_cross_talk`, over the rated output, of elements other than the main ones. `cross_talk`: its
    largest value, over the rated output at the rated load.
    """

    channels: tuple[str, ...]
    capacity: FloatArray | None
    static: FloatArray | None
    u_static: float = 0.0
    cross_talk: float | None = None
    u_cross_talk: float | None = None

    @classmethod
    def of(cls, sensor: Sensor) -> StatedMatrix:
        """Return the statements of rig.toml."""
        capacity, static = (
            None if stated is None else np.array(stated, dtype=np.float64)
            for stated in (sensor.capacity, sensor.static_sensitivity)
        )
        u_static, cross_talk = sensor.static_sensitivity_uncertainty, sensor.cross_talk
        return cls(tuple(sensor.channels), capacity, static, u_static, cross_talk, sensor.cross_talk_uncertainty)

    @property
    def u_relative(self) -> float:
        """Return the relative standard uncertainty of main elements, `U_STATIC` where none is stated."""
        return self.u_static or U_STATIC

    def u_elements(self, static: FloatArray) -> FloatArray:
        """Return the standard uncertainties of rows of the static matrix (C, 6), in their units."""
        share = U_STATIC if self.u_cross_talk is None else self.u_cross_talk
        signal = np.abs(static) * self.rated
        u = np.hypot(self.u_relative * np.abs(static), share * signal.max(axis=1)[:, None] / self.rated)
        main = np.arange(len(static)), np.argmax(signal, axis=1)
        u[main] = self.u_relative * np.abs(static[main])
        return np.asarray(u)

    @property
    def rated(self) -> FloatArray:
        """Return the rated loads (6,); if none are stated, moments are scaled by 0.1 m."""
        return np.array([1.0] * 3 + [BODY_SIZE_M] * 3) if self.capacity is None else self.capacity


@dataclass(frozen=True)
class PriorMatrix:
    """Prior matrix of C outputs under the driven load `component` d.

    `main` m: the output that belongs to it. `rows`: the E outputs with an element of the recording. `value` (C, 6): up
    to one complex factor, the change of the driven element over frequency. `unknowns`: real, each with its change (C,
    6) of the value per standard uncertainty. `static`: the values are a static calibration (normal unknowns), or zero
    except for the driven element, with rated cross-talk as bounds (uniform unknowns).
    """

    channels: tuple[str, ...]
    component: int
    main: int
    rows: tuple[int, ...]
    value: FloatArray
    unknowns: tuple[Unknown[ComplexArray], ...]
    static: bool

    def elements(
        self, outputs: ComplexArray, load: ComplexArray, matrix: ComplexArray | FloatArray | None = None
    ) -> ComplexArray:
        """Return the E elements (..., E) of outputs (..., C) under loads (..., 6).

        `matrix` (..., C, 6): another value. S_cd = (U_c - h Σ_{j≠d} S⁰_cj L_j) / L_d with h = U_m / Σ_j S⁰_mj L_j.
        """
        value = self.value if matrix is None else matrix
        rows, d = list(self.rows), self.component
        parts = value * load[..., None, :]
        change = quotient(outputs[..., self.main], np.sum(parts[..., self.main, :], axis=-1))
        others = np.sum(np.delete(parts[..., rows, :], d, axis=-1), axis=-1)
        return quotient(outputs[..., rows] - change[..., None] * others, np.asarray(load[..., d, None] + 0.0j))

    def frequency_unknowns(self, outputs: ComplexArray, load: ComplexArray) -> tuple[Unknown[ComplexArray], ...]:
        """Return possible deviations (K, C, 6) of other elements from the driven one's change.

        The evidence is the change |h - 1| of the driven element from its static value. Every other element may deviate
        from h by the same relative amount, in a uniform direction of the complex plane: |h - 1|/√2 as standard
        uncertainty of real and imaginary part. Each is one unknown for all frequencies and recordings, because the
        change is smooth and belongs to the sensor. Rated bounds have none.
        """
        if not self.static:
            return ()
        change = quotient(outputs[:, self.main], load @ self.value[self.main])
        deviation = np.nan_to_num(np.abs(change - 1.0)) / np.sqrt(2.0)
        driven = f"{self.channels[self.main]}/{LOAD_COMPONENTS[self.component]}"
        found = list[Unknown[ComplexArray]]()
        for c, j in np.argwhere(self.value != 0.0).tolist():
            if j == self.component or c not in (self.main, *self.rows):
                continue
            name = f"course of {self.channels[c]}/{LOAD_COMPONENTS[j]} over frequency beside {driven}"
            for part, turn in (("real part", 1.0), ("imaginary part", 1j)):
                effect = np.zeros((len(deviation), *self.value.shape), np.complex128)
                effect[:, c, j] = turn * deviation * self.value[c, j]
                label = "static matrix at this frequency"
                found.append(Unknown(f"{name}, {part}", label, float(deviation.max(initial=0.0)), "1", effect, "rig"))
        return tuple(found)

    def uncertainty(
        self, outputs: ComplexArray, load: ComplexArray, of_outputs: Uncertainty, of_load: Uncertainty, given: BoolArray
    ) -> Uncertainty:
        """Return the first-order uncertainty of the E elements of K lines.

        Unknowns of one name are one. dS_cd = [dU_c - h dP_c - P_c dh - S_cd dL_d] / L_d with P_c = Σ_{j≠d} S⁰_cj L_j, h
        = U_m/Q, Q = Σ_j S⁰_mj L_j. Hence dP_c = Σ_{j≠d} (S⁰_cj dL_j + L_j dS⁰_cj) and dh = (dU_m - h Σ_j (S⁰_mj dL_j +
        L_j dS⁰_mj)) / Q. For a load that is not `given` (K, 6) dL_j may be far larger than L_j: the variance of dL_j
        dS⁰_cj is added (JCGM 100, 5.1.2, note).
        """
        rows, m, d = list(self.rows), self.main, self.component
        driven, whole = np.asarray(load[:, d, None] + 0.0j), load @ self.value[m]
        others = self.value[rows]
        others[:, d] = 0.0
        ratio, parasitic = quotient(outputs[:, m], whole)[:, None], load @ others.T
        back = quotient(ratio * parasitic, whole[:, None])
        by_outputs = np.zeros((len(load), len(rows), len(self.channels)), np.complex128)
        by_outputs[:, range(len(rows)), rows] = 1.0
        by_outputs[:, :, m] -= quotient(parasitic, whole[:, None])
        by_load = back[:, :, None] * self.value[m] - ratio[:, :, None] * others
        by_load[:, :, d] -= self.elements(outputs, load)
        total = of_outputs.nan_as_zero().transformed(
            real_stacked(np.nan_to_num(quotient(by_outputs, driven[:, :, None])))
        )
        total = total.plus(
            of_load.nan_as_zero().transformed(real_stacked(np.nan_to_num(quotient(by_load, driven[:, :, None]))))
        )
        influences, products = list[Influence](), list[Contribution]()
        hidden = ~np.tile(given, (1, 2))
        unsure = np.where(hidden[:, :, None] & hidden[:, None, :], np.nan_to_num(of_load.covariance), 0.0)
        unknowns = (*self.unknowns, *self.frequency_unknowns(outputs, load))
        if unknowns:
            shape = len(load), *self.value.shape
            effect = np.stack([np.broadcast_to(unknown.effect, shape) for unknown in unknowns])
            others_effect = effect[:, :, rows]
            others_effect[..., d] = 0.0
            by_each = back[:, :, None] * effect[:, :, None, m] - ratio[:, :, None] * others_effect
            slope = np.nan_to_num(quotient(by_each, driven[:, :, None]))
            acting = real_stack(np.einsum("ukcj,kj->ukc", slope, np.nan_to_num(load)))
            both = real_stacked(slope)
            spread = both @ unsure @ both.swapaxes(2, 3)
            influences = [unknown.acting(change) for unknown, change in zip(unknowns, acting, strict=True)]
            products = [Contribution(u.label, "B", square) for u, square in zip(unknowns, spread, strict=True)]
        lost = np.tile(~np.isfinite(self.elements(outputs, load)), (1, 2))
        first = total.random[0]
        blank = np.where(lost[:, :, None] | lost[:, None, :], np.nan, first.covariance)
        random = (replace(first, covariance=blank), *total.random[1:], *products)
        return Uncertainty(merge_contributions(random), (*total.influences, *influences))


def prior_matrix(stated: StatedMatrix, channels: Sequence[str], component: int, sizes: ArrayLike) -> PriorMatrix | None:
    """Return the prior matrix of some outputs under a driven load, None without statements.

    With a static matrix every other element S_cj is S⁰_cj·h, with the change h of the driven main element, which the
    recording measures. From rest to the frequency the measuring chain changes first, equally for all elements of an
    output, and elastic parts change other loads like the driven one. Only differences between elements remain
    (`PriorMatrix.frequency_unknowns`). For the main output S = S⁰_md·U_m / Σ_j S⁰_mj L_j, so that a scale error of the
    static calibration cancels.

    Uncertainty of S⁰: relative, and for other than main elements over the rated output, because a cross-talk of 2 % is
    not known to a thousandth of itself. A row with only its main element (zeros otherwise) gives no cross-talk unless
    `u_cross_talk` states how near to zero it is.

    Without a static matrix, rated cross-talk x: S_mj uniform within ± x·|S_md|·capacity_d/capacity_j, for the main
    output only, with the measured S_md. `sizes` (C,): outputs over the driven load, which select the main output if
    neither its name nor a static matrix does.
    """
    names, rated = tuple(channels), stated.rated
    indices = [stated.channels.index(name) for name in names]
    if stated.static is not None:
        static, main_name = stated.static[indices], stated.channels[int(np.argmax(np.abs(stated.static[:, component])))]
        main = names.index(main_name) if main_name in names else None
        informative = np.count_nonzero(static, axis=1) > (stated.u_cross_talk is None)
        if main is not None and informative[main] and static[main, component] != 0.0:
            rows = tuple(np.flatnonzero(informative).tolist())
            return PriorMatrix(
                names, component, main, rows, static, static_unknowns(stated, names, static), static=True
            )
    if stated.cross_talk is None or stated.capacity is None:
        return None
    named = LOAD_COMPONENTS[component]
    main = names.index(named) if named in names else int(np.argmax(np.nan_to_num(np.abs(np.asarray(sizes)))))
    value, unknowns = np.zeros((len(names), 6)), list[Unknown[ComplexArray]]()
    value[main, component] = 1.0
    for j in (j for j in range(6) if j != component):
        effect = np.zeros(value.shape, np.complex128)
        effect[main, j] = stated.cross_talk / np.sqrt(3.0) * rated[component] / rated[j]
        name = f"{RATED} {names[main]}/{LOAD_COMPONENTS[j]}"
        u = stated.cross_talk / float(np.sqrt(3.0))
        unknowns.append(Unknown(name, RATED, u, "1", effect, "rig", distribution="uniform"))
    return PriorMatrix(names, component, main, (main,), value, tuple(unknowns), static=False)


def static_unknowns(
    stated: StatedMatrix, channels: tuple[str, ...], static: FloatArray
) -> tuple[Unknown[ComplexArray], ...]:
    """Return one unknown per element of a static matrix (C, 6), in the element's unit."""
    u, found = stated.u_elements(static), []
    for c, j in np.ndindex(static.shape):
        effect = np.zeros(static.shape, np.complex128)
        effect[c, j] = u[c, j]
        name = f"static sensitivity {channels[c]}/{LOAD_COMPONENTS[j]}"
        found.append(Unknown(name, "static sensitivity", float(u[c, j]), "", effect, "rig"))
    return tuple(found)


def sensor_element(
    outputs: Outputs, load: LoadResult, prior: PriorMatrix, multiple: ArrayLike, notices: Sequence[Notice] = ()
) -> Sensitivity:
    """Return the elements of the driven load at the fundamentals (`PriorMatrix.elements`)."""
    usable = (np.asarray(multiple) == 1) & load.observed[:, prior.component]
    force = np.where(usable[:, None], load.value, complex(np.nan, np.nan))
    signal = outputs.phasors.value
    value = np.full((*signal.shape, 6), complex(np.nan, np.nan))
    value[:, list(prior.rows), prior.component] = prior.elements(signal, force)
    return Sensitivity(
        frequency_hz=outputs.phasors.frequency_hz,
        value=value,
        elements=tuple((channel, prior.component) for channel in prior.rows),
        uncertainty=prior.uncertainty(signal, force, outputs.uncertainty, load.uncertainty, load.observed),
        channels=outputs.phasors.channels,
        components=LOAD_COMPONENTS,
        unit=outputs.phasors.unit[0],
        kind=tuple("element" for _ in signal),
        notices=tuple(notices),
    )


# Contradictions of outputs and static matrix.

CHANGED = 0.3
"""Relative change of an element since rest from which its static value is doubted."""
CROSS_TALK = 0.05
"""Cross-talk, over the rated output at the rated load, that a static matrix may omit (chosen)."""


def contradicting_outputs(
    outputs: Outputs, load: LoadResult, prior: PriorMatrix, rated: FloatArray, line: int
) -> Iterator[Notice]:
    """Yield a warning of outputs that contradict the static matrix at one line.

    An output may deviate by `CHANGED` of its prediction, by a cross-talk of `CROSS_TALK` of the load that is largest
    over its rated one, and by three standard uncertainties.
    """
    signal, force, names = outputs.phasors.value[line], np.nan_to_num(load.value[line]), prior.channels
    predicted = force @ prior.value.T
    full = np.max(np.abs(prior.value) * rated, axis=1)
    at_line = load.uncertainty.at_lines([line]).nan_as_zero()
    of_load = at_line.transformed(real_stacked(prior.value[None].astype(np.complex128)))
    pair = np.diagonal(of_load.covariance[0]).reshape(2, -1).sum(axis=0)
    cross = CROSS_TALK * np.max(np.abs(force) / rated) * full
    noise = 3.0 * np.hypot(np.sqrt(pair), np.hypot(outputs.phasors.u_re[line], outputs.phasors.u_im[line]))

    def agrees(found: int, named: int) -> bool:
        distance = abs(signal[found] - predicted[named])
        return bool(distance <= CHANGED * abs(predicted[named]) + cross[named] + noise[named])

    stated = [c for c in range(len(names)) if np.isfinite(signal[c]) and full[c] > 0.0]
    doubted = [c for c in stated if not agrees(c, c)]
    if not doubted:
        return
    listed, mistakes = list[str](), list[str]()
    for c in doubted:
        ratio = complex(quotient(signal[c], predicted[c, None])[0])
        mistake = likely_mistake(ratio, CHANGED, OUTPUT_MISTAKES) if abs(predicted[c]) > cross[c] else ""
        if not mistake and abs(abs(ratio) - 1.0) < CHANGED:
            mistake = "the delay or response of its chain were missing or in another unit"
        mistakes.append(mistake)
        listed.append(describe_deviation(names[c], ratio, mistake))
    pairs = [(a, b) for a, b in combinations(doubted, 2) if agrees(a, b) and agrees(b, a)]
    exchanges = [f"whether {names[a]} and {names[b]} are exchanged" for a, b in pairs]
    checks = (
        "sensor.static_sensitivity, sensor.unit, sensor.sense, load.mass, load.inertia and load.centre_of_mass "
        "in rig.toml, scale, delay, response and channel of the outputs in recording.toml"
    )
    yield Notice(
        OUTPUT_CONTRADICTS,
        "sensitivity",
        frequency_hz=outputs.phasors.frequency_hz[line],
        outputs="; ".join(listed),
        checks=", ".join([*exchanges, checks]),
        mistake_explains=any(mistakes) or bool(pairs),
    )


MIN_CHANGE_FROM_REST, MAX_RESONANCE_HZ = 0.03, 500.0
"""Relative change of the driven element from rest that needs a resonance, and the highest such resonance (chosen)."""


def mass_notices(element: str, ratio: complex, frequency_hz: float) -> Iterator[Notice]:
    """Yield a warning of a wrong or missing mass if no resonance explains the element.

    `ratio`: the element over its static value at one frequency. Below its resonance f₀ an oscillator's is 1/(1 -
    (f/f₀)²), never below one, in phase.
    """
    size, resonance = abs(ratio), "which no resonance above that explains"
    if not MIN_CHANGE_FROM_REST < abs(size - 1.0) <= CHANGED or abs(np.angle(ratio)) > CHANGED:
        return
    if size > 1.0:
        natural_hz = frequency_hz / np.sqrt(1.0 - 1.0 / size)
        if natural_hz > MAX_RESONANCE_HZ:
            return
        resonance = f"as with a resonance at {natural_hz:.3g} Hz"
    yield Notice(
        MASS_DOUBTED, "sensitivity", element=element, factor=size, frequency_hz=frequency_hz, resonance=resonance
    )


# The ratio point by point, where several vibrometer points look along the force that was driven.


def with_ratios(spread: PointSpread, outputs: Outputs, sensitivity: Sensitivity, body: Body) -> PointSpread:
    """Return the spread with the ratio S_i = U/(m a_i) of each point.

    Of the output with the largest response to the force along the points. m is the mass above the elastic element, for
    a rigid load. dS = S (dU/U - da/a - dm/m), in which an unknown of both sides (a clock) is one change. The spread is
    unchanged if the excitation drives another component.
    """
    axis = int(np.argmax(np.abs(spread.direction)))
    along = abs(spread.direction[axis]) > 1.0 - PARALLEL
    elements = np.abs(sensitivity.value[:, :, axis])
    if spread.body != "load" or not along or not np.isfinite(elements).any():
        return spread
    channel = int(np.argmax(np.nanmax(elements, axis=0)))
    rigid = replace(body.weightless, elastic=())
    mass = rigid.load_matrix(spread.frequency_hz)[:, axis, axis]
    driven = mass[:, None] * spread.value
    value = outputs.phasors.value[:, channel, None] / driven
    from_output = outputs.uncertainty.at([channel]).transformed(real_stacked((1.0 / driven)[:, :, None]))
    first_order = from_output.plus(spread.uncertainty.scaled(-value / spread.value))
    # Change per kilogram times the uncertainty of the masses.
    masses = [
        change.acting(real_stack(-value / mass[:, None] * change.effect[:, axis, axis, None]))
        for change in rigid.matrix_changes(spread.frequency_hz)
        if np.any(change.effect[:, axis, axis])
    ]
    ratios = PointRatios(
        channel=sensitivity.channels[channel],
        component=sensitivity.components[axis],
        unit=sensitivity.unit,
        value=value,
        uncertainty=Uncertainty(first_order.random, (*first_order.influences, *masses)),
        fused=sensitivity.value[:, channel, axis],
    )
    return replace(spread, ratios=ratios)
