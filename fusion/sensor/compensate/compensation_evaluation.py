"""Evaluation of compensation filters: design, effects, and filtered recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusion.base import CommandEvaluation
from fusion.errors import InputError
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import Manifest, find_recordings, load_manifest
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
)
from fusion.sensor.transfer.transfer_records import align
from fusion.sensor.unmodelled_effects import CAUSE_LABELS, describe_coverage
from shaker.arrays import FloatArray
from shaker.compensation.effects import (
    MODEL_ERROR_SHARE,
    CompensationWithUncertainty,
    residual_ringing,
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
from shaker.compensation.force_feedback import FeedbackRun, HapticLoop, largest_stable_gain, push, simulate_feedback
from shaker.lti.indices import LABELS, find_figure_range, indices
from shaker.lti.system import LinearSystem, ModalModel
from shaker.release.load_model import LoadModel, figures_u
from shakercal._common.notices import Notice, Severity

# The force-feedback check: a loop through the sensor without filter, with one for no load, and with its own.

HAND_STIFFNESS, HAND_DAMPING = 500.0, 5.0
HANDLE_MASS, HANDLE_DAMPING = 0.8, 2.0
PUSH_M, WALL_M, PUSH_S = 0.03, 0.005, 0.5
"""How far the hand moves, where the ball begins on its way, and how long it takes."""
BEYOND, HALF = 10.0, 0.5
"""The shared gain over the largest stable one of the filter for no load, but at most half that of the own filter."""


@dataclass(frozen=True)
class HapticCase:
    """One treatment of the sensor's signal, with the `largest_gain` of stable force control.

    `own_error`: tracking error at half of it. `run`: simulation at the gain that all cases share.
    """

    name: str
    largest_gain: float
    own_error: float
    run: FeedbackRun


@dataclass(frozen=True)
class Haptics:
    """The force-feedback check of one channel with one load.

    `load_mass` in kg; `gain`: the force gain that all cases share.
    """

    channel: str
    load_mass: float
    gain: float
    ball_stiffness: float
    cases: tuple[HapticCase, ...]


def check_haptics(results: Sequence[SubjectResult], wish: CompensationSettings) -> Haptics | None:
    """Check the first force with a load model at its heaviest load.

    None if no check is requested.
    """
    if wish.ball_stiffness is None:
        return None
    force = next((one for one in results if one.subject.is_scheduled and one.subject.load_unit == "N"), None)
    if force is None:
        expected = "a model of a force over the load (load.json) for --ball"
        raise InputError(COMMAND, "--ball", found="none", expected=expected)
    own = max(force.filters, key=lambda one: one.load_mass or 0.0)
    mass, rate = own.load_mass or 0.0, own.sections.sample_rate_hz
    unloaded = Compensation(force.subject.dynamics(0.0, wish.modes, real_poles=False), own.compensation.target)
    sensor = own.compensation.sensor.system
    ways: dict[str, Sections | None] = {
        "no filter": None,
        "filter for no load": discretise(unloaded, rate, wish.discretisation),
        f"filter for {1e3 * mass:.4g} g": own.sections,
    }
    loop = HapticLoop(HAND_STIFFNESS, HAND_DAMPING, HANDLE_MASS, HANDLE_DAMPING, wish.ball_stiffness, 0.0, rate)
    limits = [largest_stable_gain(loop, sensor, sections) for sections in ways.values()]
    shared = min(BEYOND * limits[1], HALF * limits[2])
    cases = []
    hand = push(np.arange(round(PUSH_S * rate)) / rate, PUSH_M, PUSH_S)
    for (name, sections), limit in zip(ways.items(), limits, strict=True):
        alone, together = (
            simulate_feedback(replace(loop, force_gain=gain), sensor, sections, hand, wall_m=WALL_M)
            for gain in (HALF * limit, shared)
        )
        cases.append(HapticCase(name, limit, alone.tracking_error, together))
    return Haptics(force.subject.name, mass, shared, wish.ball_stiffness, tuple(cases))


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
        raise InputError(path, "", found=f"{len(recordings)} recordings", expected="one recording for --apply")
    manifest = load_manifest(recordings[0], allow_outside=allow_outside)
    if manifest.take:
        raise InputError(manifest.path, "take", found=f"{len(manifest.take)} takes", expected="a recording of one take")
    wanted = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    if not wanted:
        raise InputError(manifest.path, "daq.channel", found="none", expected='a channel with quantity = "output"')
    read = align(manifest, read_daqs(manifest), wanted, "daq")
    names = tuple(entry.channel or entry.name for _, entry in wanted)
    unit = manifest.rig.unit_of(wanted[0][1])
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
        known = ", ".join(one.subject.channel for one in results)
        found = f"outputs {', '.join(record.channels)}"
        raise InputError(record.manifest.path, "daq.channel", found=found, expected=f"one of the channels {known}")
    name = record.manifest.folder.name
    if skipped:
        notices = (*notices, Notice("note", f"left out, since no filter is for it: {', '.join(skipped)}", name))
    return CompensatedRecording(name, record.sample_rate_hz, record.start_s, tuple(filtered)), notices


def _filtered(
    name: str, values: FloatArray, record: OutputRecord, made: LoadFilter, wish: CompensationSettings
) -> CompensatedChannel:
    """Return one output after its filter."""
    subject, rate_hz, own_hz = made.subject, record.sample_rate_hz, made.sections.sample_rate_hz
    if subject.channel != STATED and subject.unit != record.unit:
        expected = f"{subject.unit}, the unit of the model of {name}"
        raise InputError(record.manifest.path, "sensor.unit", found=record.unit, expected=expected)
    if own_hz != rate_hz:
        expected = f"samples at {own_hz:g} Hz, the rate of the filter"
        raise InputError(record.manifest.path, "daq", found=f"{rate_hz:g} Hz", expected=expected)
    first = max(1, min(len(values), round(rate_hz / made.compensation.target.frequency_hz)))
    level, noise = float(np.mean(values[:first])), white_noise(values)
    run = CompensationWithUncertainty(made.compensation, rate_hz, wish.discretisation, level=level, noise=noise)
    signal, unit = run(values[None]), made.output_unit if wish.calibrated else record.unit
    k = subject.factors(signal.u[0], signal.u_scatter[0])[1]
    raw = made.sections.gain * values
    return CompensatedChannel(name, unit, raw, signal.value[0], signal.u[0], signal.u_noise, k)


def white_noise(values: FloatArray) -> float:
    """Return the standard deviation of the noise of samples (N,).

    It is estimated from third differences, robust against steps.
    """
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
        raise InputError(COMMAND, "--load-mass", found=f"{len(settings.load_masses)}", expected=expected)
    rig = record.manifest.rig
    if settings.load_masses or rig.load is None:
        return settings
    return replace(settings, load_masses=(rig.load.mass + sum(part.mass for part in rig.part if part.body == "load"),))


# What the user should know of a compensation.

WIDTH_SHARE = 0.3
"""u of a frequency over half the width of its resonance from which first order no longer holds."""
LARGE_ERROR = 0.01
"""Discretisation error in the band, and share of a mode in the step, from which the user is told."""
LARGE_NOISE = 10.0
BETTER = 1.05
"""Factor by which another damping ratio widens the band from which it is named."""


def remarks(result: SubjectResult, wish: CompensationSettings) -> Iterator[Notice]:
    """Yield notices on the limits of the filters of a channel."""
    subject = result.subject
    if subject.scope:
        load = [] if subject.is_scheduled else [CAUSE_LABELS["load"]]
        untold = ", ".join([CAUSE_LABELS["mounting"], *load, CAUSE_LABELS["temperature"], CAUSE_LABELS["structure"]])
        outside = subject.basis.outside
        yield Notice("note", describe_coverage(subject.scope, untold if outside is None else outside), subject.name)
    for made in result.filters:
        several = made.load_mass is not None and len(result.filters) > 1
        where = f"{subject.name}, {subject.load_text(made.load_mass or 0.0)}" if several else subject.name
        for severity, text in (*_of_design(made, wish), *_of_effects(made)):
            yield Notice(severity, text, where)
        for when, figures in (("before the filter", made.before), ("after the filter", made.after)):
            yield from (Notice(one.severity, f"{when}, {one.text}", where) for one in figures.notices)


def _of_design(made: LoadFilter, wish: CompensationSettings) -> Iterator[tuple[Severity, str]]:
    """Yield notices on the certainty of the model, the target, and the requested band."""
    sensor, target, error = made.compensation.sensor, made.compensation.target, wish.permitted_error
    if wish.real_hz is not None and not len(sensor.real_hz):
        yield "note", "the model has no real pole that --real-pole could move"
    if sensor.covariance is None:
        yield "note", "the model has no covariance: what its errors do to the signal is not known"
    for hertz, damping, u in zip(sensor.frequency_hz, sensor.damping_ratio, sensor.u, strict=False):
        if u > WIDTH_SHARE * damping * hertz:  # never of an unknown u, which is NaN
            text = f"u of the mode at {hertz:.4g} Hz is {100 * u / (damping * hertz):.0f} % of half the width of its "
            text += "resonance: around it the uncertainty of the compensated signal is a first-order figure only"
            yield "warning", text
    reached, best = band_ratio(target.damping_ratio, error), best_damping((1.0 - MODEL_ERROR_SHARE) * error)
    if wish.damping_ratio is not None and band_ratio(best, error) > BETTER * reached:
        hertz, widest = target.frequency_hz * reached, target.frequency_hz * band_ratio(best, error)
        text = f"ζ = {target.damping_ratio:g} keeps ±{100 * error:g} % of one mode to {hertz:.4g} Hz; "
        yield "note", f"{text}ζ = {best:.3f} keeps it to {widest:.4g} Hz"
    if wish.bandwidth_hz is not None:
        gain = np.abs(made.compensation.compensated.response(np.linspace(0.0, wish.bandwidth_hz, 500)))
        worst = float(np.max(np.abs(gain / gain[0] - 1.0)))
        if worst > error * (1.0 + 1e-9):
            text = f"up to {wish.bandwidth_hz:g} Hz the gain leaves the static one by {100 * worst:.3g} %"
            yield "warning", f"{text}, since the target is that of another load"


def _of_effects(made: LoadFilter) -> Iterator[tuple[Severity, str]]:
    """Yield notices on modes that are not compensated, sampling error and noise."""
    kept = made.compensation.system.poles
    for mode in made.after.indices.modes:
        share = mode.step_share
        if np.min(np.abs(kept - mode.pole)) > 1e-9 * abs(mode.pole) and share is not None and share > LARGE_ERROR:
            text = f"a mode at {mode.natural_hz:.4g} Hz (ζ = {mode.damping_ratio:.3g}) stays and swings by "
            yield "warning", f"{text}{100 * share:.2g} % of a step; --modes compensates it too"
    if made.discretisation_error > LARGE_ERROR:
        text = f"at {made.sections.sample_rate_hz:g} Hz the sampled filter is off the continuous one by up to "
        text += f"{100 * made.discretisation_error:.2g} % below {made.band_hz:.4g} Hz; a higher rate makes it better"
        yield "warning", text
    if made.noise_factor > LARGE_NOISE:
        text = f"white noise rises {made.noise_factor:.3g}-fold; "
        yield "warning", f"{text}a lower target frequency or --low-pass passes less of it"


# Everything a compensation found, as it is written and shown.


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


# Filters for every channel and load, and what they do before and after.

SAMPLES_PER_PERIOD = 50.0
"""Samples per period of the target where neither the user nor the model states a rate."""
AFTER_PERIODS = 2.0
"""Periods of the target after which what still rings is read: 2 ms for 1000 Hz."""
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
    >>> from fusion.sensor.compensate.compensation_subjects import Wish, read_sources  # doctest: +SKIP
    >>> wish = Wish(frequency_hz=3000.0, damping_ratio=0.6)  # doctest: +SKIP
    >>> evaluation = evaluate_compensation(read_sources([Path("steps/step")]), wish, None, {})  # doctest: +SKIP
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
            text = f"the filter is made for a load of {load}; --load-mass names others"
            notices.append(Notice("note", text, result.subject.name))
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


def _subject(subject: CompensationSubject, wish: CompensationSettings, rate_hz: float | None) -> SubjectResult:
    """Return the filters of one channel, one per load, all with one target."""
    if subject.is_scheduled and wish.real_hz is not None:
        expected = "no --real-pole: a model over the load has none"
        raise InputError(COMMAND, "--real-pole", found=f"{wish.real_hz:g} Hz", expected=expected)
    masses: tuple[float | None, ...] = (wish.load_masses or (0.0,)) if subject.is_scheduled else (None,)
    try:
        sensors = [subject.dynamics(mass, wish.modes, wish.real_hz is not None) for mass in masses]
        targets = [wish.target(sensor) for sensor in sensors]
        target = max(targets, key=lambda one: (one.frequency_hz, one.damping_ratio))
        rate = wish.sample_rate_hz or rate_hz or subject.sample_rate_hz or SAMPLES_PER_PERIOD * target.frequency_hz
        designs = [Compensation(sensor, target, wish.calibrated) for sensor in sensors]
        count = max(len(one.factors) for one in designs)
        filters = [_filter(subject, mass, one, wish, (rate, count)) for mass, one in zip(masses, designs, strict=True)]
    except ValueError as error:
        option = OPTIONS.get(str(error).partition(":")[0])
        if option is None:  # the model itself
            raise InputError.from_exception(error, subject.file or Path(COMMAND), subject.name) from error
        raise InputError.from_exception(error, Path(COMMAND), f"{option} ({subject.name})") from error
    return SubjectResult(subject, tuple(filters))


def _filter(
    subject: CompensationSubject,
    mass: float | None,
    design: Compensation,
    wish: CompensationSettings,
    samples: tuple[float, int],
) -> LoadFilter:
    """Return one filter and its effects; `samples`: rate in Hz, and number of sections."""
    rate_hz, count = samples
    sections = pad_sections(discretise(design, rate_hz, wish.discretisation), count)
    gain = white_noise_gain(sections)
    before, after = (_figures(design, subject, mass, alone=alone) for alone in (True, False))
    band = wish.bandwidth_hz or after.indices.band_10_hz or design.target.frequency_hz
    band = min(band, 0.5 * rate_hz, 2.0 * design.target.frequency_hz)
    error = np.abs(discretisation_error(design, sections, np.linspace(0.0, band, BAND_POINTS)))
    after_s = AFTER_PERIODS / design.target.frequency_hz
    off = OFF_FREQUENCY if len(design.sensor.frequency_hz) else OFF_FREQUENCY[:0]
    loads = np.zeros(0)
    if isinstance(subject.model, LoadModel) and mass is not None:
        loads = np.unique(np.array([*wish.load_masses, *subject.model.load_masses, mass]))
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


def _figures(design: Compensation, subject: CompensationSubject, mass: float | None, *, alone: bool) -> IndexEstimates:
    """Return the indices of the sensor, alone or with its filter.

    Their u follows from the covariance of the model. The filter is constant while the model varies within its
    uncertainty, including poles and zeros that no filter cancels.
    """

    def values(system: LinearSystem) -> FloatArray:
        seen = indices(system if alone else system.times(design.system)).figures().values()
        return np.array([np.nan if value is None else value for value in seen])

    model, sensor = subject.model, design.sensor
    found = indices(sensor.system if alone else design.compensated, 1.0 if alone else design.compensated.static_gain)
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
    known = {name: float(one) if np.isfinite(one) else None for name, one in zip(names, spread, strict=True)}
    return IndexEstimates(found, known, dof, tuple(seen.notices(names)))
