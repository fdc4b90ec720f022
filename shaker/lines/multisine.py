"""Multisines of small peak, with lines on a grid that a slow camera resolves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shakercal._common.arrays import Arrays, FloatArray, IntArray, check_shape

MOST_PERIODS = 16
"""Most periods of a multisine in a record: more would only thin out the grid."""
_GRIDS = (  # in the order of preference: odd multiples, shares of the camera rate for aliases, free places per line
    (True, (0.05, 0.45), 1.5),
    (True, (0.01, 0.49), 1.1),
    (False, (0.02, 0.48), 1.1),
)
_WHOLE = (0.0, 0.5)  # shares of the camera rate for the largest number of lines
_FARTHEST = 0.5  # of the distance to the next target by which a line moves where the grid permits
_OVERSAMPLING = 8  # points of the waveform per period of the highest line, at least
_POWERS = (4, 8, 16, 32, 64)  # exponents of the norms that are minimised in turn; the last is close to the peak
_STEPS = 100  # of the minimisation of each norm


@dataclass(frozen=True)
class LineGrid(Arrays, shapes="numbers K"):
    """Lines as multiples of a common frequency, and the frames that observe them.

    Attributes
    ----------
    rate_hz : camera rate, Hz.
    period_frames : frames of one period of the multisine; even.
    periods : whole periods of the record.
    numbers : (K,), multiples of the common frequency, ascending.
    odd : whether all of them are odd, so that no product of second order lies on a line.
    """

    rate_hz: float
    period_frames: int
    periods: int
    numbers: IntArray
    odd: bool

    @property
    def frames(self) -> int:
        """Frames of the record."""
        return self.periods * self.period_frames

    @property
    def spacing_hz(self) -> float:
        """The common frequency, Hz."""
        return self.rate_hz / self.period_frames

    @property
    def frequency_hz(self) -> FloatArray:
        """Frequencies (K,) of the lines, Hz."""
        return np.asarray(self.spacing_hz * self.numbers)

    @property
    def alias_numbers(self) -> IntArray:
        """Aliases (K,) of the lines, in multiples of the common frequency."""
        return _aliases(self.numbers, self.period_frames)


def place_lines(target_hz: FloatArray, rate_hz: float, frames: int) -> LineGrid:
    """Move target frequencies (K,) onto a grid that a slow camera resolves.

    Parameters
    ----------
    target_hz
        (K,), desired frequencies in Hz, ascending.
    rate_hz
        Camera rate in Hz.
    frames
        Frames of the record, at most.

    Returns
    -------
    Lines, and the number of frames used: whole periods.

    Raises
    ------
    ValueError
        The frames cannot resolve as many lines.

    Notes
    -----
    The grid is rate/n with an even number n of frames per period. The camera sees line k at |k - n·round(k/n)|, which
    is odd where k is. With odd numbers alone, all sums and differences of two lines are even: they lie on no line, at
    the camera, too (odd multisines: Pintelon and Schoukens, System Identification, 2012, section 4.3). Where the frames
    allow it, n is such that the record has several periods. Each line takes the place nearest to its target of those
    whose alias is free. Places on a third-order product 3f or 2f₁ ± f₂ of other lines are avoided.
    """
    check_shape("target_hz", target_hz, (None,))
    lines, wish = len(target_hz), np.sort(target_hz) / rate_hz
    for odd, (lowest, highest), spare in _GRIDS:
        shares = (min(lowest, 0.5 * float(wish[0])), highest)
        for periods in range(MOST_PERIODS, 0, -1):
            period = 2 * (frames // (2 * periods))
            if len(_free_aliases(period, odd, shares)) >= spare * lines:
                numbers = _choose(wish * period, period, odd, shares)
                if numbers is not None:
                    return LineGrid(rate_hz, period, periods, numbers, odd)
    period = 2 * (frames // 2)
    numbers = _choose(wish * period, period, False, _WHOLE, farthest=np.inf) if frames > 2 * lines + 1 else None
    if numbers is None:
        raise ValueError(f"frames: expected more than {2 * lines + 1} for {lines} lines, found {frames}")
    return LineGrid(rate_hz, period, 1, numbers, False)


def _aliases(numbers: IntArray, period: int) -> IntArray:
    """Return the aliases of multiples, in multiples of the grid."""
    rest = numbers % period
    return np.asarray(np.minimum(rest, period - rest))


def _free_aliases(period: int, odd: bool, shares: tuple[float, float]) -> IntArray:
    """Return the aliases that lines may have."""
    first, last = max(1, int(np.ceil(shares[0] * period))), min(period // 2 - 1, int(shares[1] * period))
    places = np.arange(first, last + 1, dtype=np.int64)
    return np.asarray(places[places % 2 == 1] if odd else places)


def _choose(
    target: FloatArray, period: int, odd: bool, shares: tuple[float, float], farthest: float = _FARTHEST
) -> IntArray | None:
    """Return multiples near ascending targets with distinct aliases, None if one is too far."""
    free = np.zeros(period // 2 + 1, dtype=np.bool_)
    free[_free_aliases(period, odd, shares)] = True
    distance = np.diff(target)
    gaps = np.minimum(np.append(distance, np.inf), np.append(np.inf, distance))
    chosen: list[int] = []
    for wish, gap in zip(target, gaps, strict=True):
        reach = min(int(np.ceil(farthest * gap)) if np.isfinite(farthest * gap) else period, period)
        around = np.arange(max(1, int(wish) - reach), int(wish) + reach + 2, dtype=np.int64)
        around = around[free[_aliases(around, period)]]
        if not len(around):
            return None
        around = around[np.argsort(np.abs(around - wish), kind="stable")]
        others = np.array(chosen, dtype=np.int64)
        chosen.append(next((int(k) for k in around if not _collides(int(k), others)), int(around[0])))
        free[_aliases(np.array(chosen[-1:]), period)] = False
    return np.array(sorted(chosen), dtype=np.int64)


def _collides(number: int, others: IntArray) -> bool:
    """Return whether a line would be a product 3f or 2f₁ ± f₂ of others."""
    if not len(others):
        return False
    twice = np.abs(np.add.outer(2 * others, np.concatenate([others, -others])))
    np.fill_diagonal(twice[:, len(others) :], 0)  # 2f - f is the line itself
    products = [np.abs(2 * number + others), np.abs(2 * number - others), 2 * others + number, 2 * others - number]
    of_both = np.concatenate([*products, [3 * number]])
    return bool(np.any(twice == number) or np.any(np.isin(np.abs(of_both), [*others.tolist(), number])))


def products_on_lines(numbers: IntArray, order: int, period: int = 0) -> int:
    """Return how many lines coincide with products of second or third order.

    Parameters
    ----------
    numbers
        (K,), lines as multiples of a common frequency.
    order
        2: f₁ ± f₂; 3: f₁ ± f₂ ± f₃ without the line's f + f₂ - f₂, which no choice of lines avoids.
    period
        Frames per period: coincidences at a camera; 0: at the true frequencies.

    Returns
    -------
    Number of lines.
    """
    if order not in (2, 3):
        raise ValueError(f"order: expected 2 or 3, found {order}")
    signed = np.concatenate([numbers, -numbers])
    first, second = np.triu_indices(len(signed))
    total = signed[first] + signed[second]
    if order == 3:
        pairs = total != 0  # f - f
        total = np.add.outer(total[pairs], signed)
        own = (signed[first][pairs, None] == -signed) | (signed[second][pairs, None] == -signed)
        total = total[~own]
    distinct = np.unique(np.abs(total))
    if period:
        return int(np.sum(np.isin(_aliases(numbers, period), _aliases(distinct, period))))
    return int(np.sum(np.isin(numbers, distinct)))


def waveform(numbers: IntArray, amplitude: FloatArray, phase_rad: FloatArray) -> FloatArray:
    """Return one period of a multisine Σ A·cos(2πkt/T + φ), oversampled (M,)."""
    length = _length(numbers)
    spectrum = np.zeros(length // 2 + 1, dtype=np.complex128)
    spectrum[numbers] = amplitude * np.exp(1j * phase_rad) * (length / 2.0)
    return np.asarray(np.fft.irfft(spectrum, length))


def crest_factor(numbers: IntArray, amplitude: FloatArray, phase_rad: FloatArray) -> float:
    """Return peak over rms value of a multisine."""
    rms = float(np.sqrt(np.sum(amplitude**2) / 2.0))
    return float(np.max(np.abs(waveform(numbers, amplitude, phase_rad)))) / rms


def small_crest_phases(numbers: IntArray, amplitude: FloatArray) -> FloatArray:
    """Return phases (K,) in rad that give a multisine a small crest factor.

    Parameters
    ----------
    numbers
        (K,), multiples of the common frequency, ascending.
    amplitude
        (K,), amplitudes of the lines.

    Returns
    -------
    Phases of cosines at time zero.

    Notes
    -----
    Schroeder's phases (IEEE Trans. Inf. Theory 16 (1970) 85) give a sweep whose time at each frequency is in proportion
    to the power there. From there, norms of the waveform of rising order are minimised, as an approximation to its peak
    (Guillaume, Schoukens, Pintelon and Kollár, IEEE Trans. Instrum. Meas. 40 (1991) 982).
    """
    from scipy.optimize import minimize

    power = amplitude**2 / np.sum(amplitude**2)
    spent = np.concatenate([[0.0], np.cumsum(power)[:-1]])
    phase = -2.0 * np.pi * np.cumsum(np.diff(numbers, prepend=numbers[:1]) * spent)
    relative = amplitude / np.sqrt(np.sum(amplitude**2) / 2.0)

    def log_norm(phases: FloatArray, order: int) -> tuple[float, FloatArray]:
        values = waveform(numbers, relative, phases)
        peak = float(np.max(np.abs(values)))
        values /= peak
        weight = np.abs(values) ** (order - 2) * values
        mean = float(np.mean(weight * values))
        moment = np.fft.rfft(weight)[numbers] / len(values)
        slope = -np.imag(relative * np.exp(1j * phases) * np.conj(moment))
        return float(np.log(peak) + np.log(mean) / order), np.asarray(slope / (peak * mean))

    for order in _POWERS:
        phase = minimize(log_norm, phase, (order,), "L-BFGS-B", jac=True, options={"maxiter": _STEPS}).x
    return np.asarray(np.angle(np.exp(1j * phase)))


def _length(numbers: IntArray) -> int:
    """Return the points of a waveform, a power of two."""
    return 1 << int(np.ceil(np.log2(2 * _OVERSAMPLING * int(np.max(numbers)))))
