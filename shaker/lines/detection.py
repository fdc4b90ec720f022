"""Detection and naming of the lines of a record: driven, harmonic, mains, alias."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np

from shaker.io.channel import Stacked
from shaker.lines.peaks import MOST_LINES, FloorSpectrum, Peaks, find_peaks
from shaker.signal_notices import NO_NOMINAL_LINE, TOO_MANY_LINES
from shaker.sine.aliasing import CAPTURE, alias_frequency, frequency_of_alias
from shakercal._common.arrays import Arrays, BoolArray, FloatArray
from shakercal._common.notices import Notice

# Most likely explanation of a line.

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
MAINS_HZ = (50.0, 60.0)  # nominal frequencies of public grids
MAINS_MULTIPLES = 20  # highest harmonic of the mains that is named; chosen
_MAINS_ALONE = 7  # highest multiple taken for mains without another mains line to prove it
MAX_MULTIPLE = 40  # highest harmonic that is named; chosen
_LOW_MULTIPLE = 10  # highest multiple of an aliased harmonic that is mentioned in addition to another explanation
_MAINS_TOLERANCE = 2e-3  # relative: how far a grid strays
_TOLERANCE_U = 4.0  # standard uncertainties within which two frequencies agree
_TOLERANCE_BINS = 0.2  # and resolutions
_SIMPLE_ORDERS, _HIGHER_ORDERS = range(2, 4), range(4, 6)  # m + n of the combinations m·f1 ± n·f2
_FUNDAMENTAL = 0.01  # of the strongest line: a weaker line without explanation is no fundamental
_BASE = 0.05  # of a line that is to be a harmonic of it: the weakest fundamental
_PROOF = 1e-3  # of the line that is to be a harmonic: smallest further multiple that proves it
_HUM = 0.2  # of the strongest line: the largest mains line that is not taken for a fundamental
_SMALLER = 0.5  # of the fundamental: the largest side band, combination, part of it or aliased harmonic
_PAIR_RATIO = 2.0  # ratio up to which two side bands are a pair
_DIVISORS = (2, 3)  # of the sub-harmonics that are named
_PERHAPS = 0.1  # expected number of chance coincidences from which a name is doubtful


@dataclass(frozen=True)
class LineOrigin:
    """Explanation of a line: kind, description, fundamental (Hz, NaN without one), and multiple."""

    kind: Kind
    text: str
    fundamental_hz: float = float("nan")
    multiple: int = 0


UNEXPLAINED = LineOrigin("unexplained", "unexplained")


@dataclass(frozen=True)
class DetectedLines:
    """Lines to be explained, with frequency, uncertainty and relative strength (L,)."""

    frequency_hz: FloatArray
    u_hz: FloatArray
    strength: FloatArray
    rate_hz: float
    resolution_hz: float


@dataclass
class _Naming:
    """Names found so far, and the fundamentals in use."""

    lines: DetectedLines
    fundamentals: FloatArray = field(default_factory=lambda: np.empty((3, 0)))
    origins: dict[int, LineOrigin] = field(default_factory=dict)
    mains: dict[float, tuple[float, float]] = field(default_factory=dict)  # by nominal: as found, with uncertainty

    def accept(self, frequency: float, u: float, strength: float) -> None:
        """Add a fundamental."""
        index = int(np.searchsorted(-self.fundamentals[2], -strength, side="right"))
        self.fundamentals = np.insert(self.fundamentals, index, (frequency, u, strength), axis=1)

    def tolerance(self, i: int, u_other: FloatArray | float) -> FloatArray:
        """Return the distance within which line i agrees with predictions of these uncertainties."""
        u = np.hypot(self.lines.u_hz[i], u_other)
        return np.asarray(np.maximum(_TOLERANCE_U * u, _TOLERANCE_BINS * self.lines.resolution_hz))

    def fits(self, i: int, predicted: FloatArray | float, u_predicted: FloatArray | float) -> BoolArray:
        """Return whether line i lies at the alias of a predicted frequency."""
        alias = np.abs(predicted - self.lines.rate_hz * np.round(np.divide(predicted, self.lines.rate_hz)))
        return np.asarray(np.abs(alias - self.lines.frequency_hz[i]) <= self.tolerance(i, u_predicted))

    def find(self, predicted: float, u_predicted: float) -> int | None:
        """Return the line nearest to a frequency, None where none agrees."""
        if predicted >= self.lines.rate_hz / 2.0:
            return None
        i = int(np.argmin(np.abs(self.lines.frequency_hz - predicted)))
        return i if self.fits(i, predicted, u_predicted) else None

    def doubt(self, i: int, predictions: float) -> str:
        """Return "perhaps " where a chance coincidence with one of the predictions is likely."""
        chance = predictions * 4.0 * float(self.tolerance(i, 0.0)) / self.lines.rate_hz
        return "perhaps " if chance > _PERHAPS else ""


def name_lines(lines: DetectedLines, fundamental_hz: FloatArray | None = None) -> tuple[LineOrigin, ...]:
    """Return the explanation of each line, with given fundamentals or those that explain most.

    Without given fundamentals, lines are examined in the order of their strength. A line that no fundamental explains
    becomes a fundamental. With a line at its half, third, … and a further multiple of that which it does not explain,
    it becomes a harmonic instead. The strongest line may thus be the second harmonic, but a single sub-harmonic is not
    the fundamental. Mains and pairs of side bands are named first. An unexplained line weaker than a hundredth of the
    strongest one is no fundamental.
    """
    state, strongest_first = _Naming(lines), np.argsort(-lines.strength, kind="stable").tolist()
    for f in () if fundamental_hz is None else fundamental_hz:
        _accept_fundamental(state, float(f))
    for i in strongest_first if fundamental_hz is None else ():
        if i in state.origins or lines.strength[i] < _FUNDAMENTAL:
            continue
        explained = _explain(state, i) if state.fundamentals.size else None
        if explained is None:
            lowest = _lowest_harmonic(state, i)
            _accept_fundamental(state, float(lines.frequency_hz[lowest]), lowest)
            explained = state.origins[i] if lowest == i else _explain(state, i) or UNEXPLAINED
        state.origins[i] = explained
    for _ in range(2):  # a name may rest on a line that was named later
        for i in strongest_first:
            if state.origins.get(i, UNEXPLAINED).kind == "unexplained":
                state.origins[i] = _explain(state, i) or UNEXPLAINED
    return tuple(state.origins[i] for i in range(len(lines.frequency_hz)))


def _accept_fundamental(state: _Naming, frequency: float, index: int | None = None) -> None:
    """Accept a frequency as a fundamental and name its line where there is one."""
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


def _lowest_harmonic(state: _Naming, i: int) -> int:
    """Return the line of which line i is a proven harmonic, else i."""
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


def _explain(state: _Naming, i: int) -> LineOrigin | None:
    """Return the simplest explanation of a line, None without one."""
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


def _harmonic(state: _Naming, i: int) -> LineOrigin | None:
    """Explain a line as the lowest fitting multiple of a fundamental."""
    f, u, strength = state.fundamentals
    m = np.round(state.lines.frequency_hz[i] / f)
    fits = (m >= 2) & (m <= MAX_MULTIPLE) & (m * f < state.lines.rate_hz / 2.0) & state.fits(i, m * f, m * u)
    if not np.any(fits):
        return None
    best = int(np.argmin(np.where(fits, m, np.inf)))
    text = f"harmonic {m[best]:.0f} of {f[best]:.6g} Hz, {state.lines.strength[i] / strength[best]:.2g} of it"
    return LineOrigin("harmonic", text, float(f[best]), int(m[best]))


def _mains(state: _Naming, i: int, multiples: range) -> LineOrigin | None:
    """Explain a line as a multiple of the mains frequency."""
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


def _sub_harmonic(state: _Naming, i: int) -> LineOrigin | None:
    """Explain a line as half or third of a fundamental, or its multiple."""
    f, u, strength = state.fundamentals[..., None]
    part = np.array(_DIVISORS)
    k = np.round(part * state.lines.frequency_hz[i] / f)
    small = (k % part > 0) & (k < 2 * part + 2) & (state.lines.strength[i] <= _SMALLER * strength)
    for row, column in np.argwhere(small & state.fits(i, k * f / part, k * u / part)).tolist():
        base, p, times = float(f[row, 0]), _DIVISORS[column], int(k[row, column])
        if times == 1 or state.find(base / p, float(u[row, 0]) / p) is not None:
            return LineOrigin("sub-harmonic", f"sub-harmonic, {times}/{p} of {base:.6g} Hz", base)
    return None


def _combination(state: _Naming, i: int, orders: range, folded: bool = False) -> LineOrigin | None:
    """Explain a line as the simplest combination of two stronger fundamentals, in band or aliased."""
    available = state.fundamentals[:2, _SMALLER * state.fundamentals[2] > state.lines.strength[i]]
    predictions = state.fundamentals.shape[1] * (state.fundamentals.shape[1] - 1) * orders[-1]
    for order in orders if available.shape[1] > 1 else ():
        found = _sum(state, i, available, order, folded)
        if found is not None:
            (m, f1), (n, f2) = found
            predicted = m * f1 + n * f2
            # The positive part is written first.
            positive_first = found if n > 0 or predicted >= 0.0 else ((-n, f2), (-m, f1))
            first, second = (f"{abs(k)}·{f:.6g}" if abs(k) > 1 else f"{f:.6g}" for k, f in positive_first)
            text = f"{state.doubt(i, predictions)}combination {first} {'+' if n > 0 else '-'} {second} Hz"
            if folded:
                return LineOrigin("folded combination", f"{text}, aliased from {abs(predicted):.6g} Hz")
            return LineOrigin("combination", text)
    return None


def _sum(
    state: _Naming, i: int, available: FloatArray, order: int, folded: bool
) -> tuple[tuple[int, float], tuple[int, float]] | None:
    """Return the strongest pair of fundamentals that explains line i.

    The result is (m, f1), (n, f2) with line i = m·f1 + n·f2. |m| + |n| = order. Each of `available` (2, F), frequencies
    and their uncertainties, is tried as f1, and f2 is searched for among all.
    """
    f, u = available
    rate_hz = state.lines.rate_hz
    terms = np.array([(m, sign * (order - m)) for m in range(1, order) for sign in (1, -1)], dtype=np.float64)
    seen = float(state.lines.frequency_hz[i])
    # Where the line may come from; m·f1 + n·f2 may be negative.
    turns = range(1, round(order * float(f.max()) / rate_hz) + 1) if folded else ()
    origin = [turn * rate_hz + part for turn in turns for part in (seen, -seen)] if folded else [seen]
    origin += [-frequency for frequency in origin]
    ascending = np.argsort(f)
    m, n = terms.T[..., None, None]
    partner = (np.array(origin)[:, None] - m * f) / n
    # As wide as the least certain pair and rounding need; matches are then tested exactly.
    reach = (float(state.tolerance(i, order * float(u.max()))) + 1e-9 * rate_hz) / np.abs(n)
    low, high = (np.searchsorted(f[ascending], partner + sign * reach) for sign in (-1, 1))
    matches = np.argwhere(high > low)
    count = (high - low)[high > low]
    term, _, one = np.repeat(matches, count, axis=0).T
    within = np.arange(len(term)) - np.repeat(np.cumsum(count) - count, count)
    other = ascending[np.repeat(low[high > low], count) + within]
    m, n = terms[term].T
    predicted = np.abs(m * f[one] + n * f[other])
    fits = (other > one) & (predicted > 0.0) & ((predicted >= rate_hz / 2.0) == folded)
    fits &= state.fits(i, predicted, np.hypot(m * u[one], n * u[other]))
    if not np.any(fits):
        return None
    term, one, other = term[fits], one[fits], other[fits]
    best = np.lexsort((term, other, one))[0]
    (m1, n1), a, b = terms[term[best]], one[best], other[best]
    return (int(m1), float(f[a])), (int(n1), float(f[b]))


def _folded(state: _Naming, i: int) -> LineOrigin | None:
    """Explain a line as an aliased harmonic above the Nyquist frequency."""
    f, u, strength = state.fundamentals
    m = np.arange(2, MAX_MULTIPLE + 1)[:, None]
    beyond = (m * f >= state.lines.rate_hz / 2.0) & (state.lines.strength[i] < _SMALLER * strength)
    fits = np.argwhere(beyond & state.fits(i, m * f, m * u))
    if not len(fits):
        return None
    multiple, base = int(m[fits[0, 0], 0]), float(f[fits[0, 1]])
    doubt = state.doubt(i, multiple * len(f))
    text = f"{doubt}harmonic {multiple} of {base:.6g} Hz, aliased from {multiple * base:.6g} Hz"
    return LineOrigin("folded harmonic", text, base, multiple)


def _side_band(state: _Naming, i: int) -> LineOrigin | None:
    """Explain a line as one of two equal side bands of a stronger line."""
    lines = state.lines
    frequency, u = float(lines.frequency_hz[i]), float(lines.u_hz[i])
    named = [j for j, origin in state.origins.items() if origin.kind in ("fundamental", "harmonic")]
    for j in sorted(named, key=lambda j: abs(float(lines.frequency_hz[j]) - frequency)):
        carrier = float(lines.frequency_hz[j])
        if lines.strength[i] > _SMALLER * lines.strength[j] or i == j:
            continue
        distance = frequency - carrier
        partner = (
            state.find(carrier - distance, float(np.hypot(u, 2.0 * lines.u_hz[j]))) if distance < carrier else None
        )
        if partner is None or partner == i or partner in named:
            continue
        ratio = float(lines.strength[partner] / lines.strength[i])
        if 1.0 / _PAIR_RATIO <= ratio <= _PAIR_RATIO:
            text = f"side band of {carrier:.6g} Hz at {'+' if distance > 0 else '-'}{abs(distance):.4g} Hz"
            return LineOrigin("side band", state.doubt(i, len(named)) + text, carrier)
    return None


# Every line of a record, its level over the noise, and its explanation.

FALSE_ALARM = 1e-3  # probability that noise alone adds any line to the list
_SAME_BINS = 0.75  # lines of two channels closer than this are one
_EXPECTED_MULTIPLE = 20  # highest multiple of a fundamental that is expected; chosen
_EXPECTED_MAINS = 7  # highest multiple of the mains that is expected; chosen
_FEWEST = 32  # samples
_MOST_COMBINED = 6  # fundamentals whose sums and differences are expected
_FLOOR_POINTS = 400  # of the decimated noise floor, enough for a figure
_MAX_STORED_BINS = 1 << 24  # bins of spectra that are stored from the first search for the second: 256 MiB
_PER_LINE = ("frequency_hz", "u_frequency_hz", "amplitude", "u_amplitude", "snr")
_HANN_NOISE = 3.0  # noise power in a Hann bin over the variance of a fitted quadrature: 6 σ²/N over 2 σ²/N


@dataclass(frozen=True)
class Survey(
    Arrays,
    shapes="frequency_hz L; u_frequency_hz L; snr L; origin L; amplitude L C; u_amplitude L C; floor_hz B; floor B C",
):
    """Lines of a record in ascending frequency.

    Aliased lines are at their alias.

    Attributes
    ----------
    frequency_hz, u_frequency_hz : (L,), in Hz.
    amplitude, u_amplitude : (L, C), peak amplitude in each channel with standard uncertainty from noise, NaN where the
        line does not exceed the noise of that channel.
    snr : (L,), power of the line over the noise power in a bin of the Hann spectrum, the best of the channels.
    origin : L explanations.
    floor_hz, floor : (B,) and (B, C), decimated noise floor as amplitude per bin.
    notices : notices of the search.
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

    def __repr__(self) -> str:
        return f"Survey({len(self.frequency_hz)} lines in {self.amplitude.shape[1]} channels)"

    @property
    def why(self) -> tuple[str, ...]:
        """Description of each line, with its level over the noise floor."""
        return tuple(
            f"{origin.text}, {decibel(snr):.0f} dB over the noise floor"
            for origin, snr in zip(self.origin, self.snr.tolist(), strict=True)
        )

    def select(self, chosen: BoolArray) -> Survey:
        """Return the lines of a mask (L,) only."""
        selected: dict[str, Any] = {name: getattr(self, name)[chosen] for name in _PER_LINE}
        return replace(self, origin=tuple(self.origin[i] for i in np.flatnonzero(chosen)), **selected)

    def with_lines(
        self, frequency_hz: FloatArray, u_frequency_hz: FloatArray, amplitude: FloatArray, u_amplitude: FloatArray
    ) -> Survey:
        """Return the survey with further lines (N,) of amplitude (N, C)."""
        power = np.max(amplitude**2 / np.maximum(_HANN_NOISE * u_amplitude**2, np.finfo(np.float64).tiny), axis=1)
        order = np.argsort(np.concatenate([self.frequency_hz, frequency_hz]), kind="stable")
        origin = (*self.origin, *(UNEXPLAINED,) * len(frequency_hz))
        added = (frequency_hz, u_frequency_hz, amplitude, u_amplitude, power)
        both: dict[str, Any] = {
            k: np.concatenate([getattr(self, k), more])[order] for k, more in zip(_PER_LINE, added, strict=True)
        }
        return replace(self, origin=tuple(origin[i] for i in order), **both)


def empty_survey() -> Survey:
    """Return a survey without lines."""
    empty, no_channels = np.empty(0), np.empty((0, 0))
    return Survey(empty, empty, no_channels, no_channels, empty, (), empty, no_channels)


def decibel(power_ratio: float) -> float:
    """Return 10·lg of a ratio of powers."""
    return float(10.0 * np.log10(power_ratio))


def survey_lines(
    values: FloatArray | Stacked, rate_hz: float, nominal_hz: Sequence[float] = (), false_alarm: float = FALSE_ALARM
) -> Survey:
    """Find and name the lines of uniform samples: spectral peaks over the noise floor.

    Parameters
    ----------
    values
        (S,) or (S, C), uniform samples without NaN.
    rate_hz
        Sampling rate in Hz.
    nominal_hz
        Nominal fundamentals in Hz; default: those that explain most lines.
    false_alarm
        Probability that noise alone adds a line; default 1e-3.

    Returns
    -------
    The lines with their explanations, and the noise floor.

    Raises
    ------
    ValueError
        There are too few samples, NaN, or no positive rate.

    Notes
    -----
    `false_alarm` is for any length of the record and number of channels, if the noise spectrum is smooth over some 16
    bins. Frequencies where lines are expected (harmonics and halves of the fundamentals, mains) need less height. The
    record is therefore searched twice.

    Examples
    --------
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
    given, notices = _find_nominal(first, nominal_hz, rate_hz, len(data))
    seen = given
    if not len(nominal_hz):
        named = with_origins(first, rate_hz, len(data))
        seen = np.array([o.fundamental_hz for o in named.origin if o.kind == "fundamental"])
    second = detect_lines(spectra, data.shape, rate_hz, false_alarm, expected_frequencies(seen, rate_hz))
    named = with_origins(second, rate_hz, len(data), given if len(nominal_hz) else None)
    return replace(named, notices=named.notices + notices)


class _Spectra:
    """Spectra of channels one by one; small first ones are stored."""

    def __init__(self, data: Stacked) -> None:
        self._data, self._stored = data, list[FloorSpectrum]()

    def __iter__(self) -> Iterator[FloorSpectrum]:
        yield from self._stored
        bins = len(self._data) // 2 + 1
        for c in range(len(self._stored), self._data.shape[1]):
            floored = FloorSpectrum(next(self._data.select([c]).iterate_channels()))
            if len(self._stored) == c and (c + 1) * bins <= _MAX_STORED_BINS:
                self._stored.append(floored)
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
    """Return the unnamed lines of the spectra of C channels.

    `shape` (S, C) is that of their uniform samples. Lines at `expected_hz` need less height. `fitted_hz` are lines
    already fitted, with these samples as residual. `min_amplitude` (C,) is the amplitude below which a peak is
    rounding.
    """
    samples, channels = shape
    to_bins = samples / rate_hz
    expected = np.empty(0) if expected_hz is None else expected_hz * to_bins
    taken = np.empty(0) if fitted_hz is None else alias_frequency(fitted_hz, rate_hz) * to_bins
    least = np.zeros(channels) if min_amplitude is None else min_amplitude
    peaks = [
        find_peaks(spectrum, false_alarm / channels, expected, taken, float(smallest))
        for spectrum, smallest in zip(spectra, least, strict=True)
    ]
    return _merge_peaks(peaks, rate_hz / samples)


def expected_frequencies(fundamental_hz: FloatArray, rate_hz: float) -> FloatArray:
    """Return expected lines below the Nyquist frequency: multiples, parts, sums of fundamentals, mains."""
    frequencies = [m * mains for mains in MAINS_HZ for m in range(1, _EXPECTED_MAINS + 1)]
    for f in fundamental_hz.tolist():
        frequencies += [m * f for m in range(1, _EXPECTED_MULTIPLE + 1)] + [
            f * part for part in (1 / 3, 0.5, 2 / 3, 1.5)
        ]
    for f, g in combinations(fundamental_hz.tolist()[:_MOST_COMBINED], 2):
        frequencies += [f + g, abs(f - g)]
    return np.unique([frequency for frequency in frequencies if frequency < rate_hz / 2.0])


def with_origins(survey: Survey, rate_hz: float, samples: int, fundamental_hz: FloatArray | None = None) -> Survey:
    """Return a survey with explained lines, by given fundamentals or those that explain most."""
    if not len(survey.frequency_hz):
        return survey
    strength = relative_strength(survey.amplitude)
    lines = DetectedLines(survey.frequency_hz, survey.u_frequency_hz, strength, rate_hz, rate_hz / samples)
    return replace(survey, origin=name_lines(lines, fundamental_hz))


def relative_strength(amplitude: FloatArray) -> FloatArray:
    """Return the amplitudes (L, C) over each channel's largest, best channel (L,)."""
    filled = np.nan_to_num(amplitude)
    return np.asarray(np.max(filled / np.maximum(filled.max(axis=0), np.finfo(np.float64).tiny), axis=1))


def _find_nominal(
    survey: Survey, nominal_hz: Sequence[float], rate_hz: float, samples: int
) -> tuple[FloatArray, tuple[Notice, ...]]:
    """Return the strongest line near each nominal frequency's alias, or notices."""
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
            notices.append(Notice(NO_NOMINAL_LINE, f"{nominal:.6g} Hz", capture_hz=capture, nominal_hz=nominal))
    return np.array(found), tuple(notices)


def _merge_peaks(peaks: Sequence[Peaks], resolution_hz: float) -> Survey:
    """Merge the lines of all channels: one line where they are closer than the resolution."""
    every = sorted((float(p.bin_position[i]), c, i) for c, p in enumerate(peaks) for i in range(len(p.bin_position)))
    groups: list[list[tuple[float, int, int]]] = []
    for item in every:
        if groups and item[0] - groups[-1][0][0] < _SAME_BINS and item[1] not in [c for _, c, _ in groups[-1]]:
            groups[-1].append(item)
        else:
            groups.append([item])
    lines, channels = len(groups), len(peaks)
    bin_position, u_bin_position, snr = np.empty(lines), np.empty(lines), np.empty(lines)
    amplitude, u_amplitude = np.full((lines, channels), np.nan), np.full((lines, channels), np.nan)
    for k, group in enumerate(groups):
        weight = np.array([1.0 / float(peaks[c].u_bin_position[i]) ** 2 for _, c, i in group])
        bin_position[k] = weight @ np.array([item[0] for item in group]) / weight.sum()
        u_bin_position[k] = 1.0 / np.sqrt(weight.sum())
        for _, c, i in group:
            amplitude[k, c], u_amplitude[k, c] = abs(peaks[c].value[i]), peaks[c].u_value[i]
        snr[k] = max(float(abs(peaks[c].value[i]) ** 2 / peaks[c].noise[i]) for _, c, i in group)
    bins = len(peaks[0].level)
    shown = np.unique(np.round(np.geomspace(1.0, max(bins - 1, 1), _FLOOR_POINTS)).astype(np.int64))
    cut = sum(p.cut for p in peaks)
    notices = (Notice(TOO_MANY_LINES, "spectrum", most=MOST_LINES, left_out=cut),) if cut else ()
    return Survey(
        frequency_hz=bin_position * resolution_hz,
        u_frequency_hz=u_bin_position * resolution_hz,
        amplitude=amplitude,
        u_amplitude=u_amplitude,
        snr=snr,
        origin=(UNEXPLAINED,) * lines,
        floor_hz=np.asarray(shown * resolution_hz, dtype=np.float64),
        floor=np.stack([np.sqrt(p.level[shown]) for p in peaks], axis=1),
        notices=notices,
    )
