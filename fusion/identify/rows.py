"""An identification as rows of files: parameters.csv and readings.csv."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion.coverage import coverage_factor
from fusion.identify.result import ComponentResult, IdentifyEvaluation
from fusion.results_csv import Row
from shaker.models.measured import ParameterEstimate
from shaker.models.sensor.sensor_response import CHAIN_WORDS

PARAMETER_COLUMNS = ["component", "name", "value", "u", "k", "U", "unit", "method"]
READING_COLUMNS = [
    "component",
    "recording",
    "response",
    "method",
    "frequency_hz",
    "u_frequency_hz",
    "width_hz",
    "u_width_hz",
    "damping_ratio",
    "u_damping_ratio",
    "stiffness",
    "damping",
    "note",
]


def numbers(component: ComponentResult) -> Iterator[tuple[ParameterEstimate, str]]:
    """Every number found of a component, and the method that found it."""
    fit = component.fit
    how = f"joint fit, {fit.model}"
    for estimate in fit.identification.estimates:
        stated = estimate.name == component.internal_mass.name and not fit.mass_is_free
        yield estimate, f"{how}, stated beforehand" if stated else how
    for estimate in (*fit.identification.derived, *_modes(component)):
        yield estimate, how
    if component.sensitivity is not None:
        best = component.sensitivity.comparison.best
        for estimate in best.estimates:
            yield estimate, f"sensitivity over frequency, {CHAIN_WORDS[best.chain.kind]}"
    for load, band in zip(component.loads, component.bands, strict=True):
        place = f"load {load:.6g}"
        name, label = f"usable_band: {place}", f"usable band, {place}"
        yield ParameterEstimate(name, label, band.upper_hz, band.u_upper_hz, "Hz"), "sensor model"


def parameter_rows(evaluation: IdentifyEvaluation) -> Iterator[Row]:
    """One row per number."""
    k = coverage_factor(np.inf)
    for component in evaluation.components:
        for estimate, method in numbers(component):
            values: Row = [estimate.value, estimate.u, k, k * estimate.u]
            yield [component.name, estimate.name, *values, plain(estimate.unit), method]


def reading_rows(evaluation: IdentifyEvaluation) -> Iterator[Row]:
    """One row per method and curve; what a method does not tell is `nan`."""
    for component in evaluation.components:
        for reading in component.readings:
            yield [component.name, *(getattr(reading, column) for column in READING_COLUMNS[1:])]


def plain(unit: str) -> str:
    """ASCII form of a unit for files: `N·m/rad` becomes `N.m/rad`."""
    return unit.replace("·", ".").replace("²", "^2")


def _modes(component: ComponentResult) -> Iterator[ParameterEstimate]:
    """Frequency and damping ratio of every mode of every recording that shows a curve."""
    curves = {reading.recording for reading in component.readings}
    for mode in component.fit.identification.modes:
        if mode.record not in curves:
            continue
        place = f"{mode.record}, mode {mode.number + 1}"
        frequency = (f"frequency: {place}", f"resonance f₀, {place}")
        yield ParameterEstimate(*frequency, mode.frequency_hz, mode.u_frequency_hz, "Hz")
        ratio = (f"damping_ratio: {place}", f"damping ratio ζ, {place}")
        yield ParameterEstimate(*ratio, mode.damping_ratio, mode.u_damping_ratio, "1")
