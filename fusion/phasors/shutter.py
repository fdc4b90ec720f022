"""Rolling shutters: phasors of frames whose rows were exposed one after the other (`photogram.measure.again`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import ComplexArray, FloatArray
from shaker.sine.fit import fit_sines
from shaker.sine.phasor import Phasors
from shaker.sine.solve import SineFit, SineModel


@dataclass(frozen=True, eq=False)
class Turned:
    """Frames fitted cell by cell, the delays of their rows taken back at each of K lines.

    pose (F, K, p): of six components and p - 6 shapes, beside the motion taken for known; `response` (K, p, p): what a
    motion is in them; `known` (K, p): what the known one is. `late` (6, 6): by how many rows after the first one a
    motion is seen. `delay_s` (N,): of the rows that show the points of the surface; `side_px` of the
    cells.
    """

    pose: ComplexArray
    response: ComplexArray
    known: ComplexArray
    late: FloatArray
    delay_s: FloatArray
    side_px: int

    def motion(self, time_s: FloatArray, fit: SineFit) -> Phasors:
        """Return the phasors (K, 6) of the body at the lines of a fit, each as the mean over an exposure."""
        return self._restored(time_s, fit, slice(0, 6), self.known[:, :6], lambda _, found: found.phasors)

    def shapes(
        self, time_s: FloatArray, fit: SineFit, motion: Phasors, noise: Callable[[FloatArray, SineFit], Phasors]
    ) -> Phasors:
        """Return the amplitudes (K, S) of shapes beside that motion; `noise`: of series by their fit."""
        moved = np.einsum("kij,kj->ki", self.response[:, 6:, :6], motion.value)
        return self._restored(time_s, fit, slice(6, None), self.known[:, 6:] - moved, noise)

    def _restored(
        self,
        time_s: FloatArray,
        fit: SineFit,
        own: slice,
        beside: ComplexArray,
        noise: Callable[[FloatArray, SineFit], Phasors],
    ) -> Phasors:
        """Return G⁻¹·(A + jB + what is `beside` them), A and B the phasors of the real and imaginary parts of the pose.

        A motion Re{X exp(jωt)} is in a pose turned back as G·X·exp(jωt)/2, beside what turns the other way; as the
        parts are Re{A exp(jωt)} and Re{B exp(jωt)}, that is (A + jB)/2.
        """
        frequency_hz, model = fit.phasors.frequency_hz, SineModel(robust=True)
        names, unit = fit.phasors.channels, fit.phasors.unit
        both = (*(f"Re {name}" for name in names), *(f"Im {name}" for name in names))
        inverse, unity, lines = np.linalg.inv(self.response[:, own, own]), np.eye(len(names)), list[Phasors]()
        for k in range(len(frequency_hz)):
            series = np.concatenate([self.pose[:, k, own].real, self.pose[:, k, own].imag], axis=1)
            found = noise(series, fit_sines(time_s, series, frequency_hz, both, unit * 2, model=model))
            matrix = inverse[k] @ np.hstack([unity, 1j * unity])
            lines.append(found.at_lines(np.array([k])).combined(matrix[None], names, unit))
        value, covariance = (np.concatenate([getattr(one, name) for one in lines]) for name in ("value", "covariance"))
        value = value + np.einsum("kij,kj->ki", inverse, beside)
        dof = np.concatenate([one.dof for one in lines])
        return replace(fit.phasors, value=value, covariance=covariance, dof=dof)
