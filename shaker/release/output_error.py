"""Output-error fit of a release, with covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shaker.lti.system import ModalModel, modal_poles
from shaker.release.load_response import (
    MOMENTS,
    BlockMeans,
    BlockResponses,
    ReleaseLoad,
    Stages,
    responses,
    responses_with_derivatives,
)
from shaker.release.record import TESTED_LAGS, is_white, slow_noise
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray
from shakercal._common.fitting import (
    BlockJacobian,
    LinearBlock,
    LMOptions,
    ParameterPrior,
    SeparablePoint,
    eliminate,
    levenberg_marquardt,
)

# Numbers of poles and zeros of a model, and their parameters.


@dataclass(frozen=True)
class PoleStructure:
    """Numbers of poles and numerator terms of a model.

    `modes` oscillating modes, `reals` real poles, `terms` of the numerator, 1 … 2M + Q. H(s) = Σ_k z_k (s/ω0)^k·Π ω0/(s
    - p), k below `terms`. With 2M + Q terms the residues are free. With fewer terms the response starts more smoothly:
    its first 2M + Q - terms derivatives are continuous at a step. A vector is [ln ω (M), ζ (M), ln a (Q)], poles ω(-ζ ±
    j√(1 - ζ²)) and -a in rad/s. `scale` ω0 in rad/s is fixed.
    """

    modes: int
    reals: int
    terms: int
    scale: float

    @property
    def order(self) -> int:
        """Number of poles."""
        return 2 * self.modes + self.reals

    @property
    def smoothest(self) -> int:
        """Number 2M - 1 of numerator terms of a chain of masses.

        The displacement of a mass initially responds to a force like 1/s², and every low-pass filter adds 1/s.
        """
        return max(1, 2 * self.modes - 1)

    def poles(self, vector: FloatArray) -> ComplexArray:
        """Return upper and real poles (…, M + Q) in rad/s of vectors (…, K)."""
        log_omega, zeta, log_real = np.split(vector[..., : self.order], [self.modes, 2 * self.modes], axis=-1)
        return modal_poles(np.exp(log_omega), zeta, np.exp(log_real))

    def vector(self, poles: ComplexArray) -> FloatArray:
        """Return the parameters (2M + Q,) of poles (M + Q,), upper ones first."""
        upper, real = poles[: self.modes], poles[self.modes :].real
        return np.concatenate([np.log(np.abs(upper)), -upper.real / np.abs(upper), np.log(np.abs(real))])

    def pole_slopes(self, vector: FloatArray) -> ComplexArray:
        """Return derivatives (M + Q, 2M + Q) of the poles by the parameters."""
        poles, zeta = self.poles(vector), vector[self.modes : 2 * self.modes]
        slopes = np.zeros((len(poles), self.order), dtype=np.complex128)
        mode, real = np.arange(self.modes), np.arange(self.modes, len(poles))
        slopes[mode, mode] = poles[: self.modes]
        slopes[mode, mode + self.modes] = np.abs(poles[: self.modes]) * (-1.0 - 1j * zeta / np.sqrt(1.0 - zeta**2))
        slopes[real, real + self.modes] = poles[self.modes :]
        return slopes

    def shares(self, vector: FloatArray) -> ComplexArray:
        """Return residues (…, M + Q, terms) of every numerator term, of vectors (…, K).

        Residue of term k at p_i: ω0^n (p_i/ω0)^k/Π_{j≠i}(p_i - p_j) over all n poles.
        """
        poles = self.poles(vector)
        first = self.scale * np.prod(self.scale / self._gaps(poles), axis=-1)
        return np.asarray(first[..., None] * (poles[..., None] / self.scale) ** np.arange(self.terms))

    def share_slopes(self, vector: FloatArray) -> ComplexArray:
        """Return derivatives (M + Q, terms, 2M + Q) of `shares` by the parameters."""
        poles, slopes = self.poles(vector), self.pole_slopes(vector)
        moves = np.concatenate([slopes, slopes[: self.modes].conj()])
        spread = slopes[:, None, :] - moves[None, :, :]
        by_power = np.arange(self.terms)[:, None] * (slopes / poles[:, None])[:, None, :]
        rate = by_power - (spread / self._gaps(poles)[:, :, None]).sum(axis=1)[:, None]
        return np.asarray(self.shares(vector)[:, :, None] * rate)

    def _gaps(self, poles: ComplexArray) -> ComplexArray:
        """Return differences (…, M + Q, 2M + Q) of poles, `scale` to itself."""
        gaps = poles[..., None] - np.concatenate([poles, poles[..., : self.modes].conj()], axis=-1)[..., None, :]
        diagonal = np.arange(poles.shape[-1])
        gaps[..., diagonal, diagonal] = self.scale
        return np.asarray(gaps)


# Output-error least squares: linear parameters projected out, the others by Levenberg-Marquardt.

_STEPS = 60  # more than any solvable case has needed
_ENOUGH = 1e-4  # predicted fall of the sum of squares, over the variance, below which a step has no effect
MAX_DAMPING = 0.995  # largest |ζ| of an oscillating mode


@dataclass(frozen=True, repr=False)
class OutputErrorProblem(Arrays):
    """A least-squares problem: the response of a structure to a load, and samples.

    Parameters: those of the structure, then the middle of the release in s (a timed load) and the logarithm of its
    length in s (a lasting one). For a release in stages the length is the distance of their middles; the share of the
    first and the logarithm of the length of each follow. `prior`, `u_prior` (K,): prior values and standard deviations,
    wide, infinite for the modes. With them a record that does not determine real poles or the release can be fitted.
    `onset_s`: of a load without a timed release. `colour`: density of the blocks' noise over that of white noise with
    the samples' variance, 1 for white noise. `chain`: stated logarithm of the first real pole in rad/s, and its u.
    """

    structure: PoleStructure
    load: ReleaseLoad
    samples: BlockMeans
    prior: FloatArray
    u_prior: FloatArray
    onset_s: float = 0.0
    colour: float = 1.0
    chain: tuple[float, float] | None = None

    def pull(self, vector: FloatArray) -> float:
        """Return the squared deviation from the stated real pole in its u, 0 without one."""
        if self.chain is None or not self.structure.reals:
            return 0.0
        return float((vector[2 * self.structure.modes] - self.chain[0]) / self.chain[1]) ** 2

    def release(self, vector: FloatArray) -> tuple[float, float]:
        """Return the middle and the length of the release in s."""
        order = self.structure.order
        middle = float(vector[order]) if self.load.timed else self.onset_s
        length = float(np.exp(vector[order + 1])) if self.load.lasting else 0.0
        stages = self.stages(vector)
        return middle, length if stages is None else length + stages.part_s

    def stages(self, vector: FloatArray) -> Stages | None:
        """Return the stages of the release, None for other shapes."""
        if self.load.shape != "stages":
            return None
        return Stages(float(vector[-2]), float(np.exp(vector[-1])))


@dataclass(frozen=True, repr=False)
class OutputErrorFit(Arrays):
    """A fit of a problem.

    `vector`: nonlinear parameters. `linear`: [baseline, numerator terms]. `square`: weighted sum of squares of the
    residual, `path` over the steps.
    """

    problem: OutputErrorProblem
    vector: FloatArray
    linear: FloatArray
    square: float
    path: tuple[float, ...] = ()

    @property
    def size(self) -> int:
        """Number of blocks."""
        return len(self.problem.samples.value)

    @property
    def variance(self) -> float:
        """Variance of the noise of a sample, from the residual."""
        return self.square / max(1, self.size - len(self.vector) - len(self.linear))

    @property
    def delay_s(self) -> float:
        """Mean time of the load's change plus the chain's lag at the lowest mode."""
        structure, stages = self.problem.structure, self.problem.stages(self.vector)
        middle, omega = self.problem.release(self.vector)[0], float(np.exp(self.vector[: structure.modes].min()))
        numerator = self.linear[1:] @ (1j * omega / structure.scale) ** np.arange(structure.terms) / self.linear[1]
        chain = np.prod(1.0 + 1j * omega * np.exp(-self.vector[2 * structure.modes : structure.order]))
        lag = float(np.angle(chain / numerator)) / omega
        if stages is None:
            return middle + lag
        return middle + lag + (0.5 - stages.share) * float(np.exp(self.vector[structure.order + 1]))


def columns(problem: OutputErrorProblem, vector: FloatArray, samples: BlockMeans) -> tuple[FloatArray, BlockResponses]:
    """Return the unweighted design (B, 1 + terms) and the responses of the poles."""
    poles, stages = problem.structure.poles(vector), problem.stages(vector)
    answered = responses_with_derivatives(problem.load, poles, samples, *problem.release(vector), stages=stages)
    return _design(problem, vector, answered.value), answered


def design(problem: OutputErrorProblem, vector: FloatArray, samples: BlockMeans) -> FloatArray:
    """Return the design of `columns` only."""
    poles, stages = problem.structure.poles(vector), problem.stages(vector)
    value = responses(problem.load, poles, samples, *problem.release(vector), stages=stages)
    return _design(problem, vector, value)


def _design(problem: OutputErrorProblem, vector: FloatArray, value: ComplexArray) -> FloatArray:
    """Return the design of the poles' responses (B, P)."""
    parts = np.real(value @ (_twice(problem.structure)[:, None] * problem.structure.shares(vector)))
    return np.concatenate([np.ones((len(parts), 1)), parts], axis=1)


def slopes(problem: OutputErrorProblem, vector: FloatArray, linear: FloatArray, answered: BlockResponses) -> FloatArray:
    """Return unweighted derivatives (B, K) of the fitted output by the nonlinear parameters."""
    structure = problem.structure
    twice = _twice(structure)
    residues = twice * (structure.shares(vector) @ linear[1:])
    moved = twice[:, None] * np.einsum("pkm,k->pm", structure.share_slopes(vector), linear[1:])
    poles = structure.pole_slopes(vector) * residues[:, None]
    out = [np.real(answered.by_pole @ poles + answered.value @ moved)]
    if problem.load.timed:
        out.append(np.real(answered.by_onset @ residues)[:, None])
    if problem.load.lasting:
        by_length = np.real(answered.by_length @ residues)[:, None]
        out.append(np.exp(vector[structure.order + problem.load.timed]) * by_length)
    if len(answered.by_stage):
        by_share, by_part = np.real(answered.by_stage @ residues)[:, :, None]
        out += [by_share, np.exp(vector[-1]) * (by_part + by_length)]
    return np.concatenate(out, axis=1)


def squares(problem: OutputErrorProblem, vectors: FloatArray) -> FloatArray:
    """Return the weighted sums of squares (V, terms) for 1, 2, … numerator terms.

    `vectors` (V, K) have different poles but the same release. Each takes one factorisation.
    """
    structure, samples = problem.structure, problem.samples
    poles = structure.poles(vectors)
    with np.errstate(over="ignore", invalid="ignore"):
        release = *problem.release(vectors[0]), problem.stages(vectors[0])
        value = responses(problem.load, poles.ravel(), samples, *release).T
        residues = (_twice(structure)[:, None] * structure.shares(vectors)).swapaxes(1, 2)
        parts = np.real(residues @ value.reshape(*poles.shape, -1))
    rows = np.ones((len(vectors), structure.terms + 2, len(samples.value)))
    rows[:, 1:-1], rows[:, -1] = parts, samples.value
    finite = np.all(np.isfinite(parts), axis=(1, 2))
    rows[~finite] = 0.0
    last = np.asarray(np.linalg.qr((rows * samples.weight).swapaxes(1, 2), mode="r"))[:, :, -1]
    left = np.cumsum(last[:, ::-1] ** 2, axis=1)[:, ::-1][:, 2:]
    return np.where(finite[:, None], left, np.inf)


def solve(
    problem: OutputErrorProblem, start: FloatArray, enough: float = _ENOUGH, hopeless: float = np.inf
) -> OutputErrorFit:
    """Return the fit from a start vector (K,), baseline and numerator projected out.

    It ends when a step is predicted to lower χ² by less than `enough`, or when a sum of squares below `hopeless` is
    not in sight.
    """
    weight = problem.samples.weight[:, None]
    data = problem.samples.value[:, None] * weight
    modes, order = problem.structure.modes, problem.structure.order
    lengths, longest = slice(order + 1, None, 2), np.log(problem.samples.time_s[-1] - problem.samples.time_s[0])

    def at(vector: FloatArray) -> SeparablePoint | None:
        """Return the best baseline and numerator for given poles and release, None if impossible."""
        steep = np.any(np.abs(vector[modes : 2 * modes]) > MAX_DAMPING)
        if steep or np.any(np.abs(vector[:order]) > 50.0) or np.any(vector[lengths] > longest):
            return None
        if problem.load.shape == "stages" and not 0.0 < vector[-2] < 1.0:
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            matrix, answered = columns(problem, vector, problem.samples)
            weighted = matrix * weight

        def changes(coefficients: FloatArray) -> BlockJacobian:
            change = slopes(problem, vector, coefficients[:, 0], answered) * weight
            return BlockJacobian(np.arange(change.shape[1]), change[:, :, None])

        return SeparablePoint(vector, (LinearBlock(weighted, data, changes),))

    prior, u_prior = problem.prior, problem.u_prior
    if problem.chain is not None and problem.structure.reals:
        prior, u_prior, start = prior.copy(), u_prior.copy(), start.copy()
        prior[2 * modes], u_prior[2 * modes] = problem.chain
        start[2 * modes] = problem.chain[0]
    first = at(start)
    if first is None:
        raise ValueError(f"start: expected modes that oscillate and a release in the record, found {start.tolist()}")
    rules = LMOptions(
        predicted_decrease_share=enough / first.freedom,
        tolerance=hopeless,
        max_steps=_STEPS,
        damping_decrease=0.03,
        min_damping=1e-8,
    )
    end = levenberg_marquardt(at, first, rules, prior=ParameterPrior(prior, u_prior))
    return OutputErrorFit(problem, end.point.parameters, end.point.coefficients[0][:, 0], end.point.loss, end.losses)


def predicted_gain(
    plain: OutputErrorFit, problem: OutputErrorProblem, vectors: list[FloatArray]
) -> tuple[float, FloatArray]:
    """Return the predicted gain of a richer model, and the best vector.

    The gain is the fall of B·ln(sum of squares) by one step: the design of the richer model at each vector is joined
    with the design and derivatives of the fit, and the residual of the three shows whether it is worth a fit.
    """
    weight = plain.problem.samples.weight[:, None]
    design_of_fit, answered = columns(plain.problem, plain.vector, plain.problem.samples)
    design_of_fit = np.concatenate([design_of_fit, slopes(plain.problem, plain.vector, plain.linear, answered)], axis=1)
    value = plain.problem.samples.value * weight[:, 0]
    best, chosen = 0.0, vectors[0]
    for vector in vectors:
        whole = np.concatenate([design_of_fit, design(problem, vector, plain.problem.samples)], axis=1) * weight
        left = eliminate(whole, value[:, None]).residual[:, 0]
        gain = plain.size * float(np.log(plain.square / (left @ left)))
        if gain > best:
            best, chosen = gain, vector
    return best, chosen


def _twice(structure: PoleStructure) -> FloatArray:
    """Return 2 for an upper pole with its conjugate, 1 for a real one."""
    return np.concatenate([np.full(structure.modes, 2.0), np.ones(structure.reals)])


# Covariance of a fit, also for coloured noise and for a coarse converter.

_LAGS = 20  # length of the record over the lags of the residual's correlation; at least `TESTED_LAGS` are used


@dataclass(frozen=True, repr=False)
class FitCovariance(Arrays):
    """Covariance (P, P) of a modal model, and of the release.

    The uncertainty of the load is not included. `u_onset_s`, `u_release_s`: standard uncertainties of the release.
    `fitted`, `residual` (N,): at every sample. `white`: whether the residual passes a test for white noise. `excess`:
    its density about the lowest mode over that of white noise, 1 for white noise.
    """

    covariance: FloatArray
    u_onset_s: float
    u_release_s: float
    fitted: FloatArray
    residual: FloatArray
    white: bool
    excess: float


class NoiseCovariance(NamedTuple):
    """Covariance (K, K) of parameters by noise; `white`, `excess` as in `FitCovariance`."""

    covariance: FloatArray
    white: bool
    excess: float


def noise_covariance(columns_: FloatArray, gain: FloatArray, whole: BlockMeans, fitted: FloatArray) -> NoiseCovariance:
    """Return the covariance of parameters `gain` @ samples by the noise of a fit's residual.

    `columns_` (N, K): change of the fitted output with the parameters. If the residual is not white: G·R·Gᵀ with R of
    its correlation through a Parzen window. A converter whose step is not dithered by noise has a constant error at a
    constant level, added for both levels.
    """
    residual = whole.value - fitted
    freedom = max(1, len(residual) - columns_.shape[1])
    variance = float(residual @ residual) / freedom
    white = is_white(residual)
    covariance, excess = gain @ gain.T * variance, 1.0
    if not white:
        coloured = gain @ _correlated(residual, gain.T) * len(residual) / freedom
        excess = float(coloured[0, 0] / max(1e-300, covariance[0, 0]))
        slow, taken = slow_noise(columns_, residual, gain, variance)
        covariance = coloured + (taken * slow) @ taken.T
    return NoiseCovariance(covariance + _converter(whole, residual, gain, fitted), white, excess)


def fit_covariance(solution: OutputErrorFit, whole: BlockMeans) -> FitCovariance:
    """Return the covariance of a fit's parameters from the residual at every sample.

    It contains the noise of the residual (`noise_covariance`) and the prior knowledge of the fit.
    """
    problem = solution.problem
    linear_part, answered = columns(problem, solution.vector, whole)
    jacobian = np.concatenate([slopes(problem, solution.vector, solution.linear, answered), linear_part], axis=1)
    fitted = np.asarray(linear_part @ solution.linear)
    residual = whole.value - fitted
    freedom = max(1, len(residual) - jacobian.shape[1])
    variance = float(residual @ residual) / freedom
    scale = np.sqrt(np.einsum("nk,nk->k", jacobian, jacobian))
    scale[scale == 0] = 1.0
    scaled = jacobian / scale
    prior = _prior_normal(solution, scale, scaled.T @ scaled, variance)
    inverse = np.linalg.pinv(scaled.T @ scaled + prior * variance, rcond=1e-14, hermitian=True)
    noise = noise_covariance(scaled, inverse @ scaled.T, whole, fitted)
    middle = noise.covariance + inverse @ (prior * variance**2) @ inverse
    covariance = middle / np.outer(scale, scale)
    u_onset_s = u_release_s = 0.0
    if problem.load.timed:
        order, rows = problem.structure.order, np.zeros((2, len(covariance)))
        rows[0, order] = 1.0
        if problem.load.lasting:
            lengths = slice(order + 1, len(solution.vector), 2)
            rows[:, lengths] = np.array([[-0.5], [1.0]]) * np.exp(solution.vector[lengths])
        u_onset_s, u_release_s = (float(u) for u in np.sqrt(np.diag(rows @ covariance @ rows.T)))
    slope = model_slopes(problem.structure, solution.vector, solution.linear)
    of_model = slope @ covariance @ slope.T
    return FitCovariance(of_model, u_onset_s, u_release_s, fitted, residual, noise.white, noise.excess)


def modal_model(solution: OutputErrorFit, covariance: FloatArray, u_amplitude: float) -> ModalModel:
    """Return a fit as a modal model; residues include the load's relative uncertainty."""
    structure = solution.problem.structure
    poles, m = structure.poles(solution.vector), structure.modes
    residues = structure.shares(solution.vector) @ solution.linear[1:]
    omega = np.abs(poles[:m])
    hz = -poles[m:].real / (2 * np.pi)
    common = np.concatenate([np.zeros(2 * m), residues[:m].real, residues[:m].imag, 0 * hz, residues[m:].real])
    total = covariance + u_amplitude**2 * np.outer(common, common)
    damping = -poles[:m].real / omega
    return ModalModel(omega / (2 * np.pi), damping, residues[:m], hz, residues[m:].real, 0.5 * (total + total.T))


def _prior_normal(solution: OutputErrorFit, scale: FloatArray, normal: FloatArray, variance: float) -> FloatArray:
    """Return the prior as the scaled normal matrix of unit variance.

    The prior of the onset is that of the fit. The priors of real poles and of the release's length only guided the fit.
    Each of the squares 1/a² and T²/12 is positive and at most their sum, which the record determines well even if it
    does not separate them.
    """
    problem, structure = solution.problem, solution.problem.structure
    added, squares = np.zeros(len(scale)), np.zeros(len(scale))
    if problem.load.timed:
        added[structure.order] = 1.0 / (problem.u_prior[structure.order] * scale[structure.order]) ** 2
    if problem.chain is not None and structure.reals:
        place = 2 * structure.modes
        added[place] = 1.0 / (problem.chain[1] * scale[place]) ** 2
    real = slice(2 * structure.modes, structure.order)
    squares[real] = -2.0 * np.exp(-2.0 * solution.vector[real])
    if problem.load.lasting:
        moment = MOMENTS.get(problem.load.shape, MOMENTS["ramp"])
        squares[len(solution.vector) - 1] = 2.0 * moment * np.exp(2.0 * solution.vector[-1])
    squares = squares / scale
    parts = np.flatnonzero(squares)
    if len(parts) > 1:
        free = variance * np.asarray(np.linalg.pinv(normal + np.diag(added * variance), rcond=1e-14, hermitian=True))
        spread_s2 = np.sqrt(max(0.0, float(squares @ free @ squares)))
        largest = 0.5 * float(np.sum(np.abs(squares * scale))) + 2.0 * spread_s2
        added[parts] += 3.0 * (squares[parts] / largest) ** 2
    return np.diag(added)


def _correlated(residual: FloatArray, columns_: FloatArray) -> FloatArray:
    """Return R·columns (N, K), R of the residual (N,) through a Parzen window."""
    count = len(residual)
    size = 2 ** int(np.ceil(np.log2(2 * count)))
    correlation = np.fft.irfft(np.abs(np.fft.rfft(residual, size)) ** 2)[:count] / count
    x = np.arange(count) / max(TESTED_LAGS, count // _LAGS)
    window = np.where(x <= 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * np.maximum(0.0, 1 - x) ** 3)
    windowed = correlation * window
    density = np.fft.rfft(np.concatenate([windowed, np.zeros(size - 2 * count + 1), windowed[:0:-1]]))
    spectrum = np.fft.rfft(columns_, size, axis=0)
    return np.asarray(np.fft.irfft(density[:, None] * spectrum, size, axis=0)[:count])


def _converter(whole: BlockMeans, residual: FloatArray, gain: FloatArray, fitted: FloatArray) -> FloatArray:
    """Return the covariance (K, K) that a converter's rounding adds through both levels.

    Gaussian noise of σ leaves q/π·exp(-2π²σ²/q²) of the rounding's error of a steady level, with the step q of the
    converter.
    """
    steps = np.diff(np.unique(whole.value))
    q = float(steps.min()) if steps.size else 0.0
    noise = max(0.0, float(np.var(residual)) - q**2 / 12.0)
    error = q / np.sqrt(12.0) * np.exp(-2.0 * np.pi**2 * noise / q**2) if q > 0 else 0.0
    late = (fitted - fitted[0]) * (fitted[-1] - fitted[0]) > 0.5 * (fitted[-1] - fitted[0]) ** 2
    levels = np.stack([gain @ late.astype(float), gain @ (~late).astype(float)], axis=1)
    return np.asarray(error**2 * levels @ levels.T)


def model_slopes(structure: PoleStructure, vector: FloatArray, linear: FloatArray) -> FloatArray:
    """Return derivatives (P, K + 1 + terms) of a model by the fit's parameters."""
    m, n, count = structure.modes, structure.order, len(vector)
    shares, by_vector = structure.shares(vector), structure.share_slopes(vector)
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
