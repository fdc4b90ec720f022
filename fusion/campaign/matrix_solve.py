"""Rows of the 6 x 6 matrix from several recordings, rank of the excitations, maximum likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular

from fusion.campaign.repeats import LOADS, Drive
from fusion.estimation.uncertainty import Influence, Uncertainty, as_complex, real_design, real_stack
from fusion.estimation.variance_components import EstimatedNoise
from shaker.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from shaker.labels import LOAD_COMPONENTS

# Loads and outputs of several drives in units of their own size, with everything that makes them uncertain.


SLOPE = 1.0
"""Standard uncertainty of dln S/dln f: what is not known of a sensor below a third of its resonance."""
SAME_LINE = 1e-7
"""Relative difference of frequencies that changes no sensitivity."""
LINES_APART = "lines apart"


@dataclass(frozen=True)
class Stack:
    """R drives at one frequency, loads in units of `load_size` (6,), outputs of `output_size` (C,).

    `load` (R, 6), `output` (R, C) with NaN where there is no reading; `load_noise`, `output_noise`: what is each
    drive's own, by drive; `unknowns` (E): what drives share or load and outputs share, with its change of the loads for
    one standard uncertainty `load_effect` (E, R, 6), and of the outputs relative to them `output_effect` (E, R, C).
    """

    drives: tuple[Drive, ...]
    channels: tuple[str, ...]
    load_size: FloatArray
    output_size: FloatArray
    load: ComplexArray
    output: ComplexArray
    load_noise: tuple[Uncertainty, ...]
    output_noise: tuple[Uncertainty, ...]
    unknowns: tuple[Influence, ...]
    load_effect: ComplexArray
    output_effect: ComplexArray

    @property
    def frequency_hz(self) -> float:
        """Return the mean frequency of the drives."""
        return float(np.mean([drive.frequency_hz for drive in self.drives]))

    @property
    def usable(self) -> BoolArray:
        """Return which outputs (R, C) have a reading."""
        return np.isfinite(self.output)

    @property
    def own_load_covariance(self) -> FloatArray:
        """Return the covariance (R, 12, 12) of every drive's load without what drives share."""
        return np.concatenate([noise.covariance for noise in self.load_noise])

    def load_covariance(self) -> FloatArray:
        """Return the whole covariance (R, 12, 12) of every drive's load, common errors included."""
        effect = real_stack(self.load_effect)
        return np.asarray(self.own_load_covariance + np.einsum("eri,erj->rij", effect, effect))


def stack_drives(drives: Sequence[Drive], channels: Sequence[str]) -> Stack:
    """Return drives as one stack, their outputs in the order of `channels`; a channel not recorded has no reading.

    Each component of the load is measured in its largest among the drives, each output likewise.
    """
    if not drives:
        raise ValueError("drives: expected at least one, found none")
    wanted = tuple(channels)
    load = np.stack([drive.load for drive in drives])
    output = np.array([[drive.output(channel) for channel in wanted] for drive in drives], dtype=np.complex128)
    load_size, output_size = _size(load), _size(output)
    output = output / output_size
    sized = [
        (
            of_load.scaled(np.asarray((1.0 / load_size)[None], dtype=np.complex128)),
            _outputs_in_order(of_outputs, drive, wanted, output_size),
        )
        for drive, (of_load, of_outputs) in ((drive, drive.shared()) for drive in drives)
    ]
    known = {influence.name: influence for both in sized for part in both for influence in part.influences}
    load_effect = np.zeros((len(known), len(drives), LOADS), np.complex128)
    output_effect = np.zeros((len(known), len(drives), len(wanted)), np.complex128)
    place = {name: number for number, name in enumerate(known)}
    for row, (of_load, of_outputs) in enumerate(sized):
        for influence in of_load.influences:
            load_effect[place[influence.name], row] = as_complex(influence.effect[0])
        # Relative to the output, zero where there is none.
        usable = np.isfinite(output[row]) & (output[row] != 0.0)
        for influence in of_outputs.influences:
            change, relative = as_complex(influence.effect[0]), np.zeros(len(wanted), np.complex128)
            output_effect[place[influence.name], row] = np.divide(change, output[row], out=relative, where=usable)
    stack = Stack(
        drives=tuple(drives),
        channels=wanted,
        load_size=load_size,
        output_size=output_size,
        load=load / load_size,
        output=output,
        load_noise=tuple(Uncertainty(of_load.random) for of_load, _ in sized),
        output_noise=tuple(Uncertainty(of_outputs.random) for _, of_outputs in sized),
        unknowns=tuple(known.values()),
        load_effect=load_effect,
        output_effect=output_effect,
    )
    return _with_slopes(stack)


def _size(values: ComplexArray) -> FloatArray:
    """Largest magnitude of each column, 1 where there is none."""
    largest = np.max(np.where(np.isfinite(values), np.abs(values), 0.0), axis=0)
    return np.where(largest > 0.0, largest, 1.0)


def _outputs_in_order(
    uncertainty: Uncertainty, drive: Drive, channels: tuple[str, ...], size: FloatArray
) -> Uncertainty:
    """Uncertainty of the outputs by the names wanted, in units of their size; zero where there is no reading."""
    have, want = len(drive.channels), len(channels)
    matrix = np.zeros((2 * want, 2 * have))
    for row, channel in enumerate(channels):
        if np.isfinite(drive.output(channel)):
            column = drive.channels.index(channel)
            matrix[row, column] = matrix[row + want, column + have] = 1.0 / size[row]
    return uncertainty.where_known().transformed(matrix[None])


def _with_slopes(stack: Stack) -> Stack:
    """Stack with one complex unknown per channel more: how its sensitivity changes over lines that lie side by side.

    An output at f is that at the mean f₀ times 1 + s·ln(f/f₀); s has the standard uncertainty `SLOPE` in real and in
    imaginary part, so that lines apart cost what they must, and lines of one frequency nothing.
    """
    away = np.log(np.array([drive.frequency_hz for drive in stack.drives]) / stack.frequency_hz)
    if np.ptp(away) <= SAME_LINE:
        return stack
    unknowns, effects = [], []
    for place, channel in enumerate(stack.channels):
        for part, turn in (("in phase", 1.0), ("out of phase", 1.0j)):
            effect = np.zeros(stack.output.shape, np.complex128)
            effect[:, place] = SLOPE * turn * away
            effects.append(effect)
            name = f"change of {channel} with frequency at {stack.frequency_hz:.6g} Hz, {part}"
            unknowns.append(Influence(name, LINES_APART, SLOPE, "", np.zeros((1, 2)), "rig"))
    none = np.zeros((len(unknowns), *stack.load.shape), np.complex128)
    return replace(
        stack,
        unknowns=(*stack.unknowns, *unknowns),
        load_effect=np.concatenate([stack.load_effect, none]),
        output_effect=np.concatenate([stack.output_effect, effects]),
    )


# Whether recordings excite all six components of the load, and what is missing where they do not.


LEAST_SINGULAR = 10.0
"""Least size of an excitation in its standard uncertainties: its elements of the matrix are then known to 10 %."""
LEAST_SHARE = 1e-3
"""Least size of an excitation beside the largest, every component in units of its largest load."""
MEMBER = 0.05
"""Share of a missing direction above which a component takes part in it."""
TOGETHER = 0.1
"""Correlation in the missing directions above which components are told together."""
FLOOR = 1e-9
"""Standard uncertainty, relative to a load's size, below which no load is known."""

HOW = {
    "Fx": "a recording driven along x",
    "Fy": "a recording driven along y",
    "Fz": "a recording driven along z",
    "Mx": "a recording with a moment about x (force along z off the axis in y, or along y at another height)",
    "My": "a recording with a moment about y (force along z off the axis in x, or along x at another height)",
    "Mz": "a recording with a moment about z (force along x or y off the axis)",
}


class MissingExcitationError(ValueError):
    """The recordings do not excite six independent loads: `missing` names the components, alone or together."""

    def __init__(self, text: str, missing: tuple[tuple[str, ...], ...]) -> None:
        super().__init__(text)
        self.missing = missing


@dataclass(frozen=True)
class Excitation:
    """How strongly R drives excite six independent loads.

    `singular` (6,): of the loads whitened by their covariance, largest first: amplitude of an independent load in its
    standard uncertainties; `share` (6,): singular values of the loads, every component in units of its own size,
    relative to the largest. `missing`: components that are not excited, alone or only in fixed proportion.
    """

    singular: FloatArray
    share: FloatArray
    missing: tuple[tuple[str, ...], ...]

    @property
    def determines(self) -> bool:
        """Return whether all six columns of a matrix can be determined."""
        return not self.missing


def excitation(stack: Stack, drives: Sequence[int] | NDArray[np.int64] | None = None) -> Excitation:
    """Return how strongly some of the drives (all by default) excite six independent loads.

    With w_r the loads and Γ_r their complex covariances, the whitened singular values are the roots of
    vᴴ(Σ w̄_r w_rᵀ)v / vᴴ(Σ Γ̄_r)v at its extremes, a generalised eigenvalue problem: a direction v that is not excited
    has 1 or less. A direction counts as excited where vᴴ(Σ w̄_r w_rᵀ)v exceeds the squares of both `LEAST_SINGULAR`
    standard uncertainties and `LEAST_SHARE` of the largest excitation; the others are the negative eigenspace of the
    difference.
    """
    chosen = np.arange(len(stack.load)) if drives is None else np.asarray(drives, dtype=np.int64)
    return _excitation(stack.load[chosen], np.sum(stack.load_covariance()[chosen], axis=0))


def drives_excite(drives: Sequence[Drive]) -> Excitation:
    """Return `excitation` of drives that are not stacked yet, which takes no table of all unknowns by all drives."""
    size = np.tile(_size(np.stack([drive.load for drive in drives])), 2)
    covariance = np.sum([drive.load_uncertainty.covariance[0] for drive in drives], axis=0)
    load = np.stack([drive.load for drive in drives]) / size[:LOADS]
    return _excitation(load, covariance / np.outer(size, size))


def _excitation(load: ComplexArray, both: FloatArray) -> Excitation:
    """How strongly loads (R, 6) with the sum of their covariances (12, 12) excite six independent ones."""
    from scipy.linalg import eigh

    signal = load.conj().T @ load
    # E[n nᴴ] of complex errors from their covariances of [Re, Im].
    re, im, mixed = both[:LOADS, :LOADS], both[LOADS:, LOADS:], both[LOADS:, :LOADS]
    noise = (re + im + 1j * (mixed - mixed.T)).conj()
    # Components in units of what is there of them, load or uncertainty, so that none is large or small by itself.
    size = np.sqrt(np.diag(signal).real + np.diag(noise).real)
    size = np.where(size > 0.0, size, 1.0)
    signal, noise = signal / np.outer(size, size), noise / np.outer(size, size) + FLOOR**2 * np.eye(LOADS)
    singular = np.sqrt(np.maximum(eigh(signal, noise, eigvals_only=True), 0.0))[::-1]
    share = np.sqrt(np.maximum(np.linalg.eigvalsh(signal), 0.0))[::-1]
    least = LEAST_SINGULAR**2 * noise + (LEAST_SHARE * share[0]) ** 2 * np.eye(LOADS)
    values, vectors = np.linalg.eigh(signal - least)
    lacking = vectors[:, values < 0.0]
    missing = _missing(np.asarray(lacking @ lacking.conj().T))
    return Excitation(singular, share / (share[0] if share[0] > 0.0 else 1.0), missing)


def require_six(found: Excitation, drives: int) -> None:
    """Raise `MissingExcitationError` unless the drives excite six independent loads, saying what to add."""
    if found.determines:
        return
    told, wanted = [], []
    for group in found.missing:
        listed = f"{', '.join(group[:-1])} and {group[-1]}"
        alone = len(group) == 1
        told.append(group[0] if alone else f"{listed} other than together")
        wanted.append(HOW[group[-1]] + ("" if alone else f", so that {listed} are in another proportion"))
    text = f"expected loads in six independent directions, found {drives} that do not excite {', nor '.join(told)}"
    raise MissingExcitationError(f"drives: {text}; add {'; '.join(wanted)}", found.missing)


def _missing(projector: ComplexArray) -> tuple[tuple[str, ...], ...]:
    """Components of the missing directions: each alone, or those that occur in fixed proportion together."""
    size = np.diag(projector).real
    members = [j for j in range(LOADS) if size[j] > MEMBER]
    groups: list[list[int]] = []
    for j in members:
        joined = [g for g in groups if any(abs(projector[j, i]) > TOGETHER * np.sqrt(size[i] * size[j]) for i in g)]
        groups = [g for g in groups if g not in joined] + [sorted([j, *(i for g in joined for i in g)])]
    missing: list[tuple[str, ...]] = []
    for group in groups:
        names = tuple(LOAD_COMPONENTS[j] for j in group)
        whole = round(float(np.sum(size[group]))) >= len(group)
        missing += [(name,) for name in names] if whole else [names]
    return tuple(sorted(missing, key=lambda group: (len(group), LOAD_COMPONENTS.index(group[0]))))


# Maximum likelihood of a matrix from loads and outputs that both err, with unknowns they share.


ITERATIONS = 100
CONVERGED = 1e-7
"""Largest step, in standard uncertainties, at which the iteration ends."""
NOISE_FLOOR = 1e-4
"""Smallest noise of a reading relative to the common errors in it: invisible in U, and sums keep their digits."""
DIGITS = 1e-10


@dataclass(frozen=True)
class Solution:
    """Matrix, loads and unknowns that fit a stack best, in its units.

    `matrix` (C, 6), `load` (R, 6), `errors` (E,) in standard uncertainties. Of the N usable real readings, drive by
    drive: `drive` (N,), `residual` (N,) of the outputs at the measured loads, `effects` (N, E), `noise` (N, N), `gain`
    (12C, N) from readings to [Re, Im] of the matrix, `through` (R, 2C, 12) from the loads to the readings, `projector`
    (N, N) with `chi2` = residualᵀ · projector · residual, of `dof` degrees of freedom; `step`: the last one, in
    standard uncertainties of the elements.
    """

    matrix: ComplexArray
    load: ComplexArray
    errors: FloatArray
    drive: IntArray
    residual: FloatArray
    effects: FloatArray
    noise: FloatArray
    gain: FloatArray
    through: FloatArray
    projector: FloatArray
    step: float
    chi2: float
    dof: int


@dataclass(frozen=True)
class _Point:
    """Where the likelihood is linearised: matrix (C, 6), loads (R, 6), errors (E,)."""

    matrix: ComplexArray
    load: ComplexArray
    errors: FloatArray


@dataclass(frozen=True)
class _Linear:
    """The model about a point, all drives: changes of the outputs.

    `residual` (R, 2C), `design` (R, 2C, 12C) for the matrix, `through` (R, 2C, 12) for the loads, `effects` (R, 2C, E)
    for the unknowns; `load_step` (R, 12, 12) from errors of the readings of the loads to the loads themselves.
    """

    residual: FloatArray
    design: FloatArray
    through: FloatArray
    effects: FloatArray
    load_effect: FloatArray
    load_step: FloatArray


def solve(stack: Stack, discrepancy: FloatArray | None = None) -> Solution:
    """Return the matrix S, the loads L_r and the unknowns e of greatest likelihood.

    Readings are l_r = L_r + E_r(L_r)·e + noise and y_r = (1 + Σ_k ρ_rk·e_k) ∘ (S·L_r) + noise, e with unit priors, E_r
    following the size of the fitted load and ρ relative, so that no reading that happens to be low gains weight by its
    common error (D'Agostini 1994, Nucl. Instrum. Methods A 346, 306). Gauss-Newton over S, L and e, in which L and e
    are eliminated: generalised least squares with the effective covariance of y - S·l and the design at the fitted
    loads (York 1969, Earth Planet. Sci. Lett. 5, 320, for a line). `discrepancy` (R, C): further standard deviations
    of the real and the imaginary part of the outputs.
    """
    extra = np.zeros(stack.output.shape) if discrepancy is None else discrepancy
    solution = _step(stack, _start(stack), extra)
    for _ in range(ITERATIONS):
        if solution.step <= CONVERGED:
            return solution
        solution = _step(stack, _Point(solution.matrix, solution.load, solution.errors), extra)
    raise ValueError(f"drives: expected loads that determine a matrix, found none after {ITERATIONS} iterations")


def estimated_noise(stack: Stack, solution: Solution) -> EstimatedNoise:
    """Return how well the noise of loads and outputs is known that a solution's readings were judged by."""
    parts = []
    for r, usable in enumerate(np.tile(stack.usable, (1, 2))):
        for noise, turn in ((stack.output_noise[r], np.eye(len(usable))), (stack.load_noise[r], solution.through[r])):
            own = turn[usable]
            for part in noise.random:
                dof = np.inf if part.dof is None else float(part.dof[0])
                parts.append((np.flatnonzero(solution.drive == r), own @ part.covariance[0] @ own.T, dof))
    return EstimatedNoise.of_parts(parts, len(solution.residual))


def judge(stack: Stack, solution: Solution | None = None) -> Solution:
    """Return one step from a solution, or from the start, with stated uncertainties only: what they say of it.

    Where readings disagree a thousandfold, the greatest likelihood drives the unknowns far beyond where the model is
    linear, and what it says of a single reading is meaningless; one step does not.
    """
    point = _start(stack) if solution is None else _Point(solution.matrix, solution.load, solution.errors)
    return _step(stack, point, np.zeros(stack.output.shape))


def _start(stack: Stack) -> _Point:
    """Matrix by least squares as if the loads were exact."""
    rows = [
        np.linalg.lstsq(stack.load[usable], stack.output[usable, c], rcond=None)[0]
        for c, usable in enumerate(stack.usable.T)
    ]
    return _Point(np.array(rows), stack.load, np.zeros(len(stack.unknowns)))


def _linearise(stack: Stack, point: _Point) -> _Linear:
    """First-order model of all readings about a point."""
    drives, channels = stack.output.shape
    factor = 1.0 + np.einsum("erc,e->rc", stack.output_effect, point.errors)
    plain = point.load @ point.matrix.T
    # The size of a load's common errors follows the fitted load: γ = <l, L>/<l, l>, E(L) = E·γ.
    weight = stack.load.conj() / np.sum(np.abs(stack.load) ** 2, axis=1, keepdims=True)
    size = np.sum(weight * point.load, axis=1)
    shift = np.einsum("erj,e->rj", stack.load_effect, point.errors)
    step = np.linalg.inv(np.eye(LOADS) + shift[:, :, None] * weight[:, None])
    through = factor[:, :, None] * point.matrix @ step
    rows = np.einsum("cd,rc,rj->rcdj", np.eye(channels), factor, point.load)
    output_effect = (stack.output_effect * plain).transpose(1, 2, 0)
    load_effect = stack.load_effect.transpose(1, 2, 0) * size[:, None, None]
    residual = stack.output - factor * plain + output_effect @ point.errors
    residual = residual - (through @ (stack.load - point.load)[..., None])[..., 0]
    effects = output_effect - through @ load_effect
    return _Linear(
        residual=real_stack(residual),
        design=real_design(rows.reshape(drives, channels, -1)),
        through=real_design(through),
        effects=np.concatenate([effects.real, effects.imag], axis=1),
        load_effect=np.concatenate([load_effect.real, load_effect.imag], axis=1),
        load_step=real_design(step),
    )


def _step(stack: Stack, point: _Point, discrepancy: FloatArray) -> Solution:
    """One Gauss-Newton step: generalised least squares for the matrix, then loads and errors from what is left."""
    linear = _linearise(stack, point)
    drives, channels = stack.output.shape
    mask = np.tile(stack.usable, (1, 2))
    residual, design, effects = linear.residual[mask], linear.design[mask], linear.effects[mask]
    noise = _noise(stack, linear, discrepancy, mask)
    # Raised where it is far below the common errors, or below the digits of the readings.
    readings = real_stack(stack.output)[mask]
    floor = (NOISE_FLOOR * np.linalg.norm(effects, axis=1)) ** 2 + (DIGITS * np.max(np.abs(readings))) ** 2
    noise = noise + np.diag(np.maximum(floor - np.diag(noise), 0.0))
    gain, projector, spread = _least_squares(noise, design, effects)
    step = gain @ residual
    left = projector @ residual
    errors = effects.T @ left
    change = as_complex(step).reshape(channels, LOADS)
    full = np.zeros(mask.shape)
    full[mask] = left
    # What is left of a drive's outputs is shared with the noise of its load. Readings at the point,
    # l(L, e) = L + E(L)·e, leave l - l(L, e) - E·(e_new - e) - noise to the step of L.
    own = -stack.own_load_covariance @ linear.through.swapaxes(1, 2) @ full[..., None]
    apart = real_stack(stack.load - point.load) - linear.load_effect @ errors - own[..., 0]
    load = point.load + as_complex((linear.load_step @ apart[..., None])[..., 0])
    return Solution(
        matrix=point.matrix + change,
        load=load,
        errors=errors,
        drive=np.repeat(np.arange(drives), 2 * channels).reshape(mask.shape)[mask],
        residual=residual,
        effects=effects,
        noise=noise,
        gain=gain,
        through=linear.through,
        projector=projector,
        step=float(np.max(np.abs(step) / spread)),
        chi2=float(residual @ left),
        dof=len(residual) - design.shape[1],
    )


def _least_squares(
    noise: FloatArray, design: FloatArray, effects: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gain (P, N), projector (N, N) and standard uncertainties (P,) of least squares with common errors.

    The system [X A; 0 I], whitened by the noise, is equivalent to the covariance noise + A·Aᵀ but keeps its digits;
    more unknowns than readings are turned into as many.
    """
    root = np.linalg.cholesky(noise)
    white = solve_triangular(root, np.column_stack([design, effects]), lower=True)
    count, unknowns = design.shape
    common = white[:, unknowns:]
    if common.shape[1] > count:
        common = np.asarray(np.linalg.qr(common.T, mode="r")).T
    scale = np.linalg.norm(white[:, :unknowns], axis=0)
    total = unknowns + common.shape[1]
    augmented = np.zeros((count + common.shape[1], total))
    augmented[:count, :unknowns], augmented[:count, unknowns:] = white[:, :unknowns] / scale, common
    augmented[count:, unknowns:] = np.eye(common.shape[1])
    q, r = np.linalg.qr(augmented)
    inverse = solve_triangular(r, np.eye(total))
    gain = solve_triangular(root, (inverse[:unknowns] @ q[:count].T).T, lower=True, trans="T").T / scale[:, None]
    half = solve_triangular(root, np.eye(count) - q[:count] @ q[:count].T, lower=True, trans="T")
    projector = solve_triangular(root, half.T, lower=True, trans="T")
    return gain, (projector + projector.T) / 2.0, np.linalg.norm(inverse[:unknowns], axis=1) / scale


def _noise(stack: Stack, linear: _Linear, discrepancy: FloatArray, mask: NDArray[np.bool_]) -> FloatArray:
    """Covariance (N, N) of the residuals without the unknowns: outputs, loads seen through the matrix, discrepancy."""
    outputs = np.concatenate([noise.covariance for noise in stack.output_noise])
    own = outputs + linear.through @ stack.own_load_covariance @ linear.through.swapaxes(1, 2)
    own = own + np.tile(discrepancy**2, 2)[:, :, None] * np.eye(own.shape[1])
    return np.asarray(block_diag(*(own[r][np.ix_(known, known)] for r, known in enumerate(mask))))
