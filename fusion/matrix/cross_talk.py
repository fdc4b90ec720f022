"""Cross-talk: what the outputs of a sensor say of loads that are not theirs, at rated loads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.coverage import region
from fusion.drive import LOADS
from fusion.load import LOAD_COMPONENTS
from fusion.matrix.fit import MatrixFit
from fusion.system import real_design
from fusion.uncertainty import Uncertainty
from shaker._checks import BoolArray, ComplexArray, FloatArray, check_shape


@dataclass(frozen=True)
class CrossTalk:
    """Output i under the rated load j, relative to its output under its own rated load, at one frequency.

    `value` (C, 6) complex, 1 at the main elements; `main` (C,): component of each channel; `uncertainty` (K = 1) of
    the 6C values, channel by channel; `half_axis` (C, 6): larger half axis of the 95 % region in the complex plane;
    `holds_zero` (C, 6): whether that region holds zero, so that no cross-talk has been shown.
    """

    frequency_hz: float
    channels: tuple[str, ...]
    components: tuple[str, ...]
    main: tuple[int, ...]
    value: ComplexArray
    uncertainty: Uncertainty
    half_axis: FloatArray
    holds_zero: BoolArray


def main_components(value: ComplexArray, capacity: FloatArray) -> tuple[int, ...]:
    """Return for every channel of a matrix (C, 6) the component (0..5) it is made for.

    The one whose rated load moves it most; where two channels answer most to the same load, their order decides.
    """
    largest = np.argmax(np.abs(value) * capacity, axis=1)
    if len(set(largest.tolist())) == len(largest):
        return tuple(int(j) for j in largest)
    return tuple(range(len(value)))


def cross_talk(fit: MatrixFit, capacity: Sequence[float]) -> CrossTalk:
    """Return c_ij = S_ij·capacity_j/(S_im·capacity_m), m the main component of channel i, with its uncertainty.

    dc_ij = (capacity_j/capacity_m)·(dS_ij - S_ij·dS_im/S_im)/S_im: errors that a row has in common cancel.
    """
    rated = np.asarray(capacity, dtype=np.float64)
    check_shape("capacity", rated, (LOADS,))
    channels = len(fit.channels)
    main = main_components(fit.value, rated)
    own = fit.value[np.arange(channels), list(main)]
    ratio = rated / rated[list(main)][:, None]
    value = ratio * fit.value / own[:, None]
    jacobian = np.zeros((channels * LOADS, channels * LOADS), np.complex128)
    for i, j in np.ndindex(channels, LOADS):
        if j != main[i]:
            jacobian[i * LOADS + j, i * LOADS + j] = ratio[i, j] / own[i]
            jacobian[i * LOADS + j, i * LOADS + main[i]] = -value[i, j] / own[i]
    uncertainty = fit.uncertainty.transformed(real_design(jacobian)[None])
    half_axis, holds_zero = _regions(value, uncertainty)
    return CrossTalk(fit.frequency_hz, fit.channels, LOAD_COMPONENTS, main, value, uncertainty, half_axis, holds_zero)


def _regions(value: ComplexArray, uncertainty: Uncertainty) -> tuple[FloatArray, BoolArray]:
    """Larger half axis of the 95 % region of every value (C, 6), and whether it holds zero."""
    covariance, dof = uncertainty.covariance[0], uncertainty.dof()[0]
    half_axis, holds_zero = np.zeros(value.size), np.zeros(value.size, dtype=np.bool_)
    for place, element in enumerate(value.ravel()):
        both = [place, place + value.size]
        found = region(complex(element), covariance[np.ix_(both, both)], float(dof[place]))
        half_axis[place], holds_zero[place] = found.half_axes[0], found.holds_zero
    return half_axis.reshape(value.shape), holds_zero.reshape(value.shape)
