"""The fit of a beginning from start values that the record itself gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.step.beginning import Beginning, Window, fit_beginning, solved
from shaker.models.step.locate import Location
from shaker.models.step.ringing import ringing_poles

_PERIODS = 12.0  # of the lowest mode after the release that the fit takes
_PER_PERIOD = 50  # samples per period of the highest mode below which nothing is averaged
_MOST = 2000
_LENGTHS = np.array([0.1, 0.35, 0.55, 0.75, 0.95, 1.15, 1.4])  # tried, over that of a ramp that the output follows
_LONGEST = 2.0
_CENTRES = 7
_GRID = 160  # samples that the search for start values takes
_SMOOTHER = 1.33  # length of a smooth release over that of the ramp of the same spread
_UNSEEN = 0.03  # share of the change that modes too high to be seen may carry, standard deviation
_NOTHING = 1e6  # weight that leaves nothing to modes that are not seen, in the search for start values
_DECIDED = 6.0  # difference of the Schwarz criterion that decides


def find_beginning(
    samples: FloatArray, sample_rate_hz: float, start_s: float, place: Location
) -> tuple[Window, Beginning]:
    """Return the window around the beginning of samples (N,), the first at `start_s`, and its fit.

    The release is taken as a straight ramp unless the Schwarz criterion asks for a smooth one. Where nothing rings, the
    one mode tried is all there is.
    """
    after = _after_release(place, len(samples))
    poles = ringing_poles(samples[after:] - place.steady, sample_rate_hz, place.noise)
    sets = [poles] if len(poles) else _unseen(place, sample_rate_hz)
    fits = []
    for trial in sets:
        window = _window(samples, sample_rate_hz, start_s, place, trial)
        seen = replace(window, small=_NOTHING)
        first = fit_beginning(seen, _start(seen, place, trial, sample_rate_hz, start_s))
        fits.append((window, fit_beginning(window, first)) if len(poles) else (seen, first))
    window, ramp = min(fits, key=lambda fit: fit[1].squares / fit[1].rows)
    smooth = fit_beginning(window, replace(ramp, shape="smooth", release_s=_SMOOTHER * ramp.release_s))
    return window, smooth if smooth.penalty < ramp.penalty - _DECIDED else ramp


def _unseen(place: Location, sample_rate_hz: float) -> list[ComplexArray]:
    """Return poles that are tried where nothing rings: one well damped mode at several times the rise."""
    rise_s = max(place.high - place.low, 2.0) / sample_rate_hz
    frequency = np.minimum(np.array([0.3, 1.0, 3.0]) / rise_s, 0.2 * sample_rate_hz)
    return [2 * np.pi * f * np.array([-0.5 + 0.75**0.5 * 1j]) for f in frequency]


def _after_release(place: Location, count: int) -> int:
    """Return a sample that is after the release with all likelihood."""
    end = place.first + 1.5 * max(place.high - place.first, 4.0)
    return int(min(end, place.first + 0.5 * (count - place.first)))


def _window(samples: FloatArray, sample_rate_hz: float, start_s: float, place: Location, poles: ComplexArray) -> Window:
    """Return the samples around the beginning, as means of blocks where they are denser than is needed."""
    block = max(1, int(2 * np.pi * sample_rate_hz / (_PER_PERIOD * float(np.max(np.abs(poles))))))
    length = place.high - place.first
    period = 2 * np.pi * sample_rate_hz / float(np.min(np.abs(poles)))
    margin = int(min(place.first // 2, 2.0 * length + 0.7 * period + 4 * block))
    low = place.first - margin
    count = int(min(len(samples) - low, _MOST * block, margin + 2.0 * length + _PERIODS * period))
    blocks = count // block
    means = np.asarray(samples[low : low + blocks * block].reshape(blocks, block).mean(axis=1))
    middle = low + (np.arange(blocks, dtype=np.float64) + 0.5) * block - 0.5
    small = place.noise / np.sqrt(block) / max(_UNSEEN * abs(place.steady - place.baseline), 1e-300)
    rest = float(np.mean(samples[:low])) if low else 0.0
    return Window(
        np.asarray(start_s + middle / sample_rate_hz),
        means,
        rest,
        low / block,
        float(small),
        _LONGEST * place.longest / sample_rate_hz,
    )


def _start(window: Window, place: Location, poles: ComplexArray, sample_rate_hz: float, start_s: float) -> Beginning:
    """Return the best of a grid of centres and lengths, with fixed modes and no lag."""
    every = max(1, len(window.samples) // _GRID)
    thin = replace(
        window,
        time_s=window.time_s[::every],
        samples=window.samples[::every],
        before=window.before / every,
        small=float(window.small / np.sqrt(every)),
    )
    plain_s = place.longest / sample_rate_hz
    middle_s = start_s + 0.5 * (place.low + place.high) / sample_rate_hz
    early_s = np.linspace(0.0, 0.3 * 2 * np.pi / float(np.min(np.abs(poles))), _CENTRES)
    frequency, damping = np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)
    trials = [
        Beginning("ramp", middle_s - early, length, 0.0, frequency, damping, np.zeros(0))
        for length in _LENGTHS * plain_s
        for early in early_s
    ]
    return min((solved(thin, trial)[0] for trial in trials), key=lambda trial: trial.squares)
