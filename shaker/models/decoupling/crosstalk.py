"""How much of one load is read as another: before, with the static matrix alone, and behind the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from shaker._checks import ComplexArray, FloatArray
from shaker.models.decoupling.filter import DecouplingFilter
from shaker.models.decoupling.model import MultiModel

STAGES = ("raw", "static", "filtered")
_DECAYS = 5.0
_LONGEST = 20000
_SHORTENED = 0.05


@dataclass(frozen=True)
class Crosstalk:
    """Loads read over loads applied at one stage, in units of the loads: N or N·m per N or N·m.

    `stage`: "raw" (each load by the output of its name over its own sensitivity), "static" (inverse of the static
    matrix), "filtered". `value` (K, D, D) complex at `frequency_hz` (K,): reading i for load j, with standard
    uncertainty `u` (K, D, D) of its modulus by the model. `peak` (D, D): largest reading i in size while load j makes a
    unit step, with `u_peak`.
    """

    stage: str
    components: tuple[str, ...]
    frequency_hz: FloatArray
    value: ComplexArray
    u: FloatArray
    peak: FloatArray
    u_peak: FloatArray

    def rated(self, capacity: FloatArray, values: FloatArray) -> FloatArray:
        """Return readings (…, D, D) in rated loads `capacity` (D,): reading i over its own for load j at its own."""
        return np.asarray(np.abs(values) * capacity / capacity[:, None])


def main_outputs(model: MultiModel) -> tuple[int, ...] | None:
    """Return the output that each load is read from where outputs are named after loads, else that it moves most.

    None where two loads would be read from one output.
    """
    size = np.abs(model.static_gain) / np.linalg.norm(model.static_gain, axis=1, keepdims=True)
    found = tuple(
        model.channels.index(name) if name in model.channels else int(np.argmax(size[:, d]))
        for d, name in enumerate(model.components)
    )
    return found if len(set(found)) == len(found) else None


def static_inverse(model: MultiModel, noise: FloatArray) -> FloatArray:
    """Return the matrix (D, C) that reads loads from outputs at rest, of more outputs than loads by least squares."""
    weight = 1.0 / noise
    return np.asarray(np.linalg.pinv(weight[:, None] * model.static_gain) * weight)


def raw_reading(model: MultiModel) -> FloatArray | None:
    """Return the matrix (D, C) that reads each load from its own output, None where two loads share one."""
    mains = main_outputs(model)
    if mains is None:
        return None
    found = np.zeros((len(model.components), len(model.channels)))
    for d, c in enumerate(mains):
        found[d, c] = 1.0 / model.static_gain[c, d]
    return found


def crosstalks(
    model: MultiModel,
    decoupler: DecouplingFilter,
    noise: FloatArray,
    frequency_hz: FloatArray,
    rng: Generator,
    draws: int,
) -> tuple[Crosstalk, ...]:
    """Return the cross-talk at every stage that the outputs allow.

    Readings and filter stay those of the model; its uncertainty says how far the sensor may differ: over frequency by
    its covariance to first order, for the peaks by the slope towards `draws` models drawn from it.
    """
    matrices = (("raw", raw_reading(model)), ("static", static_inverse(model, noise)))
    readers = [(stage, _constant(matrix, len(frequency_hz))) for stage, matrix in matrices if matrix is not None]
    readers.append(("filtered", decoupler.response(frequency_hz)))
    response = model.response(frequency_hz)
    drawn = _peaks(model, decoupler, dict(matrices), rng, draws)
    found = []
    for stage, reader in readers:
        value = reader @ response
        peak, u_peak = drawn[stage]
        found.append(
            Crosstalk(
                stage, model.components, frequency_hz, value, _u(model, reader, value, frequency_hz), peak, u_peak
            )
        )
    return tuple(found)


def step_readings(model: MultiModel, reader: FloatArray | DecouplingFilter, time_s: FloatArray) -> FloatArray:
    """Return the loads read (N, D, D) at equally spaced times while each load makes a unit step at t = 0."""
    outputs = model.step(time_s)
    if not isinstance(reader, DecouplingFilter):
        return np.asarray(np.einsum("dc,nce->nde", reader, outputs))
    columns = [reader.process(outputs[:, :, j], reader.rest())[0] for j in range(len(model.components))]
    return np.stack(columns, axis=2)


def step_times(model: MultiModel, decoupler: DecouplingFilter) -> FloatArray:
    """Return the times of samples from a step till the slowest mode has decayed."""
    slowest = float(np.min(-model.poles.real))
    count = min(_LONGEST, int(_DECAYS / slowest * decoupler.sample_rate_hz) + 20 * (decoupler.delay + 1))
    return np.arange(count) / decoupler.sample_rate_hz


def _constant(matrix: FloatArray, count: int) -> ComplexArray:
    """A matrix at every frequency."""
    return np.asarray(np.broadcast_to(matrix, (count, *matrix.shape)), dtype=np.complex128)


def _u(model: MultiModel, reader: ComplexArray, value: ComplexArray, frequency_hz: FloatArray) -> FloatArray:
    """Standard uncertainty of every reading in a direction of the complex plane, the mean of all directions."""
    found = np.zeros(value.shape)
    for j in range(value.shape[2]):
        slope, covariance = model.column_sensitivity(j, frequency_hz)
        change = np.einsum("kdc,kcp->kdp", reader, slope, optimize=True)
        root = np.linalg.cholesky(_safe(covariance))
        parts = change @ root
        found[:, :, j] = np.linalg.norm(parts, axis=2) / np.sqrt(2.0)
    return found


def _safe(covariance: FloatArray) -> FloatArray:
    """A covariance with positive eigenvalues, however small."""
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    value, vector = np.linalg.eigh(covariance / np.outer(size, size))
    mended = (vector * np.maximum(value, 1e-12)) @ vector.T
    return np.asarray(mended * np.outer(size, size))


def _peaks(
    model: MultiModel,
    decoupler: DecouplingFilter,
    matrices: dict[str, FloatArray | None],
    rng: Generator,
    draws: int,
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Peaks of the readings in a unit step of every load by stage, and what models drawn from the covariance differ.

    What a drawn model reads is extrapolated from a model near by: the answers are linear in what the data tell, but not
    in poles far from the fitted ones, of which only the sum of their effects is known.
    """
    time_s = step_times(model, decoupler)
    near = _near(model, rng, draws)
    found = {}
    kernels = {stage: matrix[None] for stage, matrix in matrices.items() if matrix is not None}
    kernels["filtered"] = _impulses(decoupler, len(time_s))
    for stage, kernel in kernels.items():
        here = _convolved(kernel, model.step(time_s))
        peak = np.max(np.abs(here), axis=0)
        moved = [here + (_convolved(kernel, one.step(time_s)) - here) / _SHORTENED for one in near]
        spread = np.mean([(np.max(np.abs(other), axis=0) - peak) ** 2 for other in moved], axis=0)
        found[stage] = (peak, np.asarray(np.sqrt(spread)))
    return found


def _impulses(decoupler: DecouplingFilter, count: int) -> FloatArray:
    """Answers (N, D, C) of the filter to a unit sample of every output."""
    units = np.eye(len(decoupler.channels))
    columns = []
    for unit in units:
        outputs = np.zeros((count, len(units)))
        outputs[0] = unit
        columns.append(decoupler.process(outputs, decoupler.rest())[0])
    return np.stack(columns, axis=2)


def _convolved(kernel: FloatArray, outputs: FloatArray) -> FloatArray:
    """Readings (N, D, D) of outputs (N, C, D) by a filter's answers (N, D, C), or by one matrix (1, D, C)."""
    if len(kernel) == 1:
        return np.asarray(kernel[0] @ outputs)
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(2 * len(outputs), real=True)
    product = rfft(kernel, size, axis=0) @ rfft(outputs, size, axis=0)
    return np.asarray(irfft(product, size, axis=0)[: len(outputs)])


def _near(model: MultiModel, rng: Generator, draws: int) -> list[MultiModel]:
    """Models drawn from the covariance, brought near: of poles far away only what they do to first order is known."""
    if model.covariance is None:
        raise ValueError("model: expected one with covariance, found none")
    root = np.linalg.cholesky(_safe(model.covariance))
    vectors = model.vector + _SHORTENED * rng.standard_normal((draws, len(root))) @ root.T
    return [model.with_vector(vector) for vector in vectors]
