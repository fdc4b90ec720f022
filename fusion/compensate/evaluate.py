"""Filters for every channel and load, and what they do before and after."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import process_time

import numpy as np

from fusion.compensate.evaluation import CompensateEvaluation
from fusion.compensate.haptics import check_haptics
from fusion.compensate.recording import OutputRecord, apply
from fusion.compensate.remarks import of_filter, of_subject
from fusion.compensate.result import Figures, FloatArray, LoadFilter, SubjectResult
from fusion.compensate.sources import Sources, Subject, chosen
from fusion.compensate.wish import COMMAND, Wish
from fusion.errors import InputError
from fusion.provenance import versions
from shaker.models.compensation.discrete import discretisation_error, filled, sampled
from shaker.models.compensation.filter import Compensation
from shaker.models.compensation.mismatch import moved, residual_ringing, with_frequency
from shaker.models.compensation.noise import white_noise_gain
from shaker.models.indices.indices import indices
from shaker.models.indices.result import LABELS, Indices
from shaker.models.linear_system import LinearSystem
from shaker.models.load_series.model import LoadModel

SAMPLES_PER_PERIOD = 50.0
"""Samples per period of the target where neither the user nor the model states a rate."""
AFTER_PERIODS = 2.0
"""Periods of the target after which what still rings is read: 2 ms for 1000 Hz."""
OFF_FREQUENCY = np.array([-0.2, -0.1, -0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05, 0.1])
BAND_POINTS = 200


def evaluate_compensation(
    sources: Sources, wish: Wish, record: OutputRecord | None, hashes: Mapping[str, str]
) -> CompensateEvaluation:
    """Design all filters, and run them over a recording if one is given; raises `InputError` for impossible wishes."""
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
