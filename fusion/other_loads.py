"""What load components that were not meant to act contribute to the outputs of one recording, by the static matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion.estimate import real_design, real_stack
from fusion.load import LOAD_COMPONENTS, LoadResult
from fusion.notices import Notice
from fusion.outputs import Outputs
from fusion.polar import Polar, element_covariance, polar, rounded
from fusion.sensitivity import quotient
from fusion.uncertainty import Influence, Uncertainty
from shaker._checks import ComplexArray


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


def other_loads(
    outputs: Outputs, load: LoadResult, static: ArrayLike, component: int, u_static: float = 0.0
) -> OtherLoads:
    """Return z = Σ_{j≠d} S_cj L_j / U_c over the load components j other than the driven one d.

    `static` (C, 6): static sensitivity of the channels; `u_static`: relative standard uncertainty of each element by
    itself. dz = Σ (S_cj dL_j + dS_cj L_j) / U_c - z dU_c / U_c, with unknowns that act on both load and outputs as one;
    components of the motion that nobody observed are in L at zero with their uncertainty.
    """
    matrix = np.array(static, dtype=np.complex128)
    matrix[:, component] = 0.0
    signal = outputs.phasors.value
    slope = quotient(matrix, np.broadcast_to(signal[:, :, None], (*signal.shape, 6)))
    parts = slope * load.value[:, None, :]
    value = np.sum(parts, axis=2)
    from_load = load.uncertainty.transformed(real_design(slope))
    total = from_load.plus(outputs.uncertainty.scaled(quotient(-value, signal)))
    own = tuple(
        _static_influence(parts[:, channel, j], channel, j, outputs.phasors.channels, u_static)
        for channel, j in np.argwhere(matrix != 0.0).tolist()
        if u_static > 0.0
    )
    return OtherLoads(value, Uncertainty(total.random, (*total.influences, *own)))


def _static_influence(
    part: ComplexArray, channel: int, component: int, channels: Sequence[str], u_static: float
) -> Influence:
    """One element of the static sensitivity, which explains `part` (K,) of a channel's output."""
    change = np.zeros((len(part), len(channels)), dtype=np.complex128)
    change[:, channel] = u_static * part
    name = f"static sensitivity {channels[channel]} per {LOAD_COMPONENTS[component]}"
    return Influence(name, "static sensitivity", u_static, "1", real_stack(change), "rig")
