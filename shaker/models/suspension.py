"""A rigid load on the springs and dampers of a sensor that stands on a moving base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice, permutations

import numpy as np

from shaker._checks import FloatArray
from shaker.models.identification.mechanics import Mechanics, Parameter
from shaker.models.measured import MeasuredTransfer

_APART = 1.5  # factor between the resonances of the components where a fit starts
_FAR_APART = 6.0  # the same where only the lowest is seen
_MOST_ORDERS = 24  # of resonances to components that are tried
_DAMPING_RATIO = 0.01  # where a fit starts
AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Suspension:
    """Load on springs k and dampers b along `components` (indices into x y z rx ry rz), rigid along all others.

    The base moves as a rigid body along `record.drive` = d, the load with it and by p along the free components F:
    (M_FF s² + b s + k) p = -s² (M d)_F, M = mass matrix of the load + internal mass at the origin (Nitsche et al.,
    J. Sens. Sens. Syst. 7, 2018, eqs 8, 9 for one translation). With component z alone H = (k + bs)/((m + m_i)s² + bs +
    k); (0, 4) pitches, since the height of the centre of mass couples x and ry in M; (4,) turns: J α against k_ry.
    What moves with the load inside the sensor is unknown: a mass for all translations, a moment of inertia for each
    rotation. Recordings of one load alone leave it open; `identify` takes it as known where it is stated.
    """

    components: tuple[int, ...]

    def __post_init__(self) -> None:
        found = self.components
        if not found or len(set(found)) < len(found) or not set(found) <= set(range(6)):
            raise ValueError(f"components: expected different ones of 0 to 5, found {found}")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Stiffness and damping of each free component, then internal mass and moments of inertia."""
        springs, dampers = [], []
        for axis in (AXES[c] for c in self.components):
            turning = axis.startswith("r")
            springs.append(Parameter(f"stiffness_{axis}", f"stiffness k, {axis}", "N·m/rad" if turning else "N/m"))
            dampers.append(Parameter(f"damping_{axis}", f"damping b, {axis}", "N·m·s/rad" if turning else "N·s/m"))
        inertias = [Parameter(*words) for words, _ in self._internal]
        return (*springs, *dampers, *inertias)

    @property
    def _internal(self) -> list[tuple[tuple[str, str, str], FloatArray]]:
        """Words and mass matrix (6, 6) per unit of what moves with the load inside the sensor."""
        found = []
        if any(c < 3 for c in self.components):
            words = ("internal_mass", "internal mass m_i", "kg")
            found.append((words, np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])))
        for c in self.components:
            if c >= 3:
                words = (f"internal_inertia_{AXES[c]}", f"internal moment of inertia, {AXES[c]}", "kg·m²")
                found.append((words, np.diag(np.eye(6)[c])))
        return found

    @property
    def body(self) -> FloatArray:
        """Motion (6, n) of the load beside the base: along the free components."""
        return np.asarray(np.eye(6)[:, list(self.components)])

    def mechanics(self, record: MeasuredTransfer) -> Mechanics:
        """Return M, b, k and M d of a recording along the free components; other readings are those of the base."""
        free = np.array(self.components)
        size = len(free)
        masses = [record.mass_matrix, *(matrix for _, matrix in self._internal)]
        masses += [error.change for error in record.inertia_errors]
        full = np.stack([masses[0], *np.zeros((2 * size, 6, 6)), *masses[1:]])
        matrices = np.zeros((len(full), 3, size, size))
        matrices[:, 0] = full[:, free[:, None], free]
        place = np.arange(size)
        matrices[1 + place, 2, place, place] = 1.0
        matrices[1 + size + place, 1, place, place] = 1.0
        rows = np.stack([sight.row for sight in record.tops])
        return Mechanics(
            matrices=matrices,
            forcing=(full @ record.drive)[:, free],
            rows=rows @ self.body,
            offset=rows @ record.drive,
            reference=np.zeros(size),
            reference_offset=float(record.base.row @ record.drive),
        )

    def starts(self, records: Sequence[MeasuredTransfer]) -> FloatArray:
        """Return starts (S, P): resonances of the components around the largest ratio and above it, in every order."""
        size = len(self.components)
        largest = max(records, key=lambda record: float(np.abs(record.ratio.value).max()))
        line = int(np.argmax(np.abs(largest.ratio.value).max(axis=1)))
        peak = 2.0 * np.pi * float(largest.ratio.frequency_hz[line])
        rank = np.arange(size)
        spacings = [peak * _APART ** (rank - 0.5 * (size - 1)), peak * _FAR_APART**rank]
        spacings = spacings[: 1 if size == 1 else 2]
        orders = np.array([order for omega in spacings for order in islice(permutations(omega), _MOST_ORDERS)])
        inertia = largest.mass_matrix.diagonal()[list(self.components)]
        damping = 2.0 * _DAMPING_RATIO * orders * inertia
        return np.hstack([orders**2 * inertia, damping, np.zeros((len(orders), len(self._internal)))])
