"""Evaluation of compensation filters: design, effects, and filtered recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusion.base import CommandEvaluation
from fusion.errors import InputError
from fusion.estimation.coverage import coverage_factor
from fusion.phasors.aligned_channels import align
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import Manifest, find_recordings, load_manifest
from fusion.sensor import model_notices as declared
from fusion.sensor.compensate.compensation_subjects import (
    COMMAND,
    OPTIONS,
    STATED,
    CompensatedChannel,
    CompensatedRecording,
    CompensationSettings,
    CompensationSources,
    CompensationSubject,
    IndexEstimates,
    LoadFilter,
    SubjectResult,
    select_subjects,
    wrong_option,
)
from fusion.sensor.unmodelled_effects import CAUSE_LABELS, coverage_notice
from shaker.compensation.effects import (
    MODEL_ERROR_SHARE,
    CompensationWithUncertainty,
    FeedbackRun,
    HapticLoop,
    largest_stable_gain,
    push,
    residual_ringing,
    simulate_feedback,
    white_noise_gain,
    with_frequency,
)
from shaker.compensation.filter import (
    Compensation,
    Sections,
    band_ratio,
    best_damping,
    discretisation_error,
    discretise,
    pad_sections,
)
from shaker.lti.indices import LABELS, SETTLING, Indices, find_figure_range, indices, settling_interval
from shaker.lti.system import LinearSystem, ModalModel
from shaker.release.load_model import LoadModel, figures_u
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

# The force-feedback check: the sensor without filter, with one for no load, and with one for its load.

HAND_STIFFNESS, HAND_DAMPING = 500.0, 5.0
HANDLE_MASS, HANDLE_DAMPING = 0.8, 2.0
PUSH_M, WALL_M, PUSH_S = 0.03, 0.005, 0.5
"""Motion of the hand, position of the ball, and duration of the motion."""
SHARED_GAIN_FACTOR, HALF = 10.0, 0.5
"""Common gain over the largest stable gain of the filter for no load, at most half that of the filter for the load."""


@dataclass(frozen=True)
class HapticCase:
    """One treatment of the sensor's signal, with the `largest_gain` of stable force control.

    `half_gain_error`: tracking error at half of it. `run`: simulation at the gain that all cases share.
    """

    name: str
    largest_gain: float
    half_gain_error: float
    run: FeedbackRun


@dataclass(frozen=True)
class Haptics:
    """The force-feedback check of one channel with a load (kg) at a shared `gain`."""

    channel: str
    load_mass: float
    gain: float
    ball_stiffness: float
    cases: tuple[HapticCase, ...]


def check_haptics(results: Sequence[SubjectResult], settings: CompensationSettings) -> Haptics | None:
    """Check the first force with a load model at its heaviest load, if requested."""
    if settings.ball_stiffness is None:
        return None
    force = next((one for one in results if one.subject.is_scheduled and one.subject.load_unit == "N"), None)
    if force is None:
        raise wrong_option("none", "a model of a force over the load (load.json) for --ball", "--ball")
    heaviest = max(force.filters, key=lambda one: one.load_mass or 0.0)
    mass, rate = heaviest.load_mass or 0.0, heaviest.sections.sample_rate_hz
    unloaded = Compensation(force.subject.dynamics(0.0, settings.modes, real_poles=False), heaviest.compensation.target)
    sensor = heaviest.compensation.sensor.system
    treatments: dict[str, Sections | None] = {
        "no filter": None,
        "filter for no load": discretise(unloaded, rate, settings.discretisation),
        f"filter for {1e3 * mass:.4g} g": heaviest.sections,
    }
    loop = HapticLoop(HAND_STIFFNESS, HAND_DAMPING, HANDLE_MASS, HANDLE_DAMPING, settings.ball_stiffness, 0.0, rate)
    limits = [largest_stable_gain(loop, sensor, sections) for sections in treatments.values()]
    shared = min(SHARED_GAIN_FACTOR * limits[1], HALF * limits[2])
    cases = []
    hand = push(np.arange(round(PUSH_S * rate)) / rate, PUSH_M, PUSH_S)
    for (name, sections), limit in zip(treatments.items(), limits, strict=True):
        single, common = (
            simulate_feedback(replace(loop, force_gain=gain), sensor, sections, hand, wall_m=WALL_M)
            for gain in (HALF * limit, shared)
        )
        cases.append(HapticCase(name, limit, single.tracking_error, common))
    return Haptics(force.subject.name, mass, shared, settings.ball_stiffness, tuple(cases))


# A recording whose outputs go through their filters.

NOISE_FACTOR = float(np.sqrt(20.0))
"""Standard deviation of third differences over that of white noise: √(1 + 9 + 9 + 1)."""
MEDIAN_TO_STD = 1.482602218505602


@dataclass(frozen=True)
class OutputRecord:
    """Outputs `values` (C, N) of `channels` (C,) of a recording, at `start_s` + n/`sample_rate_hz`."""

    manifest: Manifest
    channels: tuple[str, ...]
    unit: str
    values: FloatArray
    sample_rate_hz: float
    start_s: float
    notices: tuple[Notice, ...]


def read_outputs(path: Path, *, allow_outside: bool = False) -> OutputRecord:
    """Read all output channels of one recording on one time base; raises `InputError`."""
    recordings = find_recordings(path)
    if len(recordings) != 1:
        found = f"{len(recordings)} recordings"
        raise InputError(declared.WRONG_RECORDING, path, found=found, expected="one recording for --apply")
    manifest = load_manifest(recordings[0], allow_outside=allow_outside)
    if manifest.take:
        found = f"{len(manifest.take)} takes"
        raise InputError(
            declared.WRONG_RECORDING, manifest.path, "take", found=found, expected="a recording of one take"
        )
    outputs = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    if not outputs:
        expected = 'a channel with quantity = "output"'
        raise InputError(declared.WRONG_RECORDING, manifest.path, "daq.channel", found="none", expected=expected)
    read = align(manifest, read_daqs(manifest), outputs, "daq")
    names = tuple(entry.channel or entry.name for _, entry in outputs)
    unit = manifest.rig.unit_of(outputs[0][1].quantity)
    return OutputRecord(manifest, names, unit, np.stack(read.values), read.rate_hz, read.start_s, read.notices)


def filter_recording(
    record: OutputRecord, results: Sequence[SubjectResult], settings: CompensationSettings
) -> tuple[CompensatedRecording, tuple[Notice, ...]]:
    """Filter every output of a recording with the filter of its channel.

    A stated sensor has one filter for all outputs. Each filter starts in the steady state at the mean of the record's
    first target period. The noise of the output is estimated from its third differences.
    """
    filtered, skipped, notices = [], [], record.notices
    for name, values in zip(record.channels, record.values, strict=True):
        made = next((one.filters[0] for one in results if one.subject.channel in (name, STATED)), None)
        if made is None:
            skipped.append(name)
        else:
            filtered.append(_filtered(name, values, record, made, settings))
    if not filtered:
        expected = f"one of the channels {', '.join(one.subject.channel for one in results)}"
        found = f"outputs {', '.join(record.channels)}"
        raise InputError(declared.WRONG_RECORDING, record.manifest.path, "daq.channel", found=found, expected=expected)
    name = record.manifest.folder.name
    if skipped:
        notices = (*notices, Notice(declared.OUTPUTS_NOT_FILTERED, name, channels=", ".join(skipped)))
    return CompensatedRecording(name, record.sample_rate_hz, record.start_s, tuple(filtered)), notices


def _filtered(
    name: str, values: FloatArray, record: OutputRecord, made: LoadFilter, settings: CompensationSettings
) -> CompensatedChannel:
    """Return one output after its filter."""
    subject, rate_hz, filter_hz = made.subject, record.sample_rate_hz, made.sections.sample_rate_hz
    if subject.channel != STATED and subject.unit != record.unit:
        expected = f"{subject.unit}, the unit of the model of {name}"
        raise InputError(
            declared.WRONG_RECORDING, record.manifest.path, "sensor.unit", found=record.unit, expected=expected
        )
    if filter_hz != rate_hz:
        expected = f"samples at {filter_hz:g} Hz, the rate of the filter"
        raise InputError(
            declared.WRONG_RECORDING, record.manifest.path, "daq", found=f"{rate_hz:g} Hz", expected=expected
        )
    first = max(1, min(len(values), round(rate_hz / made.compensation.target.frequency_hz)))
    level, noise = float(np.mean(values[:first])), white_noise(values)
    run = CompensationWithUncertainty(made.compensation, rate_hz, settings.discretisation, level=level, noise=noise)
    signal, unit = run(values[None]), made.output_unit if settings.calibrated else record.unit
    k = subject.factors(signal.u[0], signal.u_scatter[0])[1]
    raw = made.sections.gain * values
    return CompensatedChannel(name, unit, raw, signal.value[0], signal.u[0], signal.u_noise, k)


def white_noise(values: FloatArray) -> float:
    """Return the standard deviation of noise (N,) by third differences, robust against steps."""
    if len(values) < 8:
        return 0.0
    return float(MEDIAN_TO_STD * np.median(np.abs(np.diff(values, 3))) / NOISE_FACTOR)


def add_recorded_load(
    settings: CompensationSettings, sources: CompensationSources, record: OutputRecord | None
) -> CompensationSettings:
    """Return the settings with the rig's load if the models depend on the load."""
    if record is None or not any(subject.is_scheduled for subject in sources.subjects):
        return settings
    if len(settings.load_masses) > 1:
        expected = "one load mass with --apply, that of the recording"
        raise wrong_option(f"{len(settings.load_masses)}", expected, "--load-mass")
    rig = record.manifest.rig
    if settings.load_masses or rig.load is None:
        return settings
    return replace(settings, load_masses=(rig.load.mass + sum(part.mass for part in rig.part if part.body == "load"),))


# Notices of a compensation.

WIDTH_SHARE = 0.3
"""u of a frequency over the half-width of its resonance from which first order is not sufficient."""
LARGE_ERROR = 0.01
"""Discretisation error in the band, and share of a mode in the step, from which a notice is given: chosen."""
LARGE_NOISE = 10.0  # noise factor from which a notice is given: chosen
MIN_WIDENING = 1.05
"""Factor of the band from which a better damping ratio is named: chosen."""


def remarks(result: SubjectResult, settings: CompensationSettings) -> Iterator[Notice]:
    """Yield notices on the limits of the filters of a channel."""
    subject = result.subject
    if subject.scope:
        load = [] if subject.is_scheduled else [CAUSE_LABELS["load"]]
        causes = [CAUSE_LABELS["mounting"], *load, CAUSE_LABELS["temperature"], CAUSE_LABELS["structure"]]
        outside = subject.basis.outside
        yield coverage_notice(subject.scope, ", ".join(causes) if outside is None else outside, subject.name)
    for made in result.filters:
        several = made.load_mass is not None and len(result.filters) > 1
        where = f"{subject.name}, {subject.load_text(made.load_mass or 0.0)}" if several else subject.name
        yield from _of_design(made, settings, where)
        yield from _of_effects(made, where)
        for when, figures in (("before the filter", made.before), ("after the filter", made.after)):
            yield from (one.at(f"{where}, {when}") for one in figures.notices)


def _of_design(made: LoadFilter, settings: CompensationSettings, where: str) -> Iterator[Notice]:
    """Yield notices on the certainty of the model, the target, and the requested band."""
    sensor, target, error = made.compensation.sensor, made.compensation.target, settings.permitted_error
    if settings.real_hz is not None and not len(sensor.real_hz):
        yield Notice(declared.NO_REAL_POLE_TO_MOVE, where)
    if sensor.covariance is None:
        yield Notice(declared.COVARIANCE_NOT_STATED, where)
    for hertz, damping, u in zip(sensor.frequency_hz, sensor.damping_ratio, sensor.u, strict=False):
        if u > WIDTH_SHARE * damping * hertz:  # never of an unknown u, which is NaN
            share = 100.0 * float(u / (damping * hertz))
            yield Notice(declared.MODE_UNCERTAIN, where, frequency_hz=float(hertz), share_percent=share)
    reached, best = band_ratio(target.damping_ratio, error), best_damping((1.0 - MODEL_ERROR_SHARE) * error)
    if settings.damping_ratio is not None and band_ratio(best, error) > MIN_WIDENING * reached:
        yield Notice(
            declared.WIDER_BAND_POSSIBLE,
            where,
            damping_ratio=target.damping_ratio,
            permitted_percent=100.0 * error,
            band_hz=target.frequency_hz * reached,
            best_damping_ratio=best,
            widest_hz=target.frequency_hz * band_ratio(best, error),
        )
    if settings.bandwidth_hz is not None:
        gain = np.abs(made.compensation.compensated.response(np.linspace(0.0, settings.bandwidth_hz, 500)))
        worst = float(np.max(np.abs(gain / gain[0] - 1.0)))
        if worst > error * (1.0 + 1e-9):
            yield Notice(
                declared.BAND_NOT_REACHED, where, band_hz=settings.bandwidth_hz, deviation_percent=100.0 * worst
            )


def _of_effects(made: LoadFilter, where: str) -> Iterator[Notice]:
    """Yield notices on modes that are not compensated, sampling error and noise."""
    filter_poles = made.compensation.system.poles
    for mode in made.after.indices.modes:
        share = mode.step_share
        is_of_sensor = np.min(np.abs(filter_poles - mode.pole)) > 1e-9 * abs(mode.pole)
        if is_of_sensor and share is not None and share > LARGE_ERROR:
            hertz, zeta, percent = mode.natural_hz, mode.damping_ratio, 100.0 * share
            yield Notice(
                declared.MODE_NOT_COMPENSATED, where, frequency_hz=hertz, damping_ratio=zeta, share_percent=percent
            )
    if made.discretisation_error > LARGE_ERROR:
        percent, rate_hz = 100.0 * made.discretisation_error, made.sections.sample_rate_hz
        yield Notice(declared.SAMPLING_ERROR, where, rate_hz=rate_hz, deviation_percent=percent, band_hz=made.band_hz)
    if made.noise_factor > LARGE_NOISE:
        yield Notice(declared.NOISE_AMPLIFIED, where, factor=made.noise_factor)


# The evaluation of a compensation.


@dataclass(frozen=True)
class CompensateEvaluation(CommandEvaluation):
    """All filters, the recording they were applied to, and the force-feedback check."""

    target_settings: CompensationSettings
    subjects: tuple[SubjectResult, ...]
    applied: CompensatedRecording | None
    haptics: Haptics | None

    @property
    def filters(self) -> list[LoadFilter]:
        """Filters of all channels and loads."""
        return [made for result in self.subjects for made in result.filters]


# Filters for every channel and load, with their effects.

SAMPLES_PER_PERIOD = 50.0
"""Samples per period of the target if neither user nor model states a rate."""
AFTER_PERIODS = 2.0
"""Periods of the target from which residual ringing is evaluated: 2 ms for 1000 Hz."""
OFF_FREQUENCY = np.array([-0.2, -0.1, -0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05, 0.1])
BAND_POINTS = 200


def evaluate_compensation(
    sources: CompensationSources, settings: CompensationSettings, record: OutputRecord | None, hashes: Mapping[str, str]
) -> CompensateEvaluation:
    """Design all filters, and apply them to a recording if one is given.

    Parameters
    ----------
    sources
        Models of the sensor, of `read_sources`.
    settings
        Target dynamics and options of the filters.
    record
        Recording to be filtered; None for filters only.
    hashes
        SHA-256 of the input files by name, for the results.

    Returns
    -------
    CompensateEvaluation : filters with their effects, the filtered recording, and the force-feedback check.

    Raises
    ------
    InputError : the settings cannot be realised with the models.

    Examples
    --------
    >>> from fusion import evaluate_compensation
    >>> from pathlib import Path
    >>> from fusion.sensor.compensate.compensation_subjects import CompensationSettings, read_sources  # doctest: +SKIP
    >>> settings = CompensationSettings(frequency_hz=3000.0, damping_ratio=0.6)  # doctest: +SKIP
    >>> evaluation = evaluate_compensation(read_sources([Path("steps/step")]), settings, None, {})  # doctest: +SKIP
    """
    started = time.monotonic()
    rate = None if record is None else record.sample_rate_hz
    subjects = [_subject(subject, settings, rate) for subject in select_subjects(sources, settings.channels)]
    applied, more = (None, ()) if record is None else filter_recording(record, subjects, settings)
    haptics = check_haptics(subjects, settings)
    notices = list(sources.notices)
    for result in subjects:
        if result.subject.is_scheduled and len(result.filters) == 1:
            load = result.subject.load_text(result.filters[0].load_mass or 0.0)
            notices.append(Notice(declared.FILTER_FOR_ONE_LOAD, result.subject.name, load=load))
    notices += [notice for result in subjects for notice in remarks(result, settings)]
    return CompensateEvaluation(
        name=sources.name,
        target_settings=settings,
        subjects=tuple(subjects),
        applied=applied,
        haptics=haptics,
        notices=(*notices, *more),
        settings=settings.settings,
        input_hashes=dict(hashes),
        duration_s=time.monotonic() - started,
    )


def _subject(subject: CompensationSubject, settings: CompensationSettings, rate_hz: float | None) -> SubjectResult:
    """Return the filters of one channel, one per load, all with one target."""
    if subject.is_scheduled and settings.real_hz is not None:
        expected = "no --real-pole: a model over the load has none"
        raise wrong_option(f"{settings.real_hz:g} Hz", expected, "--real-pole")
    masses: tuple[float | None, ...] = (settings.load_masses or (0.0,)) if subject.is_scheduled else (None,)
    try:
        sensors = [subject.dynamics(mass, settings.modes, settings.real_hz is not None) for mass in masses]
        targets = [settings.target(sensor) for sensor in sensors]
        target = max(targets, key=lambda one: (one.frequency_hz, one.damping_ratio))
        rate = settings.sample_rate_hz or rate_hz or subject.sample_rate_hz or SAMPLES_PER_PERIOD * target.frequency_hz
        designs = [Compensation(sensor, target, settings.calibrated) for sensor in sensors]
        count = max(len(one.factors) for one in designs)
        filters = [
            _filter(subject, mass, one, settings, (rate, count)) for mass, one in zip(masses, designs, strict=True)
        ]
    except ValueError as error:
        option = OPTIONS.get(str(error).partition(":")[0])
        file = None if option else subject.file  # without an option, the model itself is refused
        key = f"{option} ({subject.name})" if option else subject.name
        raise InputError.from_exception(error, file or Path(COMMAND), key, declared.FILTER_REFUSED) from error
    return SubjectResult(subject, tuple(filters))


def _filter(
    subject: CompensationSubject,
    mass: float | None,
    design: Compensation,
    settings: CompensationSettings,
    samples: tuple[float, int],
) -> LoadFilter:
    """Return one filter and its effects; `samples`: rate in Hz, and number of sections."""
    rate_hz, count = samples
    sections = pad_sections(discretise(design, rate_hz, settings.discretisation), count)
    gain = white_noise_gain(sections)
    before, after = (_figures(design, subject, mass, alone=alone) for alone in (True, False))
    band = settings.bandwidth_hz or after.indices.band_10_hz or design.target.frequency_hz
    band = min(band, 0.5 * rate_hz, 2.0 * design.target.frequency_hz)
    error = np.abs(discretisation_error(design, sections, np.linspace(0.0, band, BAND_POINTS)))
    after_s = AFTER_PERIODS / design.target.frequency_hz
    off = OFF_FREQUENCY if len(design.sensor.frequency_hz) else OFF_FREQUENCY[:0]
    loads = np.zeros(0)
    if isinstance(subject.model, LoadModel) and mass is not None:
        loads = np.unique(np.array([*settings.load_masses, *subject.model.load_masses, mass]))
    detuned = [with_frequency(design.sensor, 1.0 + by) for by in off]
    loaded = [subject.dynamics(float(load), 1, real_poles=False).system for load in loads]
    return LoadFilter(
        subject=subject,
        load_mass=mass,
        compensation=design,
        sections=sections,
        before=before,
        after=after,
        noise_gain=gain,
        noise=None if subject.noise is None else gain * subject.noise,
        band_hz=band,
        discretisation_error=float(np.max(error)),
        after_s=after_s,
        off_frequency=off,
        off_ringing=np.array([residual_ringing(design, sensor, after_s) for sensor in detuned]),
        off_load=loads,
        load_ringing=np.array([residual_ringing(design, sensor, after_s) for sensor in loaded]),
    )


def _settle_as_step(found: Indices, model: ModalModel, u: dict[str, float | None], dof: dict[str, float]) -> None:
    """Replace u and degrees of freedom of the settling times, as `step` reports them.

    They are those of `settling_interval`. Settling times are discontinuous: a slope over the discontinuity, times the k
    of few degrees of freedom, has no meaning. An interval without the time, that of a model with fewer modes, is not
    used.
    """
    of_damping = dof["damping_ratio"]
    k = coverage_factor(of_damping)
    for name, tolerance in SETTLING.items():
        time, ends = found.figures()[name], settling_interval(model, tolerance, k)
        if time is not None and ends is not None and ends[0] <= time <= ends[1]:
            u[name], dof[name] = max(time - ends[0], ends[1] - time) / k, of_damping


def _figures(design: Compensation, subject: CompensationSubject, mass: float | None, *, alone: bool) -> IndexEstimates:
    """Return the indices of the sensor, alone or with its filter.

    Their u follows from the covariance of the model. The filter is constant while the model varies within its
    uncertainty, including poles and zeros that no filter cancels.
    """

    model, sensor = subject.model, design.sensor
    found = indices(sensor.system if alone else design.compensated, 1.0 if alone else design.compensated.static_gain)
    dominant = None if found.dominant is None else found.dominant.pole

    def values(system: LinearSystem) -> FloatArray:
        seen = indices(system if alone else system.times(design.system), dominant=dominant).figures().values()
        return np.array([np.nan if value is None else value for value in seen])

    names = tuple(LABELS)
    if isinstance(model, ModalModel) and model.covariance is not None:
        # Steps of half an uncertainty: an index that jumps from one turning point to the next does so within it.
        slope, covariance = model.jacobian(lambda one: values(one.system), 0.5)[1], model.covariance
        seen = find_figure_range(covariance, slope, lambda move: values(model.with_move(move).system))
        scatter = np.zeros_like(covariance) if subject.scatter_covariance is None else subject.scatter_covariance
        spread, of_scatter = (
            seen.factor * np.sqrt(np.maximum(np.einsum("qp,pr,qr->q", slope, part, slope), 0.0))
            for part in (covariance, scatter)
        )
    elif isinstance(model, LoadModel) and model.total_covariance is not None:
        spread, seen = figures_u(model, lambda one: values(one.system(mass or 0.0)))
        gain, of_scatter = names.index("static_gain"), spread
        spread[gain] = np.hypot(spread[gain], values(sensor.system)[gain] / model.sensitivity * model.u_sensitivity)
    else:
        return IndexEstimates(found, dict.fromkeys(names), dict.fromkeys(names, np.inf))
    dof = dict(zip(names, subject.factors(spread, of_scatter)[0].tolist(), strict=True))
    u = {name: float(one) if np.isfinite(one) else None for name, one in zip(names, spread, strict=True)}
    if alone and isinstance(model, ModalModel):
        _settle_as_step(found, model, u, dof)
    return IndexEstimates(found, u, dof, tuple(seen.notices(names)))
