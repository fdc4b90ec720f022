"""What different methods make of one release."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion.step.result import MethodRow, Release
from shaker.models.indices.indices import indices
from shaker.models.indices.result import Indices
from shaker.models.step_fit.result import StepFit

LABELS = {
    "pencil": "matrix pencil, output error",
    "arx": "instrumental-variable ARX, output error",
    "sim": "SIM, Tustin",
    "sim_zoh": "SIM, zero-order hold",
    "evolution": "differential evolution on modes",
    "evolution_coefficients": "differential evolution on coefficients",
}


def rows_of(releases: Sequence[Release]) -> tuple[MethodRow, ...]:
    """Return the fits that there are, one row per release."""
    return tuple(method_row(release.fit, release.name) for release in releases if release.fit is not None)


def method_row(fit: StepFit, recording: str) -> MethodRow:
    """Return a fit with the indices of its system."""
    return MethodRow(fit, _indices(fit), recording)


def _indices(fit: StepFit) -> Indices | None:
    """Indices of a method's system, none where it has none."""
    try:
        with np.errstate(all="ignore"):
            return indices(fit.system, sample_rate_hz=fit.sample_rate_hz)
    except (ValueError, ArithmeticError):
        return None
