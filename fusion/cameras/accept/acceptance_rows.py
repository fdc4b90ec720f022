"""Results of an acceptance test: measured value with U, tolerance, and the guarded verdict."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from fusion.estimation.coverage import coverage_factor
from shakercal._common.digits import number_text, quantity_text

Verdict = Literal["PASS", "UNDECIDED", "FAIL"]
DISPLAY = {"m": (1e6, "µm"), "rad": (1e3, "mrad"), "1": (1.0, ""), "px": (1.0, "px"), "share": (1e2, "%")}
"""Factor and unit of printed values; `share`: relative values."""
FILE_UNIT = {"share": "1"}


@dataclass(frozen=True)
class AcceptanceRow:
    """One tested quantity.

    `test`: name of the test; `name`: of the quantity in files; `label`: for readers. `value` has the standard
    uncertainty `u`, without that of the calibration, which is under test, and `dof` degrees of freedom. `cause` and
    `remedy`: the most likely ones of a deviation, if this quantity alone shows them.
    """

    test: str
    name: str
    label: str
    value: float
    u: float
    tolerance: float
    unit: str
    cause: str = ""
    remedy: str = ""
    dof: float = float("inf")

    @property
    def expanded(self) -> float:
        """U = k·u for 95 %."""
        return coverage_factor(self.dof) * self.u

    @property
    def verdict(self) -> Verdict:
        """The decision of ISO 14253-1: U reduces the range of conformity, and that of non-conformity."""
        if abs(self.value) + self.expanded <= self.tolerance:
            return "PASS"
        return "FAIL" if abs(self.value) - self.expanded > self.tolerance else "UNDECIDED"

    @property
    def value_text(self) -> str:
        """Value and U in the displayed unit."""
        factor, unit = DISPLAY[self.unit]
        if self.u == 0.0:
            return number_text(factor * self.value, 3, unit)
        return quantity_text(factor * self.value, factor * self.expanded, unit)

    @property
    def tolerance_text(self) -> str:
        """Tolerance in the displayed unit."""
        factor, unit = DISPLAY[self.unit]
        return number_text(factor * self.tolerance, 3, unit)


def overall(rows: Iterable[AcceptanceRow]) -> Verdict:
    """Return FAIL if one row fails, else UNDECIDED if one is undecided."""
    verdicts = {row.verdict for row in rows}
    return "FAIL" if "FAIL" in verdicts else "UNDECIDED" if "UNDECIDED" in verdicts else "PASS"
