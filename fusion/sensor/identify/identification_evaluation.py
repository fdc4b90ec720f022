"""Evaluation of a campaign of several loads: the mechanics of the sensor."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from fusion.base import CommandEvaluation
from fusion.campaign.excited_line import ExcitedLine, join_lines, start_names, with_starts
from fusion.campaign.recording_results import RecordingResults, SensorFacts, read_recorded
from fusion.campaign.repeats import drive_values
from fusion.errors import ARGUMENT
from fusion.recording.load import Manifest
from fusion.recording.rig import Sensor
from fusion.sensitivity.ratio import driven_component
from fusion.sensor.identify.identification_inputs import (
    EvaluatedSines,
    FlexibleLoad,
    IdentificationInputs,
    IdentifySettings,
    PreparedTransfer,
    add_clock_errors,
    load_along,
    prepare,
)
from fusion.sensor.identify.joint_fit import (
    JointFit,
    SensitivityResult,
    joint_fits,
    mass_name,
    model_sensitivity,
)
from fusion.sensor.identify.model_choice import loss_frequency_hz
from fusion.sensor.identify.sine_curves import relative_errors, sine_transfers
from fusion.sensor.response_notices import NO_BAND_OF_PITCHING_LOAD, PEAK_NOT_READ
from shaker.identification.measured_curves import CurveError, MeasuredCurve, MeasuredSensitivity, ParameterEstimate
from shaker.identification.oscillator import PeakReading, peak_readings
from shaker.identification.sensor import Load, SensorModel, UsableBand, usable_band
from shaker.labels import LOAD_COMPONENTS, sensitivity_unit
from shaker.mechanics import required_stiffness
from shakercal._common.notices import Notice

# From the results of sine recordings to the sensitivity over frequency.


INTERNAL_MASS = "internal mass: mass"
"""Label under which a load names the uncertainty of the mass inside the sensor."""
OtherMass = Callable[[float], tuple[complex, complex]]
"""Factor of a sensitivity at a frequency in Hz where another mass moves inside the sensor than was stated, and its
relative change for one standard uncertainty of that mass."""


def sensitivities(
    recordings: Sequence[RecordingResults], changes: Mapping[int, Mapping[str, OtherMass]]
) -> tuple[MeasuredSensitivity, ...]:
    """Return the sensitivity of every driven component over frequency, of all recordings together.

    If the sensor's matrix is stated, it is the element of the matrix, as in campaigns, otherwise the ratio. `changes`:
    correction for the fitted internal mass, by load component and recording.
    """
    sensor = next((recorded.sensor for recorded in recordings if recorded.sensor is not None), None)
    if sensor is None:
        return ()
    capacity = None if sensor.capacity is None else sensor.capacity.tolist()
    groups: dict[int, list[ExcitedLine]] = {}
    for drive in (drive for recorded in recordings for drive in recorded.excited_lines):
        groups.setdefault(driven_component(drive.direction, capacity), []).append(drive)
    found = [_sensitivity(sensor, j, group, changes.get(j)) for j, group in sorted(groups.items())]
    return tuple(item for item in found if item is not None)


def _sensitivity(
    sensor: SensorFacts, component: int, drives: Sequence[ExcitedLine], changes: Mapping[str, OtherMass] | None
) -> MeasuredSensitivity | None:
    """Return output over load of one component at every driven line, ascending in frequency."""
    channel = main_output(sensor, component, drives)
    usable = [drive for drive in drives if np.isfinite(drive.outputs[drive.channels.index(channel)])]
    if not usable:
        return None
    usable = sorted(usable, key=lambda drive: drive.frequency_hz)
    parts = [part for drive in usable for part in drive_values([drive], component, sensor.stated_matrix, [channel])[1]]
    value, whole = np.array([ratio[0] for ratio, _ in parts]), join_lines([part for _, part in parts])
    errors: tuple[CurveError, ...] = ()
    if changes is not None:
        factor, change = np.array([changes[drive.recording](drive.frequency_hz) for drive in usable]).T
        other = tuple(influence for influence in whole.influences if influence.label != INTERNAL_MASS)
        value, whole = value * factor, replace(whole, influences=other).scaled(factor[:, None])
        errors = (CurveError(INTERNAL_MASS, change[:, None]),)
    static = 0.0 if sensor.static is None else float(sensor.static[sensor.channels.index(channel), component])
    return MeasuredSensitivity(
        channel=channel,
        component=LOAD_COMPONENTS[component],
        frequency_hz=np.array([drive.frequency_hz for drive in usable]),
        value=value,
        covariance=np.sum([part.covariance for part in whole.random], axis=0),
        unit=sensitivity_unit(sensor.unit, LOAD_COMPONENTS[component]),
        errors=(*relative_errors(whole, value[:, None]), *errors),
        static=static or None,
        u_static=abs(static) * sensor.u_static,
    )


def main_output(sensor: SensorFacts, component: int, drives: Sequence[ExcitedLine]) -> str:
    """Return the output of a load component: that of its name, otherwise the largest."""
    channels = drives[0].channels
    if LOAD_COMPONENTS[component] in channels:
        return LOAD_COMPONENTS[component]
    if sensor.static is not None:
        rows = [sensor.channels.index(channel) for channel in channels]
        return channels[int(np.argmax(np.abs(sensor.static[rows, component])))]
    size = np.nansum([np.abs(drive.outputs) / np.abs(drive.load[component]) for drive in drives], axis=0)
    return channels[int(np.argmax(size))]


# Readings of the resonance of every curve by every method, with the joint fit.


_DEPARTS = 3.0  # residuals over the noise, rms, from which one oscillator does not explain a peak
FEWEST_LINES = 20
"""Lines of a recording below which it has no curve to be read or drawn: steps of sines."""
LABELS = {
    "maximum_bin": "line of the maximum",
    "maximum": "maximum between the lines",
    "half_power": "half-power width",
    "half_amplitude": "half-amplitude width",
    "circle": "Nyquist circle",
    "oscillator": "oscillator fit",
    "joint": "joint fit",
}
"""Words for readers, in the order in which methods are listed."""


@dataclass(frozen=True)
class CurveReading:
    """The reading of one curve by one method, with the resulting stiffness and damping.

    `width_hz`: width of the method, or 2ζf₀. k = (2πf₀)²m and b = 2ζ√(km) with m = load + internal mass. Standard
    uncertainties are those of the curve's noise, of `oscillator` and `joint` of all stated causes. NaN: not determined.
    """

    recording: str
    response: str
    method: str
    frequency_hz: float
    u_frequency_hz: float
    width_hz: float
    u_width_hz: float
    damping_ratio: float
    u_damping_ratio: float
    stiffness: float
    damping: float
    note: str = ""


def read_curves(fit: JointFit, internal_mass: float) -> tuple[tuple[CurveReading, ...], tuple[Notice, ...]]:
    """Return the readings of all curves of a joint fit, with notices of failures.

    Stiffness and damping by equations 9 and 10 of Nitsche et al. 2018 with the moving mass.
    """
    readings: list[CurveReading] = []
    notices: list[Notice] = []
    for item in fit.prepared:
        if len(item.measured.ratio.frequency_hz) < FEWEST_LINES:
            continue
        name, moved = item.measured.name, item.load_kg + internal_mass
        for response in item.measured.ratio.channels:
            try:
                peaks = list(_peak_readings(fit, item, response))
            except ValueError as error:
                reason = ARGUMENT.sub("", str(error))
                notices.append(Notice(PEAK_NOT_READ, f"{name}: {response}", reason=reason))
                continue
            for peak in peaks:
                k = required_stiffness(peak.frequency_hz, moved)
                b = 2.0 * peak.damping_ratio * float(np.sqrt(k * moved))
                readings.append(CurveReading(**vars(peak), recording=name, response=response, stiffness=k, damping=b))
    return tuple(readings), tuple(notices)


def _peak_readings(fit: JointFit, item: PreparedTransfer, response: str) -> Iterator[PeakReading]:
    """Yield the readings of one curve by each method, and by the joint fit."""
    measured = item.measured
    ratio = measured.ratio.select([response])
    correlation = measured.line_correlation
    yield from peak_readings(
        MeasuredCurve(ratio.frequency_hz, ratio.value[:, 0], ratio.covariance, line_correlation=correlation)
    ).all
    of_response = [found for found in item.resonances if found.response == response]
    if of_response:
        highest = max(of_response, key=lambda found: abs(found.fit.model(np.array([found.fit.frequency_hz]))[0]))
        departs = float(np.sqrt(highest.fit.chi_squared / highest.fit.dof))
        note = f"deviates from one oscillator by {departs:.2g} times the noise" if departs > _DEPARTS else ""
        f0, u_f0 = highest.fit.frequency_hz, highest.u_frequency_hz
        yield _mode_reading("oscillator", f0, u_f0, highest.fit.damping_ratio, highest.u_damping_ratio, note)
    for mode in fit.reported.modes:
        if mode.record == measured.name:
            f0, u_f0 = mode.frequency_hz, mode.u_frequency_hz
            yield _mode_reading("joint", f0, u_f0, mode.damping_ratio, mode.u_damping_ratio)


def _mode_reading(method: str, f0: float, u_f0: float, zeta: float, u_zeta: float, note: str = "") -> PeakReading:
    """Return f₀ (Hz) and damping ratio of a mode as a reading of width 2ζf₀."""
    return PeakReading(method, f0, u_f0, 2.0 * zeta * f0, 2.0 * u_zeta * f0, zeta, u_zeta, note)


# Parts of an identified sensor.


@dataclass(frozen=True)
class IdentifiedComponent:
    """All results of one component of the sensor.

    Attributes
    ----------
    internal_mass : value, u and unit of the mass that moves with the load inside the sensor; u is NaN where the data
        refute the model.
    sensitivity : None without evaluated sines of this component.
    model : the model for corrections, supported by data in `range_hz`.
    bands : one per load mass of `loads`.
    """

    fit: JointFit
    internal_mass: ParameterEstimate
    readings: tuple[CurveReading, ...]
    sensitivity: SensitivityResult | None
    model: SensorModel
    range_hz: tuple[float, float]
    loads: tuple[float, ...]
    bands: tuple[UsableBand, ...]

    @property
    def name(self) -> str:
        """Name of the component: x, y, z, rx, ry or rz."""
        return self.fit.axis

    @property
    def sensitivity_estimates(self) -> tuple[ParameterEstimate, ...]:
        """Numbers of the explained sensitivity; of a refuted model without U."""
        if self.sensitivity is None:
            return ()
        found = self.sensitivity.comparison.best.estimates
        return tuple(replace(one, u=np.nan) for one in found) if self.fit.is_rejected else found


@dataclass(frozen=True)
class IdentifyEvaluation(CommandEvaluation):
    """A campaign's identification: the sensor, and one result per driven component."""

    sensor: Sensor | None
    components: tuple[IdentifiedComponent, ...]


# From a campaign to the sensor as a mechanical system: curves → joint fits → readings, sensitivity, usable bands.


def evaluate_identification(campaign: IdentificationInputs, settings: IdentifySettings) -> IdentifyEvaluation:
    """Evaluate all recordings of a campaign together: stiffness, damping and internal mass of the sensor.

    Parameters
    ----------
    campaign
        Recordings of `read_campaign`.
    settings
        Choices of the identification.

    Returns
    -------
    IdentifyEvaluation : one result per driven component.

    Raises
    ------
    InputError : a file or key that the user has to correct.
    ComputeError : the recordings do not determine a model.

    Examples
    --------
    >>> from fusion import evaluate_identification
    >>> from fusion.sensor.identify.identification_inputs import IdentifySettings, read_campaign
    >>> evaluation = evaluate_identification(read_campaign("masses"), IdentifySettings())  # doctest: +SKIP
    """
    started = time.monotonic()
    manifests = [*campaign.transfers, *(item.manifest for item in campaign.sines)]
    called = [manifest.name for manifest in manifests]  # a name that occurs twice is extended by that of the folder
    names = {m.path: m.name if called.count(m.name) == 1 else f"{m.name} [{m.folder.name}]" for m in manifests}
    found, of_preparation = zip(*(prepare(m, names[m.path], settings.band_hz) for m in campaign.transfers), strict=True)
    starts = start_names({item.measured.name: item.grids for item in found})
    prepared = [add_clock_errors(item, starts[item.measured.name]) for item in found]
    notices = [*campaign.notices, *(notice for notices_of in of_preparation for notice in notices_of)]
    recorded = []
    for sine in campaign.sines:
        results, name = read_recorded(sine.results), names[sine.manifest.path]
        drives = tuple(replace(drive, recording=name) for drive in results.excited_lines)
        recorded.append(replace(results, name=name, excited_lines=drives))
    driven_lines = with_starts(drive for entry in recorded for drive in entry.excited_lines)
    starts = {drive.recording: drive.start for drive in driven_lines}
    recorded = [replace(r, excited_lines=tuple(d for d in driven_lines if d.recording == r.name)) for r in recorded]
    driven = {item.component for item in prepared}
    added = sine_transfers(campaign.sines, names, starts, settings.band_hz)
    fits = joint_fits([*prepared, *(item for item in added if item.component in driven)], settings)
    changes = {fit.component: _by_found_mass(fit, campaign.sines, names) for fit in fits if fit.mass_is_free}
    measured = {item.component: item for item in sensitivities(recorded, changes)}
    sensor = next((manifest.rig.sensor for manifest in manifests if manifest.rig.sensor is not None), None)
    components = []
    for fit in fits:
        component, of_component = _component(fit, measured.get(LOAD_COMPONENTS[fit.component]), sensor, settings)
        components.append(component)
        notices += of_component
    return IdentifyEvaluation(
        name=campaign.name,
        sensor=sensor,
        components=tuple(components),
        notices=tuple(dict.fromkeys(notices)),
        settings=settings.as_dict(),
        input_hashes=campaign.inputs.hashes,
        duration_s=time.monotonic() - started,
    )


def _by_found_mass(fit: JointFit, sines: Sequence[EvaluatedSines], names: Mapping[Path, str]) -> dict[str, OtherMass]:
    """Return the correction of a sensitivity for the fitted internal mass, by recording.

    Its factor is (m + m_i stated)/(m + m_i fitted) with the mass m on the sensor. Its relative change for one standard
    uncertainty of the internal mass is -u(m_i)/(m + m_i fitted). On a joint, m is relative to the motion below it. Of
    an elastic load, it is the effective mass at its foot.
    """
    found, index = fit.identification[mass_name(fit.component)], fit.component

    def other(manifest: Manifest, stated: float, frequency_hz: float) -> tuple[complex, complex]:
        load: complex = load_along(manifest, index)
        if (bent := FlexibleLoad.of(manifest, np.array([frequency_hz]))) is not None:
            load = complex(bent.inertia[0, index, index] / bent.follow[0, index])
        return (load + stated) / (load + found.value), -found.u / (load + found.value)

    moving = {sine.manifest.path: sine.manifest for sine in sines if sine.manifest.rig.load is not None}
    return {
        names[path]: partial(other, manifest, manifest.rig.sensor.moving(index)[0])
        for path, manifest in moving.items()
        if manifest.rig.sensor is not None
    }


def _component(
    fit: JointFit, measured: MeasuredSensitivity | None, sensor: Sensor | None, settings: IdentifySettings
) -> tuple[IdentifiedComponent, list[Notice]]:
    """Return all results of one component with their notices."""
    mass = fit.reported[mass_name(fit.component)]
    readings, unread = read_curves(fit, mass.value)
    found = model_sensitivity(fit, measured, sensor)
    notices = [*fit.notices, *unread, *found.notices]
    loads = settings.load_masses_kg or tuple(sorted(dict.fromkeys(item.load_kg for item in fit.prepared)))
    if fit.model == "pitching":
        notices.append(Notice(NO_BAND_OF_PITCHING_LOAD, fit.axis))
        loads = ()
    bands, model = [_usable(fit, found.model, kg, settings.permitted) for kg in loads], found.model
    if fit.is_rejected:
        bands = [replace(band, u_upper_hz=np.nan) for band in bands]
        model = replace(model, covariance=np.full_like(model.covariance, np.nan))
    of_model = found.sensitivity, model, found.range_hz
    return IdentifiedComponent(fit, mass, readings, *of_model, loads, tuple(bands)), notices


def _usable(fit: JointFit, model: SensorModel, load: float, permitted: float) -> UsableBand:
    """Return the usable band with a load.

    A loss factor acts at the edge as the damper of this frequency, and lowers the output at low frequencies too.
    """
    band = usable_band(model, Load(load, "force"), permitted)
    if fit.choice.best.model.loss_factor and np.isfinite(band.upper_hz):
        loss_hz = loss_frequency_hz(fit.identification, fit.axis)
        at_edge = replace(model, damping=model.damping * loss_hz / band.upper_hz)
        static = float(np.hypot(1.0, fit.identification.value(f"loss_factor_{fit.axis}")))
        edge = usable_band(at_edge, Load(load, "force"), (1.0 + permitted) / static - 1.0)
        band = replace(edge, permitted=permitted)
    return band
