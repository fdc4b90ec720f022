"""Exposure of images: rolling shutters, and cameras that are not synchronous."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.errors import ComputeError
from fusion.phasors.phasor_notices import CAMERA_DELAYED, CAMERAS_OUT_OF_STEP
from photogram.camera import StereoRig, epipolar_residual
from shaker.sine.phasor import Phasors
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineFit, SineModel
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice


@dataclass(frozen=True, eq=False)
class PhaseRotated:
    """Frames fitted cell by cell, with row delays corrected at K lines.

    `pose` (F, K, p): six components and p - 6 shapes, in addition to the reference motion. `response` (K, p, p): effect
    of a motion on them; `reference_motion` (K, p): that of the reference. `row_delay` (6, 6): number of rows after the
    first one at which a motion is measured. `delay_s` (N,): of the rows at the points of the surface. `side_px`: of the
    cells.
    """

    pose: ComplexArray
    response: ComplexArray
    reference_motion: ComplexArray
    row_delay: FloatArray
    delay_s: FloatArray
    side_px: int

    def motion(self, time_s: FloatArray, fit: SineFit) -> Phasors:
        """Return the phasors (K, 6) of the body at the lines.

        Means over an exposure.
        """
        return self._restored(time_s, fit, slice(0, 6), self.reference_motion[:, :6], lambda _, found: found.phasors)

    def shapes(
        self, time_s: FloatArray, fit: SineFit, motion: Phasors, noise: Callable[[FloatArray, SineFit], Phasors]
    ) -> Phasors:
        """Return the amplitudes (K, S) of shapes in addition to that motion.

        `noise`: noise of series by their fit.
        """
        moved = np.einsum("kij,kj->ki", self.response[:, 6:, :6], motion.value)
        return self._restored(time_s, fit, slice(6, None), self.reference_motion[:, 6:] - moved, noise)

    def _restored(
        self,
        time_s: FloatArray,
        fit: SineFit,
        columns: slice,
        offset: ComplexArray,
        noise: Callable[[FloatArray, SineFit], Phasors],
    ) -> Phasors:
        """Return G⁻¹·(A + jB + `offset`).

        A and B are the phasors of real and imaginary part of the pose. A motion Re{X exp(jωt)} appears in a rotated
        pose as G·X·exp(jωt)/2 and a part of opposite rotation. With the parts Re{A exp(jωt)} and Re{B exp(jωt)} that is
        (A + jB)/2.
        """
        frequency_hz, model = fit.phasors.frequency_hz, SineModel(robust=True)
        names, unit = fit.phasors.channels, fit.phasors.unit
        both = (*(f"Re {name}" for name in names), *(f"Im {name}" for name in names))
        inverse, unity, lines = np.linalg.inv(self.response[:, columns, columns]), np.eye(len(names)), list[Phasors]()
        for k in range(len(frequency_hz)):
            series = np.concatenate([self.pose[:, k, columns].real, self.pose[:, k, columns].imag], axis=1)
            found = noise(series, fit_sines(time_s, series, frequency_hz, both, unit * 2, model=model))
            matrix = inverse[k] @ np.hstack([unity, 1j * unity])
            lines.append(found.at_lines(np.array([k])).combined(matrix[None], names, unit))
        value, covariance = (np.concatenate([getattr(one, name) for one in lines]) for name in ("value", "covariance"))
        value = value + np.einsum("kij,kj->ki", inverse, offset)
        dof = np.concatenate([one.dof for one in lines])
        return replace(fit.phasors, value=value, covariance=covariance, dof=dof)


# Cameras of a pair that were not exposed at the same time.

LATE_RAD, LATE_U = 0.01, 5.0
"""Phase between the cameras above which it is reported, and the same in standard uncertainties (chosen)."""
FRAME_PHASE_TOLERANCE = 0.05
"""Largest difference in rad of a lag from whole frames: different frames at either end (chosen)."""
MOST_FRAMES = 5
EQUAL = 0.2
"""Relative difference of the two cameras' motion across the epipolar lines that no lag explains."""


def check_in_step(
    rig: StereoRig, frames: Sequence[FloatArray], frequency_hz: FloatArray, time_s: FloatArray
) -> tuple[Notice, ...]:
    """Return a warning if one camera is delayed; raise `ComputeError` if by whole frames.

    Across the epipolar lines both cameras measure the same motion. With phasors a of n_left · L and b of n_right · R of
    the subsets, n being the derivatives of the epipolar residual, a + b·exp(jωδ) = 0 if the right camera is late by δ.
    Hence exp(jωδ) ∝ -Σ a·b*. `frames` (1 + 2K, N, 2) of each camera: mean positions, and these + Re, + Im of each
    phasor.
    """
    (left, right), (_, by_left, by_right) = frames, epipolar_residual(rig, *(side[0] for side in frames))

    def across(side: FloatArray, by: FloatArray) -> ComplexArray:
        moved = side[1:] - side[0]
        return np.asarray(np.einsum("ni,kni->kn", by, moved[0::2] + 1j * moved[1::2]))

    a, b = across(left, by_left), across(right, by_right)
    k = int(np.argmax(np.sum(np.abs(b) ** 2, axis=1)))
    power = float(np.sum(np.abs(b[k]) ** 2))
    z = -complex(np.sum(a[k] * b[k].conj())) / power if power > 0.0 else 0.0
    if abs(abs(z) - 1.0) > EQUAL:
        return ()
    phase = float(np.angle(z))
    u = float(np.sqrt(np.sum(np.abs(a[k] + b[k] * z / abs(z)) ** 2) / (2.0 * len(a[k]) * power)))
    if abs(phase) <= max(LATE_RAD, LATE_U * u):
        return ()
    omega, period_s = 2.0 * np.pi * float(frequency_hz[k]), float(np.min(np.diff(time_s)))
    for count in sorted((n for n in range(-MOST_FRAMES, MOST_FRAMES + 1) if n), key=abs):
        distance = abs(np.angle(np.exp(1j * (phase - omega * count * period_s))))
        if distance < min(FRAME_PHASE_TOLERANCE, abs(phase) / 2.0):
            late, early = ("right", "left") if count > 0 else ("left", "right")
            delay_ms = 1e3 * abs(count) * period_s
            raise ComputeError(CAMERAS_OUT_OF_STEP, late=late, early=early, frames=abs(count), delay_ms=delay_ms)
    notice = Notice(
        CAMERA_DELAYED,
        "exposure",
        late="right" if phase > 0.0 else "left",
        delay_us=1e6 * abs(phase) / omega,
        phase_mrad=1e3 * abs(phase),
        frequency_hz=frequency_hz[k],
        u_mrad=1e3 * u,
    )
    return (notice,)
