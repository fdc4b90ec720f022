"""Covariance of a fit, honest with noise that is coloured by a filter and with a coarse converter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray
from shaker.models.modal import ModalModel
from shaker.models.step_fit.output_error import Solution, columns, slopes
from shaker.models.step_fit.samples import Samples
from shaker.models.step_fit.structure import Structure

_LAGS = 20  # the record's length over the lags of the residual's correlation that are kept
_TESTED = 40  # lags that the residual is tested for correlation at
_WHITE = 73.4  # largest sum of N·r² over forty lags that white noise passes 999 times in 1000


@dataclass(frozen=True)
class Spread:
    """Covariance (P, P) of a modal model's vector, without that of the load; standard uncertainties of the release.

    `fitted`, `residual` (N,): at every sample; `white`: whether the residual passes as white noise; `excess`: its
    density about the lowest mode over that of white noise, 1 where it is white.
    """

    covariance: FloatArray
    u_onset_s: float
    u_release_s: float
    fitted: FloatArray
    residual: FloatArray
    white: bool
    excess: float


def spread(solution: Solution, whole: Samples) -> Spread:
    """Return what is known of a fit's parameters, from the residual at every sample.

    Where the residual is not white, (JᵀJ)⁻¹JᵀRJ(JᵀJ)⁻¹ with R of its correlation through a Parzen window. A converter
    whose step is not dithered by noise errs by one value for a whole level: that is added for both levels.
    """
    problem = solution.problem
    design, found = columns(problem, solution.vector, whole)
    jacobian = np.concatenate([slopes(problem, solution.vector, solution.linear, found), design], axis=1)
    fitted = np.asarray(design @ solution.linear)
    residual = whole.value - fitted
    freedom = max(1, len(residual) - jacobian.shape[1])
    variance = float(residual @ residual) / freedom
    scale = np.sqrt(np.einsum("nk,nk->k", jacobian, jacobian))
    scale[scale == 0] = 1.0
    scaled = jacobian / scale
    known = _known(solution, scale, scaled.T @ scaled, variance)
    normal = scaled.T @ scaled + known * variance
    inverse = np.linalg.pinv(normal, rcond=1e-14, hermitian=True)
    gain = inverse @ scaled.T
    white = _passes_as_white(residual)
    middle = inverse * variance
    excess = 1.0
    if not white:
        coloured = gain @ _correlated(residual, gain.T) * len(residual) / freedom
        excess = float(coloured[0, 0] / max(1e-300, (gain @ gain.T)[0, 0] * variance))
        middle = coloured + inverse @ (known * variance**2) @ inverse
    middle = middle + _converter(whole, residual, gain, fitted)
    covariance = middle / np.outer(scale, scale)
    onset, length = _release(solution, covariance)
    return Spread(_mapped(solution, covariance), onset, length, fitted, residual, white, excess)


def modal_model(solution: Solution, covariance: FloatArray, u_amplitude: float) -> ModalModel:
    """Return a fit as a model; the load's relative uncertainty joins the residues."""
    structure = solution.problem.structure
    poles, residues, m = structure.poles(solution.vector), solution.residues, structure.modes
    omega = np.abs(poles[:m])
    hz = -poles[m:].real / (2 * np.pi)
    model = ModalModel(omega / (2 * np.pi), -poles[:m].real / omega, residues[:m], hz, residues[m:].real)
    common = np.concatenate([np.zeros(2 * m), residues[:m].real, residues[:m].imag, 0 * hz, residues[m:].real])
    total = covariance + u_amplitude**2 * np.outer(common, common)
    return ModalModel(
        model.frequency_hz,
        model.damping_ratio,
        model.residue,
        model.real_hz,
        model.real_residue,
        0.5 * (total + total.T),
    )


def _known(solution: Solution, scale: FloatArray, normal: FloatArray, variance: float) -> FloatArray:
    """Return what is known beforehand as the scaled normal matrix of one variance.

    Of the onset it is what the fit was given. Of real poles and the release's length, which the fit was only led by, it
    is that each of the squares 1/a² and T²/12 is positive and at most their sum, which the record tells well even where
    it cannot tell them apart.
    """
    problem, order = solution.problem, solution.problem.structure.order
    added = np.zeros(len(scale))
    if problem.load.timed:
        added[order] = 1.0 / (problem.u_known[order] * scale[order]) ** 2
    squares = _squares(solution) / scale
    parts = np.flatnonzero(squares)
    if len(parts) > 1:
        free = variance * np.asarray(np.linalg.pinv(normal + np.diag(added * variance), rcond=1e-14, hermitian=True))
        spread_s2 = np.sqrt(max(0.0, float(squares @ free @ squares)))
        largest = 0.5 * float(np.sum(np.abs(squares * scale))) + 2.0 * spread_s2
        added[parts] += 3.0 * (squares[parts] / largest) ** 2
    return np.diag(added)


def _squares(solution: Solution) -> FloatArray:
    """Return derivatives (K + 1 + terms,) of Σ 1/a² + T²/12 in s², real poles -a and length T, to the parameters."""
    problem, structure = solution.problem, solution.problem.structure
    found = np.zeros(problem.count + len(solution.linear))
    real = slice(2 * structure.modes, structure.order)
    found[real] = -2.0 * np.exp(-2.0 * solution.vector[real])
    if problem.load.lasting:
        found[structure.order + problem.load.timed] = problem.release(solution.vector)[1] ** 2 / 6.0
    return found


def _passes_as_white(residual: FloatArray) -> bool:
    """Return whether the correlation of a residual (N,) at forty lags is that of white noise."""
    if not np.any(residual):
        return True
    count = len(residual)
    power = np.abs(np.fft.rfft(residual, 2 * count)) ** 2
    correlation = np.fft.irfft(power)[: _TESTED + 1]
    return bool(count * np.sum((correlation[1:] / correlation[0]) ** 2) < _WHITE)


def _correlated(residual: FloatArray, columns_: FloatArray) -> FloatArray:
    """Return R·columns (N, K), R the correlation matrix of the residual (N,) by a Parzen window."""
    count = len(residual)
    size = 2 ** int(np.ceil(np.log2(2 * count)))
    correlation = np.fft.irfft(np.abs(np.fft.rfft(residual, size)) ** 2)[:count] / count
    x = np.arange(count) / max(_TESTED, count // _LAGS)
    window = np.where(x <= 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * np.maximum(0.0, 1 - x) ** 3)
    kept = correlation * window
    density = np.fft.rfft(np.concatenate([kept, np.zeros(size - 2 * count + 1), kept[:0:-1]]))
    spectrum = np.fft.rfft(columns_, size, axis=0)
    return np.asarray(np.fft.irfft(density[:, None] * spectrum, size, axis=0)[:count])


def _converter(whole: Samples, residual: FloatArray, gain: FloatArray, fitted: FloatArray) -> FloatArray:
    """Return the covariance (K, K) that a converter's rounding adds through both levels.

    Gaussian noise of σ leaves q/π·exp(-2π²σ²/q²) of the rounding's error of a steady level, q the converter's step.
    """
    steps = np.diff(np.unique(whole.value))
    q = float(steps.min()) if steps.size else 0.0
    noise = max(0.0, float(np.var(residual)) - q**2 / 12.0)
    error = q / np.sqrt(12.0) * np.exp(-2.0 * np.pi**2 * noise / q**2) if q > 0 else 0.0
    late = (fitted - fitted[0]) * (fitted[-1] - fitted[0]) > 0.5 * (fitted[-1] - fitted[0]) ** 2
    levels = np.stack([gain @ late.astype(float), gain @ (~late).astype(float)], axis=1)
    return np.asarray(error**2 * levels @ levels.T)


def _release(solution: Solution, covariance: FloatArray) -> tuple[float, float]:
    """Return standard uncertainties of the onset and of the release's length in s."""
    problem = solution.problem
    order = problem.structure.order
    if not problem.load.timed:
        return 0.0, 0.0
    row = np.zeros((2, len(covariance)))
    row[0, order] = 1.0
    if problem.load.lasting:
        length = problem.release(solution.vector)[1]
        row[:, order + 1] = -0.5 * length, length
    u = np.sqrt(np.diag(row @ covariance @ row.T))
    return float(u[0]), float(u[1])


def _mapped(solution: Solution, covariance: FloatArray) -> FloatArray:
    """Return the covariance (P, P) of the modal model's vector from that of the fit's parameters."""
    problem, structure = solution.problem, solution.problem.structure
    jacobian = _model_slopes(structure, solution.vector, solution.linear, problem.count)
    return np.asarray(jacobian @ covariance @ jacobian.T)


def _model_slopes(structure: Structure, vector: FloatArray, linear: FloatArray, count: int) -> FloatArray:
    """Return derivatives (P, K + 1 + terms) of a modal model's vector to the fit's parameters."""
    m, n = structure.modes, structure.order
    shares, by_vector = structure.shares(vector)
    out = np.zeros((4 * m + 2 * structure.reals, count + len(linear)))
    frequency, hz = np.exp(vector[:m]) / (2 * np.pi), np.exp(vector[2 * m : n]) / (2 * np.pi)
    out[np.arange(m), np.arange(m)] = frequency
    out[np.arange(m, 2 * m), np.arange(m, 2 * m)] = 1.0
    reals = np.arange(structure.reals)
    out[4 * m + reals, 2 * m + reals] = hz
    moved = np.zeros((len(shares), count + len(linear)), dtype=np.complex128)
    moved[:, :n] = np.einsum("pkm,k->pm", by_vector, linear[1:])
    moved[:, count + 1 :] = shares
    out[2 * m : 3 * m], out[3 * m : 4 * m] = moved[:m].real, moved[:m].imag
    out[4 * m + structure.reals :] = moved[m:].real
    return out
