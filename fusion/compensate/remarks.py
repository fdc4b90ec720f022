"""What the user should know of a compensation."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion.compensate.result import LoadFilter, SubjectResult
from fusion.compensate.wish import Wish
from fusion.notices import Notice
from shaker.models.compensation.bandwidth import KEPT_SHARE
from shaker.models.compensation.target import band_ratio, best_damping

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
