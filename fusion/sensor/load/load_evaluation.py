"""Evaluation of releases of several loads: stiffness, damping and resonance over the load mass."""

from __future__ import annotations

import csv
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
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
from fusion.sensor import model_notices as declared
from fusion.sensor.model_files import parameter_units
from fusion.sensor.step.step_pool import effective_dof
from fusion.sensor.step.step_releases import StepRelease, check_driven_output, read_recording
from fusion.sensor.unmodelled_effects import CAUSE_LABELS, ModelInfluences, coverage_notice, stated_influences
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
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

# Choices of `shakercal load`.

PERMITTED = 0.05  # default of a permitted error, as of ±5 % bands


@dataclass(frozen=True)
class LoadSettings:
    """Choices of an evaluation of load characteristics.

    Attributes
    ----------
    permitted : permitted error of a formula, or change of the resonance, as a ratio. Default 0.05.
    target_hz : resonances for which the permitted load is reported, Hz.
    predicted : load masses for which characteristics are predicted, kg or kg·m².
    moving_mass : moving mass of a table's sensor with its standard uncertainty, kg; None for recordings.
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


# A series of loads: records with their masses, or a table of resonances.

MOVING_MASS_LABEL = "moving mass of the sensor"
NO_CAUSE = ("load",)  # the load is a variable of the model itself
TABLE_INFLUENCES = ModelInfluences(
    missing=tuple(cause for cause in CAUSE_LABELS if cause not in NO_CAUSE), records="within this table"
)


@dataclass(frozen=True)
class LoadSeries:
    """Records or table rows (R) of one component, with resonances, masses and decays.

    `noise` (R,): standard deviations of the records in output units, None of a table. `influences`: influences on the
    models that the records do not show.
    """

    output: SeriesOutput
    names: tuple[str, ...]
    measured: Resonances
    masses: SeriesMasses
    decays: tuple[FreeDecay, ...]
    noise: FloatArray | None
    influences: ModelInfluences = TABLE_INFLUENCES
    poles: tuple[ComplexArray, ...] = ()


def read_series(manifests: Sequence[Manifest]) -> tuple[tuple[LoadSeries, ...], tuple[Notice, ...]]:
    """Return one series per released component of a campaign, and the notices of reading.

    Raises `InputError` for a file or key that the user has to correct.
    """
    releases, of_reading = zip(*(read_recording(manifest) for manifest in manifests), strict=True)
    notices = [*chain(*of_reading, *(manifest.certificate_notices for manifest in manifests))]
    series, refused = list[LoadSeries](), list[InputError]()
    for index, component in enumerate(LOAD_COMPONENTS):
        of_component = [release for release in releases if release.record.component == component]
        moving = [_moving(release.manifest, index) for release in of_component]
        if of_component and moving[0].value > 0.0:
            series.append(_series(of_component, moving, index))
        elif of_component:
            rig_path = of_component[0].manifest.rig_path
            refused.append(InputError(declared.NO_MOVING_MASS, rig_path, moving[0].key, found=moving[0].value))
            notices.append(Notice(declared.COMPONENT_WITHOUT_MOVING_MASS, component, key=moving[0].key))
    if not series and refused:
        raise refused[0]
    return tuple(series), tuple(notices)


class MovingMass(NamedTuple):
    """Mass, or moment of inertia, that moves with a sensor's spring."""

    value: float
    u: float
    key: str


def _moving(manifest: Manifest, component: int) -> MovingMass:
    """Return the moving mass that a rig states for a load component."""
    sensor = manifest.rig.sensor
    if sensor is None:
        raise InputError(declared.MOVING_MASS_NOT_STATED, manifest.rig_path, "sensor")
    return MovingMass(*sensor.moving(component), f"sensor.internal_{'mass' if component < 3 else 'inertia'}")


def _series(releases: Sequence[StepRelease], moving: Sequence[MovingMass], component: int) -> LoadSeries:
    """Return the records of one component with their masses, the lightest load first."""
    masses = [_load(release.manifest, component) for release in releases]
    order = sorted(range(len(releases)), key=lambda index: masses[index][0])
    releases, masses = [releases[index] for index in order], [masses[index] for index in order]
    moving = [moving[index] for index in order]
    decays, modes = [], []
    for release in releases:
        try:
            decays.append(free_decay(release.record, release.driven, release.reading))
            modes.append(record_modes(decays[-1]))
        except ValueError as error:
            key = f"daq.channel.{release.driven}"
            raise InputError.from_exception(error, release.manifest.path, key, declared.NO_FREE_OSCILLATION) from error
    first, reading = releases[0], releases[0].reading
    for release, mass in zip(releases, moving, strict=True):
        check_driven_output(first, release)
        _check_equal_mass((first.manifest, moving[0]), (release.manifest, mass))
    manifests = [release.manifest for release in releases]
    mountings = [manifest.mounting for manifest in manifests]
    gains, u = np.array([(release.reading.static_gain, release.reading.u_static_gain) for release in releases]).T
    between = float(np.std(gains, ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else 0.0
    u_gain = max(between, float(np.sqrt(np.sum(u**2))) / len(u))
    return LoadSeries(
        output=SeriesOutput(reading.component, reading.channel, reading.unit, float(np.mean(gains)), u_gain),
        names=tuple(release.name for release in releases),
        measured=as_resonances(modes),
        masses=_masses(moving[0], masses),
        decays=tuple(decays),
        noise=np.array([item.noise for item in modes]),
        poles=tuple(item.poles for item in modes),
        influences=stated_influences(_rig_with_influences(manifests), mountings, NO_CAUSE),
    )


def _check_equal_mass(first: tuple[Manifest, MovingMass], other: tuple[Manifest, MovingMass]) -> None:
    """Raise `InputError` if two rigs state different moving masses of their sensor."""
    (reference, expected), (manifest, found) = first, other
    if found != expected:
        key, stated, here = found.key, expected.value, found.value
        if here == stated:
            key, stated, here = f"{key}_uncertainty", expected.u, found.u
        file = reference.rig_path.name
        raise InputError(
            declared.CONTRADICTORY_MOVING_MASS, manifest.rig_path, key, file=file, expected=stated, found=here
        )


def check_one_sensor(manifests: Sequence[Manifest]) -> None:
    """Raise `InputError` if recordings of several loads state contradictory values of their sensor."""
    stating = [manifest for manifest in manifests if manifest.rig.sensor is not None]
    for manifest, component in product(stating[1:], range(len(LOAD_COMPONENTS))):
        _check_equal_mass((stating[0], _moving(stating[0], component)), (manifest, _moving(manifest, component)))
    _rig_with_influences(manifests)


def _rig_with_influences(manifests: Sequence[Manifest]) -> Rig:
    """Return the rig that states influences; all such rigs must state the same."""
    stating = [one for one in manifests if one.rig.model is not None] or [manifests[0]]
    for other in stating:
        if other.rig.model != stating[0].rig.model:
            file = stating[0].rig_path.name
            raise InputError(declared.CONTRADICTORY_MODEL_STATEMENT, other.rig_path, "model", file=file)
    return stating[0].rig


def _load(manifest: Manifest, component: int) -> tuple[float, dict[str, float]]:
    """Return the load mass along a component, with the change by each error."""
    if manifest.rig.load is None:
        stranded = next((part.name for part in manifest.part if part.body == "load"), None)
        if stranded is not None:
            raise InputError(declared.PART_WITHOUT_LOAD, manifest.rig_path, "load", part=stranded)
        return 0.0, {}
    body = rigid_load(manifest)
    changes = {error.name: float(error.change[component, component]) for error in inertia_errors(manifest, body)}
    return float(body.mass_matrix[component, component]), {name: value for name, value in changes.items() if value}


def _masses(moving: MovingMass, loads: Sequence[tuple[float, dict[str, float]]]) -> SeriesMasses:
    """Return all masses; errors of the same name are one unknown."""
    of_sensor = [MOVING_MASS_LABEL] if moving.u > 0.0 else []
    names = [*of_sensor, *dict.fromkeys(name for _, changes in loads for name in changes)]
    effect = np.array([[changes.get(name, 0.0) for name in names] for _, changes in loads])
    moved = np.array([moving.u if name in of_sensor else 0.0 for name in names])
    mass = np.array([load for load, _ in loads])
    return SeriesMasses(moving.value, mass, tuple(names), moved, effect.reshape(len(loads), len(names)))


# A table of resonance frequencies of several loads, such as publications and spectrum analysers give.

LOAD, FIRST, U_FIRST, SECOND, U_LOAD = "load_mass_kg", "frequency_hz", "u_frequency_hz", "second_hz", "u_load_mass_kg"
COLUMNS = (LOAD, FIRST, U_FIRST, SECOND, U_LOAD)
LARGEST_TABLE, MOST_LOADS = 1_000_000, 100
"""Bytes and rows: published series have some ten loads, and each takes a tenth of a second of fits."""


def read_table(path: Path, moving_mass: float, u_moving_mass: float) -> LoadSeries:
    """Return the series of a table; raises `InputError` at the row and column to correct.

    Columns load_mass_kg and frequency_hz are required; u_frequency_hz, second_hz and u_load_mass_kg are optional. A
    value that is not known is an empty cell.
    """
    columns = _columns(path)
    order = np.argsort(columns[LOAD], kind="stable")
    first, load = columns[FIRST][order], columns[LOAD][order]
    u_first = np.nan_to_num(columns[U_FIRST][order])
    names = tuple(f"row {index + 1}" for index in order)
    measured = stated_resonances(first, u_first, columns[SECOND][order])
    masses = stated_masses(moving_mass, u_moving_mass, load, np.nan_to_num(columns[U_LOAD][order]))
    return LoadSeries(SeriesOutput("F", "", ""), names, measured, masses, (), None)


def _columns(path: Path) -> dict[str, FloatArray]:
    """Return all columns as numbers, NaN for empty cells."""
    text = read_text(path, LARGEST_TABLE, "a table of loads")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    read = csv.DictReader(lines, delimiter=";" if lines and ";" in lines[0] else ",", skipinitialspace=True)
    try:
        rows = [{name.strip(): (cell or "").strip() for name, cell in row.items() if name is not None} for row in read]
    except csv.Error as error:
        raise InputError(declared.LOAD_TABLE_NOT_READABLE, path, reason=str(error)) from error
    if len(rows) > MOST_LOADS:
        raise InputError(declared.TOO_MANY_LOADS, path, found=len(rows), limit=MOST_LOADS)
    head = list(rows[0] if rows else {})
    missing = next((name for name in (LOAD, FIRST) if name not in head), None)
    if missing is not None:
        raise InputError(declared.LOAD_COLUMN_MISSING, path, missing)
    unknown = next((name for name in head if name not in COLUMNS), None)
    if unknown is not None:
        raise InputError(declared.UNKNOWN_LOAD_COLUMN, path, unknown, expected=", ".join(COLUMNS))

    def number(column: str, text: str, row: int) -> float:
        if not text and column not in (LOAD, FIRST):
            return float("nan")
        low = 0.0 if column in (LOAD, U_FIRST, U_LOAD) else np.nextafter(0.0, 1.0)
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value < np.inf or wrong_size(value):
            expected = "a number of at least 0" if low == 0.0 else "a frequency above 0"
            found, expected = (text, expected) if text else ("no value", "a number")
            raise InputError(declared.WRONG_LOAD_NUMBER, path, f"{column}, row {row}", found=found, expected=expected)
        return value

    return {name: np.array([number(name, row.get(name, ""), n) for n, row in enumerate(rows, 1)]) for name in COLUMNS}


# Parts of evaluated load characteristics.


@dataclass(frozen=True)
class LoadSolution:
    """One model that the data support, with its characteristics.

    Attributes
    ----------
    recorded, predicted, drawn : curves of both modes at the recorded loads (R), the requested loads (P), and a grid
        (G).
    bands, predicted_bands : (R, 2) and (P, 2), Hz, limits within which the gain is within 5 and 10 % of the static
        gain.
    u_bands, u_predicted_bands : their standard uncertainties, NaN if not known.
    limits : permitted loads, NaN without a limit.
    notices : bands that do not change in proportion to the model.
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

    `formula_hz` (R,): √(k/(m_E + m_L))/2π of a rigid load, with k from the lightest load. `dof`: degrees of freedom of
    U, those of the scatter about the model if it determines U.
    """

    series: LoadSeries
    identification: LoadIdentification
    formula_hz: FloatArray
    solutions: tuple[LoadSolution, ...]
    dof: float

    @property
    def name(self) -> str:
        """The component, Fx … Mz, or F of a table."""
        return self.series.output.component

    @property
    def k(self) -> float:
        """Coverage factor for 95 %."""
        return coverage_factor(self.dof)

    @property
    def covers(self) -> bool:
        """Whether the model has an uncertainty."""
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
BEYOND = 1.25  # largest load of drawn curves, over the largest one recorded or requested


def evaluate_loads(
    name: str,
    series: Sequence[LoadSeries],
    notices: Iterable[Notice],
    settings: LoadSettings,
    input_hashes: dict[str, str],
    manifest: Manifest | None = None,
) -> LoadEvaluation:
    """Evaluate the load characteristics of every series.

    Parameters
    ----------
    name
        Name of the evaluation in the results.
    series
        One per component, of `read_series` or `read_table`.
    notices
        Notices of reading.
    settings
        Choices of the evaluation.
    input_hashes
        SHA-256 of the input files by name, for the results.
    manifest
        A recording, for the names of rig and sensor; None (default) of a table.

    Returns
    -------
    LoadEvaluation : model, resonances, bands and limits of every component.

    Raises
    ------
    ComputeError : no model was found for a component.

    Examples
    --------
    >>> from fusion import evaluate_loads, load_for_command
    >>> from fusion.sensor.load.load_evaluation import LoadSettings, read_series
    >>> series, notices = read_series(load_for_command(["loads"], "load"))  # doctest: +SKIP
    >>> evaluation = evaluate_loads("loads", series, notices, LoadSettings(), {})  # doctest: +SKIP
    """
    started = time.monotonic()
    components = tuple(_component(one, settings) for one in series)
    found = [*notices]
    for component in components:
        found += component.identification.notices
        influences = component.series.influences
        found.append(coverage_notice(influences.scope, influences.outside, component.name))
        found += [notice for solution in component.solutions for notice in solution.notices]
        largest, unit = float(np.max(component.series.masses.load)), component.series.output.mass_unit
        if loads := ", ".join(f"{mass:g}" for mass in settings.predicted if mass > largest):
            found.append(Notice(declared.EXTRAPOLATED_LOAD, component.name, loads=loads, unit=unit, largest=largest))
    sensor = None if manifest is None else manifest.rig.sensor
    return LoadEvaluation(
        name=name,
        rig="" if manifest is None else manifest.rig.name,
        sensor="" if sensor is None else f"{sensor.name} {sensor.serial}".strip(),
        components=components,
        chosen=settings,
        notices=tuple(dict.fromkeys(found)),
        settings=settings.as_settings(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _component(series: LoadSeries, settings: LoadSettings) -> ComponentLoads:
    """Model and characteristics of one component."""
    try:
        identified = identify_loads(
            series.measured, series.masses, series.output, series.decays, series.noise, series.poles
        )
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise ComputeError(declared.NO_LOAD_MODEL, series.output.component, reason=str(error)) from error
    loads, moving = series.masses.load, series.masses.moving
    lightest = int(np.argmin(loads))
    scale = np.sqrt((moving + loads[lightest]) / (moving + loads))
    fit = identified.chosen[0]
    dof = float(fit.dof[0]) if fit.scatter[0] > 0.0 else float(np.inf)
    models = [series.influences.on_loads(model) for model in identified.models]
    if np.isfinite(dof) and series.influences.unknowns and models[0].total_covariance is not None:
        whole, by_scatter = (np.diag(np.asarray(one.covariance)) for one in (models[0], identified.models[0]))
        dof = float(np.min(effective_dof(whole, by_scatter, dof)[by_scatter > 0.0], initial=np.inf))
    solutions = tuple(_solution(model, dof, series, settings) for model in models)
    formula_hz = series.measured.frequency_hz[lightest, 0] * scale
    return ComponentLoads(series, identified, formula_hz, solutions, dof)


def _solution(model: LoadModel, dof: float, series: LoadSeries, settings: LoadSettings) -> LoadSolution:
    """Return the characteristics of one model."""
    loads = series.masses.load
    requested = np.array(settings.predicted, dtype=np.float64)
    largest = float(np.max(np.concatenate([loads, requested]))) or model.moving_mass
    share, unit = settings.permitted, parameter_units(model.component)["moving_mass"]
    percent = f"{100.0 * share:g} %"
    limits = [
        ("formula_limit", f"two-mass formula within {percent} of the resonance", formula_limit(model, share)),
        ("change_limit", f"resonance within {percent} of that without load", change_limit(model, share)),
        *(
            ("frequency_limit", f"resonance of at least {hertz:g} Hz", frequency_limit(model, hertz))
            for hertz in settings.target_hz
        ),
    ]
    unlimited, where = LoadLimit(float("nan"), float("nan")), f"{series.output.component}, {{:.4g}} {unit}"
    (bands, u_bands, notices), (others, u_others, more) = (
        _bands(model, masses, u, where) for masses, u in ((loads, series.masses.u_load), (requested, 0.0 * requested))
    )
    return LoadSolution(
        model=model,
        recorded=load_curve(model, loads, series.masses.u_load),
        predicted=load_curve(model, requested),
        drawn=load_curve(model, np.linspace(0.0, BEYOND * largest, GRID)),
        bands=bands,
        predicted_bands=others,
        u_bands=u_bands,
        u_predicted_bands=u_others,
        notices=tuple(dict.fromkeys((*notices, *more))),
        limits=tuple(NamedQuantity(*(limit or unlimited), dof, unit, name, label) for name, label, limit in limits),
    )


def _bands(
    model: LoadModel, loads: FloatArray, u_loads: FloatArray, where: str
) -> tuple[FloatArray, FloatArray, list[Notice]]:
    """Return bands (R, 2) of loads (R,), their u, and notices of nonlinear ones."""
    bands, u, notices = np.full((len(loads), 2), np.nan), np.full((len(loads), 2), np.nan), list[Notice]()
    for index, (load, u_load) in enumerate(zip(loads.tolist(), u_loads.tolist(), strict=True)):
        bands[index] = working_bands(model, load)
        if model.total_covariance is not None:
            u[index], seen = figures_u(model, partial(working_bands, load_mass=load))
            if u_load > 0.0:
                heavy, light = (working_bands(model, max(load + by, 0.0)) for by in (u_load, -u_load))
                u[index] = np.hypot(u[index], 0.5 * (heavy - light))
            notices += [one.at(where.format(load)) for one in seen.notices(("band_5_hz", "band_10_hz"))]
    return bands, np.where(np.isnan(bands), np.nan, u), notices
