"""Whether the lines of a transfer function resolve its resonances."""

from __future__ import annotations

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.notice import Notice

_LEAST = 6.0  # lines of a Hann window, or of local polynomials, between half-power points below which a peak reads low
_PROMINENCE = 2.0  # factor by which a peak stands above its surroundings
_REACH = 40  # lines on either side that are its surroundings
_CERTAIN = 0.1  # relative uncertainty of |H| from which a peak may be noise


def resolution_notices(
    frequency_hz: FloatArray, ratio: ComplexArray, u_ratio: FloatArray, name: str, cause: str
) -> list[Notice]:
    """Tell peaks of |H| (K,), uncertainty `u_ratio` (K,), so narrow that the `cause` named lowers and widens them."""
    from scipy.signal import find_peaks, peak_widths

    magnitude = np.abs(ratio)
    level = np.log(np.maximum(magnitude, np.finfo(np.float64).tiny))
    peaks = find_peaks(level, prominence=np.log(_PROMINENCE), wlen=2 * _REACH + 1)[0]
    peaks = peaks[u_ratio[peaks] < _CERTAIN * magnitude[peaks]]
    if not len(peaks):
        return []
    # Half power lies ln √2 below the peak of the logarithm.
    prominences = (np.full(len(peaks), 0.5 * np.log(2.0)), np.maximum(peaks - _REACH, 0), peaks + _REACH)
    bounds = (prominences[0], prominences[1], np.minimum(prominences[2], len(level) - 1))
    widths = peak_widths(level, peaks, rel_height=1.0, prominence_data=bounds)[0]
    narrow = widths < _LEAST
    if not narrow.any():
        return []
    spacing = float(frequency_hz[1] - frequency_hz[0])
    listed = ", ".join(f"{frequency_hz[p]:.6g}" for p in peaks[narrow][:6])
    width = float(widths[narrow].min())
    text = (
        f"half-power width of {width:.2g} lines at {listed} Hz: {cause} lowers and widens such a peak; lines "
        f"{spacing * max(1.0, width) / (2.0 * _LEAST):.2g} Hz apart would show it"
    )
    return [Notice("warning", text, name)]
