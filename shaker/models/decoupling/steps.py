"""A model of all outputs over all loads from records of releases of every load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.decoupling.excited import in_order
from shaker.models.decoupling.order import Fitted, chosen, fit_poles, needed, otherwise, shaped
from shaker.models.decoupling.projection import covariances
from shaker.models.decoupling.release_basis import SampleBlocks
from shaker.models.decoupling.start import averaged, highest_frequency, shared_poles
from shaker.models.decoupling.step_data import Poles, Release, Sampled, StepProblem, prepared
from shaker.models.decoupling.step_result import MultiFit, misfits, multi_fit
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step.release import read_release

_PER_PERIOD = 6.0
_LEAST_BLOCKS = 1200
_DETECTED = 2.0
_APART = 2.0
_NEAR = 0.5
_BEFORE, _AFTER = 0.3, 2.0
"""Time constants of the slowest mode that the number of poles is looked for in, before and after a release."""


def fit_steps(records: Sequence[StepRecord], most_modes: int | None = None, most_reals: int = 2) -> MultiFit:
    """Return the model with common poles of all outputs over all loads that the records release, with covariance.

    Output-error least squares over the common poles and every record's release, residues by projection; numbers of
    modes and real poles by a rule, at most `most_modes` and `most_reals`. All records hold the same channels at one
    rate. Loads that the outputs do not tell apart are refused with their names.
    """
    components = _checked(records)
    readings = [_clearest(record) for record in records]
    noise = _noise(records, readings)
    problem, releases, start = _posed(records, readings, noise, components)
    start = needed(problem, start, releases, most_modes)
    near = _around(problem, releases, 1.0 / float(np.min(-start.values.real)))
    found, trials = chosen(near, start, releases, most_modes, most_reals)
    found = otherwise(near, found)
    found = _settled(problem, shaped(problem, fit_poles(problem, found.poles, found.releases, calm=_NEAR)))
    again = noise * misfits(found, len(noise))
    problem = replace(problem, records=tuple(_reweighted(record, noise / again) for record in problem.records))
    found = fit_poles(problem, found.poles, found.releases)
    return multi_fit(records, problem, found, again, tuple(trials))


def _checked(records: Sequence[StepRecord]) -> tuple[str, ...]:
    """The loads of records that fit together, Fx first."""
    if not records:
        raise ValueError("records: expected at least one, found none")
    first = records[0]
    for record in records:
        for name in ("channels", "unit", "sample_rate_hz"):
            if getattr(record, name) != getattr(first, name):
                found, expected = getattr(record, name), getattr(first, name)
                raise ValueError(
                    f"records: expected {name} {expected} as in {first.name}, found {found} in {record.name}"
                )
    return in_order(record.component for record in records)


def _clearest(record: StepRecord) -> Reading:
    """What the output shows of a release that changes most over what it scatters by before."""
    count = record.samples.shape[1]
    rest, end = record.samples[:, : max(8, count // 50)], record.samples[:, -max(8, count // 5) :]
    change = np.abs(end.mean(axis=1) - rest.mean(axis=1)) / np.maximum(rest.std(axis=1), 1e-300)
    return read_release(record, record.channels[int(np.argmax(change))])


def _noise(records: Sequence[StepRecord], readings: Sequence[Reading]) -> FloatArray:
    """Standard deviation of a sample (C,) before the releases; a silent output has that of its digits."""
    sums, count = np.zeros(len(records[0].channels)), 0
    for record, reading in zip(records, readings, strict=True):
        rest = record.samples[:, : max(8, int(0.9 * (reading.onset_s - record.start_s) * record.sample_rate_hz))]
        sums += np.sum((rest - rest.mean(axis=1, keepdims=True)) ** 2, axis=1)
        count += rest.shape[1] - 1
    spans = np.max([np.ptp(record.samples, axis=1) for record in records], axis=0)
    return np.asarray(np.maximum(np.sqrt(sums / count), 1e-9 * spans.max()))


def _posed(
    records: Sequence[StepRecord], readings: Sequence[Reading], noise: FloatArray, components: tuple[str, ...]
) -> tuple[StepProblem, tuple[Release, ...], Poles]:
    """The least squares problem, with releases as read and poles of the decays to start from."""
    rate = records[0].sample_rate_hz
    decays = [_decay(record, reading) / noise[:, None] for record, reading in zip(records, readings, strict=True)]
    size = max(1, int(rate / (_PER_PERIOD * highest_frequency(decays, rate))))
    size = min(size, max(1, min(part.shape[1] for part in decays) // _LEAST_BLOCKS))
    sampled = tuple(
        Sampled(
            record.name,
            record.component,
            record.amplitude,
            prepared(record.samples, noise, size),
            SampleBlocks(record.start_s, rate, record.samples.shape[1] // size, size),
        )
        for record in records
    )
    found = _offered([averaged(part, size) for part in decays], [record.component for record in records], rate / size)
    if not len(found):
        raise ValueError("records: expected outputs that swing after the release, found none")
    poles = Poles(np.abs(found) / (2 * np.pi), np.clip(-found.real / np.abs(found), 1e-4, 0.9), np.zeros(0))
    releases = tuple(
        Release(
            reading.onset_s + reading.release_s / 2.0,
            max(reading.release_s, 1.0 / rate),
            True,
            "smooth" if reading.shape == "smooth" else "ramp",
        )
        for reading in readings
    )
    return StepProblem(sampled, components), releases, poles


def _offered(decays: Sequence[FloatArray], loads: Sequence[str], rate_hz: float) -> ComplexArray:
    """Poles of all decays together, and those of each load's decays that are not among them."""
    found = shared_poles(decays, rate_hz)
    for load in dict.fromkeys(loads):
        for pole in shared_poles([part for part, own in zip(decays, loads, strict=True) if own == load], rate_hz):
            if not np.any(np.abs(found - pole) < _APART * np.maximum(-pole.real, -found.real)):
                found = np.append(found, pole)
    return found


def _around(problem: StepProblem, releases: Sequence[Release], lasts_s: float) -> StepProblem:
    """The same with records cut to what surrounds the release, by a time constant in s, for the search of poles."""
    cut = []
    for record, release in zip(problem.records, releases, strict=True):
        blocks = record.blocks
        first, last = (
            int((release.middle_s + sign * release.duration_s + by - blocks.start_s) * blocks.rate_hz / blocks.size)
            for sign, by in ((-1.0, -_BEFORE * lasts_s), (1.0, _AFTER * lasts_s))
        )
        first, last = max(0, first), min(blocks.count, last)
        data = record.data[first:last]
        start_s = blocks.start_s + first * blocks.size / blocks.rate_hz
        moved = replace(blocks, start_s=start_s, count=last - first)
        cut.append(replace(record, data=data - data.mean(axis=0), blocks=moved))
    return replace(problem, records=tuple(cut))


def _decay(record: StepRecord, reading: Reading) -> FloatArray:
    """Samples (C, N) after the release, less their last level."""
    end = reading.onset_s + 1.5 * reading.release_s + 2.0 / record.sample_rate_hz
    rest = record.samples[:, int((end - record.start_s) * record.sample_rate_hz) :]
    return np.asarray(rest - rest[:, -max(8, rest.shape[1] // 5) :].mean(axis=1, keepdims=True))


def _settled(problem: StepProblem, found: Fitted) -> Fitted:
    """Take a release whose duration is not told from none for a step, and fit again."""
    _, u_duration = _release_u(found)
    releases = tuple(
        replace(release, duration_s=0.0, free=False) if release.duration_s < _DETECTED * u else release
        for release, u in zip(found.releases, u_duration, strict=True)
    )
    return fit_poles(problem, found.poles, releases, calm=_NEAR)


def _release_u(found: Fitted) -> tuple[FloatArray, FloatArray]:
    """Standard uncertainties of middle and duration of the releases for noise of unit size, none for what is fixed."""
    spread, _ = covariances(found.solution, [np.ones(block.data.shape[1]) for block in found.solution.blocks])
    table = np.sqrt(np.diag(spread))[found.poles.count :].reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _reweighted(record: Sampled, factor: FloatArray) -> Sampled:
    """A record with other noise."""
    return replace(record, data=record.data * factor)
