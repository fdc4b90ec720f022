"""The compensation filter for samples: second-order sections, each of static gain 1, and what sampling costs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape
from shaker.models.compensation.filter import Compensation

Discretisation = Literal["matched", "tustin"]
HIGHEST_SHARE = 0.45
"""Share of the sampling rate up to which a pole or a zero may lie."""
RELATIVE_STEP = 1e-6


@dataclass(frozen=True)
class Sections:
    """y = gain·Π_i (b0 + b1 z⁻¹ + b2 z⁻²)/(1 + a1 z⁻¹ + a2 z⁻²) u at `sample_rate_hz`.

    `sos` (S, 6): rows [b0, b1, b2, 1, a1, a2], run in this order; each has the static gain 1, so that a change of the
    coefficients between two samples leaves a constant signal alone.
    """

    sos: FloatArray
    gain: float
    sample_rate_hz: float

    def __post_init__(self) -> None:
        check_shape("sos", self.sos, (None, 6))
        if np.any(self.sos[:, 3] != 1.0):
            raise ValueError(f"sos: expected sections with a0 = 1, found {self.sos[:, 3].tolist()}")

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the frequency response (K,) at frequencies (K,) in Hz, section by section.

        Polynomials are taken in w = 1 - z⁻¹, which is small where the sampling is fast and differences would cancel.
        """
        w = -np.expm1(-2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None] / self.sample_rate_hz)
        b, a = (_in_differences(part) for part in (self.sos[:, :3], self.sos[:, 3:]))
        tops = b[:, 0] + w * (b[:, 1] + w * b[:, 2])
        return np.asarray(self.gain * np.prod(tops / (a[:, 0] + w * (a[:, 1] + w * a[:, 2])), axis=1))

    @property
    def delay_free(self) -> float:
        """What the filter makes of a jump of 1 from one sample to the next, at once."""
        return float(self.gain * np.prod(self.sos[:, 0]))


def sampled(compensation: Compensation, sample_rate_hz: float, method: Discretisation = "matched") -> Sections:
    """Return a filter for samples at a rate.

    "matched": z = exp(s/fs) of every pole and zero; the zeros stand exactly on the poles of the sampled sensor, which
    cancel at every rate. "tustin": s = K(z - 1)/(z + 1), K = ω/tan(ω/2fs), ω = |zero| of each section, so that the
    frequency of every cancelled mode is kept.
    """
    if method not in ("matched", "tustin"):
        raise ValueError(f'method: expected "matched" or "tustin", found "{method}"')
    fastest = max(float(np.max(np.abs(np.concatenate(factor)))) for factor in compensation.factors) / (2 * np.pi)
    if not fastest <= HIGHEST_SHARE * sample_rate_hz:
        least = fastest / HIGHEST_SHARE
        raise ValueError(f"sample_rate_hz: expected at least {least:.6g} for a filter to {fastest:.6g} Hz, "
                         f"found {sample_rate_hz:g}")  # fmt: skip
    rows = [section_row(zeros, poles, sample_rate_hz, method) for zeros, poles in compensation.factors]
    return Sections(np.stack(rows), compensation.gain, float(sample_rate_hz))


def filled(sections: Sections, count: int) -> Sections:
    """Return the same filter as `count` sections, those added letting everything pass."""
    if count < len(sections.sos):
        raise ValueError(f"count: expected at least {len(sections.sos)}, as many as there are, found {count}")
    more = np.tile([1.0, 0.0, 0.0, 1.0, 0.0, 0.0], (count - len(sections.sos), 1))
    return Sections(np.concatenate([sections.sos, more]), sections.gain, sections.sample_rate_hz)


def section_row(zeros: ComplexArray, poles: ComplexArray, rate_hz: float, method: Discretisation) -> FloatArray:
    """Return one section (6,) of zeros and poles in rad/s, one or two of each, with the static gain 1.

    A low-pass, which has no zeros, is always made by Tustin's rule, prewarped at its corner.
    """
    constant = None
    if method == "tustin" or not len(zeros):
        omega = float(np.abs(zeros[0] if len(zeros) else poles[0]))
        constant = omega / np.tan(0.5 * omega / rate_hz)
    if not len(zeros):
        bottom, rest = _polynomial(poles, rate_hz, constant)
        return np.concatenate([np.array([0.25, 0.5, 0.25]) * rest, bottom])
    (top, rest_top), (bottom, rest_bottom) = (_polynomial(part, rate_hz, constant) for part in (zeros, poles))
    return np.concatenate([top * (rest_bottom / rest_top), bottom])


def _polynomial(roots: ComplexArray, rate_hz: float, constant: float | None) -> tuple[FloatArray, float]:
    """Π(1 - r z⁻¹) (3,) of the images r of roots in rad/s, and its value at z = 1."""
    if constant is None:
        images, rest = np.exp(roots / rate_hz), -np.expm1(roots / rate_hz)
    else:
        images, rest = (1.0 + roots / constant) / (1.0 - roots / constant), -2.0 * roots / (constant - roots)
    coefficients = np.array([1.0, 0.0, 0.0])
    coefficients[1] = -np.sum(images).real
    coefficients[2] = np.prod(images).real if len(roots) == 2 else 0.0
    return coefficients, float(np.prod(rest).real)


def parameter_sections(
    compensation: Compensation, sample_rate_hz: float, method: Discretisation = "matched"
) -> tuple[Sections, ...]:
    """Return the filters of ∂y/∂θ, one per parameter θ of `sensor.vector`: the section of θ is replaced.

    The poles do not depend on the sensor, so that ∂y/∂θ is y's filter with ∂b/∂θ in place of b, by central differences.
    """
    base = sampled(compensation, sample_rate_hz, method)
    sensor = compensation.sensor
    modes, reals = len(sensor.frequency_hz), len(sensor.real_hz)
    owner = [*range(modes), *range(modes), *(modes + np.arange(reals))]
    first, found = len(base.sos) - modes - reals, []
    for parameter, section in enumerate(owner):
        size = RELATIVE_STEP * (1.0 if modes <= parameter < 2 * modes else sensor.vector[parameter])
        up, down = (
            _moved_row(compensation, parameter, section, sign * size, sample_rate_hz, method) for sign in (1, -1)
        )
        sos = base.sos.copy()
        sos[first + section, :3] = (up - down)[:3] / (2.0 * size)
        found.append(Sections(sos, base.gain, base.sample_rate_hz))
    slope = -base.gain / sensor.static_gain if compensation.calibrated else 0.0
    return (*found, Sections(base.sos, slope, base.sample_rate_hz))


def _moved_row(
    compensation: Compensation, parameter: int, section: int, by: float, rate_hz: float, method: Discretisation
) -> FloatArray:
    """The section of a parameter with the sensor's value moved and the target left where it is."""
    sensor = compensation.sensor
    value = sensor.vector.copy()
    value[parameter] += by
    modes = len(sensor.frequency_hz)
    if section < modes:
        omega, zeta = 2 * np.pi * value[section], value[modes + section]
        root = 1j * omega * np.sqrt(1.0 - zeta**2)
        zeros = np.array([-zeta * omega + root, -zeta * omega - root])
    else:
        zeros = np.array([-2 * np.pi * value[modes + section] + 0j])
    first = len(compensation.factors) - modes - len(sensor.real_hz)
    return section_row(zeros, compensation.factors[first + section][1], rate_hz, method)


def discretisation_error(compensation: Compensation, sections: Sections, frequency_hz: FloatArray) -> ComplexArray:
    """Return G_d/G_c - 1 (K,), the sampled filter against the continuous one, at frequencies (K,) in Hz."""
    return np.asarray(sections.response(frequency_hz) / compensation.system.response(frequency_hz) - 1.0)


def _in_differences(coefficients: FloatArray) -> FloatArray:
    """Coefficients (S, 3) of 1, w, w² from those of 1, z⁻¹, z⁻², z⁻¹ = 1 - w."""
    c0, c1, c2 = coefficients.T
    return np.stack([c0 + c1 + c2, -c1 - 2.0 * c2, c2], axis=1)
