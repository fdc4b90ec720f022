"""What a line most likely is: fundamental, multiple or part of one, combination, mains, side band, or unexplained."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal

import numpy as np

from shaker._checks import FloatArray
from shaker.signals.folding import alias_frequency

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
class Origin:
    """What a line is: kind, the words for it, fundamental it belongs to (Hz, NaN where none), and its multiple."""

    kind: Kind
    text: str
    fundamental_hz: float = float("nan")
    multiple: int = 0


@dataclass(frozen=True)
class LineList:
    """Lines to be explained: `frequency_hz`, `u_hz`, `strength` (L,) relative to the strongest, and their sampling."""

    frequency_hz: FloatArray
    u_hz: FloatArray
    strength: FloatArray
    rate_hz: float
    resolution_hz: float


@dataclass
class _State:
    """Names found so far, and the fundamentals they rest on."""

    lines: LineList
    fundamentals: list[float] = field(default_factory=list)
    u_fundamental: list[float] = field(default_factory=list)
    strength: list[float] = field(default_factory=list)
    origins: dict[int, Origin] = field(default_factory=dict)
    mains: dict[float, tuple[float, float]] = field(default_factory=dict)  # by nominal: as found, with uncertainty

    def tolerance(self, i: int, u_other: float) -> float:
        """Return within which distance line i agrees with a prediction."""
        u = math.hypot(self.lines.u_hz[i], u_other)
        return max(_TOLERANCE_U * u, _TOLERANCE_BINS * self.lines.resolution_hz)

    def fits(self, i: int, wanted: float, u_wanted: float) -> bool:
        """Tell whether line i lies where `wanted` appears in the spectrum."""
        place = abs(wanted - self.lines.rate_hz * round(wanted / self.lines.rate_hz))
        return abs(place - float(self.lines.frequency_hz[i])) <= self.tolerance(i, u_wanted)

    def find(self, wanted: float, u_wanted: float) -> int | None:
        """Return the line nearest to a frequency, None where none agrees."""
        if wanted >= self.lines.rate_hz / 2.0:
            return None
        i = int(np.argmin(np.abs(self.lines.frequency_hz - wanted)))
        return i if self.fits(i, wanted, u_wanted) else None

    def add_fundamental(self, frequency: float, u: float, strength: float) -> None:
        """Keep another fundamental."""
        self.fundamentals.append(frequency)
        self.u_fundamental.append(u)
        self.strength.append(strength)

    def perhaps(self, i: int, places: float) -> str:
        """Return a word of doubt where so many predicted places hit a line by chance."""
        chance = places * 4.0 * self.tolerance(i, 0.0) / self.lines.rate_hz
        return "perhaps " if chance > _PERHAPS else ""


def name_lines(lines: LineList, fundamental_hz: FloatArray | None = None) -> tuple[Origin, ...]:
    """Return what each line is, with the fundamentals given, or with those that explain the most.

    Without any given, lines are taken in the order of their strength. One that no fundamental so far explains becomes
    a fundamental itself, or, where there is a line at its half, third, … and a further multiple of that which it does
    not explain, a harmonic of it: the strongest line may be the second harmonic, but a lone sub-harmonic is not the
    fundamental. Mains and pairs of side bands are told first; what is weaker than a hundredth of the strongest line and
    explained by nothing is no fundamental.
    """
    state = _State(lines)
    if fundamental_hz is None:
        _choose_fundamentals(state)
    else:
        for f in fundamental_hz:
            _accept(state, float(f))
    for _ in range(2):  # a name may rest on a line that was named later
        for i in np.argsort(-lines.strength, kind="stable").tolist():
            if i not in state.origins or state.origins[i].kind == "unexplained":
                state.origins[i] = _explain(state, i) or Origin("unexplained", "unexplained")
    return tuple(state.origins[i] for i in range(len(lines.frequency_hz)))


def _choose_fundamentals(state: _State) -> None:
    """Find the fundamentals, strongest line first."""
    lines = state.lines
    for i in np.argsort(-lines.strength, kind="stable").tolist():
        if i in state.origins or lines.strength[i] < _FUNDAMENTAL:
            continue
        explained = _explain(state, i) if state.fundamentals else None
        if explained is not None:
            state.origins[i] = explained
            continue
        lowest = _lowest(state, i)
        _accept(state, float(lines.frequency_hz[lowest]), lowest)
        if lowest != i:
            state.origins[i] = _explain(state, i) or Origin("unexplained", "unexplained")


def _accept(state: _State, frequency: float, index: int | None = None) -> None:
    """Take a frequency as a fundamental and name its line where there is one."""
    if index is None:
        folded = float(alias_frequency(frequency, state.lines.rate_hz))
        index = state.find(folded, 0.0) if len(state.lines.frequency_hz) else None
    if index is None:
        state.add_fundamental(frequency, 0.0, 1.0)
    else:
        state.add_fundamental(frequency, float(state.lines.u_hz[index]), float(state.lines.strength[index]))
        seen = state.lines.frequency_hz[index]
        above = f" {frequency:.6g} Hz, read at {seen:.6g} Hz" if frequency > state.lines.rate_hz / 2.0 else ""
        mains = next((m for m in MAINS_HZ if abs(frequency - m) <= _MAINS_TOLERANCE * m), None)
        doubt = f" (or mains hum, {mains:g} Hz)" if mains else ""
        state.origins[index] = Origin("fundamental", f"fundamental{above}{doubt}", frequency, 1)


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


def _explain(state: _State, i: int) -> Origin | None:
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
        return folded or _folded_combination(state, i)
    other = f" (or {folded.text})" if folded is not None and folded.multiple <= _LOW_MULTIPLE else ""
    return replace(found, text=found.text + other)


def _pairs(state: _State) -> Iterator[tuple[float, float, float]]:
    """Yield the fundamentals with uncertainty and strength, strongest first."""
    order = np.argsort(-np.array(state.strength), kind="stable")
    for q in order.tolist():
        yield state.fundamentals[q], state.u_fundamental[q], state.strength[q]


def _harmonic(state: _State, i: int) -> Origin | None:
    """Explain a line as a multiple of a fundamental, the lowest there is."""
    found: Origin | None = None
    for f, u, strength in _pairs(state):
        m = round(float(state.lines.frequency_hz[i]) / f)
        fits = 2 <= m <= MAX_MULTIPLE and m * f < state.lines.rate_hz / 2.0 and state.fits(i, m * f, m * u)
        if fits and (found is None or m < found.multiple):
            share = float(state.lines.strength[i]) / strength
            found = Origin("harmonic", f"harmonic {m} of {f:.6g} Hz, {share:.2g} of it", f, m)
    return found


def _mains(state: _State, i: int, multiples: range) -> Origin | None:
    """Explain a line by the grid; once one of its lines is found, the others must be multiples of that one's."""
    f, u = float(state.lines.frequency_hz[i]), float(state.lines.u_hz[i])
    for mains in MAINS_HZ if state.lines.strength[i] < _HUM else ():
        m = round(f / mains)
        if m not in multiples:
            continue
        if mains in state.mains:
            found, u_found = state.mains[mains]
            agrees = state.fits(i, m * found, m * u_found)
        else:
            strays = max(_MAINS_TOLERANCE * f, _TOLERANCE_BINS * state.lines.resolution_hz)
            agrees = m <= _MAINS_ALONE and abs(f - m * mains) <= strays
        if agrees:
            state.mains.setdefault(mains, (f / m, u / m))
            text = f"mains hum ({mains:g} Hz)" if m == 1 else f"mains hum (harmonic {m} of {mains:g} Hz)"
            return Origin("mains", text, mains, m)
    return None


def _sub_harmonic(state: _State, i: int) -> Origin | None:
    """Explain a line as a half or a third of a fundamental, or, where that is there, as a multiple of it."""
    frequency = float(state.lines.frequency_hz[i])
    for f, u, strength in _pairs(state):
        for part in _DIVISORS:
            k = round(part * frequency / f)
            if k % part == 0 or k >= 2 * part + 2 or state.lines.strength[i] > _SMALLER * strength:
                continue
            if state.fits(i, k * f / part, k * u / part) and (k == 1 or state.find(f / part, u / part) is not None):
                return Origin("sub-harmonic", f"sub-harmonic, {k}/{part} of {f:.6g} Hz", f)
    return None


def _combined(state: _State, i: int, orders: range) -> Iterator[tuple[int, int, float, float, float, float]]:
    """Yield (m, ±n, f1, f2, frequency, u) of the combinations of two fundamentals above line i, simplest first."""
    known = [(f, u) for f, u, strength in _pairs(state) if _SMALLER * strength > state.lines.strength[i]]
    for order in orders:
        for (f1, u1), (f2, u2) in combinations(known, 2):
            for m in range(1, order):
                for sign in (1, -1):
                    n = sign * (order - m)
                    wanted = m * f1 + n * f2
                    yield (m, n, f1, f2, abs(wanted), float(np.hypot(m * u1, n * u2)))


def _combination_text(m: int, n: int, f1: float, f2: float) -> str:
    """Say a combination, its positive part first."""
    if n < 0 and m * f1 + n * f2 < 0.0:
        (m, f1), (n, f2) = (-n, f2), (-m, f1)
    first, second = (f"{abs(k)}·{f:.6g}" if abs(k) > 1 else f"{f:.6g}" for k, f in ((m, f1), (n, f2)))
    return f"combination {first} {'+' if n > 0 else '-'} {second} Hz"


def _combination(state: _State, i: int, orders: range) -> Origin | None:
    """Explain a line as a combination of two fundamentals."""
    places = len(state.fundamentals) * (len(state.fundamentals) - 1) * orders[-1]
    for m, n, f1, f2, wanted, u in _combined(state, i, orders):
        if 0.0 < wanted < state.lines.rate_hz / 2.0 and state.fits(i, wanted, u):
            return Origin("combination", state.perhaps(i, places) + _combination_text(m, n, f1, f2))
    return None


def _folded_combination(state: _State, i: int) -> Origin | None:
    """Explain a line as a combination of two fundamentals above the Nyquist frequency."""
    places = len(state.fundamentals) * (len(state.fundamentals) - 1) * _SIMPLE_ORDERS[-1]
    for m, n, f1, f2, wanted, u in _combined(state, i, _SIMPLE_ORDERS):
        if wanted >= state.lines.rate_hz / 2.0 and state.fits(i, wanted, u):
            text = f"{_combination_text(m, n, f1, f2)}, folded from {wanted:.6g} Hz"
            return Origin("folded combination", state.perhaps(i, places) + text)
    return None


def _folded(state: _State, i: int) -> Origin | None:
    """Explain a line as a harmonic above the Nyquist frequency that no filter kept out."""
    for m in range(2, MAX_MULTIPLE + 1):
        for f, u, strength in _pairs(state):
            beyond = m * f >= state.lines.rate_hz / 2.0 and state.lines.strength[i] < _SMALLER * strength
            if beyond and state.fits(i, m * f, m * u):
                doubt = state.perhaps(i, m * len(state.fundamentals))
                text = f"{doubt}harmonic {m} of {f:.6g} Hz, folded from {m * f:.6g} Hz"
                return Origin("folded harmonic", text, f, m)
    return None


def _side_band(state: _State, i: int) -> Origin | None:
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
            return Origin("side band", state.perhaps(i, len(named)) + text, carrier)
    return None
