"""The Monte Carlo run: all that follows tracks and channels, once per draw of everything uncertain."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.base import ProgressCallback, no_progress
from fusion.estimation.consistency import Acceleration
from fusion.estimation.fuse import UNOBSERVED, solve_consistently
from fusion.estimation.least_squares import build_system, hidden_motion
from fusion.estimation.measurement_model import Reading, StereoReading
from fusion.estimation.uncertainty import Uncertainty
from fusion.estimation.variance_components import LEAST_DOF
from fusion.sensitivity.analyse import Analysis, FirstOrder, Inputs, MonteCarlo, Propagated, judged, summarise
from fusion.sensitivity.draws import Deviates, Estimator, Instrument, draw_instrument, draw_load_matrices, pair_up
from shaker.arrays import ComplexArray, FloatArray, IntArray, Notice
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS, MOTION_COMPONENTS

NAMED = 4  # quantities named in a notice
BLOCK = 2000
"""Draws that are made at once; each block has streams of its own, so that blocks may be computed in any order."""


@dataclass(frozen=True)
class Known:
    """What a Monte Carlo run draws from: the inputs of the analysis, and what its observations were made of."""

    inputs: Inputs
    pairs: tuple[StereoReading, ...]
    readings: tuple[Reading, ...]


@dataclass(frozen=True)
class _Motion:
    """The fused acceleration of a body and how it comes from its instruments."""

    fused: Acceleration
    instruments: tuple[Instrument, ...]
    estimator: Estimator

    @property
    def estimate(self) -> ComplexArray:
        """Return the estimate (K, 6), zero where not observed."""
        return np.asarray(np.nan_to_num(self.fused.phasors.value))


def propagate(
    known: Known, found: Analysis, draws: int, seed: int, progress: ProgressCallback = no_progress
) -> MonteCarlo:
    """Return what N draws of everything uncertain make of acceleration, load and sensitivity at the driven lines.

    JCGM 101 and 102: noise from multivariate t-distributions with its degrees of freedom; masses, points, directions,
    poses, scales, delays, clocks from normal distributions of their stated standard uncertainties, each once by its
    name; places, finite rotations, products and delays enter exactly. Motion that nobody observes and disagreement
    between instruments are drawn as the evaluation states them. The weights of the instruments are the evaluation's.
    """
    motions = _motions(known, found)
    driven = np.flatnonzero(known.inputs.lines.multiple == 1)
    firsts = [_at(first, driven) for first in _first_order(found)]
    drawn: dict[str, list[ComplexArray]] = {first.name: [] for first, _ in firsts}
    for number, start in enumerate(range(0, draws, BLOCK)):
        deviates = Deviates(seed, number, min(BLOCK, draws - start))
        values = _draw(known, found, motions, deviates)
        for first, kept in firsts:
            drawn[first.name].append(values[first.name][:, driven][:, :, kept])
        progress("Monte Carlo", start + deviates.count, draws)
    results = [summarise(first, _where_known(first, drawn.pop(first.name))) for first, _ in firsts]
    return MonteCarlo(draws, seed, tuple(results), _notices(results, draws))


def _motions(known: Known, found: Analysis) -> tuple[_Motion, ...]:
    """Every fused acceleration with the instruments that took part in it."""
    inputs = known.inputs
    gravity = None if inputs.gravity_mps2 is None else np.array(inputs.gravity_mps2)
    instruments = pair_up(inputs.observations, known.pairs, known.readings, gravity)
    motions = []
    for fused in found.accelerations:
        if fused.source == "fused":
            own = [one for one in instruments if one.observation.body == fused.body]
            used = [one for one in own if one.observation.stated] or own
            seen = [one.observation for one in used]
            system = build_system(seen)
            solution = solve_consistently(system, fused.scatter).final
            motions.append(_Motion(fused, tuple(used), Estimator.of(seen, system.expand, solution)))
    return tuple(motions)


def _draw(known: Known, found: Analysis, motions: Sequence[_Motion], deviates: Deviates) -> dict[str, ComplexArray]:
    """One block of draws of every result, by its name: (N, K, components)."""
    drawn: dict[str, ComplexArray] = {}
    for motion in motions:
        drawn[_acceleration_name(motion.fused)] = acceleration = _draw_motion(motion, deviates)
        if motion.fused.body == "load" and found.load is not None:
            drawn["load"] = _draw_load(known.inputs, acceleration, deviates)
    if found.outputs is not None and found.sensitivity is not None:
        outputs = _draw_values(found.outputs.phasors.value, found.outputs.uncertainty, deviates, "outputs")
        places = np.array(found.sensitivity.elements)
        drawn["sensitivity"] = outputs[:, :, places[:, 0]] / drawn["load"][:, :, places[:, 1]]
    return drawn


def _draw_motion(motion: _Motion, deviates: Deviates) -> ComplexArray:
    """Accelerations (N, K, 6) of a body; where nobody observed a component, what it may be."""
    fused, estimate = motion.fused, motion.estimate
    parts = deviates.normal(f"unobserved motion of the {fused.body}", *estimate.shape, 2)
    hidden = hidden_motion(estimate, fused.observed) / np.sqrt(2.0) * (parts[..., 0] + 1j * parts[..., 1])
    readings = [draw_instrument(one, estimate, deviates) for one in motion.instruments]
    value = motion.estimator.acceleration(readings, estimate, hidden)
    value = value + _further(motion, deviates)
    return np.where(fused.observed, value, hidden)


def _further(motion: _Motion, deviates: Deviates) -> ComplexArray:
    """Changes (N, K, 6) by what is in the estimate's uncertainty beside the instruments' own errors: disagreement.

    A variance of it that the data hardly tell from zero has nominally less than one degree of freedom, of which no
    distribution follows; it is drawn with no fewer than `LEAST_DOF`.
    """
    fused = motion.fused
    own = {f"{name}: noise" for name in fused.instruments} | {UNOBSERVED}
    known = {error.name for one in motion.instruments for error in one.observation.common}
    change = np.zeros((deviates.count, *fused.observed.shape), dtype=np.complex128)
    for part in fused.uncertainty.random:
        if part.label not in own:
            dof = np.full(len(part.covariance), np.inf) if part.dof is None else np.maximum(part.dof, LEAST_DOF)
            change += _complex(deviates.noise(f"{part.label} of the {fused.body}", part.covariance, dof))
    for influence in fused.uncertainty.influences:
        if influence.name not in known:
            effect = np.nan_to_num(influence.effect)
            change += _complex(deviates.normal(influence.name)[:, None, None] * effect)
    return change


def _draw_load(inputs: Inputs, acceleration: ComplexArray, deviates: Deviates) -> ComplexArray:
    """Wrenches (N, K, 6) in the sensor's sense."""
    assert inputs.body is not None
    gravity = None if inputs.gravity_mps2 is None else np.array(inputs.gravity_mps2)
    frequency = inputs.lines.frequency_hz
    matrices = draw_load_matrices(inputs.body, frequency, gravity, np.array(inputs.u_gravity_mps2), deviates)
    sign = -1.0 if inputs.sensor is not None and inputs.sensor.sense == "on_sensor" else 1.0
    return np.asarray(sign * np.einsum("nkij,nkj->nki", matrices, acceleration))


def _draw_values(value: ComplexArray, uncertainty: Uncertainty, deviates: Deviates, name: str) -> ComplexArray:
    """Values (N, K, C) with noise, without their chains' relative errors, which act exactly: (1 + Re c)·exp(j·Im c)."""
    drawn = np.repeat(value[None], deviates.count, axis=0)
    for part in uncertainty.random:
        dof = np.full(len(part.covariance), np.inf) if part.dof is None else part.dof
        drawn = drawn + _complex(deviates.noise(f"{part.label} of {name}", part.covariance, dof))
    for influence in uncertainty.influences:
        effect = _complex(influence.effect[None])[0]
        relative = np.divide(effect, value, out=np.zeros_like(value), where=(value != 0.0) & np.isfinite(effect))
        size = deviates.normal(influence.name)[:, None, None]
        drawn = drawn / ((1.0 + size * relative.real) * np.exp(1j * size * relative.imag))
    return np.asarray(drawn)


def _complex(values: FloatArray) -> ComplexArray:
    """Values (N, K, C) of [all Re, all Im]."""
    half = values.shape[-1] // 2
    return np.asarray(values[..., :half] + 1j * values[..., half:])


def _acceleration_name(fused: Acceleration) -> str:
    """Name of an acceleration among the results."""
    return f"acceleration of the {fused.body}"


def _first_order(found: Analysis) -> Iterable[FirstOrder]:
    """Every result with its first-order uncertainty, all lines and elements."""
    for fused in found.accelerations:
        if fused.source == "fused":
            seen = fused.phasors
            yield _of(_acceleration_name(fused), MOTION_COMPONENTS, seen.unit, seen.value, fused.uncertainty, found)
    if found.load is not None:
        value = np.where(found.load.observed, found.load.value, complex(np.nan, np.nan))
        yield _of("load", LOAD_COMPONENTS, LOAD_UNITS, value, found.load.uncertainty, found)
    ratio = found.sensitivity
    if ratio is not None and found.outputs is not None:
        names = tuple(f"{ratio.channels[c]} per {ratio.components[j]}" for c, j in ratio.elements)
        units = tuple(f"({ratio.unit})/{'N' if j < 3 else '(N.m)'}" for _, j in ratio.elements)
        places = np.array(ratio.elements)
        yield _of("sensitivity", names, units, ratio.value[:, places[:, 0], places[:, 1]], ratio.uncertainty, found)


def _of(
    name: str,
    elements: Sequence[str],
    units: Sequence[str],
    value: ComplexArray,
    uncertainty: Uncertainty,
    found: Analysis,
) -> FirstOrder:
    """Collect one result."""
    count = len(elements)
    pair = np.arange(count)[:, None] + [0, count]
    covariance = uncertainty.covariance[:, pair[:, :, None], pair[:, None, :]]
    frequency = found.accelerations[0].phasors.frequency_hz
    return FirstOrder(name, frequency, tuple(elements), tuple(units), value, covariance, uncertainty.dof())


def _at(first: FirstOrder, driven: IntArray) -> tuple[FirstOrder, IntArray]:
    """Take the driven lines of a result and those elements that any of them determines; return their places as well."""
    kept = np.flatnonzero(np.isfinite(first.value[driven]).any(axis=0))
    place = np.ix_(driven, kept)
    own = FirstOrder(
        name=first.name,
        frequency_hz=first.frequency_hz[driven],
        elements=tuple(first.elements[q] for q in kept),
        unit=tuple(first.unit[q] for q in kept),
        value=first.value[place],
        covariance=first.covariance[place],
        dof=first.dof[place],
    )
    return own, kept


def _where_known(first: FirstOrder, blocks: Sequence[ComplexArray]) -> ComplexArray:
    """Join blocks of draws, NaN where a line does not determine an element."""
    return np.where(np.isfinite(first.value), np.concatenate(blocks), complex(np.nan, np.nan))


def _notices(results: Sequence[Propagated], draws: int) -> tuple[Notice, ...]:
    """Say where first-order propagation does not hold: a warning where its U is too small, else a remark."""
    small, large = judged(results, draws)
    found = []
    if small:
        text = (
            f"{draws} Monte Carlo draws do not confirm first-order propagation, whose U is too small: {_some(small)}; "
            "the intervals and regions of the Monte Carlo run hold there"
        )
        found.append(Notice("warning", text, "monte carlo"))
    if large:
        text = f"first-order U is larger than {draws} Monte Carlo draws need it to be: {_some(large)}"
        found.append(Notice("info", text, "monte carlo"))
    return tuple(found)


def _some(texts: Sequence[str]) -> str:
    """Join the first texts and count the others."""
    return "; ".join(texts[:NAMED]) + (f" and {len(texts) - NAMED} more" if len(texts) > NAMED else "")
