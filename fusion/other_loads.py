"""What load components that were not meant to act contribute to the outputs of one recording, by the static matrix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.estimate import real_design
from fusion.load import LoadResult
from fusion.notices import Notice
from fusion.outputs import Outputs
from fusion.polar import Polar, element_covariance, polar, rounded
from fusion.sensitivity import quotient
from fusion.uncertainty import Uncertainty

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class OtherLoads:
    """Share (K, C) of each output that the other load components explain, and its uncertainty.

    `value`: complex, relative to the whole output, NaN where the load is not known; nearly equal to what the ratio of
    output and driven load is wrong by, relative, if it is read as an element of the sensitivity.
    """

    value: ComplexArray
    uncertainty: Uncertainty

    def element(self, line: int, channel: int) -> Polar:
        """Return one share with its uncertainty; its real part enlarges the output, its imaginary part turns it."""
        pair = element_covariance(self.uncertainty.covariance[line], channel)
        return polar(complex(self.value[line, channel]), pair, float(self.uncertainty.dof()[line, channel]))

    def notices(self, line: int, channel: int, where: str) -> tuple[Notice, ...]:
        """Return what the output of one channel at one line owes to other loads; `where` names both."""
        if not abs(self.value[line, channel]) > 0.0:
            return ()
        share = self.element(line, channel)
        more, turn = (
            rounded(100.0 * share.re, 100.0 * share.k * share.u_re, 0),
            rounded(1e3 * share.im, 1e3 * share.k * share.u_im, 0),
        )
        text = (
            f"by the static sensitivity the other load components make ({more.value} ± {more.expanded}) % of {where} "
            f"and turn it by ({turn.value} ± {turn.expanded}) mrad"
        )
        return (Notice("info", text, "sensitivity"),)


def other_loads(outputs: Outputs, load: LoadResult, static: ArrayLike, component: int) -> OtherLoads:
    """Return z = Σ_{j≠d} S_cj L_j / U_c over the load components j other than the driven one d.

    `static` (C, 6): static sensitivity of the channels, taken as exact. dz = Σ S_cj dL_j / U_c - z dU_c / U_c, with
    unknowns that act on both as one; components of the motion that nobody observed are in L at zero with their
    uncertainty.
    """
    matrix = np.array(static, dtype=np.complex128)
    matrix[:, component] = 0.0
    signal = outputs.phasors.value
    slope = quotient(matrix, np.broadcast_to(signal[:, :, None], (*signal.shape, 6)))
    value = np.einsum("kcj,kj->kc", slope, load.value)
    from_load = load.uncertainty.transformed(real_design(slope))
    return OtherLoads(value, from_load.plus(outputs.uncertainty.scaled(quotient(-value, signal))))
