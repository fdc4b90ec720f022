"""Joint fits of all curves, and models of the sensor with its measuring chain."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import count_text
from fusion.campaign.excited_line import with_campaign_names
from fusion.errors import ARGUMENT, ComputeError, InputError
from fusion.estimation.uncertainty import Uncertainty
from fusion.recording.load import Manifest
from fusion.recording.rig import Sensor
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results, read_uncertainty
from fusion.sensitivity.moving_body import inertia_errors, rigid_load
from fusion.sensor import response_notices as declared
from fusion.sensor.identify.identification_inputs import (
    EvaluatedSines,
    FlexibleLoad,
    IdentifySettings,
    PreparedTransfer,
    component_of,
    drive_of,
    mass_unit,
)
from fusion.sensor.unmodelled_effects import stated_influences
from shaker.identification.measured_curves import (
    CurveError,
    MeasuredSensitivity,
    MeasuredTransfer,
    ParameterEstimate,
    Placement,
)
from shaker.identification.sensitivity import (
    CHAIN_WORDS,
    SensitivityComparison,
    SpringPrior,
    fit_sensitivity,
    sensor_model,
)
from shaker.identification.sensor import NO_CHAIN, SensorModel
from shaker.identification.structure_fit import Identification, identify
from shaker.identification.structures import ChainStructure, MechanicalStructure, SpringSuspension
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS, sensitivity_unit
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

# One joint fit per driven component: which model, which internal mass, and why.


_DIFFERENT = 0.01  # relative difference of load masses that separates internal mass and stiffness
_MISFIT = 3.0  # residuals over their uncertainty, rms, from which one translation does not explain the curves
_BETTER = 0.5  # share of χ² per degree of freedom that a richer model has to reach
_PITCHES_WITH = {0: 4, 1: 3, 3: 1, 4: 0}


@dataclass(frozen=True)
class JointFit:
    """The model fitted to all curves of one component; `mass_is_free`: not as stated."""

    component: int
    model: str
    reason: str
    mass_is_free: bool
    identification: Identification
    prepared: tuple[PreparedTransfer, ...]
    notices: tuple[Notice, ...]

    @property
    def axis(self) -> str:
        """Name of the component: x, y, z, rx, ry or rz."""
        return MOTION_COMPONENTS[self.component]

    @property
    def range_hz(self) -> tuple[float, float]:
        """First and last line of all curves."""
        lines = np.concatenate([item.measured.ratio.frequency_hz for item in self.prepared])
        return float(lines.min()), float(lines.max())


def joint_fits(prepared: Sequence[PreparedTransfer], settings: IdentifySettings) -> tuple[JointFit, ...]:
    """Return one fit per driven component; components share no parameter."""
    groups: dict[int, list[PreparedTransfer]] = {}
    for item in prepared:
        groups.setdefault(item.component, []).append(item)
    return tuple(_joint_fit(component, group, settings) for component, group in sorted(groups.items()))


def _joint_fit(component: int, group: Sequence[PreparedTransfer], settings: IdentifySettings) -> JointFit:
    """Fit one component; "auto" is translation, unless a second peak indicates pitching."""
    free = _mass_is_free(component, group, settings)
    peaks = max((item.peaks_hz(name) for item in group for name in item.measured.ratio.channels), key=len)

    def fitted(model: str) -> Identification:
        return _fitted(model, component, group, settings, free=free)

    if settings.model == "auto":
        model, reason, identification = _chosen(peaks if component in _PITCHES_WITH else (), fitted)
    else:
        model, reason, identification = settings.model, "as selected", fitted(settings.model)
    notices = identification.notices
    if model == "translation" and len(peaks) > 1 and departure(identification) >= _MISFIT:
        notices = (*notices, Notice(declared.SECOND_PEAK_NOT_EXPLAINED, f"model {MOTION_COMPONENTS[component]}"))
    return JointFit(component, model, reason, free, identification, tuple(group), notices)


def _chosen(peaks_hz: Sequence[float], fitted: Callable[[str], Identification]) -> tuple[str, str, Identification]:
    """Return selected model, reason and fit: pitching if it explains two peaks."""
    pitching, reason = None, ""
    if len(peaks_hz) > 1:
        pitching = fitted("pitching")
        listed = " and ".join(f"{peak:.6g} Hz" for peak in peaks_hz[:2])
        reason = (
            f"the curves have peaks at {listed}, of which one translation explains one; translation and pitching "
            f"together leave residuals of {departure(pitching):.3g} times their uncertainty"
        )
        if departure(pitching) < _MISFIT:
            return "pitching", reason, pitching
    translation = fitted("translation")
    if pitching is not None and departure(pitching) ** 2 < _BETTER * departure(translation) ** 2:
        return "pitching", f"{reason}, one translation {departure(translation):.3g}", pitching
    reason = f"one spring and damper leave residuals of {departure(translation):.3g} times their uncertainty"
    return "translation", reason, translation


def _fitted(
    model: str, component: int, group: Sequence[PreparedTransfer], settings: IdentifySettings, *, free: bool
) -> Identification:
    """Fit a model to all curves of a group; `free` fits the internal mass."""
    structure: MechanicalStructure = ChainStructure(component) if model == "adapter" else SpringSuspension((component,))
    if model == "pitching":
        if component not in _PITCHES_WITH:
            driven = MOTION_COMPONENTS[component]
            raise InputError(declared.PITCHING_NOT_DRIVEN, group[0].manifest.path, "excitation.direction", found=driven)
        structure = SpringSuspension((component, _PITCHES_WITH[component]))
    names = [parameter.name for parameter in structure.parameters]
    each = [name for name in names if name.startswith("damping_")] if settings.damping == "each" else []
    inside = {} if free else {mass_name(axis): axis for axis in reversed(range(6)) if mass_name(axis) in names}
    sensor = next((item.manifest.rig.sensor for item in group if item.manifest.rig.sensor is not None), None)
    if inside and sensor is None:
        expected = "[sensor] with internal_mass, which recordings of one load mass cannot separate from the stiffness"
        raise InputError(declared.MISSING_IDENTIFICATION_ENTRY, group[0].manifest.rig_path, "sensor", expected=expected)
    stated = {} if sensor is None else {name: sensor.moving(axis) for name, axis in inside.items()}
    records = [item.measured for item in group]
    try:
        return _with_influences(identify(records, structure, stated_values=stated, each_recording=each), group)
    except (ValueError, np.linalg.LinAlgError) as error:
        names_text, reason = ", ".join(record.name for record in records), ARGUMENT.sub("", str(error))
        raise ComputeError(declared.NO_MODEL_FITTED, recordings=names_text, reason=reason) from error


def _with_influences(found: Identification, group: Sequence[PreparedTransfer]) -> Identification:
    """Return a fit whose uncertainty includes the stated influences (`fusion.sensor.unmodelled_effects`).

    A relative change of frequencies changes k by twice as much, and the damping ratio b/(2√(km)) changes b. Several
    loads in the fit show the influence of the load themselves.
    """
    rig = next((item.manifest.rig for item in group if item.manifest.rig.model is not None), None)
    if rig is None:
        return found
    several = np.ptp([item.load_kg for item in group]) > _DIFFERENT * group[0].load_kg
    mountings = [item.manifest.mounting for item in group]
    influences = stated_influences(rig, mountings, ("load",) if several else (), mounting_scatter=False)

    relative = np.array([(one.frequency, one.damping_ratio) for one in influences.unknowns]).reshape(-1, 2)

    def moved(item: ParameterEstimate) -> FloatArray:
        """Return the change (E,) by each unknown; of b/k that of its parts."""
        kind = item.name.partition("_")[0]
        by = {"stiffness": (2.0, 0.0), "damping": (1.0, 1.0)}.get(kind, (0.0, 0.0))
        return np.asarray(item.value * (relative @ ((-1.0, 1.0) if item in found.derived else by)))

    def wider(item: ParameterEstimate) -> ParameterEstimate:
        return replace(item, u=float(np.linalg.norm([item.u, *moved(item)])))

    effects = np.stack([moved(item) for item in found.estimates], axis=1)
    of_frequency, of_damping = np.linalg.norm(relative, axis=0)
    modes = tuple(
        replace(
            mode,
            u_frequency_hz=float(np.hypot(mode.u_frequency_hz, of_frequency * mode.frequency_hz)),
            u_damping_ratio=float(np.hypot(mode.u_damping_ratio, of_damping * mode.damping_ratio)),
        )
        for mode in found.modes
    )
    return replace(
        found,
        estimates=tuple(map(wider, found.estimates)),
        covariance=found.covariance + effects.T @ effects,
        derived=tuple(map(wider, found.derived)),
        modes=modes,
        budget={**found.budget, **influences.by_cause(lambda indices: np.linalg.norm(effects[indices], axis=0))},
    )


def _mass_is_free(component: int, group: Sequence[PreparedTransfer], settings: IdentifySettings) -> bool:
    """Return whether the internal mass is fitted; refuse it for equal loads."""
    loads = [item.load_kg for item in group]
    differ = max(loads) > (1.0 + _DIFFERENT) * min(loads)
    if settings.internal_mass == "free" and not differ:
        path, unit, count = group[0].manifest.rig_path, mass_unit(component), count_text(len(loads), "recording")
        raise InputError(declared.EQUAL_LOAD_MASSES, path, "load.mass", load=loads[0], unit=unit, recordings=count)
    return differ if settings.internal_mass == "auto" else settings.internal_mass == "free"


def mass_name(component: int) -> str:
    """Return the name of the parameter of the internal mass."""
    return "internal_mass" if component < 3 else f"internal_inertia_{MOTION_COMPONENTS[component]}"


def departure(found: Identification) -> float:
    """Return √(χ²/dof): residuals over their uncertainty, rms."""
    return float(np.sqrt(found.chi_squared / found.dof))


# From the results of sine recordings to load over base acceleration: further points of the transfer functions.


def sine_transfers(
    items: Sequence[EvaluatedSines],
    names: Mapping[Path, str],
    starts: Mapping[str, str],
    band_hz: tuple[float, float] | None,
) -> tuple[PreparedTransfer, ...]:
    """Return load over base along the drive, of recordings of sines.

    Recordings of one load and mounting are one curve. `names`: unique names of the recordings by the path of their
    manifest. `starts`: names of their starts, if several recordings have a common start.
    """
    groups: dict[tuple[object, ...], list[PreparedTransfer]] = {}
    for item in items:
        name = names[item.manifest.path]
        measured = _transfer(item, name, starts.get(name, name), band_hz)
        if measured is not None:
            load = measured.mass_matrix.tobytes(), str(item.manifest.rig.load)
            key = (*load, measured.drive.tobytes(), item.manifest.mounting, measured.clock)
            groups.setdefault(key, []).append(PreparedTransfer(item.manifest, measured))
    curves = [(group[0].manifest, _bent(group[0].manifest, _joined(group))) for group in groups.values()]
    if len({measured.name for _, measured in curves}) < len(curves):
        curves = [(m, replace(one, name=f"{one.name}, mounting {m.mounting}")) for m, one in curves]
    return tuple(PreparedTransfer(manifest, measured) for manifest, measured in curves)


def _bent(manifest: Manifest, measured: MeasuredTransfer) -> MeasuredTransfer:
    """Return a curve with the elastic properties of its load."""
    bent = FlexibleLoad.of(manifest, measured.ratio.frequency_hz)
    return measured if bent is None else replace(measured, bending=bent.bending(measured.tops, manifest.mounting))


PER_LINE = ("frequency_hz", "value", "covariance", "dof")
"""Fields of a ratio that have an entry for every line."""


def _joined(group: Sequence[PreparedTransfer]) -> MeasuredTransfer:
    """Return the lines of several recordings as one curve, ascending in frequency.

    Equal names of errors are one unknown.
    """
    records = [item.measured for item in group]
    ratios = [record.ratio for record in records]
    order = np.argsort(np.concatenate([ratio.frequency_hz for ratio in ratios]), kind="stable")
    parts: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in ratios])[order] for name in PER_LINE}
    ratio = replace(ratios[0], **parts)
    by_name = [{error.name: error.relative for error in record.errors} for record in records]
    zeros = [np.zeros(one.value.shape, dtype=np.complex128) for one in ratios]

    def relative(name: str) -> ComplexArray:
        return np.concatenate([found.get(name, zero) for found, zero in zip(by_name, zeros, strict=True)])[order]

    joined = tuple(CurveError(name, relative(name)) for name in dict.fromkeys(chain(*by_name)))
    steps = f"{len(order)} steps of sines, {group[0].manifest.rig.name}"
    return replace(records[0], name=steps, ratio=ratio, errors=joined)


def relative_errors(uncertainty: Uncertainty, value: ComplexArray) -> tuple[CurveError, ...]:
    """Return named unknowns of values (K, C) as complex relative deviations for one standard uncertainty."""
    count = value.shape[1]
    return tuple(
        CurveError(influence.name, (influence.effect[:, :count] + 1j * influence.effect[:, count:]) / value)
        for influence in uncertainty.influences
        if np.any(influence.effect != 0.0)
    )


def _transfer(
    item: EvaluatedSines, name: str, start: str, band_hz: tuple[float, float] | None
) -> MeasuredTransfer | None:
    """Return load over base acceleration along the drive at the driven lines, None without both."""
    manifest = item.manifest
    drive = drive_of(manifest)
    component = component_of(drive)
    if manifest.rig.load is None or component >= 3:  # of a rig that is turned, sines add no points
        return None
    with open_results(item.results / RESULT_FILE) as file:
        groups = ["accelerations/load-fused", "accelerations/base-fused"]
        if any(group not in file for group in groups):
            return None
        frequency = file["lines/frequency_hz"][()]
        driven = file["lines/multiple"][()] == 1
        values = [file[group]["phasors/value"][()][:, component] for group in groups]
        parts = [read_uncertainty(file[group]["uncertainty"]).at([component]) for group in groups]
    chosen = driven & np.isfinite(values[0]) & np.isfinite(values[1])
    if band_hz is not None:
        chosen &= (frequency >= band_hz[0]) & (frequency <= band_hz[1])
    if not np.any(chosen):
        return None
    # common errors of load and base act on both
    base = values[1][chosen]
    ratio = values[0][chosen] / base
    below = parts[1].at_lines(chosen).scaled((-ratio / base)[:, None])
    relabelled = tuple(replace(part, label=f"base: {part.label}") for part in below.random)
    whole = parts[0].at_lines(chosen).scaled((1.0 / base)[:, None]).plus(replace(below, random=relabelled))
    whole = with_campaign_names(whole, name, manifest.mounting, start)
    body = rigid_load(manifest)
    along = Placement(np.zeros(3), np.eye(3)[component])
    clock = manifest.daq[0] if manifest.daq else None
    return MeasuredTransfer(
        name=name,
        ratio=Phasors(
            frequency_hz=frequency[chosen],
            value=ratio[:, None],
            covariance=np.sum([part.covariance for part in whole.random], axis=0),
            channels=(f"load {MOTION_COMPONENTS[component]}",),
            unit=("1",),
            dof=whole.dof()[:, 0],
        ),
        tops=(along,),
        base=along,
        drive=drive,
        mass_matrix=body.mass_matrix,
        errors=relative_errors(whole, ratio[:, None]),
        inertia_errors=inertia_errors(manifest, body),
        clock=f"clock of {clock.name}" if clock else f"clock of {name}",
        u_clock=clock.clock_uncertainty if clock else 0.0,
    )


# The sensor of one component as a correction needs it: spring and damper of the joint fit, chain of S(f).


_FEWEST_LINES = 4


@dataclass(frozen=True)
class SensitivityResult:
    """The sensitivity of one output over frequency, as measured and as explained."""

    measured: MeasuredSensitivity
    comparison: SensitivityComparison


@dataclass(frozen=True)
class ModelledSensitivity:
    """The model of one component, its frequency range, and its sensitivity if measured."""

    model: SensorModel
    range_hz: tuple[float, float]
    sensitivity: SensitivityResult | None
    notices: tuple[Notice, ...]


def model_sensitivity(
    fit: JointFit, measured: MeasuredSensitivity | None, sensor: Sensor | None
) -> ModelledSensitivity:
    """Return the model of a component, with a measuring chain if its sensitivity supports one."""
    found, covariance = mechanics(fit)
    if measured is None or len(measured.frequency_hz) < _FEWEST_LINES:
        model, which = _without_chain(fit, found, covariance, sensor)
        component = LOAD_COMPONENTS[fit.component]
        notice = Notice(
            declared.SENSITIVITY_NOT_MEASURED, fit.axis, component=component, sensitivity=which, fewest=_FEWEST_LINES
        )
        return ModelledSensitivity(model, fit.range_hz, None, (notice,))
    r_kb = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]) if covariance[0, 1] != 0.0 else 0.0
    u_k, u_b = (float(np.sqrt(covariance[index, index])) for index in (0, 1))
    spring = SpringPrior(float(found[0]), u_k, float(found[1]), u_b, float(r_kb))
    try:
        comparison = fit_sensitivity(measured, spring)
        model = sensor_model(comparison.best, found, covariance)
    except (ValueError, np.linalg.LinAlgError) as error:
        reason = ARGUMENT.sub("", str(error))
        notice = Notice(declared.SENSITIVITY_NOT_EXPLAINED, measured.channel, channel=measured.channel, reason=reason)
        model, _ = _without_chain(fit, found, covariance, sensor)
        return ModelledSensitivity(model, fit.range_hz, None, (notice,))
    range_hz = (float(measured.frequency_hz[0]), float(measured.frequency_hz[-1]))
    where = f"sensitivity {measured.component}"
    supported, contradicted = (_explanations(comparison, verdict) for verdict in ("supported", "refuted"))
    notices = [Notice(declared.SENSITIVITY_EXPLANATION, where, supported=supported, contradicted=contradicted)]
    if (test := comparison.damping) is not None:
        outcome = declared.DAMPING_CONTRADICTED if test.contradicts else declared.DAMPING_AGREES
        needed_us, resonance_us = 1e6 * test.needed_s, 1e6 * test.resonance_s
        times = {"needed_us": needed_us, "resonance_us": resonance_us, "deviation": test.deviation}
        notices.append(Notice(outcome, where, **times))
    explained = SensitivityResult(measured, comparison)
    return ModelledSensitivity(model, range_hz, explained, (*notices, *comparison.notices))


def _explanations(comparison: SensitivityComparison, verdict: str) -> str:
    kinds = [fit.chain.kind for fit, one in zip(comparison.fits, comparison.verdict, strict=True) if one == verdict]
    return ", ".join(CHAIN_WORDS[kind] for kind in kinds) or "no explanation"


def mechanics(fit: JointFit) -> tuple[FloatArray, FloatArray]:
    """Return [k, b, m_i] (3,) of a joint fit and their covariance (3, 3).

    Of one damping per recording it is the mean, with the scatter of the dampings as uncertainty.
    """
    found, axis = fit.identification, fit.axis
    dampers = [i for i, name in enumerate(found.names) if name.partition(": ")[0] == f"damping_{axis}"]
    pick = np.zeros((3, len(found.names)))
    pick[0, found.names.index(f"stiffness_{axis}")] = 1.0
    pick[1, dampers] = 1.0 / len(dampers)
    pick[2, found.names.index(mass_name(fit.component))] = 1.0
    used = np.any(pick != 0.0, axis=0)
    if not np.all(np.isfinite(found.covariance[used][:, used])):
        raise ComputeError(declared.STIFFNESS_NOT_DETERMINED, component=axis)
    values = np.array([estimate.value for estimate in found.estimates])
    covariance = pick[:, used] @ found.covariance[np.ix_(used, used)] @ pick[:, used].T
    if len(dampers) > 1:
        covariance[1, 1] += float(np.var(values[dampers], ddof=1))
    return pick @ values, covariance


def _without_chain(
    fit: JointFit, found: FloatArray, covariance: FloatArray, sensor: Sensor | None
) -> tuple[SensorModel, str]:
    """Return a model without a chain, and in words which static sensitivity it has."""
    component = LOAD_COMPONENTS[fit.component]
    static, u_static, unit, which = 1.0, 0.0, "1", "an output of one per force"
    if sensor is not None and sensor.static_sensitivity is not None:
        column = np.array(sensor.static_sensitivity)[:, fit.component]
        index = sensor.channels.index(component) if component in sensor.channels else int(np.argmax(np.abs(column)))
        if column[index] != 0.0:
            static, unit, which = float(column[index]), sensor.unit, "the stated static sensitivity"
            u_static = abs(static) * sensor.static_sensitivity_uncertainty
    whole = np.zeros((4, 4))
    whole[0, 0], whole[1:, 1:] = u_static**2, covariance
    stiffness, damping, mass = float(found[0]), float(found[1]), max(float(found[2]), 0.0)
    return SensorModel(static, stiffness, damping, mass, NO_CHAIN, whole, sensitivity_unit(unit, component)), which
