"""Every line of a record, how far it stands out of the noise, and what it most likely is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from shaker._checks import BoolArray, FloatArray, check_shape
from shaker.notice import Notice
from shaker.signals.folding import alias_frequency
from shaker.signals.survey.origins import MAINS_HZ, LineList, Origin, name_lines
from shaker.signals.survey.peaks import MOST_LINES, Peaks, find_peaks

FALSE_ALARM = 1e-3  # probability that noise alone adds any line to the list
_SAME_BINS = 0.75  # lines of two channels closer than this are one
_EXPECTED_MULTIPLE = 20
_EXPECTED_MAINS = 7
_CAPTURE = 5e-3  # relative: how far a fundamental may lie from its nominal frequency, besides two bins
_FEWEST = 32  # samples
_MOST_COMBINED = 6  # fundamentals whose sums and differences are expected
_FLOOR_POINTS = 400
_HANN_NOISE = 3.0  # noise power in a Hann bin over the variance of a fitted quadrature: 6 σ²/N over 2 σ²/N


@dataclass(frozen=True)
class Survey:
    """Lines of a record in ascending frequency, as they stand in its spectrum (folded lines at their alias).

    `frequency_hz`, `u_frequency_hz` (L,); `amplitude`, `u_amplitude` (L, C) peak amplitude in each channel with the
    standard uncertainty from its noise, NaN where the line does not stand out of that channel; `snr` (L,) power of the
    line over the noise power in a bin of the Hann spectrum, the best of the channels; `origin` (L,) what it most likely
    is. `floor_hz` (B,), `floor` (B, C): the noise floor as amplitude per bin, thinned.
    """

    frequency_hz: FloatArray
    u_frequency_hz: FloatArray
    amplitude: FloatArray
    u_amplitude: FloatArray
    snr: FloatArray
    origin: tuple[Origin, ...]
    floor_hz: FloatArray
    floor: FloatArray
    notices: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        check_shape("frequency_hz", self.frequency_hz, (None,))
        lines = self.frequency_hz.shape
        check_shape("u_frequency_hz", self.u_frequency_hz, lines)
        check_shape("amplitude", self.amplitude, (*lines, None))
        check_shape("u_amplitude", self.u_amplitude, self.amplitude.shape)
        check_shape("snr", self.snr, lines)
        check_shape("floor", self.floor, (len(self.floor_hz), self.amplitude.shape[1]))
        if len(self.origin) != lines[0]:
            raise ValueError(f"origin: expected {lines[0]} origins, one per line, found {len(self.origin)}")

    @property
    def why(self) -> tuple[str, ...]:
        """For each line, what it is and how far it stands out."""
        return tuple(
            f"{origin.text}, {decibel(snr):.0f} dB over the noise floor"
            for origin, snr in zip(self.origin, self.snr.tolist(), strict=True)
        )

    def select(self, chosen: BoolArray) -> Survey:
        """Return the lines of a mask (L,) only."""
        index = np.flatnonzero(chosen)
        return Survey(
            self.frequency_hz[index],
            self.u_frequency_hz[index],
            self.amplitude[index],
            self.u_amplitude[index],
            self.snr[index],
            tuple(self.origin[int(i)] for i in index),
            self.floor_hz,
            self.floor,
            self.notices,
        )

    def named(self, origin: tuple[Origin, ...]) -> Survey:
        """Return the same lines under other names."""
        return replace(self, origin=origin)

    def joined(
        self, frequency_hz: FloatArray, u_frequency_hz: FloatArray, amplitude: FloatArray, u_amplitude: FloatArray
    ) -> Survey:
        """Return the lines with others (N,) of amplitude (N, C) that had been taken out of the record."""
        power = np.max(amplitude**2 / np.maximum(_HANN_NOISE * u_amplitude**2, np.finfo(np.float64).tiny), axis=1)
        order = np.argsort(np.concatenate([self.frequency_hz, frequency_hz]), kind="stable")
        origin = (*self.origin, *(Origin("unexplained", "unexplained"),) * len(frequency_hz))
        return replace(
            self,
            frequency_hz=np.concatenate([self.frequency_hz, frequency_hz])[order],
            u_frequency_hz=np.concatenate([self.u_frequency_hz, u_frequency_hz])[order],
            amplitude=np.concatenate([self.amplitude, amplitude])[order],
            u_amplitude=np.concatenate([self.u_amplitude, u_amplitude])[order],
            snr=np.concatenate([self.snr, power])[order],
            origin=tuple(origin[int(i)] for i in order),
        )


def no_lines() -> Survey:
    """Return a survey of nothing."""
    nothing, none = np.empty(0), np.empty((0, 0))
    return Survey(nothing, nothing, none, none, nothing, (), nothing, none)


def decibel(power_ratio: float) -> float:
    """Return 10·lg of a ratio of powers."""
    return float(10.0 * np.log10(power_ratio))


def survey_lines(
    values: FloatArray,
    rate_hz: float,
    nominal_hz: Sequence[float] = (),
    false_alarm: float = FALSE_ALARM,
) -> Survey:
    """Find and name the lines of uniform samples (S,) or (S, C): peaks of each channel's spectrum over its noise floor.

    Noise alone adds a line with probability `false_alarm`, whatever the length of the record and the number of
    channels, for noise whose spectrum is smooth over some 16 bins. Places where lines are expected (harmonics and
    halves of the fundamentals, mains) need less height; for this the record is looked at twice. Without nominal
    frequencies the fundamentals are those that explain the most.
    """
    data = values[:, None] if values.ndim == 1 else values
    check_shape("values", data, (None, None))
    if len(data) < _FEWEST:
        raise ValueError(f"values: expected at least {_FEWEST} samples, found {len(data)}")
    if not np.isfinite(data).all():
        raise ValueError(f"values: expected finite samples, found {int(np.sum(~np.isfinite(data)))} that are not")
    if not rate_hz > 0.0:
        raise ValueError(f"rate_hz: expected a positive number, found {rate_hz}")
    first = look(data, rate_hz, false_alarm)
    given, notices = _nominal(first, nominal_hz, rate_hz, len(data))
    fundamentals = given if len(nominal_hz) else None
    if fundamentals is None:
        named = with_origins(first, rate_hz, len(data))
        fundamentals_seen = np.array([o.fundamental_hz for o in named.origin if o.kind == "fundamental"])
    else:
        fundamentals_seen = fundamentals
    second = look(data, rate_hz, false_alarm, expected_places(fundamentals_seen, rate_hz))
    found = with_origins(second, rate_hz, len(data), fundamentals)
    return replace(found, notices=found.notices + notices)


def look(
    data: FloatArray,
    rate_hz: float,
    false_alarm: float,
    expected_hz: FloatArray | None = None,
    taken_hz: FloatArray | None = None,
    smallest: FloatArray | None = None,
) -> Survey:
    """Return the lines of uniform samples (S, C), not yet named.

    `expected_hz`: where less height is enough. `taken_hz`: lines whose fit left these samples as residual. `smallest`
    (C,): amplitude below which a peak is rounding.
    """
    samples, channels = data.shape
    to_bins = samples / rate_hz
    expected = np.empty(0) if expected_hz is None else expected_hz * to_bins
    taken = np.empty(0) if taken_hz is None else alias_frequency(taken_hz, rate_hz) * to_bins
    least = np.zeros(channels) if smallest is None else smallest
    peaks = [
        find_peaks(np.ascontiguousarray(data[:, c]), false_alarm / channels, expected, taken, float(least[c]))
        for c in range(channels)
    ]
    return _merged(peaks, rate_hz / samples)


def expected_places(fundamental_hz: FloatArray, rate_hz: float) -> FloatArray:
    """Return where lines are expected below the Nyquist frequency: multiples, parts, sums of fundamentals, mains."""
    places = [m * mains for mains in MAINS_HZ for m in range(1, _EXPECTED_MAINS + 1)]
    for f in fundamental_hz.tolist():
        places += [m * f for m in range(1, _EXPECTED_MULTIPLE + 1)] + [f * part for part in (1 / 3, 0.5, 2 / 3, 1.5)]
    for f, g in combinations(fundamental_hz.tolist()[:_MOST_COMBINED], 2):
        places += [f + g, abs(f - g)]
    return np.unique([place for place in places if place < rate_hz / 2.0])


def with_origins(survey: Survey, rate_hz: float, samples: int, fundamental_hz: FloatArray | None = None) -> Survey:
    """Return a survey with its lines named, by the fundamentals given or those that explain the most."""
    if not len(survey.frequency_hz):
        return survey
    strength = relative_strength(survey.amplitude)
    lines = LineList(survey.frequency_hz, survey.u_frequency_hz, strength, rate_hz, rate_hz / samples)
    return replace(survey, origin=name_lines(lines, fundamental_hz))


def relative_strength(amplitude: FloatArray) -> FloatArray:
    """Return the amplitudes (L, C) relative to each channel's largest, the best of the channels (L,)."""
    filled = np.nan_to_num(amplitude)
    return np.asarray(np.max(filled / np.maximum(filled.max(axis=0), np.finfo(np.float64).tiny), axis=1))


def _nominal(
    survey: Survey, nominal_hz: Sequence[float], rate_hz: float, samples: int
) -> tuple[FloatArray, tuple[Notice, ...]]:
    """Return the strongest line near each nominal frequency (at its alias), and a notice where there is none."""
    found, notices = [], []
    strength = relative_strength(survey.amplitude) if len(survey.frequency_hz) else np.empty(0)
    for nominal in sorted(set(nominal_hz)):
        alias = float(alias_frequency(nominal, rate_hz))
        capture = _CAPTURE * nominal + 2.0 * rate_hz / samples
        near = np.flatnonzero(np.abs(survey.frequency_hz - alias) <= capture)
        if len(near):
            seen = float(survey.frequency_hz[near[np.argmax(strength[near])]])
            downwards = nominal - rate_hz * np.floor(nominal / rate_hz) > rate_hz / 2.0
            found.append(nominal + (alias - seen if downwards else seen - alias))
        else:
            text = f"no line stands out of the noise within {capture:.3g} Hz of the nominal {nominal:.6g} Hz"
            notices.append(Notice("warning", text, f"{nominal:.6g} Hz"))
    return np.array(found), tuple(notices)


def _merged(peaks: Sequence[Peaks], resolution_hz: float) -> Survey:
    """Put the lines of all channels together: one line where they lie closer than a bin can tell."""
    every = sorted((float(p.place[i]), c, i) for c, p in enumerate(peaks) for i in range(len(p.place)))
    groups: list[list[tuple[float, int, int]]] = []
    for item in every:
        if groups and item[0] - groups[-1][0][0] < _SAME_BINS and item[1] not in [c for _, c, _ in groups[-1]]:
            groups[-1].append(item)
        else:
            groups.append([item])
    lines, channels = len(groups), len(peaks)
    place, u_place, snr = np.empty(lines), np.empty(lines), np.empty(lines)
    amplitude, u_amplitude = np.full((lines, channels), np.nan), np.full((lines, channels), np.nan)
    for k, group in enumerate(groups):
        weight = np.array([1.0 / float(peaks[c].u_place[i]) ** 2 for _, c, i in group])
        place[k] = weight @ np.array([item[0] for item in group]) / weight.sum()
        u_place[k] = 1.0 / np.sqrt(weight.sum())
        for _, c, i in group:
            amplitude[k, c], u_amplitude[k, c] = abs(peaks[c].value[i]), peaks[c].u_value[i]
        snr[k] = max(float(abs(peaks[c].value[i]) ** 2 / peaks[c].noise[i]) for _, c, i in group)
    level = np.stack([np.sqrt(p.level) for p in peaks], axis=1)
    shown = np.unique(np.round(np.geomspace(1.0, max(len(level) - 1, 1), _FLOOR_POINTS)).astype(np.int64))
    cut = sum(p.cut for p in peaks)
    told = f"more than {MOST_LINES} lines in a channel; the {cut} weakest are left out"
    return Survey(
        frequency_hz=place * resolution_hz,
        u_frequency_hz=u_place * resolution_hz,
        amplitude=amplitude,
        u_amplitude=u_amplitude,
        snr=snr,
        origin=(Origin("unexplained", "unexplained"),) * lines,
        floor_hz=np.asarray(shown * resolution_hz, dtype=np.float64),
        floor=level[shown],
        notices=(Notice("info", told, "spectrum"),) if cut else (),
    )
