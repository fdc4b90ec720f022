"""What different methods make of one release."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.notices import Notice
from fusion.step.result import MethodRow, Release
from fusion.step.settings import StepSettings
from shaker.models.indices.indices import indices
from shaker.models.indices.result import Indices
from shaker.models.step_fit.compare import METHODS, compare
from shaker.models.step_fit.result import Method, StepFit

SEED = 1
"""Of the generator that draws the first generation of differential evolution."""
FAILURES = (ValueError, ArithmeticError, np.linalg.LinAlgError)
"""What an identification raises where it finds no model."""
LABELS: dict[Method, str] = {
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


def compare_methods(release: Release, settings: StepSettings) -> tuple[tuple[MethodRow, ...], tuple[Notice, ...]]:
    """Return what every method makes of a release; a notice says which of them finds nothing, and what each remarks."""
    record = replace(release.input.record, u_amplitude=0.0)
    rng = np.random.default_rng(SEED)
    rows: list[MethodRow] = []
    notices: list[Notice] = []
    for method in METHODS:
        try:
            fit = compare(
                record,
                release.driven,
                rng=rng,
                reading=release.reading,
                methods=(method,),
                modes=settings.modes,
                real_poles=settings.real_poles,
            )[0]
        except FAILURES as error:
            notices.append(Notice("info", f"{LABELS[method]}: no model ({error})", release.name))
            continue
        rows.append(method_row(fit, release.name))
        notices += [Notice("info", f"{LABELS[method]}: {n.text}", release.name) for n in fit.notices]
    return tuple(rows), tuple(notices)


def method_row(fit: StepFit, recording: str) -> MethodRow:
    """Return a fit with the indices of its system."""
    return MethodRow(fit, _indices(fit), recording)


def _indices(fit: StepFit) -> Indices | None:
    """Indices of a method's system, none where it has none."""
    try:
        with np.errstate(all="ignore"):
            return indices(fit.system, sample_rate_hz=fit.sample_rate_hz)
    except FAILURES:
        return None
