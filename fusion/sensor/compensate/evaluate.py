"""A model to a filter, and what it does."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import numpy as np

from fusion.base import InputError, versions
from fusion.recording.files import read_daqs
from fusion.recording.load import Manifest, find_recordings, load_manifest
from fusion.sensor.compensate.source import (
    COMMAND,
    CompensatedChannel,
    CompensatedRecording,
    Figures,
    LoadFilter,
    Sources,
    Subject,
    SubjectResult,
    Wish,
    chosen,
)
from fusion.sensor.transfer.records import align
from shaker.arrays import FloatArray, Notice
from shaker.compensation.effects import (
    KEPT_SHARE,
    CompensationWithUncertainty,
    moved,
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
    filled,
    sampled,
)
from shaker.compensation.force_feedback import FeedbackRun, HapticLoop, largest_stable_gain, push, simulate_feedback
from shaker.lti.indices import LABELS, Indices, indices
from shaker.lti.system import LinearSystem
from shaker.release.load_model import LoadModel

# The force-feedback check: a loop through the sensor without filter, with one for no load, and with its own.


HAND_STIFFNESS, HAND_DAMPING = 500.0, 5.0
HANDLE_MASS, HANDLE_DAMPING = 0.8, 2.0
PUSH_M, WALL_M, PUSH_S = 0.03, 0.005, 0.5
"""How far the hand moves, where the ball begins on its way, and how long it takes."""
BEYOND, HALF = 10.0, 0.5
"""The shared gain over the largest stable one of the filter for no load, but at most half that of the own filter."""


@dataclass(frozen=True)
class HapticCase:
    """One way to treat the sensor's signal: `largest_gain` of the force control at which the loop is stable.

    `own_error`: tracking error at half of it; `run`: at the gain that all cases share.
    """

    name: str
    largest_gain: float
    own_error: float
    run: FeedbackRun


@dataclass(frozen=True)
class Haptics:
    """The check of one channel with a load of `load_mass` in kg at the shared force gain `gain`."""

    channel: str
    load_mass: float
    gain: float
    ball_stiffness: float
    cases: tuple[HapticCase, ...]


def check_haptics(results: Sequence[SubjectResult], wish: Wish) -> Haptics | None:
    """Run the check for the first force whose load is modelled, with its heaviest load; None where none is wanted."""
    if wish.ball_stiffness is None:
        return None
    found = next((one for one in results if one.subject.is_scheduled and one.subject.load_unit == "N"), None)
    if found is None:
        expected = "a model of a force over the load (load.json) for --ball"
        raise InputError(COMMAND, "--ball", found="none", expected=expected)
    own = max(found.filters, key=lambda one: one.load_mass or 0.0)
    mass, rate = own.load_mass or 0.0, own.sections.sample_rate_hz
    unloaded = Compensation(found.subject.dynamics(0.0, wish.modes, real_poles=False), own.compensation.target)
    sensor = own.compensation.sensor.system
    ways: dict[str, Sections | None] = {
        "no filter": None,
        "filter for no load": sampled(unloaded, rate, wish.discretisation),
        f"filter for {1e3 * mass:.4g} g": own.sections,
    }
    loop = HapticLoop(HAND_STIFFNESS, HAND_DAMPING, HANDLE_MASS, HANDLE_DAMPING, wish.ball_stiffness, 0.0, rate)
    limits = [largest_stable_gain(loop, sensor, sections) for sections in ways.values()]
    shared = min(BEYOND * limits[1], HALF * limits[2])
    cases = [
        _case(name, replace(loop, force_gain=HALF * limit), shared, sensor, sections)
        for (name, sections), limit in zip(ways.items(), limits, strict=True)
    ]
    return Haptics(found.subject.name, mass, shared, wish.ball_stiffness, tuple(cases))


def _case(name: str, loop: HapticLoop, shared: float, sensor: LinearSystem, sections: Sections | None) -> HapticCase:
    """One case at half its own largest gain, and at the shared one."""
    hand = push(np.arange(round(PUSH_S * loop.sample_rate_hz)) / loop.sample_rate_hz, PUSH_M, PUSH_S)
    alone, together = (
        simulate_feedback(replace(loop, force_gain=gain), sensor, sections, hand, wall_m=WALL_M)
        for gain in (loop.force_gain, shared)
    )
    return HapticCase(name, loop.force_gain / HALF, alone.tracking_error, together)


# A recording whose outputs go through their filters.


NOISE_FACTOR = float(np.sqrt(20.0))
"""Standard deviation of third differences over that of white noise: √(1 + 9 + 9 + 1)."""
MEDIAN_TO_STD = 1.482602218505602
STATED = "sensor"


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
    """Read every output channel of one recording of any kind on one time base; raises `InputError`."""
    recordings = find_recordings(path)
    if len(recordings) != 1:
        raise InputError(path, "", found=f"{len(recordings)} recordings", expected="one recording for --apply")
    manifest = load_manifest(recordings[0], allow_outside=allow_outside)
    if manifest.take:
        raise InputError(manifest.path, "take", found=f"{len(manifest.take)} takes", expected="a recording of one take")
    wanted = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    if not wanted:
        raise InputError(manifest.path, "daq.channel", found="none", expected='a channel with quantity = "output"')
    found = align(manifest, read_daqs(manifest), wanted, "daq")
    names = tuple(entry.channel or entry.name for _, entry in wanted)
    unit = manifest.rig.unit_of(wanted[0][1])
    return OutputRecord(manifest, names, unit, np.stack(found.values), found.rate_hz, found.start_s, found.notices)


def rig_load_mass(manifest: Manifest) -> float | None:
    """Return the mass in kg that the rig says stands on the sensor, None where it names no load."""
    rig = manifest.rig
    if rig.load is None:
        return None
    return rig.load.mass + sum(part.mass for part in rig.part if part.body == "load")


def apply(
    record: OutputRecord, results: Sequence[SubjectResult], wish: Wish
) -> tuple[CompensatedRecording, tuple[Notice, ...]]:
    """Run every output through the filter of its channel; a stated sensor's filter is that of all outputs.

    Each filter starts settled at the mean of the record's first target period. The noise of the output is read from its
    third differences.
    """
    filtered, skipped = [], []
    for name, values in zip(record.channels, record.values, strict=True):
        own = [one for one in results if one.subject.channel in (name, STATED)]
        if own:
            filtered.append(_channel(name, values, record, own[0], wish))
        else:
            skipped.append(name)
    if not filtered:
        known = ", ".join(one.subject.channel for one in results)
        found = f"outputs {', '.join(record.channels)}"
        raise InputError(record.manifest.path, "daq.channel", found=found, expected=f"one of the channels {known}")
    notices = record.notices
    if skipped:
        text = f"left out, since no filter is for it: {', '.join(skipped)}"
        notices = (*notices, Notice("info", text, record.manifest.folder.name))
    name = record.manifest.folder.name
    return CompensatedRecording(name, record.sample_rate_hz, record.start_s, tuple(filtered)), notices


def _channel(
    name: str, values: FloatArray, record: OutputRecord, result: SubjectResult, wish: Wish
) -> CompensatedChannel:
    """One output after its filter."""
    subject, found = result.subject, result.filters[0]
    if subject.channel != STATED and subject.unit != record.unit:
        expected = f"{subject.unit}, the unit of the model of {name}"
        raise InputError(record.manifest.path, "sensor.unit", found=record.unit, expected=expected)
    if found.sections.sample_rate_hz != record.sample_rate_hz:
        told = f"{found.sections.sample_rate_hz:g} Hz"
        raise InputError(
            record.manifest.path,
            "daq",
            found=f"{record.sample_rate_hz:g} Hz",
            expected=f"samples at {told}, the rate of the filter",
        )
    first = max(1, min(len(values), round(record.sample_rate_hz / found.compensation.target.frequency_hz)))
    run = CompensationWithUncertainty(
        found.compensation,
        record.sample_rate_hz,
        wish.discretisation,
        level=float(np.mean(values[:first])),
        noise=white_noise(values),
    )
    signal = run(values[None])
    unit = record.unit if not wish.calibrated else result.output_unit
    return CompensatedChannel(name, unit, found.sections.gain * values, signal.value[0], signal.u[0], signal.u_noise)


def white_noise(values: FloatArray) -> float:
    """Return the standard deviation of the noise of samples (N,) by their third differences, robust against steps."""
    if len(values) < 8:
        return 0.0
    return float(MEDIAN_TO_STD * np.median(np.abs(np.diff(values, 3))) / NOISE_FACTOR)


def with_load(wish: Wish, sources: Sources, record: OutputRecord | None) -> Wish:
    """Return the wish with the load of the rig where a recording is filtered by models over the load."""
    if record is None or not any(subject.is_scheduled for subject in sources.subjects):
        return wish
    if len(wish.load_masses) > 1:
        expected = "one load mass with --apply, that of the recording"
        raise InputError(COMMAND, "--load-mass", found=f"{len(wish.load_masses)}", expected=expected)
    mass = rig_load_mass(record.manifest)
    return wish if wish.load_masses or mass is None else replace(wish, load_masses=(mass,))


# What the user should know of a compensation.


WIDTH_SHARE = 0.3
"""u of a frequency over half the width of its resonance from which first order no longer holds."""
LARGE_ERROR = 0.01
"""Discretisation error in the band, and share of a mode in the step, from which the user is told."""
LARGE_NOISE = 10.0
BETTER = 1.05
"""Factor by which another damping ratio widens the band from which it is named."""


def of_subject(result: SubjectResult) -> Iterator[Notice]:
    """Say of a channel what all its loads share."""
    if result.subject.is_scheduled and len(result.filters) == 1:
        load = result.subject.load_text(result.filters[0].load_mass or 0.0)
        text = f"the filter is made for a load of {load}; --load-mass names others"
        yield Notice("info", text, result.subject.name)


def of_filter(result: SubjectResult, found: LoadFilter, wish: Wish) -> Iterator[Notice]:
    """Say of one filter what limits it."""
    where = result.subject.name
    if found.load_mass is not None and len(result.filters) > 1:
        where += f", {result.subject.load_text(found.load_mass)}"
    if wish.real_hz is not None and not len(found.compensation.sensor.real_hz):
        yield Notice("info", "the model has no real pole that --real-pole could move", where)
    for severity, text in (*_model(found), *_target(found, wish), *_left(found), *_samples(found)):
        yield Notice(severity, text, where)  # type: ignore[arg-type]


def _model(found: LoadFilter) -> Iterator[tuple[str, str]]:
    """Whether the model is known well enough."""
    sensor = found.compensation.sensor
    if sensor.covariance is None:
        yield "info", "the model has no covariance: what its errors do to the signal is not known"
        return
    for hertz, damping, u in zip(sensor.frequency_hz, sensor.damping_ratio, sensor.u, strict=False):
        if u > WIDTH_SHARE * damping * hertz:
            yield (
                "warning",
                f"u of the mode at {hertz:.4g} Hz is {100 * u / (damping * hertz):.0f} % of half the width of its "
                "resonance: around it the uncertainty of the compensated signal is a first-order figure only",
            )


def _target(found: LoadFilter, wish: Wish) -> Iterator[tuple[str, str]]:
    """Whether the target is the best for the permitted error, and whether a wanted band is kept."""
    target, error = found.compensation.target, wish.permitted_error
    reached, percent = band_ratio(target.damping_ratio, error), 100 * error
    best = best_damping((1.0 - KEPT_SHARE) * error)
    if wish.damping_ratio is not None and band_ratio(best, error) > BETTER * reached:
        yield (
            "info",
            f"ζ = {target.damping_ratio:g} keeps ±{percent:g} % of one mode to {reached * target.frequency_hz:.4g} Hz; "
            f"ζ = {best:.3f} keeps it to {band_ratio(best, error) * target.frequency_hz:.4g} Hz",
        )
    if wish.bandwidth_hz is not None:
        hertz = np.linspace(0.0, wish.bandwidth_hz, 500)
        gain = np.abs(found.compensation.compensated.response(hertz))
        worst = float(np.max(np.abs(gain / gain[0] - 1.0)))
        if worst > error * (1.0 + 1e-9):
            text = f"up to {wish.bandwidth_hz:g} Hz the gain leaves the static one by {100 * worst:.3g} %"
            yield "warning", f"{text}, since the target is that of another load"


def _left(found: LoadFilter) -> Iterator[tuple[str, str]]:
    """Modes of the sensor that the filter leaves."""
    kept = found.compensation.system.poles
    for mode in found.after.indices.modes:
        share = mode.step_share
        if np.min(np.abs(kept - mode.pole)) > 1e-9 * abs(mode.pole) and share is not None and share > LARGE_ERROR:
            yield (
                "warning",
                f"a mode at {mode.natural_hz:.4g} Hz (ζ = {mode.damping_ratio:.3g}) stays and swings by "
                f"{100 * share:.2g} % of a step; --modes compensates it too",
            )


def _samples(found: LoadFilter) -> Iterator[tuple[str, str]]:
    """What sampling and noise cost."""
    if found.discretisation_error > LARGE_ERROR:
        yield (
            "warning",
            f"at {found.sections.sample_rate_hz:g} Hz the sampled filter is off the continuous one by up to "
            f"{100 * found.discretisation_error:.2g} % below {found.band_hz:.4g} Hz; a higher rate makes it better",
        )
    if found.noise_gain / found.sections.gain > LARGE_NOISE:
        times = found.noise_gain / abs(found.sections.gain)
        yield "warning", f"white noise rises {times:.3g}-fold; a lower target frequency or --low-pass passes less of it"


# Everything a compensation found, as it is written and shown.


@dataclass(frozen=True)
class CompensateEvaluation:
    """All filters, the recording they were applied to, the force-feedback check, notices and origin."""

    name: str
    wish: Wish
    subjects: tuple[SubjectResult, ...]
    applied: CompensatedRecording | None
    haptics: Haptics | None
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str]
    input_hashes: dict[str, str]
    duration_s: float


# Filters for every channel and load, and what they do before and after.


SAMPLES_PER_PERIOD = 50.0
"""Samples per period of the target where neither the user nor the model states a rate."""
AFTER_PERIODS = 2.0
"""Periods of the target after which what still rings is read: 2 ms for 1000 Hz."""
OFF_FREQUENCY = np.array([-0.2, -0.1, -0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05, 0.1])
BAND_POINTS = 200


def evaluate_compensation(
    sources: Sources, wish: Wish, record: OutputRecord | None, hashes: Mapping[str, str]
) -> CompensateEvaluation:
    """Design all filters, and run them over a recording if one is given; raises `InputError` for impossible wishes.

    >>> from fusion import evaluate_compensation
    >>> from fusion.sensor.compensate.source import Wish, read_sources  # doctest: +SKIP
    >>> wish = Wish(frequency_hz=3000.0, damping_ratio=0.6)  # doctest: +SKIP
    >>> evaluation = evaluate_compensation(read_sources(["steps/step"]), wish, None, {})  # doctest: +SKIP
    """
    started = process_time()
    rate = None if record is None else record.sample_rate_hz
    subjects = [_subject(subject, wish, rate) for subject in chosen(sources, wish.channels)]
    applied, more = (None, ()) if record is None else apply(record, subjects, wish)
    haptics = check_haptics(subjects, wish)
    remarks = [notice for result in subjects for notice in of_subject(result)]
    remarks += [notice for result in subjects for one in result.filters for notice in of_filter(result, one, wish)]
    return CompensateEvaluation(
        name=sources.name,
        wish=wish,
        subjects=tuple(subjects),
        applied=applied,
        haptics=haptics,
        notices=(*sources.notices, *remarks, *more),
        settings=wish.settings,
        versions=versions(),
        input_hashes=dict(hashes),
        duration_s=process_time() - started,
    )


def _subject(subject: Subject, wish: Wish, rate_hz: float | None) -> SubjectResult:
    """The filters of one channel, one per load, all with one target."""
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
        raise InputError.told_by(error, Path(COMMAND), subject.name) from error
    return SubjectResult(subject, tuple(filters))


def _filter(
    subject: Subject, mass: float | None, design: Compensation, wish: Wish, samples: tuple[float, int]
) -> LoadFilter:
    """One filter and what it does; `samples`: their rate in Hz, and how many sections the filter shall have."""
    rate_hz, count = samples
    sections = filled(sampled(design, rate_hz, wish.discretisation), count)
    before, after = _figures(design, alone=True), _figures(design, alone=False)
    band = wish.bandwidth_hz or after.indices.band_10_hz or design.target.frequency_hz
    band = min(band, 0.5 * rate_hz, 2.0 * design.target.frequency_hz)
    error = np.abs(discretisation_error(design, sections, np.linspace(0.0, band, BAND_POINTS)))
    after_s = AFTER_PERIODS / design.target.frequency_hz
    gain = white_noise_gain(sections)
    off = OFF_FREQUENCY if len(design.sensor.frequency_hz) else OFF_FREQUENCY[:0]
    others = _other_loads(subject, mass, wish)
    return LoadFilter(
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
        off_ringing=_ringing(design, [with_frequency(design.sensor, 1.0 + by) for by in off], after_s),
        off_load=others,
        load_ringing=_ringing(design, [_loaded(subject, float(load)) for load in others], after_s),
    )


def _figures(design: Compensation, *, alone: bool) -> Figures:
    """Indices of the sensor alone or with its filter, with u by differences over one u of each parameter.

    The filter stays while the sensor moves within its uncertainty.
    """
    sensor = design.sensor

    def whole(vector: FloatArray) -> LinearSystem:
        return moved(sensor, vector) if alone else moved(sensor, vector).times(design.system)

    found = indices(sensor.system if alone else design.compensated, 1.0 if alone else design.compensated.static_gain)
    known = _known(sensor.covariance, sensor.vector, lambda vector: _values(indices(whole(vector))))
    return Figures(found, dict.fromkeys(LABELS) if known is None else known)


def _known(
    covariance: FloatArray | None, vector: FloatArray, values: Callable[[FloatArray], FloatArray]
) -> dict[str, float | None] | None:
    """Standard uncertainties of the figures, None without a covariance."""
    if covariance is None:
        return None
    u = np.sqrt(np.diag(covariance))
    jacobian = np.zeros((len(LABELS), len(u)))
    for place in np.flatnonzero(u):
        shift = np.eye(len(u))[place] * min(u[place], 0.5 * abs(vector[place]))
        jacobian[:, place] = (values(vector + shift) - values(vector - shift)) / (2.0 * shift[place])
    spread = np.sqrt(np.maximum(np.einsum("qp,pr,qr->q", jacobian, covariance, jacobian), 0.0))
    return {name: float(one) if np.isfinite(one) else None for name, one in zip(LABELS, spread, strict=True)}


def _values(found: Indices) -> FloatArray:
    """All figures as numbers, NaN where there is none."""
    return np.array([np.nan if value is None else value for value in found.figures().values()])


def _other_loads(subject: Subject, mass: float | None, wish: Wish) -> FloatArray:
    """The loads in kg with which a filter is tried: those wanted, else those that the model was fitted to."""
    if not isinstance(subject.model, LoadModel) or mass is None:
        return np.zeros(0)
    return np.unique(np.array([*wish.load_masses, *subject.model.load_masses, mass]))


def _loaded(subject: Subject, load_mass: float) -> LinearSystem:
    """The whole sensor with a load."""
    return subject.dynamics(load_mass, 1, real_poles=False).system


def _ringing(design: Compensation, sensors: Sequence[LinearSystem], after_s: float) -> FloatArray:
    """Residual ringing with other sensors."""
    return np.array([residual_ringing(design, sensor, after_s) for sensor in sensors])
