"""How far a load can be used, and phasors and records corrected by the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, Notice, check_shape
from shaker.frf.chain import common_covariance, split_ratio
from shaker.identification.sensor import Load, SensorModel
from shaker.sine.phasor import Phasors

# Up to which frequency the static sensitivity is enough.


Limit = Literal["rise", "drop", "phase", "nothing"]

_LIMITS: tuple[Limit, Limit, Limit] = ("rise", "drop", "phase")
_POINTS_PER_DECADE = 200


@dataclass(frozen=True)
class UsableBand:
    """Frequencies from 0 to `upper_hz` at which the output stays within what is permitted of its static value.

    `permitted`: relative deviation of the magnitude; `permitted_phase_rad`: of the phase, None where any is permitted;
    `limit`: what ends the band. `upper_hz` is infinite where nothing does.
    """

    upper_hz: float
    u_upper_hz: float
    permitted: float
    permitted_phase_rad: float | None
    limit: Limit


def usable_band(
    model: SensorModel, load: Load, permitted: float, permitted_phase_rad: float | None = None
) -> UsableBand:
    """Return the band in which `output_factor` keeps within ± `permitted` of its value at f → 0, with its uncertainty.

    The factor (1 + m_i/m) of a moving base is the same at all frequencies and no deviation here. Light damping and no
    chain give f = f₀√(p/(1 + p)) for a force on the load: 0.2182 f₀ at 5 %, 0.3015 f₀ at 10 %. The edge moves with the
    parameters by -(∂Λ/∂θ)/(∂Λ/∂f), Λ the logarithm of the magnitude, or the phase.
    """
    if not 0.0 < permitted < 1.0:
        raise ValueError(f"permitted: expected a share between 0 and 1, found {permitted:g}")
    if permitted_phase_rad is not None and not 0.0 < permitted_phase_rad < np.pi:
        raise ValueError(f"permitted_phase_rad: expected more than 0 and less than π, found {permitted_phase_rad:g}")
    from scipy import optimize

    def excess(frequency_hz: FloatArray) -> FloatArray:
        ratio = model.output_factor(frequency_hz, load) / model.output_factor(np.zeros(1), load)
        size = np.abs(ratio)
        turned = np.abs(np.angle(ratio)) - (np.inf if permitted_phase_rad is None else permitted_phase_rad)
        return np.stack([size - 1.0 - permitted, 1.0 - permitted - size, turned])

    grid = _grid(model, load)
    outside = excess(grid) > 0.0
    if not outside.any():
        return UsableBand(np.inf, 0.0, permitted, permitted_phase_rad, "nothing")
    last = int(np.argmax(outside.any(axis=0)))
    first = float(grid[last - 1]) if last else 0.0
    edges = []
    for i in np.flatnonzero(outside[:, last]).tolist():
        edge = optimize.brentq(lambda f, i=i: excess(np.array([f]))[i, 0], first, grid[last], xtol=1e-9 * grid[last])
        edges.append((float(edge), i))
    upper, which = min(edges)
    u = _edge_uncertainty(model, load, upper, phase=which == 2)
    return UsableBand(upper, u, permitted, permitted_phase_rad, _LIMITS[which])


def _edge_uncertainty(model: SensorModel, load: Load, edge_hz: float, *, phase: bool) -> float:
    """Return the standard uncertainty of a band's edge from the model's covariance."""
    at, turn = np.array([edge_hz]), -1j if phase else 1.0
    slopes = model.log_slopes(at, load) - model.log_slopes(np.zeros(1), load)
    moved = (turn * slopes @ model.covariance_root(load)).real
    by_frequency = float((turn * model.log_frequency_slope(at, load)).real[0])
    return float(np.linalg.norm(moved) / abs(by_frequency))


def _grid(model: SensorModel, load: Load) -> FloatArray:
    """Return frequencies from far below to far above all time constants, dense enough to meet the first edge."""
    chain = model.chain
    times = [model.damping / model.stiffness, chain.delay_s, chain.lag_s, abs(chain.square_s2) ** 0.5]
    times += [1.0 / (2.0 * np.pi * model.resonance_hz(load))] if load.drive == "force" else []
    scales = [1.0 / (2.0 * np.pi * abs(time)) for time in times if time != 0.0] or [1.0]
    low, high = 1e-3 * min(scales), 1e2 * max(scales)
    return np.geomspace(low, high, int(_POINTS_PER_DECADE * np.log10(high / low)) + 1)


# Force on the load from the sensor's output: the model's response taken off, with the uncertainty of the model.


TRANSITION = 0.25
"""Share of the band above its limit in which the taper falls to nothing."""
ATTENUATION_DB = 100.0
"""Attenuation of the taper beyond, and so its ripple below: 1e-5."""


@dataclass(frozen=True)
class CorrectedPhasors:
    """Phasors of the force (random covariance only) and `errors` (E, K, 1): what the model's parameters may add.

    `errors` are relative deviations common to all lines and channels, of E independent causes.
    """

    phasors: Phasors
    errors: ComplexArray

    def __post_init__(self) -> None:
        check_shape("errors", self.errors, (None, len(self.phasors.frequency_hz), 1))

    @property
    def covariance(self) -> FloatArray:
        """Covariance (K, 2C, 2C) of both together."""
        return np.asarray(self.phasors.covariance + common_covariance(self.phasors.value, self.errors))


@dataclass(frozen=True)
class CorrectedRecord:
    """Force on the load (N,) at the instants of the output's samples, up to `band_hz`.

    `u` (N,) standard uncertainty from noise and model; `errors` (E, N) force that one standard deviation of each of E
    independent causes of the model makes. Within `settling` samples of either end the result depends on what was
    before and after the record. `beyond`: rms of what the output held above the band, as force by the static factor.
    """

    force: FloatArray
    u: FloatArray
    errors: FloatArray
    unit: str
    sample_rate_hz: float
    band_hz: float
    settling: int
    beyond: float
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        check_shape("u", self.u, self.force.shape)
        check_shape("errors", self.errors, (None, len(self.force)))


def correct_phasors(phasors: Phasors, model: SensorModel, load: Load) -> CorrectedPhasors:
    """Return the force on the load from phasors (K, C) of the output, all channels by the same model: X / factor."""
    output, force = split_ratio(model.unit)
    other = [unit for unit in phasors.unit if unit != output]
    if other:
        raise ValueError(f"phasors: expected the output in {output}, found {', '.join(other)}")
    response = model.response(phasors.frequency_hz, load)
    corrected = phasors.scaled(1.0 / response.value[:, None], [force] * len(phasors.unit))
    return CorrectedPhasors(corrected, response.errors[:, :, None])


def correct_record(
    output: FloatArray, sample_rate_hz: float, model: SensorModel, load: Load, band_hz: float, *, u_noise: float = 0.0
) -> CorrectedRecord:
    """Return the force on the load from a uniformly sampled record (N,) of the output.

    The spectrum is divided by `output_factor` and multiplied by a taper of zero phase: 1 up to `band_hz`, 0 from
    (1 + `TRANSITION`)·`band_hz`, the response of a symmetric Kaiser-window filter of 2h + 1 taps. The record is
    continued by its odd reflection over h samples (and the chain's delay) at both ends, so that no end sees the other.
    `u_noise`: standard deviation of white noise of one sample. The model's covariance is carried by derivatives.
    """
    check_shape("output", output, (None,))
    from scipy import fft

    taps = _taper(sample_rate_hz, band_hz)
    settling = len(taps) // 2 + int(np.ceil(abs(model.chain.delay_s) * sample_rate_hz))
    if len(output) <= settling:
        raise ValueError(
            f"output: expected more than {settling} samples for a band of {band_hz:g} Hz at {sample_rate_hz:g} Hz, "
            f"found {len(output)}"
        )
    size = fft.next_fast_len(len(output) + 2 * settling, real=True)
    frequency = np.arange(size // 2 + 1) * (sample_rate_hz / size)
    taper = np.fft.rfft(np.roll(np.pad(taps, (0, size - len(taps))), -(len(taps) // 2))).real
    spectrum = np.fft.rfft(_continued(output, settling), size)
    inverse = taper / model.output_factor(frequency, load)

    def back(values: ComplexArray) -> FloatArray:
        return np.asarray(np.fft.irfft(values, size, axis=-1)[..., settling : settling + len(output)])

    causes = (model.log_slopes(frequency, load) @ model.covariance_root(load)).T
    errors = back(-causes * inverse * spectrum)
    noise = u_noise * float(np.sqrt(np.mean(np.fft.irfft(inverse, size) ** 2) * size))
    u = np.sqrt(noise**2 + np.sum(errors**2, axis=0))
    static = float(model.output_factor(np.zeros(1), load)[0].real)
    beyond = float(np.std(output - back(taper * spectrum)) / abs(static))
    force = back(inverse * spectrum)
    least = max(float(np.sqrt(np.mean(u**2))), 10.0 ** (-ATTENUATION_DB / 20.0) * float(np.abs(force).max()))
    unit = split_ratio(model.unit)[1]
    return CorrectedRecord(
        force=force,
        u=u,
        errors=errors,
        unit=unit,
        sample_rate_hz=sample_rate_hz,
        band_hz=band_hz,
        settling=settling,
        beyond=beyond,
        notices=_notices(beyond, least, unit, band_hz),
    )


def _taper(sample_rate_hz: float, band_hz: float) -> FloatArray:
    """Return the taps (2h + 1,) of the taper."""
    highest = 0.5 * sample_rate_hz / (1.0 + TRANSITION)
    if not 0.0 < band_hz <= highest:
        raise ValueError(f"band_hz: expected up to {highest:g} Hz for {sample_rate_hz:g} Hz, found {band_hz:g}")
    from scipy import signal

    width = TRANSITION * band_hz
    count, beta = signal.kaiserord(ATTENUATION_DB, 2.0 * width / sample_rate_hz)
    middle = min(band_hz + 0.5 * width, 0.499999 * sample_rate_hz)
    return np.asarray(signal.firwin(count | 1, middle, window=("kaiser", beta), fs=sample_rate_hz))


def _continued(samples: FloatArray, count: int) -> FloatArray:
    """Return a record with its odd reflection at both ends, `count` samples each."""
    before = 2.0 * samples[0] - samples[count:0:-1]
    after = 2.0 * samples[-1] - samples[-2 : -count - 2 : -1]
    return np.concatenate([before, samples, after])


def _notices(beyond: float, least: float, unit: str, band_hz: float) -> tuple[Notice, ...]:
    """Say what the band limit has taken away where that is more than uncertainty and ripple."""
    if beyond <= least:
        return ()
    text = f"the output holds {beyond:.3g} {unit} rms above {band_hz:g} Hz, which is removed, not corrected"
    return (Notice("warning", text, "band"),)
