"""Every line of a record, and what it is: driven, harmonic, mains, alias."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np

from shaker.arrays import BoolArray, FloatArray, Stacked, check_shape, check_shapes
from shaker.lines.peaks import MOST_LINES, FloorSpectrum, Peaks, find_peaks
from shaker.sine.aliasing import CAPTURE, alias_frequency, frequency_of_alias
from shakercal._common.notices import Notice

# What a line most likely is: fundamental, multiple or part of one, combination, mains, side band, or unexplained.

Kind = Literal[
    "fundamental",
    "harmonic",
    "sub-harmonic",
    "combination",
    "mains",
    "folded harmonic",
    "folded combination",
    "side band",
    "unexplained",
]
MAINS_HZ = (50.0, 60.0)
MAINS_MULTIPLES = 20
_MAINS_ALONE = 7  # highest multiple taken for mains without another mains line to prove it
MAX_MULTIPLE = 40
_LOW_MULTIPLE = 10  # of a folded harmonic that is told beside another explanation
_MAINS_TOLERANCE = 2e-3  # relative: how far a grid strays
_TOLERANCE_U = 4.0  # standard uncertainties within which two frequencies agree
_TOLERANCE_BINS = 0.2  # and resolutions
_SIMPLE_ORDERS, _HIGHER_ORDERS = range(2, 4), range(4, 6)  # m + n of the combinations m·f1 ± n·f2
_FUNDAMENTAL = 0.01  # of the strongest line: below it, what nothing explains is unexplained, not another fundamental
_BASE = 0.05  # of a line that is to be a harmonic of it: the weakest fundamental
_PROOF = 1e-3  # of the line that is to be a harmonic: what a further multiple must reach
_HUM = 0.2  # of the strongest line: the largest mains line that is not taken for a fundamental
_SMALLER = 0.5  # of the fundamental: the largest side band, combination, part of it or folded harmonic
_ALIKE = 2.0  # ratio up to which two side bands are a pair
_DIVISORS = (2, 3)
_PERHAPS = 0.1  # expected number of chance coincidences from which a name is doubtful


@dataclass(frozen=True)
class LineOrigin:
    """What a line is: kind, the words for it, fundamental it belongs to (Hz, NaN where none), and its multiple."""

    kind: Kind
    text: str
    fundamental_hz: float = float("nan")
    multiple: int = 0


UNEXPLAINED = LineOrigin("unexplained", "unexplained")


@dataclass(frozen=True)
class DetectedLines:
    """Lines to be explained: `frequency_hz`, `u_hz`, `strength` (L,) relative to the strongest, and their sampling."""

    frequency_hz: FloatArray
    u_hz: FloatArray
    strength: FloatArray
    rate_hz: float
    resolution_hz: float


@dataclass
class _State:
    """Names found so far, and the fundamentals they rest on: in Hz, with uncertainty and strength, strongest first."""

    lines: DetectedLines
    fundamentals: FloatArray = field(default_factory=lambda: np.empty((3, 0)))
    origins: dict[int, LineOrigin] = field(default_factory=dict)
    mains: dict[float, tuple[float, float]] = field(default_factory=dict)  # by nominal: as found, with uncertainty

    def accept(self, frequency: float, u: float, strength: float) -> None:
        """Add a fundamental."""
        place = int(np.searchsorted(-self.fundamentals[2], -strength, side="right"))
        self.fundamentals = np.insert(self.fundamentals, place, (frequency, u, strength), axis=1)

    def tolerance(self, i: int, u_other: FloatArray | float) -> FloatArray:
        """Return within which distance line i agrees with predictions of these uncertainties."""
        u = np.hypot(self.lines.u_hz[i], u_other)
        return np.asarray(np.maximum(_TOLERANCE_U * u, _TOLERANCE_BINS * self.lines.resolution_hz))

    def fits(self, i: int, wanted: FloatArray | float, u_wanted: FloatArray | float) -> BoolArray:
        """Tell whether line i lies where `wanted` appears in the spectrum."""
        place = np.abs(wanted - self.lines.rate_hz * np.round(np.divide(wanted, self.lines.rate_hz)))
        return np.asarray(np.abs(place - self.lines.frequency_hz[i]) <= self.tolerance(i, u_wanted))

    def find(self, wanted: float, u_wanted: float) -> int | None:
        """Return the line nearest to a frequency, None where none agrees."""
        if wanted >= self.lines.rate_hz / 2.0:
            return None
        i = int(np.argmin(np.abs(self.lines.frequency_hz - wanted)))
        return i if self.fits(i, wanted, u_wanted) else None

    def perhaps(self, i: int, places: float) -> str:
        """Return a word of doubt where so many predicted places hit a line by chance."""
        chance = places * 4.0 * float(self.tolerance(i, 0.0)) / self.lines.rate_hz
        return "perhaps " if chance > _PERHAPS else ""


def name_lines(lines: DetectedLines, fundamental_hz: FloatArray | None = None) -> tuple[LineOrigin, ...]:
    """Return what each line is, with the fundamentals given, or with those that explain the most.

    Without any given, lines are taken in the order of their strength. One that no fundamental so far explains becomes
    a fundamental itself, or, where there is a line at its half, third, … and a further multiple of that which it does
    not explain, a harmonic of it: the strongest line may be the second harmonic, but a lone sub-harmonic is not the
    fundamental. Mains and pairs of side bands are told first; what is weaker than a hundredth of the strongest line and
    explained by nothing is no fundamental.
    """
    state, strongest_first = _State(lines), np.argsort(-lines.strength, kind="stable").tolist()
    for f in () if fundamental_hz is None else fundamental_hz:
        _accept(state, float(f))
    for i in strongest_first if fundamental_hz is None else ():
        if i in state.origins or lines.strength[i] < _FUNDAMENTAL:
            continue
        explained = _explain(state, i) if state.fundamentals.size else None
        if explained is None:
            lowest = _lowest(state, i)
            _accept(state, float(lines.frequency_hz[lowest]), lowest)
            explained = state.origins[i] if lowest == i else _explain(state, i) or UNEXPLAINED
        state.origins[i] = explained
    for _ in range(2):  # a name may rest on a line that was named later
        for i in strongest_first:
            if state.origins.get(i, UNEXPLAINED).kind == "unexplained":
                state.origins[i] = _explain(state, i) or UNEXPLAINED
    return tuple(state.origins[i] for i in range(len(lines.frequency_hz)))


def _accept(state: _State, frequency: float, index: int | None = None) -> None:
    """Take a frequency as a fundamental and name its line where there is one."""
    if index is None:
        folded = float(alias_frequency(frequency, state.lines.rate_hz))
        index = state.find(folded, 0.0) if len(state.lines.frequency_hz) else None
    if index is None:
        state.accept(frequency, 0.0, 1.0)
    else:
        state.accept(frequency, float(state.lines.u_hz[index]), float(state.lines.strength[index]))
        seen = state.lines.frequency_hz[index]
        above = f" {frequency:.6g} Hz, read at {seen:.6g} Hz" if frequency > state.lines.rate_hz / 2.0 else ""
        mains = next((m for m in MAINS_HZ if abs(frequency - m) <= _MAINS_TOLERANCE * m), None)
        doubt = f" (or mains hum, {mains:g} Hz)" if mains else ""
        state.origins[index] = LineOrigin("fundamental", f"fundamental{above}{doubt}", frequency, 1)


def _lowest(state: _State, i: int) -> int:
    """Return the line of which line i is a harmonic, with a further multiple to prove it; i itself where none is."""
    f, u = float(state.lines.frequency_hz[i]), float(state.lines.u_hz[i])
    strength = state.lines.strength
    for m in reversed(_DIVISORS):
        base = state.find(f / m, u / m)
        if base is None or base in state.origins or strength[base] < _BASE * strength[i]:
            continue
        others = [state.find(k * f / m, k * u / m) for k in range(2, 2 * m + 2) if k % m]
        if any(o is not None and o not in state.origins and strength[o] > _PROOF * strength[i] for o in others):
            return base
    return i


def _explain(state: _State, i: int) -> LineOrigin | None:
    """Return the simplest explanation of a line, None where there is none; with a low folded harmonic as another."""
    plain = _harmonic(state, i) or _mains(state, i, range(1, 2))
    if plain is not None:
        return plain
    found = (
        _sub_harmonic(state, i)
        or _combination(state, i, _SIMPLE_ORDERS)
        or _mains(state, i, range(2, MAINS_MULTIPLES + 1))
        or _combination(state, i, _HIGHER_ORDERS)
        or _side_band(state, i)
    )
    folded = _folded(state, i)
    if found is None:
        return folded or _combination(state, i, _SIMPLE_ORDERS, folded=True)
    other = f" (or {folded.text})" if folded is not None and folded.multiple <= _LOW_MULTIPLE else ""
    return replace(found, text=found.text + other)


def _harmonic(state: _State, i: int) -> LineOrigin | None:
    """Explain a line as a multiple of a fundamental, the lowest there is."""
    f, u, strength = state.fundamentals
    m = np.round(state.lines.frequency_hz[i] / f)
    fits = (m >= 2) & (m <= MAX_MULTIPLE) & (m * f < state.lines.rate_hz / 2.0) & state.fits(i, m * f, m * u)
    if not np.any(fits):
        return None
    best = int(np.argmin(np.where(fits, m, np.inf)))
    text = f"harmonic {m[best]:.0f} of {f[best]:.6g} Hz, {state.lines.strength[i] / strength[best]:.2g} of it"
    return LineOrigin("harmonic", text, float(f[best]), int(m[best]))


def _mains(state: _State, i: int, multiples: range) -> LineOrigin | None:
    """Explain a line by the grid; once one of its lines is found, the others must be multiples of that one's."""
    f, u = float(state.lines.frequency_hz[i]), float(state.lines.u_hz[i])
    for mains in MAINS_HZ if state.lines.strength[i] < _HUM else ():
        m = round(f / mains)
        if m not in multiples:
            continue
        strays = max(_MAINS_TOLERANCE * f, _TOLERANCE_BINS * state.lines.resolution_hz)
        found, u_found = state.mains.get(mains, (None, 0.0))
        alone = found is None and m <= _MAINS_ALONE and abs(f - m * mains) <= strays
        if alone or (found is not None and state.fits(i, m * found, m * u_found)):
            state.mains.setdefault(mains, (f / m, u / m))
            text = f"mains hum ({mains:g} Hz)" if m == 1 else f"mains hum (harmonic {m} of {mains:g} Hz)"
            return LineOrigin("mains", text, mains, m)
    return None


def _sub_harmonic(state: _State, i: int) -> LineOrigin | None:
    """Explain a line as a half or a third of a fundamental, or, where that is there, as a multiple of it."""
    f, u, strength = state.fundamentals[..., None]
    part = np.array(_DIVISORS)
    k = np.round(part * state.lines.frequency_hz[i] / f)
    small = (k % part > 0) & (k < 2 * part + 2) & (state.lines.strength[i] <= _SMALLER * strength)
    for row, column in np.argwhere(small & state.fits(i, k * f / part, k * u / part)).tolist():
        base, p, times = float(f[row, 0]), _DIVISORS[column], int(k[row, column])
        if times == 1 or state.find(base / p, float(u[row, 0]) / p) is not None:
            return LineOrigin("sub-harmonic", f"sub-harmonic, {times}/{p} of {base:.6g} Hz", base)
    return None


def _combination(state: _State, i: int, orders: range, folded: bool = False) -> LineOrigin | None:
    """Explain a line as the simplest combination of two stronger fundamentals, in band or folded."""
    known = state.fundamentals[:2, _SMALLER * state.fundamentals[2] > state.lines.strength[i]]
    places = state.fundamentals.shape[1] * (state.fundamentals.shape[1] - 1) * orders[-1]
    for order in orders if known.shape[1] > 1 else ():
        found = _sum(state, i, known, order, folded)
        if found is not None:
            (m, f1), (n, f2) = found
            wanted = m * f1 + n * f2
            # Its positive part is told first.
            told = found if n > 0 or wanted >= 0.0 else ((-n, f2), (-m, f1))
            first, second = (f"{abs(k)}·{f:.6g}" if abs(k) > 1 else f"{f:.6g}" for k, f in told)
            text = f"{state.perhaps(i, places)}combination {first} {'+' if n > 0 else '-'} {second} Hz"
            if folded:
                return LineOrigin("folded combination", f"{text}, folded from {abs(wanted):.6g} Hz")
            return LineOrigin("combination", text)
    return None


def _sum(
    state: _State, i: int, known: FloatArray, order: int, folded: bool
) -> tuple[tuple[int, float], tuple[int, float]] | None:
    """Return (m, f1), (n, f2) of the strongest pair of fundamentals for which line i is m·f1 + n·f2, |m| + |n| = order.

    Of `known` (2, F), frequencies and their uncertainties, each is taken as f1, and f2 looked for among all in order.
    """
    f, u = known
    rate_hz = state.lines.rate_hz
    terms = np.array([(m, sign * (order - m)) for m in range(1, order) for sign in (1, -1)], dtype=np.float64)
    seen = float(state.lines.frequency_hz[i])
    # Where the line may come from; m·f1 + n·f2 may be negative.
    turns = range(1, round(order * float(f.max()) / rate_hz) + 1) if folded else ()
    origin = [turn * rate_hz + part for turn in turns for part in (seen, -seen)] if folded else [seen]
    origin += [-place for place in origin]
    ascending = np.argsort(f)
    m, n = terms.T[..., None, None]
    partner = (np.array(origin)[:, None] - m * f) / n
    # As wide as the least certain pair asks for, and rounding: what is found is looked at exactly.
    reach = (float(state.tolerance(i, order * float(u.max()))) + 1e-9 * rate_hz) / np.abs(n)
    low, high = (np.searchsorted(f[ascending], partner + sign * reach) for sign in (-1, 1))
    here = np.argwhere(high > low)
    count = (high - low)[high > low]
    term, _, one = np.repeat(here, count, axis=0).T
    within = np.arange(len(term)) - np.repeat(np.cumsum(count) - count, count)
    other = ascending[np.repeat(low[high > low], count) + within]
    m, n = terms[term].T
    wanted = np.abs(m * f[one] + n * f[other])
    fits = (other > one) & (wanted > 0.0) & ((wanted >= rate_hz / 2.0) == folded)
    fits &= state.fits(i, wanted, np.hypot(m * u[one], n * u[other]))
    if not np.any(fits):
        return None
    term, one, other = term[fits], one[fits], other[fits]
    best = np.lexsort((term, other, one))[0]
    (m1, n1), a, b = terms[term[best]], one[best], other[best]
    return (int(m1), float(f[a])), (int(n1), float(f[b]))


def _folded(state: _State, i: int) -> LineOrigin | None:
    """Explain a line as a harmonic above the Nyquist frequency that no filter kept out."""
    f, u, strength = state.fundamentals
    m = np.arange(2, MAX_MULTIPLE + 1)[:, None]
    beyond = (m * f >= state.lines.rate_hz / 2.0) & (state.lines.strength[i] < _SMALLER * strength)
    fits = np.argwhere(beyond & state.fits(i, m * f, m * u))
    if not len(fits):
        return None
    multiple, base = int(m[fits[0, 0], 0]), float(f[fits[0, 1]])
    doubt = state.perhaps(i, multiple * len(f))
    text = f"{doubt}harmonic {multiple} of {base:.6g} Hz, folded from {multiple * base:.6g} Hz"
    return LineOrigin("folded harmonic", text, base, multiple)


def _side_band(state: _State, i: int) -> LineOrigin | None:
    """Explain a line by the modulation of a stronger one: a partner of like height on the other side, or mains."""
    lines = state.lines
    frequency, u = float(lines.frequency_hz[i]), float(lines.u_hz[i])
    named = [j for j, origin in state.origins.items() if origin.kind in ("fundamental", "harmonic")]
    for j in sorted(named, key=lambda j: abs(float(lines.frequency_hz[j]) - frequency)):
        carrier = float(lines.frequency_hz[j])
        if lines.strength[i] > _SMALLER * lines.strength[j] or i == j:
            continue
        apart = frequency - carrier
        partner = state.find(carrier - apart, float(np.hypot(u, 2.0 * lines.u_hz[j]))) if apart < carrier else None
        if partner is None or partner == i or partner in named:
            continue
        ratio = float(lines.strength[partner] / lines.strength[i])
        if 1.0 / _ALIKE <= ratio <= _ALIKE:
            text = f"side band of {carrier:.6g} Hz at {'+' if apart > 0 else '-'}{abs(apart):.4g} Hz"
            return LineOrigin("side band", state.perhaps(i, len(named)) + text, carrier)
    return None


# Every line of a record, how far it stands out of the noise, and what it most likely is.

FALSE_ALARM = 1e-3  # probability that noise alone adds any line to the list
_SAME_BINS = 0.75  # lines of two channels closer than this are one
_EXPECTED_MULTIPLE = 20
_EXPECTED_MAINS = 7
_FEWEST = 32  # samples
_MOST_COMBINED = 6  # fundamentals whose sums and differences are expected
_FLOOR_POINTS = 400
_KEPT = 1 << 24  # bins of spectra that are kept from the first look for the second
_PER_LINE = ("frequency_hz", "u_frequency_hz", "amplitude", "u_amplitude", "snr")
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
    origin: tuple[LineOrigin, ...]
    floor_hz: FloatArray
    floor: FloatArray
    notices: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        lines = self.frequency_hz.shape
        check_shapes(self, (len(self.frequency_hz),), "frequency_hz", "u_frequency_hz", "snr")
        check_shape("amplitude", self.amplitude, (*lines, None))
        check_shape("u_amplitude", self.u_amplitude, self.amplitude.shape)
        check_shape("floor", self.floor, (len(self.floor_hz), self.amplitude.shape[1]))
        if len(self.origin) != lines[0]:
            raise ValueError(f"origin: expected {lines[0]} origins, one per line, found {len(self.origin)}")

    def __repr__(self) -> str:
        return f"Survey({len(self.frequency_hz)} lines in {self.amplitude.shape[1]} channels)"

    @property
    def why(self) -> tuple[str, ...]:
        """For each line, what it is and how far it stands out."""
        return tuple(
            f"{origin.text}, {decibel(snr):.0f} dB over the noise floor"
            for origin, snr in zip(self.origin, self.snr.tolist(), strict=True)
        )

    def select(self, chosen: BoolArray) -> Survey:
        """Return the lines of a mask (L,) only."""
        kept: dict[str, Any] = {name: getattr(self, name)[chosen] for name in _PER_LINE}
        return replace(self, origin=tuple(self.origin[i] for i in np.flatnonzero(chosen)), **kept)

    def joined(
        self, frequency_hz: FloatArray, u_frequency_hz: FloatArray, amplitude: FloatArray, u_amplitude: FloatArray
    ) -> Survey:
        """Return the lines with others (N,) of amplitude (N, C) that had been taken out of the record."""
        power = np.max(amplitude**2 / np.maximum(_HANN_NOISE * u_amplitude**2, np.finfo(np.float64).tiny), axis=1)
        order = np.argsort(np.concatenate([self.frequency_hz, frequency_hz]), kind="stable")
        origin = (*self.origin, *(UNEXPLAINED,) * len(frequency_hz))
        added = (frequency_hz, u_frequency_hz, amplitude, u_amplitude, power)
        both: dict[str, Any] = {
            k: np.concatenate([getattr(self, k), more])[order] for k, more in zip(_PER_LINE, added, strict=True)
        }
        return replace(self, origin=tuple(origin[i] for i in order), **both)


def empty_survey() -> Survey:
    """Return a survey of nothing."""
    nothing, none = np.empty(0), np.empty((0, 0))
    return Survey(nothing, nothing, none, none, nothing, (), nothing, none)


def decibel(power_ratio: float) -> float:
    """Return 10·lg of a ratio of powers."""
    return float(10.0 * np.log10(power_ratio))


def survey_lines(
    values: FloatArray | Stacked,
    rate_hz: float,
    nominal_hz: Sequence[float] = (),
    false_alarm: float = FALSE_ALARM,
) -> Survey:
    """Find and name the lines of uniform samples (S,) or (S, C): peaks of each channel's spectrum over its noise floor.

    Noise alone adds a line with probability `false_alarm`, whatever the length of the record and the number of
    channels, for noise whose spectrum is smooth over some 16 bins. Places where lines are expected (harmonics and
    halves of the fundamentals, mains) need less height; for this the record is looked at twice. Without nominal
    frequencies the fundamentals are those that explain the most.

    >>> import numpy as np
    >>> from shaker import survey_lines
    >>> time_s, noise = np.arange(4000) / 1000.0, np.random.default_rng(0).normal(size=4000)
    >>> driven = 10.0 * np.sin(2 * np.pi * 80.0 * time_s) + np.sin(2 * np.pi * 160.0 * time_s)
    >>> lines = survey_lines(driven + noise, rate_hz=1000.0)
    >>> [origin.kind for origin in lines.origin]
    ['fundamental', 'harmonic']
    """
    data = Stacked.from_array(values)
    if len(data) < _FEWEST:
        raise ValueError(f"values: expected at least {_FEWEST} samples, found {len(data)}")
    missing = sum(int(np.count_nonzero(~np.isfinite(part))) for part in data.iterate_row_blocks())
    if missing:
        raise ValueError(f"values: expected finite samples, found {missing} that are not")
    if not rate_hz > 0.0:
        raise ValueError(f"rate_hz: expected a positive number, found {rate_hz}")
    spectra = _Spectra(data)
    first = detect_lines(spectra, data.shape, rate_hz, false_alarm)
    given, notices = _nominal(first, nominal_hz, rate_hz, len(data))
    seen = given
    if not len(nominal_hz):
        named = with_origins(first, rate_hz, len(data))
        seen = np.array([o.fundamental_hz for o in named.origin if o.kind == "fundamental"])
    second = detect_lines(spectra, data.shape, rate_hz, false_alarm, expected_frequencies(seen, rate_hz))
    named = with_origins(second, rate_hz, len(data), given if len(nominal_hz) else None)
    return replace(named, notices=named.notices + notices)


class _Spectra:
    """The spectra of channels one by one, each time anew but for those first ones that together take little memory."""

    def __init__(self, data: Stacked) -> None:
        self._data, self._kept = data, list[FloorSpectrum]()

    def __iter__(self) -> Iterator[FloorSpectrum]:
        yield from self._kept
        bins = len(self._data) // 2 + 1
        for c in range(len(self._kept), self._data.shape[1]):
            floored = FloorSpectrum(next(self._data.select([c]).iterate_channels()))
            if len(self._kept) == c and (c + 1) * bins <= _KEPT:
                self._kept.append(floored)
            yield floored


def detect_lines(
    spectra: Iterable[FloorSpectrum],
    shape: tuple[int, ...],
    rate_hz: float,
    false_alarm: float,
    expected_hz: FloatArray | None = None,
    fitted_hz: FloatArray | None = None,
    min_amplitude: FloatArray | None = None,
) -> Survey:
    """Return the lines of the spectra of C columns of uniform samples (S,), `shape` (S, C), not yet named.

    `expected_hz`: where less height is enough. `taken_hz`: lines whose fit left these samples as residual. `smallest`
    (C,): amplitude below which a peak is rounding.
    """
    samples, channels = shape
    to_bins = samples / rate_hz
    expected = np.empty(0) if expected_hz is None else expected_hz * to_bins
    taken = np.empty(0) if fitted_hz is None else alias_frequency(fitted_hz, rate_hz) * to_bins
    least = np.zeros(channels) if min_amplitude is None else min_amplitude
    peaks = [
        find_peaks(spectrum, false_alarm / channels, expected, taken, float(smallest_here))
        for spectrum, smallest_here in zip(spectra, least, strict=True)
    ]
    return _merged(peaks, rate_hz / samples)


def expected_frequencies(fundamental_hz: FloatArray, rate_hz: float) -> FloatArray:
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
    lines = DetectedLines(survey.frequency_hz, survey.u_frequency_hz, strength, rate_hz, rate_hz / samples)
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
        capture = CAPTURE * nominal + 2.0 * rate_hz / samples
        near = np.flatnonzero(np.abs(survey.frequency_hz - alias) <= capture)
        if len(near):
            seen = survey.frequency_hz[near[np.argmax(strength[near])]]
            found.append(float(frequency_of_alias(seen, np.asarray(nominal), rate_hz)))
        else:
            text = f"no line stands out of the noise within {capture:.3g} Hz of the nominal {nominal:.6g} Hz"
            notices.append(Notice("warning", text, f"{nominal:.6g} Hz"))
    return np.array(found), tuple(notices)


def _merged(peaks: Sequence[Peaks], resolution_hz: float) -> Survey:
    """Put the lines of all channels together: one line where they lie closer than a bin can tell."""
    every = sorted((float(p.bin_position[i]), c, i) for c, p in enumerate(peaks) for i in range(len(p.bin_position)))
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
        weight = np.array([1.0 / float(peaks[c].u_bin_position[i]) ** 2 for _, c, i in group])
        place[k] = weight @ np.array([item[0] for item in group]) / weight.sum()
        u_place[k] = 1.0 / np.sqrt(weight.sum())
        for _, c, i in group:
            amplitude[k, c], u_amplitude[k, c] = abs(peaks[c].value[i]), peaks[c].u_value[i]
        snr[k] = max(float(abs(peaks[c].value[i]) ** 2 / peaks[c].noise[i]) for _, c, i in group)
    bins = len(peaks[0].level)
    shown = np.unique(np.round(np.geomspace(1.0, max(bins - 1, 1), _FLOOR_POINTS)).astype(np.int64))
    cut = sum(p.cut for p in peaks)
    told = f"more than {MOST_LINES} lines in a channel; the {cut} weakest are left out"
    return Survey(
        frequency_hz=place * resolution_hz,
        u_frequency_hz=u_place * resolution_hz,
        amplitude=amplitude,
        u_amplitude=u_amplitude,
        snr=snr,
        origin=(UNEXPLAINED,) * lines,
        floor_hz=np.asarray(shown * resolution_hz, dtype=np.float64),
        floor=np.stack([np.sqrt(p.level[shown]) for p in peaks], axis=1),
        notices=(Notice("note", told, "spectrum"),) if cut else (),
    )
