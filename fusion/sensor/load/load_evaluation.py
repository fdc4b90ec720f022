"""Releases of several loads to stiffness, damping and resonance over the load mass."""

from __future__ import annotations

import csv
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fusion.base import CommandEvaluation
from fusion.errors import ComputeError, InputError
from fusion.estimation.coverage import NamedQuantity, coverage_factor
from fusion.recording.load import Manifest
from fusion.recording.rig import Rig
from fusion.recording.toml import read_text
from fusion.recording.values import wrong_size
from fusion.sensitivity.moving_body import inertia_errors, rigid_load
from fusion.sensor.model_files import parameter_units
from fusion.sensor.step.step_records import effective_dof
from fusion.sensor.step.step_releases import StepRelease, read_recording
from fusion.sensor.unmodelled_effects import CAUSE_LABELS, ModelInfluences, describe_coverage, stated_influences
from shaker.arrays import FloatArray
from shaker.labels import LOAD_COMPONENTS
from shaker.release.load_model import (
    LoadCurve,
    LoadLimit,
    LoadModel,
    change_limit,
    figures_u,
    formula_limit,
    frequency_limit,
    load_curve,
    working_bands,
)
from shaker.release.load_modes import (
    FreeDecay,
    Resonances,
    SeriesMasses,
    SeriesOutput,
    as_resonances,
    free_decay,
    record_modes,
    stated_masses,
    stated_resonances,
)
from shaker.release.load_series import LoadIdentification, identify_loads
from shakercal._common.notices import Notice

# What a user of `shakercal load` may choose.

PERMITTED = 0.05


@dataclass(frozen=True)
class LoadSettings:
    """`permitted`: error of a formula, or change of the resonance, up to which a load is permitted, as a share.

    `wanted_hz`: resonances that are to be kept; `predicted`: masses, such as those of grippers or of a hand, that
    characteristics are foretold for, kg or kg·m². `moving_mass`: of a table's sensor with its standard uncertainty, kg;
    of recordings the rig states it.
    """

    permitted: float = PERMITTED
    target_hz: tuple[float, ...] = ()
    predicted: tuple[float, ...] = ()
    moving_mass: tuple[float, float] | None = None

    def as_settings(self) -> dict[str, str | float | int]:
        """Return the choices by name."""
        moving = zip(("moving_mass_kg", "u_moving_mass_kg"), self.moving_mass or (), strict=False)
        return {
            "permitted": self.permitted,
            "wanted_hz": " ".join(f"{value:.9g}" for value in self.target_hz),
            "predicted_load_masses": " ".join(f"{value:.9g}" for value in self.predicted),
            **dict(moving),
        }


# What a series of loads consists of before any model: records with their masses, or a table of resonances.

MOVING_MASS_LABEL = "moving mass of the sensor"
NO_CAUSE = ("load",)  # what a model over the load holds itself
TABLE_INFLUENCES = ModelInfluences(
    missing=tuple(cause for cause in CAUSE_LABELS if cause not in NO_CAUSE), records="within this table"
)


@dataclass(frozen=True)
class LoadSeries:
    """R records or table rows of one component: names, resonances, masses, the decays behind them (none of a table).

    `noise` (R,): standard deviations of the records, in output units, None of a table. `beside`: what is known of the
    models beside them.
    """

    output: SeriesOutput
    names: tuple[str, ...]
    measured: Resonances
    masses: SeriesMasses
    decays: tuple[FreeDecay, ...]
    noise: FloatArray | None
    influences: ModelInfluences = TABLE_INFLUENCES


def read_series(manifests: Sequence[Manifest]) -> tuple[tuple[LoadSeries, ...], tuple[Notice, ...]]:
    """Return a series for every component that recordings of a campaign release, and what had to be done.

    Raises `InputError` for what the user can mend in the files.
    """
    releases, told = zip(*(read_recording(manifest) for manifest in manifests), strict=True)
    notices = [
        *chain.from_iterable(told),
        *(notice for manifest in manifests for notice in manifest.certificate_notices),
    ]
    series, refused = list[LoadSeries](), list[InputError]()
    for place, component in enumerate(LOAD_COMPONENTS):
        own = [release for release in releases if release.record.component == component]
        moving = [_moving(release.manifest, place) for release in own]
        if own and moving[0].value > 0.0:
            series.append(_series(own, moving, place))
        elif own:
            expected = "what of the sensor moves with its spring, above 0: only ratios of masses show in a resonance"
            refused.append(InputError(own[0].manifest.rig_path, moving[0].key, found="0", expected=expected))
            text = f"left out: {moving[0].key} is 0, so that stiffness cannot be told"
            notices.append(Notice("warning", text, component))
    if not series and refused:
        raise refused[0]
    return tuple(series), tuple(notices)


class MovingMass(NamedTuple):
    """What of a sensor moves with its spring: mass, or moment of inertia, its standard uncertainty, its key."""

    value: float
    u: float
    key: str


def _moving(manifest: Manifest, component: int) -> MovingMass:
    """What a rig states of it for a load component."""
    sensor = manifest.rig.sensor
    if sensor is None:
        raise InputError(manifest.rig_path, "sensor", found="nothing", expected="[sensor] with internal_mass")
    return MovingMass(*sensor.moving(component), f"sensor.internal_{'mass' if component < 3 else 'inertia'}")


def _series(releases: Sequence[StepRelease], moving: Sequence[MovingMass], component: int) -> LoadSeries:
    """The records of one component with their masses, the lightest load first; all drive the same output."""
    masses = [_load(release.manifest, component) for release in releases]
    order = sorted(range(len(releases)), key=lambda place: masses[place][0])
    releases, masses = [releases[place] for place in order], [masses[place] for place in order]
    moving = [moving[place] for place in order]
    decays, modes = [], []
    for release in releases:
        try:
            decays.append(free_decay(release.record, release.driven, release.reading))
            modes.append(record_modes(decays[-1]))
        except ValueError as error:
            raise InputError.from_exception(error, release.manifest.path, f"daq.channel.{release.driven}") from error
    first, manifests = releases[0], [release.manifest for release in releases]
    for release, manifest, own in zip(releases, manifests, moving, strict=True):
        if release.driven != first.driven:
            expected = f"{first.driven}, the output that is driven in {first.name}"
            raise InputError(manifest.path, "daq.channel", found=release.driven, expected=expected)
        _check_alike((first.manifest, moving[0]), (manifest, own))
    gains, u = np.array([(release.reading.static_gain, release.reading.u_static_gain) for release in releases]).T
    between = float(np.std(gains, ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else 0.0
    u_gain = max(between, float(np.sqrt(np.sum(u**2))) / len(u))
    reading = first.reading
    return LoadSeries(
        output=SeriesOutput(reading.component, reading.channel, reading.unit, float(np.mean(gains)), u_gain),
        names=tuple(release.name for release in releases),
        measured=as_resonances(modes),
        masses=_masses(moving[0], masses),
        decays=tuple(decays),
        noise=np.array([item.noise for item in modes]),
        influences=stated_influences(
            _telling([release.manifest for release in releases]),
            [release.manifest.mounting for release in releases],
            NO_CAUSE,
        ),
    )


def _check_alike(first: tuple[Manifest, MovingMass], other: tuple[Manifest, MovingMass]) -> None:
    """Raise `InputError` where two rigs say different things of what moves in their one sensor."""
    (known, stated), (manifest, own) = first, other
    if own != stated:
        key, here, there = own.key, f"{own.value:g}", f"{stated.value:g}"
        if own.value == stated.value:
            key, here, there = f"{own.key}_uncertainty", f"{own.u:g}", f"{stated.u:g}"
        raise InputError(manifest.rig_path, key, found=here, expected=f"{there} as in {known.rig_path.name}")


def check_one_sensor(manifests: Sequence[Manifest]) -> None:
    """Raise `InputError` where recordings of several loads contradict each other in what they say of their sensor."""
    told = [manifest for manifest in manifests if manifest.rig.sensor is not None]
    for manifest, component in product(told[1:], range(len(LOAD_COMPONENTS))):
        _check_alike((told[0], _moving(told[0], component)), (manifest, _moving(manifest, component)))
    _telling(manifests)


def _telling(manifests: Sequence[Manifest]) -> Rig:
    """The rig that states what no record shows, of those of several loads; all that state something state the same."""
    telling = [one for one in manifests if one.rig.model is not None] or [manifests[0]]
    for other in telling:
        if other.rig.model != telling[0].rig.model:
            expected = f"the same as in {telling[0].rig_path.name}, since all are of one sensor"
            raise InputError(other.rig_path, "model", found="another statement", expected=expected)
    return telling[0].rig


def _load(manifest: Manifest, component: int) -> tuple[float, dict[str, float]]:
    """Load mass along a component with what each of its named errors changes; nothing without a [load]."""
    if manifest.rig.load is None:
        stranded = next((part.name for part in manifest.part if part.body == "load"), None)
        if stranded is not None:
            expected = f"the [load] that the part {stranded} belongs to"
            raise InputError(manifest.rig_path, "load", found="nothing", expected=expected)
        return 0.0, {}
    body = rigid_load(manifest)
    changes = {error.name: float(error.change[component, component]) for error in inertia_errors(manifest, body)}
    return float(body.mass_matrix[component, component]), {name: value for name, value in changes.items() if value}


def _masses(moving: MovingMass, loads: Sequence[tuple[float, dict[str, float]]]) -> SeriesMasses:
    """All masses; an error that several recordings name alike is one unknown."""
    own = [MOVING_MASS_LABEL] if moving.u > 0.0 else []
    names = [*own, *dict.fromkeys(name for _, changes in loads for name in changes)]
    effect = np.array([[changes.get(name, 0.0) for name in names] for _, changes in loads])
    moved = np.array([moving.u if name in own else 0.0 for name in names])
    mass = np.array([load for load, _ in loads])
    return SeriesMasses(moving.value, mass, tuple(names), moved, effect.reshape(len(loads), len(names)))


# A table of resonance frequencies of several loads, such as publications and spectrum analysers give.

LOAD, FIRST, U_FIRST, SECOND, U_LOAD = "load_mass_kg", "frequency_hz", "u_frequency_hz", "second_hz", "u_load_mass_kg"
COLUMNS = (LOAD, FIRST, U_FIRST, SECOND, U_LOAD)
LARGEST_TABLE, MOST_LOADS = 1_000_000, 100
"""Bytes and rows: published series have some ten loads, and each takes a tenth of a second of fits."""


def read_table(path: Path, moving_mass: float, u_moving_mass: float) -> LoadSeries:
    """Return the series that a table holds; raises `InputError` that names row and column.

    Columns load_mass_kg and frequency_hz are needed; u_frequency_hz, second_hz and u_load_mass_kg may stand beside
    them, an empty cell where a value is not known.
    """
    columns = _columns(path)
    order = np.argsort(columns[LOAD], kind="stable")
    first, load = columns[FIRST][order], columns[LOAD][order]
    u_first = np.nan_to_num(columns[U_FIRST][order])
    names = tuple(f"row {place + 1}" for place in order)
    measured = stated_resonances(first, u_first, columns[SECOND][order])
    masses = stated_masses(moving_mass, u_moving_mass, load, np.nan_to_num(columns[U_LOAD][order]))
    return LoadSeries(SeriesOutput("F", "", ""), names, measured, masses, (), None)


def _columns(path: Path) -> dict[str, FloatArray]:
    """All columns as numbers, NaN where nothing stands."""
    text = read_text(path, LARGEST_TABLE, "a table of loads")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    read = csv.DictReader(lines, delimiter=";" if lines and ";" in lines[0] else ",", skipinitialspace=True)
    try:
        rows = [{name.strip(): (cell or "").strip() for name, cell in row.items() if name is not None} for row in read]
    except csv.Error as error:
        raise InputError(path, "", found=str(error), expected="a table in text") from error
    if len(rows) > MOST_LOADS:
        raise InputError(path, "", found=f"{len(rows)} rows", expected=f"at most {MOST_LOADS} loads, one in each row")
    head = list(rows[0] if rows else {})
    missing = next((name for name in (LOAD, FIRST) if name not in head), None)
    if missing is not None:
        raise InputError(path, missing, found="nothing", expected="this column and a row for every load")
    unknown = next((name for name in head if name not in COLUMNS), None)
    if unknown is not None:
        raise InputError(path, unknown, found="this column", expected="columns of " + ", ".join(COLUMNS))

    def number(column: str, text: str, place: int) -> float:
        if not text and column not in (LOAD, FIRST):
            return float("nan")
        low = 0.0 if column in (LOAD, U_FIRST, U_LOAD) else np.nextafter(0.0, 1.0)
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value < np.inf or wrong_size(value):
            expected = "a number of at least 0" if low == 0.0 else "a frequency above 0"
            told = (text, expected) if text else ("nothing", "a number")
            raise InputError(path, f"{column}, row {place}", found=told[0], expected=told[1])
        return value

    return {name: np.array([number(name, row.get(name, ""), n) for n, row in enumerate(rows, 1)]) for name in COLUMNS}


# What evaluated load characteristics consist of.


@dataclass(frozen=True)
class LoadSolution:
    """One model that the data support, and what follows from it.

    Curves of both modes: `recorded` at the loads (R,), `predicted` at those asked for (P,), `drawn` over a grid (G,);
    `bands` (R, 2) and `predicted_bands` (P, 2): up to where the gain is within 5 and 10 % of that at rest, Hz, with the
    standard uncertainties `u_bands`, `u_predicted_bands`, NaN where unknown. `limits`: loads that are permitted, NaN
    where there is no limit. `notices`: which bands do not change in proportion to the model.
    """

    model: LoadModel
    recorded: LoadCurve
    predicted: LoadCurve
    drawn: LoadCurve
    bands: FloatArray
    predicted_bands: FloatArray
    limits: tuple[NamedQuantity, ...]
    u_bands: FloatArray
    u_predicted_bands: FloatArray
    notices: tuple[Notice, ...]


@dataclass(frozen=True)
class ComponentLoads:
    """The load characteristics of one component.

    `formula_hz` (R,): √(k/(m_E + m_L))/2π with k from the lightest load alone, what a rigid load would have. `dof`:
    degrees of freedom of U, those of the scatter about the model where that makes it.
    """

    series: LoadSeries
    identification: LoadIdentification
    formula_hz: FloatArray
    solutions: tuple[LoadSolution, ...]
    dof: float

    @property
    def name(self) -> str:
        """The component, Fx … Mz, or F of a table that does not say."""
        return self.series.output.component

    @property
    def k(self) -> float:
        """Coverage factor for 95 %."""
        return coverage_factor(self.dof)

    @property
    def covers(self) -> bool:
        """Whether there is an uncertainty at all."""
        return self.identification.chosen[0].covariance is not None


@dataclass(frozen=True)
class LoadEvaluation(CommandEvaluation):
    """Load characteristics of every component of a sensor."""

    rig: str
    sensor: str
    components: tuple[ComponentLoads, ...]
    chosen: LoadSettings

    @property
    def models(self) -> tuple[LoadModel, ...]:
        """Every model, of each component in the order of its solutions."""
        return tuple(solution.model for component in self.components for solution in component.solutions)


# From recordings with several loads, or a table of resonances, to load characteristics.

GRID = 61
BEYOND = 1.25  # largest load that curves are drawn to, over the largest one recorded or asked for


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

    >>> from fusion import evaluate_loads, load_for_command
    >>> from fusion.sensor.load.load_evaluation import LoadSettings, read_series
    >>> series, notices = read_series(load_for_command(["loads"], "load"))  # doctest: +SKIP
    >>> evaluation = evaluate_loads("loads", series, notices, LoadSettings(), {})  # doctest: +SKIP
    """
    started = time.monotonic()
    components = tuple(_component(own, settings) for own in series)
    told = [*notices]
    for component in components:
        told += component.identification.notices
        known = component.series.influences
        told.append(Notice("note", describe_coverage(known.scope, known.outside), component.name))
        told += [notice for solution in component.solutions for notice in solution.notices]
        largest, unit = float(np.max(component.series.masses.load)), component.series.output.mass_unit
        if beyond := ", ".join(f"{mass:g}" for mass in settings.predicted if mass > largest):
            text = f"{beyond} {unit} lies beyond the largest load recorded, {largest:.4g} {unit}"
            told.append(Notice("warning", f"{text}: the model is extrapolated", component.name))
    sensor = None if manifest is None else manifest.rig.sensor
    return LoadEvaluation(
        name=name,
        rig="" if manifest is None else manifest.rig.name,
        sensor="" if sensor is None else f"{sensor.name} {sensor.serial}".strip(),
        components=components,
        chosen=settings,
        notices=tuple(dict.fromkeys(told)),
        settings=settings.as_settings(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _component(series: LoadSeries, settings: LoadSettings) -> ComponentLoads:
    """Model and characteristics of one component."""
    try:
        identified = identify_loads(series.measured, series.masses, series.output, series.decays, series.noise)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        text = f"{series.output.component}: no load model was found ({error}); see docs/load.md, when it refuses"
        raise ComputeError(text) from error
    loads, moving = series.masses.load, series.masses.moving
    lightest = int(np.argmin(loads))
    scale = np.sqrt((moving + loads[lightest]) / (moving + loads))
    fit = identified.chosen[0]
    dof = float(fit.dof[0]) if fit.scatter[0] > 0.0 else float(np.inf)
    models = [series.influences.on_loads(model) for model in identified.models]
    if np.isfinite(dof) and series.influences.unknowns and models[0].total_covariance is not None:
        whole, own = (np.diag(np.asarray(one.covariance)) for one in (models[0], identified.models[0]))
        dof = float(np.min(effective_dof(whole, own, dof)[own > 0.0], initial=np.inf))
    solutions = tuple(_solution(model, dof, series, settings) for model in models)
    formula_hz = series.measured.frequency_hz[lightest, 0] * scale
    return ComponentLoads(series, identified, formula_hz, solutions, dof)


def _solution(model: LoadModel, dof: float, series: LoadSeries, settings: LoadSettings) -> LoadSolution:
    """What follows from one model."""
    loads = series.masses.load
    asked = np.array(settings.predicted, dtype=np.float64)
    largest = float(np.max(np.concatenate([loads, asked]))) or model.moving_mass
    share, unit = settings.permitted, parameter_units(model.component)["moving_mass"]
    percent = f"{100.0 * share:g} %"
    limits = [
        ("formula_limit", f"two-mass formula within {percent} of the resonance", formula_limit(model, share)),
        ("change_limit", f"resonance within {percent} of that without load", change_limit(model, share)),
    ]
    for wanted in settings.target_hz:
        limits.append(("frequency_limit", f"resonance of at least {wanted:g} Hz", frequency_limit(model, wanted)))
    unlimited, where = LoadLimit(float("nan"), float("nan")), f"{series.output.component}, {{:.4g}} {unit}"
    (bands, u_bands, told), (others, u_others, more) = (_bands(model, masses, where) for masses in (loads, asked))
    return LoadSolution(
        model=model,
        recorded=load_curve(model, loads, series.masses.u_load),
        predicted=load_curve(model, asked),
        drawn=load_curve(model, np.linspace(0.0, BEYOND * largest, GRID)),
        bands=bands,
        predicted_bands=others,
        u_bands=u_bands,
        u_predicted_bands=u_others,
        notices=tuple(dict.fromkeys((*told, *more))),
        limits=tuple(NamedQuantity(*(limit or unlimited), dof, unit, name, label) for name, label, limit in limits),
    )


def _bands(model: LoadModel, loads: FloatArray, where: str) -> tuple[FloatArray, FloatArray, list[Notice]]:
    """Bands (R, 2) of loads (R,), their standard uncertainties, and which do not change in proportion to the model."""
    bands, u, told = np.full((len(loads), 2), np.nan), np.full((len(loads), 2), np.nan), list[Notice]()
    for place, load in enumerate(loads.tolist()):
        bands[place] = working_bands(model, load)
        if model.total_covariance is not None:
            u[place], seen = figures_u(model, partial(working_bands, load_mass=load))
            told += [replace(one, where=where.format(load)) for one in seen.notices(("band_5_hz", "band_10_hz"))]
    return bands, np.where(np.isnan(bands), np.nan, u), told
