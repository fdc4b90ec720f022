"""Joint fits of all curves, and models of the sensor with its measuring chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.base import count_text
from fusion.errors import ARGUMENT, ComputeError, InputError
from fusion.recording.rig import Sensor
from fusion.sensor import response_notices as declared
from fusion.sensor.identify.identification_inputs import IdentifySettings, PreparedTransfer, mass_unit
from fusion.sensor.identify.model_choice import choice_notices, departure, describe_choice
from fusion.sensor.transfer.resonances import AMPLITUDE, FIRST_ORDER
from fusion.sensor.unmodelled_effects import stated_influences
from shaker.identification.measured_curves import MeasuredSensitivity, MeasuredTransfer, ParameterEstimate
from shaker.identification.rival_models import (
    FittedRival,
    ModelChoice,
    RivalModel,
    StructureName,
    added_uncertainty,
    choose_model,
    covering,
    with_unstated_filters,
    without_uncertainty,
)
from shaker.identification.sensitivity import (
    CHAIN_WORDS,
    SensitivityComparison,
    SpringPrior,
    fit_sensitivity,
    sensor_model,
)
from shaker.identification.sensor import NO_CHAIN, SensorModel
from shaker.identification.structure_fit import Identification, ModeEstimate, identify
from shaker.identification.structures import ChainStructure, MechanicalStructure, SpringSuspension
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS, sensitivity_unit
from shaker.model_notices import MODEL_MISFIT, STATED_ERROR_TOO_SMALL
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

# One joint fit per driven component: which model, which internal mass, and why.


_DIFFERENT = 0.01  # relative difference of load masses that separates internal mass and stiffness
_OTHER_LEVEL = 1.05  # ratio of amplitudes from which recordings show whether these matter
_MISFIT = 3.0  # residuals over their uncertainty, rms, from which one translation does not explain the curves
_PITCHES_WITH = {0: 4, 1: 3, 3: 1, 4: 0}
_LAWS = {
    "auto": (RivalModel(), RivalModel(loss_factor=True)),
    "common": (RivalModel(),),
    "each": (RivalModel(each=True),),
}
"""Damping of the first models by the option."""


@dataclass(frozen=True)
class JointFit:
    """The model fitted to all curves of one component; `mass_is_free`: not as stated.

    `choice`: the rival models; `identification`: the chosen one, whose U includes those that the data leave open, and
    `reported`: the same, without U where the data refute it.
    """

    component: int
    reason: str
    mass_is_free: bool
    choice: ModelChoice
    identification: Identification
    prepared: tuple[PreparedTransfer, ...]
    notices: tuple[Notice, ...]

    @property
    def model(self) -> StructureName:
        """Structure of the chosen model: translation, pitching or adapter."""
        return self.choice.best.model.structure

    @property
    def is_rejected(self) -> bool:
        """Whether the data refute the chosen model, so that its values have no U."""
        return self.identification.is_rejected

    @property
    def reported(self) -> Identification:
        """The identification as reported."""
        return without_uncertainty(self.identification) if self.is_rejected else self.identification

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
    """Return the model of one component that the data call for."""
    free = _mass_is_free(component, group, settings)
    peaks = max((item.peaks_hz(name) for item in group for name in item.measured.ratio.channels), key=len)
    refused: list[ComputeError] = []

    def fitted(model: RivalModel) -> Identification | None:
        try:
            return _fitted(model, component, group, settings, free=free)
        except ComputeError as error:
            refused.append(error)
            return None

    structures: tuple[StructureName, ...] = ("translation",) if settings.model == "auto" else (settings.model,)
    if settings.model == "auto" and len(peaks) > 1:
        structures = ("pitching",) if component in _PITCHES_WITH else ("translation", "adapter")
    start = [replace(law, structure=structure) for structure in structures for law in _LAWS[settings.damping]]
    try:
        choice = choose_model(start, lambda best: _richer(best, component, group, settings), fitted)
    except ValueError as error:
        raise refused[-1] from error
    identification = _with_amplitudes(_with_influences(covering(choice), group), group)
    rejected = identification.is_rejected
    notices = [one for one in identification.notices if not (rejected and one.code == MODEL_MISFIT.code)]
    if choice.best.model.structure == "translation" and len(peaks) > 1 and departure(identification) >= _MISFIT:
        notices.append(Notice(declared.SECOND_PEAK_NOT_EXPLAINED, f"model {MOTION_COMPONENTS[component]}"))
    highest_hz = max(float(item.measured.ratio.frequency_hz.max()) for item in group)
    forces = [item.amplitude for item in group if item.peak > 0.0]
    notices += choice_notices(choice, f"model {MOTION_COMPONENTS[component]}", highest_hz, forces)
    reason = describe_choice(choice, settings.model, peaks)
    return JointFit(component, reason, free, choice, identification, tuple(group), tuple(notices))


def _richer(
    best: FittedRival, component: int, group: Sequence[PreparedTransfer], settings: IdentifySettings
) -> list[RivalModel]:
    """Return models with one more feature, where the data contradict the best one.

    Springs that are not linear could pass for a joint or a filter, which are left out where the amplitude matters.
    """
    found, model = best.identification, best.model
    late = any(one.code == STATED_ERROR_TOO_SMALL.code and one.where.endswith(": delay") for one in found.notices)
    if found.is_explained and not late:
        return []
    others: list[RivalModel] = []
    linear = not any(any(item.amplitude_change) for item in group)
    if settings.model == "auto" and linear:
        names: list[StructureName] = ["translation", "adapter"]
        other = _PITCHES_WITH.get(component)
        if other is not None and any(np.any(item.measured.mass_matrix[component, other] != 0.0) for item in group):
            names.append("pitching")
        others += [replace(model, structure=name) for name in names if name != model.structure]
    if settings.damping == "auto" and not model.each:
        others += [] if model.loss_factor else [replace(model, loss_factor=True)]
        others += [replace(model, each=True, loss_factor=False)] if len(group) > 1 else []
    if model.structure != "adapter" and not model.by_amplitude and _levels_differ(group):
        others.append(replace(model, by_amplitude=True))
    channels = dict.fromkeys(
        name for item in group if linear and item.reference for name in (item.reference, *item.measured.ratio.channels)
    )
    others += [replace(model, filtered=(*model.filtered, name)) for name in channels if name not in model.filtered]
    return others


def _levels_differ(group: Sequence[PreparedTransfer]) -> bool:
    """Return whether one load was recorded with different amplitudes."""
    pairs = [(one, other) for one in group for other in group if one.peak > 0.0 and other.peak > 0.0]
    return any(
        abs(one.load_kg - other.load_kg) <= _DIFFERENT * one.load_kg and other.peak > _OTHER_LEVEL * one.peak
        for one, other in pairs
    )


def _with_levels(group: Sequence[PreparedTransfer]) -> list[MeasuredTransfer]:
    """Return the curves with their levels, of the amplitudes of all that are known."""
    known = [item.amplitude for item in group if item.peak > 0.0]
    span = np.ptp(known) if known else 0.0
    if not span > 0.0:
        return [item.measured for item in group]
    middle = 0.5 * (min(known) + max(known))
    levels = [(item.amplitude - middle) / span if item.peak > 0.0 else 0.0 for item in group]
    return [replace(item.measured, level=float(level)) for item, level in zip(group, levels, strict=True)]


def _fitted(
    model: RivalModel, component: int, group: Sequence[PreparedTransfer], settings: IdentifySettings, *, free: bool
) -> Identification:
    """Fit a model to all curves of a group; `free` fits the internal mass."""
    loss_hz = _middle_hz(group) if model.loss_factor else 0.0
    structure: MechanicalStructure = SpringSuspension((component,), loss_hz, model.by_amplitude)
    if model.structure == "adapter":
        structure = ChainStructure(component, loss_hz=loss_hz)
    if model.structure == "pitching":
        if component not in _PITCHES_WITH:
            driven = MOTION_COMPONENTS[component]
            raise InputError(declared.PITCHING_NOT_DRIVEN, group[0].manifest.path, "excitation.direction", found=driven)
        structure = SpringSuspension((component, _PITCHES_WITH[component]), loss_hz, model.by_amplitude)
    names = [parameter.name for parameter in structure.parameters]
    each = [name for name in names if name.startswith("damping_")] if model.each else []
    free = free and (model.structure != "adapter" or settings.internal_mass == "free")  # order of both springs
    inside = {} if free else {mass_name(axis): axis for axis in reversed(range(6)) if mass_name(axis) in names}
    sensor = next((item.manifest.rig.sensor for item in group if item.manifest.rig.sensor is not None), None)
    if inside and sensor is None and not _mass_is_free(component, group, settings):
        expected = "[sensor] with internal_mass, which recordings of one load mass cannot separate from the stiffness"
        raise InputError(declared.MISSING_IDENTIFICATION_ENTRY, group[0].manifest.rig_path, "sensor", expected=expected)
    stated = {} if sensor is None else {name: sensor.moving(axis) for name, axis in inside.items()}
    records = _with_levels(group)
    records = with_unstated_filters(records, [item.reference for item in group], model.filtered)
    try:
        return identify(records, structure, stated_values=stated, each_recording=each)
    except (ValueError, np.linalg.LinAlgError) as error:
        names_text, reason = ", ".join(record.name for record in records), ARGUMENT.sub("", str(error))
        raise ComputeError(declared.NO_MODEL_FITTED, recordings=names_text, reason=reason) from error


def _middle_hz(group: Sequence[PreparedTransfer]) -> float:
    """Return the geometric mean of the highest lines of all curves."""
    largest = [np.argmax(np.abs(item.measured.ratio.value).max(axis=1)) for item in group]
    pairs = zip(group, largest, strict=True)
    return float(np.exp(np.mean([np.log(item.measured.ratio.frequency_hz[line]) for item, line in pairs])))


def _with_influences(found: Identification, group: Sequence[PreparedTransfer]) -> Identification:
    """Return a fit whose uncertainty includes the stated influences (`fusion.sensor.unmodelled_effects`).

    A relative change of frequencies changes k by twice as much, and the damping ratio b/(2√(km)) changes b, or η/2 =
    bω₀/(2k). Several loads in the fit show the influence of the load themselves.
    """
    rig = next((item.manifest.rig for item in group if item.manifest.rig.model is not None), None)
    if rig is None:
        return found
    several = np.ptp([item.load_kg for item in group]) > _DIFFERENT * group[0].load_kg
    mountings = [item.manifest.mounting for item in group]
    influences = stated_influences(rig, mountings, ("load",) if several else (), mounting_scatter=False)

    relative = np.array([(one.frequency, one.damping_ratio) for one in influences.unknowns]).reshape(-1, 2)

    loss_factor = any(item.name.startswith("loss_factor") for item in found.derived)
    changes = {"stiffness": (2.0, 0.0), "damping": (1.0, 1.0), "lag": (-1.0, 1.0), "loss": (0.0, 1.0)}
    changes |= {"damping": (2.0, 1.0)} if loss_factor else {}

    def moved(item: ParameterEstimate) -> FloatArray:
        """Return the change (E,) by each unknown; of b/k that of its parts."""
        return np.asarray(item.value * (relative @ changes.get(item.name.partition("_")[0], (0.0, 0.0))))

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


def _with_amplitudes(found: Identification, group: Sequence[PreparedTransfer]) -> Identification:
    """Return a fit of vanishing amplitude whose U covers the amplitudes of the recordings.

    The stiffness changes by twice as much as the frequency, b by as much as frequency and damping ratio together.
    """
    changes = {item.measured.name: FIRST_ORDER * np.array(item.amplitude_change) for item in group}
    if not any(np.any(change) for change in changes.values()):
        return found
    by = {"stiffness": (2.0, 0.0), "damping": (1.0, 1.0), "lag": (-1.0, 1.0), "loss": (0.0, 1.0)}

    def added(item: ParameterEstimate) -> float:
        slopes = np.array(by.get(item.name.partition("_")[0], (0.0, 0.0)))
        largest = max((float(slopes @ change) for change in changes.values()), key=abs)
        return added_uncertainty(item.value, item.u, item.value * (1.0 + largest), item.u)

    def wider(item: ParameterEstimate) -> ParameterEstimate:
        return replace(item, u=float(np.hypot(item.u, added(item))))

    def wider_mode(mode: ModeEstimate) -> ModeEstimate:
        frequency, damping = mode.frequency_hz, mode.damping_ratio
        by_frequency, by_damping = changes[mode.record]
        more_f = added_uncertainty(
            frequency, mode.u_frequency_hz, frequency * (1.0 + by_frequency), mode.u_frequency_hz
        )
        more_d = added_uncertainty(damping, mode.u_damping_ratio, damping * (1.0 + by_damping), mode.u_damping_ratio)
        u_frequency_hz, u_damping_ratio = np.hypot(mode.u_frequency_hz, more_f), np.hypot(mode.u_damping_ratio, more_d)
        return replace(mode, u_frequency_hz=float(u_frequency_hz), u_damping_ratio=float(u_damping_ratio))

    effects = np.array([added(item) for item in found.estimates])
    return replace(
        found,
        estimates=tuple(map(wider, found.estimates)),
        covariance=found.covariance + np.multiply.outer(effects, effects),
        derived=tuple(map(wider, found.derived)),
        modes=tuple(map(wider_mode, found.modes)),
        budget={**found.budget, AMPLITUDE: np.abs(effects)},
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
