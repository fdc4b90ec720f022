"""What the phasors of a recording consist of."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.base import AnyNotice
from photogram.epipolar import EpipolarCheck
from photogram.images import GreyImage, NoiseModel
from photogram.motion import Deformation, RigidMotion
from shaker.arrays import ComplexArray, FloatArray, check_shape
from shaker.lines.aliasing import exposure_gain, sine_columns
from shaker.sine.fit import Stationarity
from shaker.sine.normal_equations import solve_sines
from shaker.sine.phasor import Phasors
from shaker.sine.solve import SineFit
from shaker.timebase.tie import ClockTie
from shaker.timebase.trigger import TriggerFit

# Operating deflection shape: phasors of what a body does beside its rigid motion, point by point.


LEAST_FREEDOM = 4  # frames beyond the unknowns of the fit that make a scatter


@dataclass(frozen=True, eq=False)
class DeflectionShape:
    """Complex deflection of N points of a body at K lines, in m, peak values, in the body's axes.

    `frequency_hz` (K,); `reference_m` (N, 3); `value` (K, N, 3) of x(t) = Re{X exp(jωt)}, exposure loss corrected;
    `u` (K, N, 3): standard uncertainty of the real and of the imaginary part. A point seen too rarely is NaN.
    """

    frequency_hz: FloatArray
    reference_m: FloatArray
    value: ComplexArray
    u: FloatArray


def deflection_shape(
    time_s: FloatArray, frequency_hz: FloatArray, deformation: Deformation, exposure_s: float
) -> DeflectionShape:
    """Return the phasors of a deformation of F frames at times (F,) and lines (K,), by sine approximation.

    Least squares with all lines and an offset, as `fit_sines` does for the rigid motion, on the frames in which the
    point is seen; u² = s²·(2/S)·(XᵀX)⁻¹ with the variance s² of the point's own residual, mean of both parts.
    """
    shape = (len(frequency_hz), *deformation.reference_m.shape)
    value, u = np.full(shape, np.nan, dtype=np.complex128), np.full(shape, np.nan)
    seen = np.isfinite(deformation.residual_m).all(axis=2)
    patterns, member = np.unique(seen, axis=1, return_inverse=True)
    for index, pattern in enumerate(patterns.T):
        if pattern.sum() < 2 * len(frequency_hz) + 1 + LEAST_FREEDOM:
            continue
        points = np.flatnonzero(member.ravel() == index)
        data = deformation.residual_m[np.ix_(pattern, points)].reshape(pattern.sum(), -1)
        found = _fit(time_s[pattern], frequency_hz, data)
        if found is not None:
            value[:, points], u[:, points] = (part.reshape(len(frequency_hz), -1, 3) for part in found)
    gain = exposure_gain(frequency_hz, exposure_s)[:, None, None]
    return DeflectionShape(frequency_hz, deformation.reference_m, np.asarray(value / gain), u / gain)


def _fit(time_s: FloatArray, frequency_hz: FloatArray, data: FloatArray) -> tuple[ComplexArray, FloatArray] | None:
    """Phasors (K, C) and their standard uncertainties; None where these frames cannot tell the lines apart."""
    try:
        solution = solve_sines(sine_columns(time_s, frequency_hz), data)
    except ValueError:
        return None
    samples, last = len(data), 2 * len(frequency_hz)
    cosine, sine = solution.coefficients[0:last:2], solution.coefficients[1:last:2]
    variance = np.sum(solution.residual**2, axis=0) / (samples - last - 1)
    spread = np.diagonal(solution.inverse)[:last].reshape(-1, 2).mean(axis=1)
    u = np.sqrt(2.0 / samples * np.multiply.outer(spread, variance))
    return np.sqrt(2.0 / samples) * (cosine - 1j * sine), u


# Clocks, channels, motion and takes of a recording, as the stages that find them return them.


@dataclass(frozen=True)
class StereoResult:
    """Motion seen by one stereo pair, in the sensor frame.

    `time_s` (F,): exposure middles on the first DAQ's clock. `motion`: from the first frame's pose.
    `motion_from_mean`: re-referred to the mean pose, the series that `fit` (six components, m and rad) describes and
    of which it leaves `residual` (F, 6).
    `reference_image` (H, W) and `subsets_px` (N, 2): first left image and the subsets tracked in it, None for points
    of another program. `usable` (K,): which lines of the recording this camera rate can tell apart. `deflection`: what
    the points do beside the rigid motion at the usable lines. `noise`: of the left and the right camera. `sigma_px`
    (2,): median standard deviation of a subset's coordinate, as predicted from the first images and as found.
    `epipolar`: whether the cameras are what was calibrated, frame by frame; its notices are among the evaluation's.
    `stationarity`: the six components over blocks of whole beats, exposure loss not corrected. `u_exposure_s`: 0 where
    the exposure is stated.
    """

    name: str
    body: str
    time_s: FloatArray
    exposure_s: float
    motion: RigidMotion
    motion_from_mean: RigidMotion
    fit: SineFit
    residual: FloatArray = field(init=False)
    usable: NDArray[np.bool_]
    reprojection_px: float
    reference_image: GreyImage | None = None
    subsets_px: FloatArray | None = None
    speckle_px: float | None = None
    noise_grey: float | None = None
    median_zncc: float | None = None
    deflection: DeflectionShape | None = None
    noise: tuple[NoiseModel, ...] = ()
    sigma_px: FloatArray | None = None
    epipolar: EpipolarCheck | None = None
    stationarity: Stationarity | None = None
    u_exposure_s: float = 0.0

    def __post_init__(self) -> None:
        residual = self.fit.residual_of(self.time_s, self.motion_from_mean.pose)
        object.__setattr__(self, "residual", residual)


@dataclass(frozen=True)
class ChannelResult:
    """One DAQ channel: phasors in SI at the recording's lines, and what the figures need.

    `excerpt_s`, `excerpt`, `excerpt_fit` (S,): a short stretch with its fit. `spectrum_hz`, `spectrum` (B,):
    amplitude spectrum of the signal; `residual_rms`: of what the lines leave, in the channel's SI unit.
    `stationarity`: phasors over blocks of whole periods, delay and response not corrected. `notices`: what its fit
    wants the user to know.
    """

    name: str
    daq: str
    quantity: str
    body: str
    unit: str
    sample_rate_hz: float
    samples: int
    phasors: Phasors
    residual_rms: float
    excerpt_s: FloatArray
    excerpt: FloatArray
    excerpt_fit: FloatArray
    spectrum_hz: FloatArray
    spectrum: FloatArray
    stationarity: Stationarity | None = None
    notices: tuple[AnyNotice, ...] = ()


@dataclass(frozen=True)
class ClockResult:
    """One DAQ block: its file, the trigger found in it and its tie to the first block's clock (None for the first).

    `pulse_width_s`, `u_pulse_width_s`: of the trigger's pulses, None where their ends cannot be told.
    """

    daq: str
    file: Path
    trigger: TriggerFit | None
    tie: ClockTie | None
    pulse_width_s: float | None = None
    u_pulse_width_s: float | None = None


@dataclass(frozen=True)
class TakeResult:
    """What ties one take to the first: its reference channel, and the exact lines on its own clock.

    `frequency_hz` (K,) in the order of the evaluation's lines; `value` (K,) phasors R_i of the reference, counted on
    the take's own clock; `factor` (K,): R_1/R_i, by which all phasors of the take were multiplied, NaN where the
    reference does not stand out; `drift` (K,): |R_i/R_1| - 1 and its standard uncertainty from noise.
    """

    name: str
    reference: str
    frequency_hz: FloatArray
    value: ComplexArray
    factor: ComplexArray
    drift: FloatArray
    u_drift: FloatArray

    def __post_init__(self) -> None:
        lines = self.frequency_hz.shape
        for name in ("value", "factor", "drift", "u_drift"):
            check_shape(name, getattr(self, name), lines)
