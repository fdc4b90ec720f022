"""From recordings with several loads, or a table of resonances, to load characteristics."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence

import numpy as np

from fusion.errors import ComputeError
from fusion.load_series.result import ComponentLoads, LoadEvaluation, NamedLimit, Solution
from fusion.load_series.series import LoadSeries
from fusion.load_series.settings import LoadSettings
from fusion.manifest import Manifest
from fusion.notices import Notice
from fusion.provenance import versions
from shaker.models.load_series.bands import working_bands
from shaker.models.load_series.characteristics import load_curve
from shaker.models.load_series.identify import identify_loads
from shaker.models.load_series.limits import LoadLimit, change_limit, formula_limit, frequency_limit
from shaker.models.load_series.model import LoadModel

GRID = 61
BEYOND = 1.25
"""Largest load that curves are drawn to, over the largest one recorded or asked for."""


def evaluate_loads(
    name: str,
    series: Sequence[LoadSeries],
    notices: Iterable[Notice],
    settings: LoadSettings,
    input_hashes: dict[str, str],
    manifest: Manifest | None = None,
) -> LoadEvaluation:
    """Return the load characteristics of every series; `manifest`: of a recording, for rig and sensor.

    Raises `ComputeError` where no model is found.
    """
    started = time.monotonic()
    components = tuple(_component(own, settings) for own in series)
    told = [*notices]
    for component in components:
        told += [*component.identification.notices, *_of_range(component, settings)]
    sensor = None if manifest is None else manifest.rig.sensor
    return LoadEvaluation(
        name=name,
        rig="" if manifest is None else manifest.rig.name,
        sensor="" if sensor is None else f"{sensor.name} {sensor.serial}".strip(),
        components=components,
        chosen=settings,
        notices=tuple(dict.fromkeys(told)),
        settings=settings.as_settings(),
        versions=versions(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _component(series: LoadSeries, settings: LoadSettings) -> ComponentLoads:
    """Model and characteristics of one component."""
    try:
        found = identify_loads(series.measured, series.masses, series.output, series.decays, series.noise)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        text = f"{series.output.component}: no load model was found ({error}); see docs/load.md, when it refuses"
        raise ComputeError(text) from error
    loads, moving = series.masses.load, series.masses.moving
    lightest = int(np.argmin(loads))
    scale = np.sqrt((moving + loads[lightest]) / (moving + loads))
    solutions = tuple(_solution(model, series, settings) for model in found.models)
    return ComponentLoads(series, found, series.measured.frequency_hz[lightest, 0] * scale, solutions)


def _solution(model: LoadModel, series: LoadSeries, settings: LoadSettings) -> Solution:
    """What follows from one model."""
    loads = series.masses.load
    asked = np.array(settings.predicted, dtype=np.float64)
    largest = float(np.max(np.concatenate([loads, asked]))) or model.moving_mass
    return Solution(
        model=model,
        recorded=load_curve(model, loads, series.masses.u_load),
        predicted=load_curve(model, asked),
        drawn=load_curve(model, np.linspace(0.0, BEYOND * largest, GRID)),
        bands=np.array([working_bands(model, float(load)) for load in loads]).reshape(-1, 2),
        predicted_bands=np.array([working_bands(model, float(load)) for load in asked]).reshape(-1, 2),
        limits=_limits(model, settings),
    )


def _limits(model: LoadModel, settings: LoadSettings) -> tuple[NamedLimit, ...]:
    """Loads that are permitted."""
    share = settings.permitted
    percent = f"{100.0 * share:g} %"
    found = [
        ("formula_limit", f"two-mass formula within {percent} of the resonance", formula_limit(model, share)),
        ("change_limit", f"resonance within {percent} of that without load", change_limit(model, share)),
    ]
    for wanted in settings.wanted_hz:
        found.append(("frequency_limit", f"resonance of at least {wanted:g} Hz", frequency_limit(model, wanted)))
    none = LoadLimit(float("nan"), float("nan"))
    return tuple(NamedLimit(name, label, *(limit or none)) for name, label, limit in found)


def _of_range(component: ComponentLoads, settings: LoadSettings) -> list[Notice]:
    """Say which predictions lie beyond the loads that were recorded."""
    largest = float(np.max(component.series.masses.load))
    unit = component.series.output.mass_unit
    beyond = [mass for mass in settings.predicted if mass > largest]
    if not beyond:
        return []
    told = ", ".join(f"{mass:g}" for mass in beyond)
    text = f"{told} {unit} lies beyond the largest load recorded, {largest:.4g} {unit}: the model is extrapolated"
    return [Notice("warning", text, component.name)]
