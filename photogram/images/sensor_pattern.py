"""Fixed pattern of an image sensor, as far as it is known (EMVA 1288)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shakercal._common.arrays import FloatArray

SMALLEST = 2e-4  # of prnu, and ten times that of dsnu: a sensor that is stated to have none


@dataclass(frozen=True)
class SensorPattern:
    """Fixed pattern of a sensor: differences of its pixels in every image, rms.

    PRNU and DSNU as in EMVA 1288, release 4.0, section 8. The default is a good industrial sensor, of which an
    individual one may differ much.

    Attributes
    ----------
    prnu : of the pixels' gains, relative.
    dsnu : of the pixels' dark values, share of full scale.
    variance_uncertainty : relative standard uncertainty of both variances.
    lines : standard uncertainty of the gain of whole columns and rows, relative.
    shadows : the same of shadows of dust, some pixels wide.
    known : whether it was stated or measured for this camera.
    """

    prnu: float = 0.005
    dsnu: float = 0.0005
    variance_uncertainty: float = 2.0
    lines: float = 0.002
    shadows: float = 0.01
    known: bool = False

    def __post_init__(self) -> None:
        for name in ("prnu", "dsnu", "variance_uncertainty", "lines", "shadows"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name}: expected a finite number of 0 or more, found {getattr(self, name)}")

    def variance(self, grey2: FloatArray, full_scale: float) -> FloatArray:
        """Return the variance of pixels in grey² by their squared grey values."""
        prnu, dsnu = max(self.prnu, SMALLEST), max(self.dsnu, SMALLEST / 10.0)
        return np.asarray(prnu**2 * grey2 + (dsnu * full_scale) ** 2)


TYPICAL = SensorPattern()


def stated_pattern(prnu: float | None, dsnu: float | None) -> SensorPattern:
    """Return the pattern of a data sheet; single cameras differ by some 30 %."""
    if prnu is None and dsnu is None:
        return TYPICAL
    prnu, dsnu = (
        default if value is None else value for value, default in ((prnu, TYPICAL.prnu), (dsnu, TYPICAL.dsnu))
    )
    return SensorPattern(prnu, dsnu, variance_uncertainty=0.6, known=True)
