"""What a coverage benchmark counts: how often 95 % regions hold the truth, and whether U is as large as the errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, t

from fusion.estimation.coverage import Polar
from fusion.estimation.uncertainty import Uncertainty, polar_elements
from fusion.sensitivity.analyse import Analysis

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
QUANTITIES = ("acceleration", "load", "sensitivity")
LEVEL = 0.95
HEAD = (
    "| case | quantity | values | covered | acceptance at 95 % | U / half-width | largest error / u |\n"
    "|---|---|---|---|---|---|---|"
)


@dataclass
class Tally:
    """Errors of one complex quantity over many recordings, with what was stated of each value."""

    errors: list[FloatArray] = field(default_factory=list)
    stated: list[Polar] = field(default_factory=list)

    def add(self, error: complex, stated: Polar | None) -> None:
        """Take in the error of one value and the value as it is stated, where there is one."""
        if stated is not None and np.isfinite(error) and np.isfinite(stated.covariance).all():
            self.errors.append(np.array([error.real, error.imag]))
            self.stated.append(stated)

    @property
    def covered(self) -> FloatArray:
        """Return for each value whether its 95 % region holds the truth."""
        errors, matrices = np.array(self.errors), np.array([one.region_matrix for one in self.stated])
        return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(matrices, errors[..., None])[..., 0]) <= 1.0)

    @property
    def u(self) -> FloatArray:
        """Return the standard uncertainties (N, 2) of Re and Im."""
        return np.array([(one.u_re, one.u_im) for one in self.stated])

    @property
    def normalised(self) -> FloatArray:
        """Return the errors (2N,) of Re and Im over their standard uncertainties."""
        return np.asarray((np.array(self.errors) / self.u).ravel())

    @property
    def expanded_over_errors(self) -> float:
        """Return the median U (95 %, of Re or Im) over the half-width that holds 95 % of the errors, the larger one."""
        factor = t.ppf(0.5 + LEVEL / 2.0, np.minimum([one.dof for one in self.stated], 1e6))
        expanded = factor[:, None] * self.u
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


@dataclass
class Counts:
    """Tallies of the fundamental by quantity and component; relative errors of the driven acceleration (N,).

    `warned`: recordings whose instruments were found to disagree.
    """

    acceleration: list[Tally] = field(default_factory=lambda: [Tally() for _ in range(6)])
    load: list[Tally] = field(default_factory=lambda: [Tally() for _ in range(6)])
    sensitivity: list[Tally] = field(default_factory=lambda: [Tally() for _ in range(6)])
    driven: list[complex] = field(default_factory=list)
    warned: int = 0

    def add(
        self, driven: int, found: Analysis, acceleration: ComplexArray, load: ComplexArray, outputs: ComplexArray
    ) -> None:
        """Take in one recording, its driven load component, and the truth: motion (6,), wrench (6,), outputs (C,)."""
        fused = next(a for a in found.accelerations if (a.body, a.source) == ("load", "fused"))
        value = fused.phasors.value[0]
        self.driven.append(complex(value[driven] / acceleration[driven] - 1.0))
        self.warned += any(notice.severity == "warning" for notice in fused.notices)
        _add(self.acceleration, value - acceleration, fused.phasors.value, fused.uncertainty)
        if found.load is not None:
            _add(self.load, found.load.value[0] - load, found.load.value, found.load.uncertainty)
        ratio = found.sensitivity
        if ratio is not None:
            error = ratio.value[0, :, driven] - outputs / load[driven]
            for c, tally in enumerate(self.sensitivity):
                tally.add(complex(error[c]), ratio.polar[0][ratio.elements.index((c, driven))])

    def join(self, other: Counts) -> None:
        """Take in what was counted elsewhere."""
        for name in QUANTITIES:
            for own, found in zip(getattr(self, name), getattr(other, name), strict=True):
                own.errors += found.errors
                own.stated += found.stated
        self.driven += other.driven
        self.warned += other.warned

    def rows(self, case: str) -> Iterator[str]:
        """Yield a row of the table for each quantity."""
        for name in QUANTITIES:
            yield row(case, name, getattr(self, name))


def _add(tallies: Sequence[Tally], error: ComplexArray, value: ComplexArray, uncertainty: Uncertainty) -> None:
    """Take in six components of the first line."""
    for tally, own, stated in zip(tallies, error.tolist(), polar_elements(value, uncertainty)[0], strict=True):
        tally.add(own, stated)
