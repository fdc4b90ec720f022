"""Deformation of a body at the lines, point by point and in shapes.

Shapes are fitted to all grey values.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fusion.estimation.uncertainty import real_stack
from fusion.phasors.phasor_notices import PAIR_BODY_DEFORMS
from fusion.phasors.stereo_motion import PhaseRotated
from photogram.direct.surface import PLAIN, ShapeAmplitudes, Shapes
from photogram.geometry import displacement_jacobian
from photogram.motion import Deformation
from shaker.sine.aliasing import alias_frequency, exposure_gain, sine_columns
from shaker.sine.normal_equations import SineSums
from shaker.sine.phasor import Phasors
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineFit, SineModel
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray
from shakercal._common.notices import Notice

# Operating deflection shape: phasors of the deformation of a body, point by point.


MIN_FREEDOM = 4  # frames beyond the unknowns of the fit for an estimate of scatter


@dataclass(frozen=True, repr=False, eq=False)
class DeflectionShape(Arrays):
    """Complex deflection of N points of a body at K lines, in m, peak values.

    In the body's axes. `frequency_hz` (K,); `reference_m` (N, 3); `value` (K, N, 3) of x(t) = Re{X exp(jωt)}, corrected
    for the exposure; `u` (K, N, 3): standard uncertainty of the real and of the imaginary part. NaN for a point in too
    few frames.
    """

    frequency_hz: FloatArray
    reference_m: FloatArray
    value: ComplexArray
    u: FloatArray


def deflection_shape(
    time_s: FloatArray, frequency_hz: FloatArray, deformation: Iterable[Deformation], exposure_s: float
) -> DeflectionShape:
    """Return the phasors of a deformation of F frames at K lines by sine approximation.

    Times (F,). Least squares with all lines and an offset, like `fit_sines` for the rigid motion, on the frames with
    the point. u² = s²·(2/S)·(XᵀX)⁻¹ with the variance s² of the point's residual, mean of both parts. `deformation`:
    blocks of frames.
    """
    sums = None
    for part in deformation:
        sums = SineSums(time_s, frequency_hz, np.zeros_like(part.reference_m)) if sums is None else sums
        sums.add(part.residual_m)
    assert sums is not None
    _, value, u = sums.solve(MIN_FREEDOM)
    gain = exposure_gain(frequency_hz, exposure_s)[:, None, None]
    return DeflectionShape(frequency_hz, part.reference_m, np.asarray(value / gain), u / gain)


# Amplitudes of shapes by the grey values of all pixels, and the test of any deformation.

LEVEL = 0.01
"""Probability of a false deformation of a rigid body, over all lines of a recording."""
LOUDER, SLOW = 0.001, 3.09  # probability that white noise seems louder around a line; its quantile


@dataclass(frozen=True, repr=False, eq=False)
class ShapePhasors(Arrays):
    """Amplitudes of S shapes of a body at K lines, in m, peak values.

    Corrected for the exposure. `phasors`: with the covariance of their noise. `effects` (P, K, S): changes per standard
    uncertainty of unknowns of all frames (calibration, errors periodic in the pixel). `share` (6, S): rigid motion that
    an amplitude of 1 m adds to that of the pair. `chance` (K,): of an F at least as large on a rigid body. `modes`:
    number of independent shapes that are significant at the lines together. `form` (S, N, 3): displacement of the
    points in addition to the rigid motion of the pair, for an amplitude of 1 m; None if no line deforms.
    """

    phasors: Phasors
    effects: ComplexArray
    share: FloatArray
    f: FloatArray
    chance: FloatArray
    modes: int
    form: FloatArray | None = None

    @property
    def covariance(self) -> FloatArray:
        """Covariance (K, 2S, 2S) of all real and all imaginary parts, noise and effects."""
        return with_effects(self.phasors.covariance, self.effects)

    @property
    def u_size(self) -> FloatArray:
        """Standard uncertainty (K, S) of a part of each amplitude, the mean of both."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2).reshape(len(self.f), 2, -1)
        return np.asarray(np.sqrt(variance.mean(axis=1)))

    @property
    def deforms(self) -> BoolArray:
        """Lines (K,) at which a deformation is significant, at 1 % over all of them."""
        return np.asarray(self.chance < LEVEL / len(self.chance))

    def at_points(self, shapes: Shapes, points_m: FloatArray) -> ShapePhasors:
        """Add the `form` of the shapes at points (N, 3) if the body deforms."""
        if not self.deforms.any():
            return self
        return replace(
            self, form=shapes(points_m) - np.einsum("ncm,ms->snc", displacement_jacobian(points_m), self.share)
        )

    def notices(self) -> list[Notice]:
        """Return a warning for each line at which the body deforms beyond stated modes."""
        notices = list[Notice]()
        if self.phasors.channels != PLAIN:
            return notices
        size = self.u_size
        for k in np.flatnonzero(self.deforms):
            most = int(np.argmax(np.abs(self.phasors.value[k]) / size[k]))
            frequency_hz = float(self.phasors.frequency_hz[k])
            notices.append(
                Notice(
                    PAIR_BODY_DEFORMS,
                    f"{frequency_hz:.6g} Hz",
                    frequency_hz=frequency_hz,
                    shape=self.phasors.channels[most],
                    amplitude_nm=1e9 * float(np.abs(self.phasors.value[k, most])),
                    u_nm=1e9 * float(size[k, most]),
                    chance=max(float(self.chance[k]), 1e-12),
                )
            )
        return notices


def shape_phasors(
    time_s: FloatArray,
    frequency_hz: FloatArray,
    deformed: ShapeAmplitudes,
    exposure_s: float,
    effects: ComplexArray,
    moved: Phasors | None = None,
    phase_rotated: PhaseRotated | None = None,
) -> ShapePhasors | None:
    """Return the phasors of shape amplitudes (F, S) at K lines.

    None for too few frames. By sine approximation. Hotelling's T² = xᵀ·C⁻¹·x of the 2S parts of a line, with C of ν
    degrees of freedom and the `effects` (P, K, S) added, is 2Sν/(ν − 2S + 1) times F(2S, ν − 2S + 1) on a rigid body.
    `phase_rotated`: frames of a rolling shutter, of a body that has `moved` so.
    """
    from scipy.special import fdtrc

    names, count = deformed.shapes.names, len(deformed.shapes.names)
    gain = exposure_gain(frequency_hz, exposure_s)[:, None]
    freedom = max(MIN_FREEDOM, count if phase_rotated is None else 2 * count)
    if np.count_nonzero(np.isfinite(deformed.amplitude).all(axis=1)) < 2 * len(frequency_hz) + 1 + freedom:
        return None
    try:
        model = SineModel(robust=True)
        fit = fit_sines(time_s, deformed.amplitude, frequency_hz, names, ("m",) * count, model=model)
    except ValueError:
        return None
    if phase_rotated is None or moved is None:
        phasors = _tested_noise(time_s, deformed.amplitude, fit)
    else:
        phasors = phase_rotated.shapes(time_s, fit, moved, partial(_tested_noise, time_s))
    free = np.maximum(phasors.dof - 2 * count + 1, 1.0)
    phasors = phasors.scaled(1.0 / gain)
    covariance = with_effects(phasors.covariance, effects)
    both = real_stack(phasors.value)
    square = np.einsum("ki,ki->k", both, np.linalg.solve(covariance, both[..., None])[..., 0])
    f = square * free / (2 * count * phasors.dof)
    chance = fdtrc(2.0 * count, free, f)
    return ShapePhasors(phasors, effects, deformed.share, f, chance, _independent(phasors, covariance))


def _tested_noise(time_s: FloatArray, amplitude: FloatArray, fit: SineFit) -> Phasors:
    """Return the phasors of a fit with white noise, if it is white.

    Like pixel noise, it then has the degrees of freedom of all frames. At a slow beat the density at a line has only
    two degrees of freedom. It is used if noise is significantly slow, by the mean square of successive differences (von
    Neumann 1941, Ann. Math. Stat. 12, 367), or louder around the line, in all shapes together: air and lamps are not
    white.
    """
    from scipy.special import fdtrc

    used = np.array(np.isfinite(amplitude).all(axis=1))
    used[fit.spikes] = False
    times, frequency = time_s[used], fit.phasors.frequency_hz
    columns, left = sine_columns(times, frequency), fit.residual_of(time_s, amplitude)[used]
    dof = float(max(len(left) - columns.shape[1], 1))
    sigma = left.T @ left / dof
    inverse = np.linalg.inv(columns.T @ columns) * 2.0 / len(left)
    white = np.linalg.solve(np.linalg.cholesky(sigma), left.T)
    slow = 1.0 - 0.5 * float(np.sum(np.diff(white) ** 2) / np.sum(white**2)) > SLOW / np.sqrt(white.size)
    covariance, freedom = np.empty_like(fit.phasors.covariance), np.full(len(frequency), dof)
    for k in range(len(frequency)):
        parts = inverse[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] * np.array([[1.0, -1.0], [-1.0, 1.0]])
        covariance[k] = np.kron(parts, sigma)
        around = _neighbouring_frequencies(times, frequency, k)
        power = np.abs(white @ np.exp(-2j * np.pi * np.multiply.outer(times, around))) ** 2 / len(times)
        if slow or (power.size and fdtrc(2.0 * power.size, dof, float(power.mean())) < LOUDER):
            covariance[k], freedom[k] = fit.phasors.covariance[k], min(fit.phasors.dof[k], dof)
    return replace(fit.phasors, covariance=covariance, dof=freedom)


def _neighbouring_frequencies(time_s: FloatArray, frequency_hz: FloatArray, line: int) -> FloatArray:
    """Return frequencies for the density around a line, without those that the fit removes."""
    bin_hz, rate_hz = 1.0 / float(np.ptp(time_s)), (len(time_s) - 1) / float(np.ptp(time_s))
    around = frequency_hz[line] + bin_hz * np.array([-3.5, -2.5, -1.5, 1.5, 2.5, 3.5])
    folded, taken = alias_frequency(around, rate_hz), np.append(alias_frequency(frequency_hz, rate_hz), 0.0)
    return np.asarray(around[np.abs(folded[:, None] - taken).min(axis=1) > bin_hz])


def with_effects(covariance: FloatArray, effects: ComplexArray) -> FloatArray:
    """Return the covariance (K, 2S, 2S) of noise and of effects (P, K, S)."""
    both = real_stack(effects)
    return np.asarray(covariance + np.einsum("pki,pkj->kij", both, both))


def _independent(phasors: Phasors, covariance: FloatArray) -> int:
    """Return the number of independent shapes that are significant at all lines together.

    Real and imaginary parts of K lines as 2K rows, in units of their uncertainty, have rank r and noise: the sum of
    squares after the first r singular values is nearly χ² of (2K − r)(S − r) (Malinowski 1989, J. Chemometrics 3, 49).
    The result is the first r for which that is not improbable, at 1 %.
    """
    from scipy.special import fdtrc

    count = phasors.value.shape[1]
    of_parts = (covariance[:, :count, :count] + covariance[:, count:, count:]) / 2.0
    lower = np.linalg.cholesky(of_parts)
    parts = np.concatenate([phasors.value.real, phasors.value.imag])[..., None]
    rows = np.linalg.solve(np.concatenate([lower, lower]), parts)[..., 0]
    singular = np.linalg.svd(rows, compute_uv=False)
    for rank in range(len(singular)):
        numbers = (len(rows) - rank) * (count - rank)
        if fdtrc(numbers, phasors.dof.min(), float(np.sum(singular[rank:] ** 2)) / numbers) > LEVEL:
            return rank
    return len(singular)
