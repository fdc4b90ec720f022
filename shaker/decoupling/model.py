"""Several outputs and loads with common poles: the model, its state space, its linear parameters by projection.

Least squares with many linear and few other parameters: the linear ones are projected out.

Golub and Pereyra, Separable nonlinear least squares, Inverse Problems 19 (2003) R1, with Kaufman's Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, IntArray, check_shape
from shaker.lti.modal import ModalModel

# A system with several outputs and several loads as a sum of modes that all its elements share.


@dataclass(frozen=True)
class ModelParts:
    """Numbers in the places of a model's parameters: modes (M,) and residues (M, C, D), real poles (Q,), (Q, C, D)."""

    frequency_hz: FloatArray
    damping_ratio: FloatArray
    residue: ComplexArray
    real_hz: FloatArray
    real_residue: FloatArray


@dataclass(frozen=True)
class MultiModel:
    """H(s) = Σ_m [R_m/(s - p_m) + R̄_m/(s - p̄_m)] + Σ_q R_q/(s - p_q), outputs `channels` (C,) over loads (D,).

    Poles are common to all elements: p_m = -ζω + jω√(1 - ζ²), ω = 2π·`frequency_hz` (M,), ζ = `damping_ratio` (M,);
    p_q = -2π·`real_hz` (Q,). Residue matrices `residue` (M, C, D) complex, `real_residue` (Q, C, D), in `unit` per N or
    N·m and second. `covariance` (P, P), P = (2M + Q)(1 + CD), of `vector` = [frequency_hz, damping_ratio, real_hz, then
    for load after load and in it output after output: Re residue (M), Im residue (M), real_residue (Q)].
    """

    channels: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    residue: ComplexArray
    real_hz: FloatArray
    real_residue: FloatArray
    covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        modes, reals, shape = len(self.frequency_hz), len(self.real_hz), (len(self.channels), len(self.components))
        check_shape("frequency_hz", self.frequency_hz, (modes,))
        check_shape("damping_ratio", self.damping_ratio, (modes,))
        check_shape("real_hz", self.real_hz, (reals,))
        check_shape("residue", self.residue, (modes, *shape))
        check_shape("real_residue", self.real_residue, (reals, *shape))
        if self.covariance is not None:
            size = self.shared + self.shared * shape[0] * shape[1]
            check_shape("covariance", self.covariance, (size, size))
        if np.any(np.abs(self.damping_ratio) >= 1.0):
            raise ValueError(f"damping_ratio: expected below 1, found {self.damping_ratio.tolist()}")

    @property
    def shared(self) -> int:
        """Number 2M + Q of parameters of the poles, which is also that of each element."""
        return 2 * len(self.frequency_hz) + len(self.real_hz)

    @property
    def vector(self) -> FloatArray:
        """All parameters (P,) in the order of `covariance`."""
        own = np.concatenate([self.residue.real, self.residue.imag, self.real_residue])
        return np.concatenate(
            [self.frequency_hz, self.damping_ratio, self.real_hz, np.transpose(own, (2, 1, 0)).ravel()]
        )

    def parts(self, vector: FloatArray) -> ModelParts:
        """Return numbers in the order of `vector`, such as standard uncertainties, in the places of the parameters."""
        modes, reals = len(self.frequency_hz), len(self.real_hz)
        f, z, hz, own = np.split(np.asarray(vector), np.cumsum([modes, modes, reals]))
        table = own.reshape(len(self.components), len(self.channels), self.shared).transpose(2, 1, 0)
        re, im, real = np.split(table, [modes, 2 * modes])
        return ModelParts(f, z, re + 1j * im, hz, real.copy())

    def with_vector(self, vector: FloatArray) -> MultiModel:
        """Return the model of another vector (P,), with the same covariance."""
        return replace(self, **vars(self.parts(vector)))

    @property
    def poles(self) -> ComplexArray:
        """Poles in rad/s: the upper ones of the modes (M,), then the real ones (Q,)."""
        omega, zeta = 2 * np.pi * self.frequency_hz, self.damping_ratio
        return np.concatenate([omega * (-zeta + 1j * np.sqrt(1 - zeta**2)), -2 * np.pi * self.real_hz + 0j])

    @property
    def stable(self) -> bool:
        """Whether every pole decays."""
        return bool(np.all(self.poles.real < 0))

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return H (K, C, D) at frequencies (K,) in Hz."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None]
        upper, real = np.split(self.poles, [len(self.frequency_hz)])
        parts = (1 / (s - upper), self.residue), (1 / (s - upper.conj()), self.residue.conj())
        found = sum(np.einsum("km,mcd->kcd", basis, residue) for basis, residue in parts)
        return np.asarray(found + np.einsum("kq,qcd->kcd", 1 / (s - real), self.real_residue))

    @property
    def static_gain(self) -> FloatArray:
        """H(0) (C, D), the static sensitivity matrix."""
        return np.asarray(self.response(np.zeros(1))[0].real)

    def step(self, time_s: FloatArray) -> FloatArray:
        """Return the responses (N, C, D) to a unit step of each load at t = 0: Σ R/p·(exp(pt) - 1), zero before."""
        t = np.maximum(np.asarray(time_s, dtype=np.float64), 0.0)[:, None]
        upper, real = np.split(self.poles, [len(self.frequency_hz)])
        swing = 2.0 * np.real(np.einsum("nm,mcd->ncd", np.expm1(upper * t) / upper, self.residue))
        return np.asarray(swing + np.einsum("nq,qcd->ncd", np.expm1(real.real * t) / real.real, self.real_residue))

    def element(self, channel: str, component: str) -> ModalModel:
        """Return one output over one load, with its covariance."""
        c, d = self.channels.index(channel), self.components.index(component)
        covariance = None
        if self.covariance is not None:
            m, n = len(self.frequency_hz), self.shared
            own = n + n * (d * len(self.channels) + c) + np.arange(n)
            places = np.concatenate([np.arange(2 * m), own[: 2 * m], np.arange(2 * m, n), own[2 * m :]])
            covariance = self.covariance[np.ix_(places, places)]
        return ModalModel(
            self.frequency_hz,
            self.damping_ratio,
            self.residue[:, c, d],
            self.real_hz,
            self.real_residue[:, c, d],
            covariance,
        )

    @property
    def u(self) -> ModelParts:
        """Standard uncertainties of all parameters in their places, of Re and Im of a residue each."""
        if self.covariance is None:
            raise ValueError("covariance: expected that of the parameters, found none")
        return self.parts(np.sqrt(np.diag(self.covariance)))

    def column_sensitivity(self, component: int, frequency_hz: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Return ∂H_{·j}/∂parameters (K, C, P_j) of a load's column, and the covariance (P_j, P_j) of these.

        P_j = (2M + Q)(1 + C): poles, then the residues of every output; the response is analytic in all of them.
        """
        if self.covariance is None:
            raise ValueError("covariance: expected that of the parameters, found none")
        n, outputs = self.shared, len(self.channels)
        m = len(self.frequency_hz)
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None]
        upper, real = np.split(self.poles, [m])
        above, below = 1 / (s - upper), 1 / (s - upper.conj())
        basis = np.concatenate([above + below, 1j * (above - below), 1 / (s - real)], axis=1)
        found = np.zeros((len(s), outputs, n * (1 + outputs)), dtype=np.complex128)
        r, rq = self.residue[:, :, component].T, self.real_residue[:, :, component].T
        for k, slope in enumerate(pole_slopes(self.frequency_hz, self.damping_ratio)):
            found[:, :, k * m : (k + 1) * m] = (
                r * slope * above[:, None] ** 2 + r.conj() * slope.conj() * below[:, None] ** 2
            )
        found[:, :, 2 * m : n] = -2 * np.pi * rq * (1 / (s - real))[:, None] ** 2
        for c in range(outputs):
            found[:, c, n * (1 + c) : n * (2 + c)] = basis
        own = n + n * outputs * component + np.arange(n * outputs)
        places = np.concatenate([np.arange(n), own])
        return found, np.asarray(self.covariance[np.ix_(places, places)])


def pole_slopes(frequency_hz: FloatArray, damping_ratio: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return ∂p/∂frequency_hz (M,) and ∂p/∂ζ (M,) of the upper poles p = ω(-ζ + j√(1 - ζ²))."""
    root = np.sqrt(1 - damping_ratio**2)
    by_frequency = 2 * np.pi * (-damping_ratio + 1j * root)
    by_damping = 2 * np.pi * frequency_hz * (-1.0 - 1j * damping_ratio / root)
    return np.asarray(by_frequency), np.asarray(by_damping)


# A sum of modes at the samples' times, for loads that go straight from sample to sample.


_NO_SHAPE = 1e-9


@dataclass(frozen=True)
class StateSpace:
    """x[n+1] = a·x[n] + b·u[n], y[n] = c·x[n] + d·u[n]."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray


def sampled_modes(
    poles: ComplexArray, residues: Sequence[ComplexArray | FloatArray], sample_rate_hz: float
) -> StateSpace:
    """Return Σ R/(s - p), conjugates of complex poles with it, poles (P,) in rad/s, residues (C, D) each, sampled.

    Exact for loads that go along straight lines between samples (triangle hold), of which the response at a sample
    depends on the load there: no half sample of delay, unlike with loads that stay. Of each residue matrix as many
    states as its rank, scaled to unit size under white loads.
    """
    outputs, loads = residues[0].shape
    parts = [_pole(pole, residue, 1.0 / sample_rate_hz) for pole, residue in zip(poles, residues, strict=True)]
    size = sum(len(part.a) for part in parts)
    a, b, c = np.zeros((size, size)), np.zeros((size, loads)), np.zeros((outputs, size))
    d, row = np.zeros((outputs, loads)), 0
    for part in parts:
        here = slice(row, row + len(part.a))
        a[here, here], b[here], c[:, here] = part.a, part.b, part.c
        d += part.d
        row = here.stop
    return StateSpace(a, b, c, d)


def _pole(pole: complex, residue: ComplexArray | FloatArray, step_s: float) -> StateSpace:
    """One pole, a complex one with its conjugate.

    ξ[n+1] = E ξ[n] + (α + Eβ) g[n], answer ξ + βg: E = e^x, x = pΔ, α + β = Δ(E - 1)/x, β = Δ(E - 1 - x)/x².
    """
    left, size, right = np.linalg.svd(residue, full_matrices=False)
    rank = max(1, int(np.count_nonzero(size > _NO_SHAPE * size[0])))
    x = pole * step_s
    turn, beta = np.exp(x), step_s * (np.expm1(x) - x) / x**2
    alpha = step_s * np.expm1(x) / x - beta
    drive = (alpha + turn * beta) * right[:rank]
    shown = left[:, :rank] * size[:rank]
    spread = np.linalg.norm(drive, axis=1) / np.sqrt(max(1e-12, 1.0 - abs(turn) ** 2))
    drive, seen = drive / spread[:, None], shown * spread
    direct = (shown * beta) @ right[:rank]
    if pole.imag == 0.0:
        return StateSpace(turn.real * np.eye(rank), drive.real, seen.real, direct.real)
    unit = np.eye(rank)
    a = np.block([[turn.real * unit, -turn.imag * unit], [turn.imag * unit, turn.real * unit]])
    b = np.concatenate([drive.real, drive.imag])
    return StateSpace(a, b, np.concatenate([2 * seen.real, -2 * seen.imag], axis=1), 2 * direct.real)


# Least squares with many linear and few other parameters: the linear ones are projected out.


_RANK = 1e-11
_CALM = 1e-9
_SETTLED = 1e-2
_DAMPINGS = 8
_LEAST_DAMPING = 1e-7


@dataclass(frozen=True)
class Slope:
    """∂design/∂parameter `place`: `value` (R, b) at the rows `rows` and the columns `columns` (b,) of a design."""

    place: int
    rows: slice
    columns: IntArray
    value: FloatArray


@dataclass(frozen=True)
class Block:
    """Rows `design` (N, B) that explain `data` (N, C) of unit variance by coefficients of their own, and its slopes."""

    design: FloatArray
    data: FloatArray
    slopes: tuple[Slope, ...]


@dataclass(frozen=True)
class Projected:
    """A problem linearised at one point: coefficients (B, C) and residuals (N, C) of every block, the sum of squares
    `loss`, and the normal equations `normal` (P, P), `gradient` (P,) of the parameters that are not linear."""

    coefficients: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    loss: float
    normal: FloatArray
    gradient: FloatArray


@dataclass(frozen=True)
class Solution:
    """Where the search ended: parameters, the problem there, the loss of every step, whether it came to rest."""

    parameters: FloatArray
    blocks: tuple[Block, ...]
    projected: Projected
    losses: tuple[float, ...]
    converged: bool


def project(blocks: Sequence[Block], count: int) -> Projected:
    """Return coefficients, residuals and normal equations of blocks that share `count` other parameters."""
    normal, gradient = np.zeros((count, count)), np.zeros(count)
    coefficients, residuals = [], []
    for block in blocks:
        basis, triangle = np.linalg.qr(block.design)
        along = basis.T @ block.data
        own = _solved(triangle, along)
        rest = block.data - block.design @ own
        if block.slopes:
            places, change = _changes(block, own)
            inside = np.einsum("nb,pnc->pbc", basis, change, optimize=True)
            table, kept = change.reshape(len(change), -1), inside.reshape(len(change), -1)
            normal[np.ix_(places, places)] += table @ table.T - kept @ kept.T
            gradient[places] += table @ rest.ravel()
        coefficients.append(own)
        residuals.append(rest)
    loss = float(sum(np.vdot(rest, rest) for rest in residuals))
    return Projected(tuple(coefficients), tuple(residuals), loss, normal, gradient)


def minimise(
    blocks_at: Callable[[FloatArray], Sequence[Block] | None],
    start: FloatArray,
    scale: FloatArray,
    steps: int = 40,
    calm: float = _SETTLED,
) -> Solution:
    """Return the least squares parameters by Levenberg and Marquardt's steps.

    `blocks_at` gives the blocks of parameters (P,), None where these are not allowed; `scale` (P,): size of a change
    that matters, which also damps parameters that the data do not tell. The search ends where a step lowers the sum of
    squares, in units of the data's variance, by less than `calm`.
    """
    place, damping, losses = np.asarray(start, dtype=np.float64), 1e-3, []
    blocks = blocks_at(place)
    if blocks is None:
        raise ValueError(f"start: expected allowed parameters, found {place.tolist()}")
    here, converged = project(blocks, len(place)), False
    for _ in range(steps):
        losses.append(here.loss)
        found, promised = None, 0.0
        for _ in range(_DAMPINGS):
            step = _step(here, damping, scale)
            promised = float(step @ (2.0 * here.gradient - here.normal @ step))
            if promised < calm:
                break
            found = _tried(blocks_at, place + step, here)
            if found is not None:
                break
            damping *= 10.0
        if found is None:
            converged = True
            break
        gained = here.loss - found[1].loss
        place, (blocks, here) = place + step, found
        damping = max(damping / 10.0, _LEAST_DAMPING)
        if gained < max(_CALM * here.loss, calm):
            converged = True
            break
    return Solution(place, tuple(blocks), here, (*losses, here.loss), converged)


def _step(here: Projected, damping: float, scale: FloatArray) -> FloatArray:
    """One damped step."""
    weight = np.maximum(np.diag(here.normal), 1.0 / scale**2)
    return np.asarray(np.linalg.solve(here.normal + damping * np.diag(weight), here.gradient))


def _tried(
    blocks_at: Callable[[FloatArray], Sequence[Block] | None], place: FloatArray, here: Projected
) -> tuple[Sequence[Block], Projected] | None:
    """The problem at another place, None where that is not allowed or no better."""
    blocks = blocks_at(place)
    if blocks is None:
        return None
    there = project(blocks, len(place))
    return (blocks, there) if there.loss <= here.loss else None


def _solved(triangle: FloatArray, right: FloatArray) -> FloatArray:
    """Solve a triangular system whose columns may depend on one another."""
    diagonal = np.abs(np.diag(triangle))
    if diagonal.min() > _RANK * diagonal.max():
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(triangle, right))
    return np.asarray(np.linalg.lstsq(triangle, right, rcond=_RANK)[0])


def _changes(block: Block, own: FloatArray) -> tuple[IntArray, FloatArray]:
    """Parameters of a block (p,) and how its rows change with each (p, N, C)."""
    places = np.unique([slope.place for slope in block.slopes]).astype(np.int64)
    found = np.zeros((len(places), *block.data.shape))
    for slope in block.slopes:
        found[np.searchsorted(places, slope.place), slope.rows] += slope.value @ own[slope.columns]
    return places, found


def covariances(solution: Solution, variances: Sequence[FloatArray]) -> tuple[FloatArray, list[list[FloatArray]]]:
    """Return the covariance (P, P) of the parameters, and for every block and column how its coefficients follow them.

    `variances`: of the columns (C,) of every block, in units of the weights. Element [i][c] (B, P + B): change of the
    coefficients with the parameters, beside a square root of their covariance where the parameters are known.
    """
    projected, count = solution.projected, len(solution.parameters)
    spread = np.zeros((count, count))
    unit = 1.0 / np.sqrt(np.maximum(np.diag(projected.normal), 1e-300))
    unit[np.diag(projected.normal) <= 0.0] = 0.0
    inverse = np.linalg.pinv(projected.normal * np.outer(unit, unit), rcond=1e-13, hermitian=True) * np.outer(
        unit, unit
    )
    follows: list[list[FloatArray]] = []
    for block, own, variance in zip(solution.blocks, projected.coefficients, variances, strict=True):
        basis, triangle = np.linalg.qr(block.design)
        root = _solved(triangle, np.eye(len(triangle)))
        places, change = _changes(block, own)
        rows = []
        for c, size in enumerate(variance):
            along = basis.T @ change[:, :, c].T
            free = change[:, :, c].T - basis @ along
            spread[np.ix_(places, places)] += size * (free.T @ free)
            follow = np.zeros((len(own), count))
            follow[:, places] = -root @ along
            rows.append(np.concatenate([follow, np.sqrt(size) * root], axis=1))
        follows.append(rows)
    return inverse @ spread @ inverse, follows
