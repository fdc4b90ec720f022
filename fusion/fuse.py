"""Generalised least squares of all instruments of a body: its six-component acceleration, and whether they agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fusion.notices import AnyNotice
from shaker.signals.phasor import Phasors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

Source = Literal["fused", "photogrammetry", "vibrometer", "accelerometer"]


@dataclass(frozen=True)
class Contribution:
    """One entry of an uncertainty budget: `covariance` (K, 12, 12) of [Re x..rz, Im x..rz], NaN where unobserved."""

    label: str
    type: Literal["A", "B"]
    covariance: FloatArray


@dataclass(frozen=True)
class Consistency:
    """How one instrument agrees with the prediction of all others.

    `normalised_deviation`: root of chi-square per degree of freedom of the leave-one-out difference (1 is expected,
    NaN where the others cannot predict it); `channels` of it; `used` in the fused estimate or only compared;
    `ratio`: measured over predicted at the line where it is largest, complex, NaN where it has no prediction.
    """

    instrument: str
    normalised_deviation: float
    channels: int
    used: bool = True
    ratio: complex = complex(np.nan, np.nan)


@dataclass(frozen=True)
class Acceleration:
    """Six-component acceleration phasors of one body at the sensor origin.

    `phasors` (K, 6) in m/s^2 and rad/s^2, NaN where not `observed` (K, 6). `contributions` add up to the covariance.
    The common errors (E of them): `common` names, `common_estimate` (E,) in standard uncertainties, and
    `common_influence` (E, K, 12), what one standard uncertainty of each does to the estimate in all lines at once.
    """

    body: str
    source: Source
    phasors: Phasors
    observed: BoolArray
    instruments: tuple[str, ...]
    contributions: tuple[Contribution, ...]
    consistency: tuple[Consistency, ...]
    chi2: float
    dof: int
    common: tuple[str, ...]
    common_estimate: FloatArray
    common_influence: FloatArray
    notices: tuple[AnyNotice, ...]
