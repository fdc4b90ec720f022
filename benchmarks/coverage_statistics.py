"""What a coverage benchmark counts: how often 95 % regions hold the truth, and whether U is as large as the errors."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, f, t

FloatArray = NDArray[np.float64]
LEVEL = 0.95
HEAD = (
    "| case | quantity | values | covered | acceptance at 95 % | U / half-width | largest error / u |\n"
    "|---|---|---|---|---|---|---|"
)


def region_quantile(dof: float) -> float:
    """Return the 95 % quantile of a complex value's squared Mahalanobis distance with estimated covariance.

    2·ν/(ν − 1)·F(2, ν − 1), χ² with two degrees of freedom for many ν (Willink & Hall 2002, Metrologia 39, 361).
    """
    freedom = min(max(dof, 1.5), 1e6)
    return float(2.0 * freedom / (freedom - 1.0) * f.ppf(LEVEL, 2, freedom - 1.0))


@dataclass
class Tally:
    """Errors of one complex quantity over many recordings, with their covariances and degrees of freedom."""

    errors: list[FloatArray] = field(default_factory=list)
    covariances: list[FloatArray] = field(default_factory=list)
    dofs: list[float] = field(default_factory=list)

    def add(self, error: complex, covariance: FloatArray, dof: float) -> None:
        """Take in one value: its error, the covariance (2, 2) of Re and Im, its degrees of freedom."""
        if np.isfinite(error) and np.isfinite(covariance).all():
            self.errors.append(np.array([error.real, error.imag]))
            self.covariances.append(covariance)
            self.dofs.append(float(dof))

    @property
    def covered(self) -> FloatArray:
        """Return for each value whether its 95 % region holds the truth."""
        errors, covariances = np.array(self.errors), np.array(self.covariances)
        squares = np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])
        limits = {dof: region_quantile(dof) for dof in set(self.dofs)}
        return np.asarray(squares <= np.array([limits[dof] for dof in self.dofs]))

    @property
    def normalised(self) -> FloatArray:
        """Return the errors (2N,) of Re and Im over their standard uncertainties."""
        u = np.sqrt(np.diagonal(np.array(self.covariances), axis1=1, axis2=2))
        return np.asarray((np.array(self.errors) / u).ravel())

    @property
    def expanded_over_errors(self) -> float:
        """Return the median U (95 %, of Re or Im) over the half-width that holds 95 % of the errors, the larger one."""
        factor = t.ppf(0.5 + LEVEL / 2.0, np.minimum(np.array(self.dofs), 1e6))
        expanded = factor[:, None] * np.sqrt(np.diagonal(np.array(self.covariances), axis1=1, axis2=2))
        half = np.quantile(np.abs(np.array(self.errors)), LEVEL, axis=0)
        return float(np.max(np.median(expanded, axis=0) / half))


def row(case: str, quantity: str, tallies: list[Tally]) -> str:
    """Return a row of the table for quantities counted together."""
    used = [tally for tally in tallies if tally.errors]
    if not used:
        return f"| {case} | {quantity} | 0 | – | – | – | – |"
    covered = np.concatenate([tally.covered for tally in used])
    # The components of one recording share their errors: the limits are those of as many values as recordings.
    recordings = max(len(tally.errors) for tally in used)
    low, high = (binom.ppf(p, recordings, LEVEL) / recordings for p in (0.025, 0.975))
    ratio = max(tally.expanded_over_errors for tally in used)
    worst = max(float(np.max(np.abs(tally.normalised))) for tally in used)
    cells = [case, quantity, f"{len(covered)}", f"{100 * covered.mean():.1f} %", f"{100 * low:.1f}–{100 * high:.1f} %"]
    return "| " + " | ".join([*cells, f"{ratio:.2f}", f"{worst:.2f}"]) + " |"
