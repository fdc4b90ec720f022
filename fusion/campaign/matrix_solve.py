"""Excitation rank of several recordings, and the 6 x 6 matrix of greatest likelihood."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from fusion.campaign.excited_line import LOADS, ExcitedLine
from fusion.campaign.line_stack import Stack, largest_magnitude
from fusion.estimation.uncertainty import as_complex, real_stack
from fusion.estimation.variance_components import EstimatedNoise
from shaker.labels import LOAD_COMPONENTS
from shaker.sine.phasor import real_stacked
from shakercal._common.arrays import ComplexArray, FloatArray, IntArray

# Whether recordings excite all six components of the load, and which are missing.


MIN_SINGULAR = 10.0
"""Smallest size of an excitation in its standard uncertainties; matrix elements then have an uncertainty of 10 %."""
MIN_SHARE = 1e-3
"""Smallest size of an excitation relative to the largest, every component in units of its largest load."""
MEMBER = 0.05
"""Share of a missing direction above which a component belongs to it."""
TOGETHER = 0.1
"""Correlation in the missing directions above which components are reported together."""
FLOOR = 1e-9
"""Smallest standard uncertainty of a load relative to its size, for numerical stability."""

HOW = {
    "Fx": "a recording driven along x",
    "Fy": "a recording driven along y",
    "Fz": "a recording driven along z",
    "Mx": "a recording with a moment about x (force along z with an offset in y, or along y at another height)",
    "My": "a recording with a moment about y (force along z with an offset in x, or along x at another height)",
    "Mz": "a recording with a moment about z (force along x or y with an offset)",
}


class MissingExcitationError(ValueError):
    """The recordings do not excite six independent loads.

    `missing`: the components, alone or in groups of fixed proportion; `additions`: the recordings to add.
    """

    def __init__(self, text: str, missing: tuple[tuple[str, ...], ...], additions: str) -> None:
        super().__init__(text)
        self.missing, self.additions = missing, additions


@dataclass(frozen=True)
class LoadExcitation:
    """Strength of the six independent loads that R lines excite.

    `singular` (6,): singular values of the loads whitened by their covariance, largest first: amplitude of an
    independent load in its standard uncertainties. `share` (6,): singular values of the loads, every component in units
    of its largest value, relative to the largest. `missing`: components that are not excited, alone or only in fixed
    proportion.
    """

    singular: FloatArray
    share: FloatArray
    missing: tuple[tuple[str, ...], ...]

    @property
    def determines(self) -> bool:
        """Whether all six columns of a matrix can be determined."""
        return not self.missing


def excitation(stack: Stack, drives: Sequence[int] | NDArray[np.int64] | None = None) -> LoadExcitation:
    """Return the strength of the six independent loads that some lines (default: all) excite.

    With w_r the loads and Γ_r their complex covariances, the whitened singular values are the roots of vᴴ(Σ w̄_r w_rᵀ)v
    / vᴴ(Σ Γ̄_r)v at its extremes, a generalised eigenvalue problem: a direction v that is not excited has 1 or less. A
    direction is excited if vᴴ(Σ w̄_r w_rᵀ)v exceeds the squares of both `MIN_SINGULAR` standard uncertainties and
    `MIN_SHARE` of the largest excitation. The others are the negative eigenspace of the difference.
    """
    chosen = np.arange(len(stack.load)) if drives is None else np.asarray(drives, dtype=np.int64)
    return _excitation(stack.load[chosen], np.sum(stack.load_covariance()[chosen], axis=0))


def drives_excite(drives: Sequence[ExcitedLine]) -> LoadExcitation:
    """Return `excitation` of lines without stacking them, which needs less memory."""
    size = np.tile(largest_magnitude(np.stack([drive.load for drive in drives])), 2)
    covariance = np.sum([drive.load_uncertainty.covariance[0] for drive in drives], axis=0)
    load = np.stack([drive.load for drive in drives]) / size[:LOADS]
    return _excitation(load, covariance / np.outer(size, size))


def _excitation(load: ComplexArray, both: FloatArray) -> LoadExcitation:
    """Return the excitation of loads (R, 6) with the sum of their covariances (12, 12)."""
    from scipy.linalg import eigh

    signal = load.conj().T @ load
    # E[n nᴴ] of complex errors from their covariances of [Re, Im].
    re, im, mixed = both[:LOADS, :LOADS], both[LOADS:, LOADS:], both[LOADS:, :LOADS]
    noise = (re + im + 1j * (mixed - mixed.T)).conj()
    # Components in units of their load or uncertainty, so that all have a similar size.
    size = np.sqrt(np.diag(signal).real + np.diag(noise).real)
    size = np.where(size > 0.0, size, 1.0)
    signal, noise = signal / np.outer(size, size), noise / np.outer(size, size) + FLOOR**2 * np.eye(LOADS)
    singular = np.sqrt(np.maximum(eigh(signal, noise, eigvals_only=True), 0.0))[::-1]
    share = np.sqrt(np.maximum(np.linalg.eigvalsh(signal), 0.0))[::-1]
    least = MIN_SINGULAR**2 * noise + (MIN_SHARE * share[0]) ** 2 * np.eye(LOADS)
    values, vectors = np.linalg.eigh(signal - least)
    lacking = vectors[:, values < 0.0]
    missing = _missing(np.asarray(lacking @ lacking.conj().T))
    return LoadExcitation(singular, share / (share[0] if share[0] > 0.0 else 1.0), missing)


def require_six(found: LoadExcitation, drives: int) -> None:
    """Raise `MissingExcitationError` unless the lines excite six independent loads."""
    if found.determines:
        return
    missing, additions = [], []
    for group in found.missing:
        listed = f"{', '.join(group[:-1])} and {group[-1]}"
        alone = len(group) == 1
        missing.append(group[0] if alone else f"{listed} in different proportions")
        additions.append(HOW[group[-1]] + ("" if alone else f", with {listed} in another proportion"))
    text = f"expected loads in six independent directions, found {drives} that do not excite {', nor '.join(missing)}"
    added = "; ".join(additions)
    raise MissingExcitationError(f"drives: {text}; add {added}", found.missing, added)


def _missing(projector: ComplexArray) -> tuple[tuple[str, ...], ...]:
    """Return the components of the missing directions, alone or in groups of fixed proportion."""
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
"""Largest number of Gauss-Newton steps; a few are usual."""
CONVERGED = 1e-7
"""Largest step, in standard uncertainties, at which the iteration ends."""
NOISE_FLOOR = 1e-4
"""Smallest noise of a reading relative to its common errors; it has no visible effect on U and keeps digits."""
DIGITS = 1e-10
"""Smallest noise of a reading relative to the largest one, for numerical stability."""


@dataclass(frozen=True)
class LinearisationPoint:
    """Linearisation point of the likelihood: matrix (C, 6), loads (R, 6), errors (E,)."""

    matrix: ComplexArray
    load: ComplexArray
    errors: FloatArray


@dataclass(frozen=True)
class MatrixSolution:
    """Matrix, loads and unknowns of greatest likelihood of a stack, in its units.

    `matrix` (C, 6), `load` (R, 6), `errors` (E,) in standard uncertainties; `point`: linearisation point. Every line
    has 2C real readings, zero if missing. `residual` (R, 2C): of the outputs at the measured loads. `noise` (R, 2C,
    2C), `size` (R, 2C): of noise and unknowns together. `gain` (R, 12C, 2C): from readings to [Re, Im] of the matrix.
    `load_design` (R, 2C, 12): from loads to readings. P is the projector of all readings, `chi2` = residualᵀ·P·residual
    with `dof` degrees of freedom: `projected_residual` (R, 2C) is P·residual, `projector` (R, 2C, 2C) its blocks of one
    line. `step`: the last step, in standard uncertainties of the elements.
    """

    matrix: ComplexArray
    load: ComplexArray
    errors: FloatArray
    point: LinearisationPoint
    residual: FloatArray
    noise: FloatArray
    size: FloatArray
    gain: FloatArray
    load_design: FloatArray
    projected_residual: FloatArray
    projector: FloatArray
    step: float
    chi2: float
    dof: int


@dataclass(frozen=True)
class _Linear:
    """Linear model of R lines about a point, zero if there is no reading.

    `residual` (R, 2C), `design` (R, 2C, 12C) for the matrix, `through` (R, 2C, 12) for the loads, `effects` (R, 2C, A)
    for the unknowns. `load_step` (R, 12, 12): from errors of the measured loads to the loads. `noise` (R, 2C, 2C), one
    if there is no reading.
    """

    residual: FloatArray
    design: FloatArray
    through: FloatArray
    effects: FloatArray
    load_step: FloatArray
    noise: FloatArray


def solve(stack: Stack, discrepancy: FloatArray | None = None) -> MatrixSolution:
    """Return the matrix S, the loads L_r and the unknowns e of greatest likelihood.

    Readings are l_r = L_r + E_r(L_r)·e + noise and y_r = (1 + Σ_k ρ_rk·e_k) ∘ (S·L_r) + noise, e with unit priors. E_r
    follows the size of the fitted load and ρ is relative, so that a low reading gets no more weight by its common error
    (D'Agostini 1994, Nucl. Instrum. Methods A 346, 306).

    Gauss-Newton over S, L and e, in which L and e are eliminated: generalised least squares with the effective
    covariance of y - S·l and the design at the fitted loads (York 1969, Earth Planet. Sci. Lett. 5, 320, for a line).
    `discrepancy` (R, C): further standard deviations of the real and the imaginary part of the outputs.
    """
    extra = np.zeros(stack.output.shape) if discrepancy is None else discrepancy
    solution = _step(stack, _start(stack), extra)
    for _ in range(ITERATIONS):
        if solution.step <= CONVERGED:
            return solution
        solution = _step(stack, LinearisationPoint(solution.matrix, solution.load, solution.errors), extra)
    raise ValueError(f"drives: expected loads that determine a matrix, found none after {ITERATIONS} iterations")


def estimated_noise(stack: Stack, solution: MatrixSolution) -> EstimatedNoise:
    """Return the degrees of freedom of the noise of loads and outputs in a solution."""
    parts = []
    for r, usable in enumerate(np.tile(stack.usable, (1, 2))):
        rows = r * len(usable) + np.flatnonzero(usable)
        for noise, turn in (
            (stack.output_noise[r], np.eye(len(usable))),
            (stack.load_noise[r], solution.load_design[r]),
        ):
            design = turn[usable]
            for part in noise.random:
                dof = np.inf if part.dof is None else float(part.dof[0])
                parts.append((rows, design @ part.covariance[0] @ design.T, dof))
    return EstimatedNoise.from_parts(parts, solution.residual.size)


def judge(stack: Stack, solution: MatrixSolution | None = None) -> MatrixSolution:
    """Return one step from a solution, or from the start, with stated uncertainties only.

    If readings disagree a thousandfold, the greatest likelihood moves the unknowns far beyond the linear range of the
    model, and the deviation of a single reading has no meaning. One step avoids this.
    """
    point = _start(stack) if solution is None else LinearisationPoint(solution.matrix, solution.load, solution.errors)
    return _step(stack, point, np.zeros(stack.output.shape))


def changes(stack: Stack, solution: MatrixSolution) -> FloatArray:
    """Return the change of the matrix by one standard uncertainty of every unknown (E, 12C)."""
    total = np.zeros((len(stack.unknowns), solution.gain.shape[1]))
    for group in stack.order.chunks():
        drives = np.concatenate([members for members, _ in group])
        effects = _linearise(stack, solution.point, drives).effects
        np.add.at(total, stack.acting[drives], (solution.gain[drives] @ effects).swapaxes(1, 2))
    return total


def reading_model(stack: Stack, matrix: ComplexArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return effects of unknowns, design and noise of all readings at a matrix.

    `matrix` (C, 6) in the units of the stack. (R, 2C, A) for the slots of `Stack.acting`, (R, 2C, 12C) for [Re, Im] of
    the matrix, (R, 2C, 2C). The measured loads are the point of linearisation.
    """
    point = LinearisationPoint(matrix, stack.load, np.zeros(len(stack.unknowns)))
    linear = _linearise(stack, point, np.arange(len(stack.load)))
    largest = np.max(np.abs(stack.output[stack.usable]))
    return linear.effects, linear.design, linear.noise + (DIGITS * largest) ** 2 * np.eye(linear.noise.shape[1])


def _start(stack: Stack) -> LinearisationPoint:
    """Return the matrix by least squares with exact loads as the first point."""
    rows = [
        np.linalg.lstsq(stack.load[usable], stack.output[usable, c], rcond=None)[0]
        for c, usable in enumerate(stack.usable.T)
    ]
    return LinearisationPoint(np.array(rows), stack.load, np.zeros(len(stack.unknowns)))


def _linearise(stack: Stack, point: LinearisationPoint, drives: IntArray) -> _Linear:
    """Return the first-order model of the readings of some lines about a point."""
    channels, acting = len(stack.channels), point.errors[stack.acting[drives]]
    load, given, output = point.load[drives], stack.load[drives], stack.output[drives]
    of_load, of_output = stack.load_effect[drives], stack.output_effect[drives]
    factor = 1.0 + (acting[:, None] @ of_output)[:, 0]
    plain = load @ point.matrix.T
    # The size of a load's common errors follows the fitted load: γ = <l, L>/<l, l>, E(L) = E·γ.
    weight = given.conj() / np.sum(np.abs(given) ** 2, axis=1, keepdims=True)
    size = np.sum(weight * load, axis=1)
    shift = (acting[:, None] @ of_load)[:, 0]
    step = np.linalg.inv(np.eye(LOADS) + shift[:, :, None] * weight[:, None])
    through = factor[:, :, None] * point.matrix @ step
    rows = np.einsum("cd,rc,rj->rcdj", np.eye(channels), factor, load)
    output_effect = (of_output * plain[:, None]).swapaxes(1, 2)
    residual = output - factor * plain + (output_effect @ acting[..., None])[..., 0]
    residual = residual - (through @ (given - load)[..., None])[..., 0]
    effects = output_effect - through @ (of_load.swapaxes(1, 2) * size[:, None, None])
    finite = np.tile(np.isfinite(output), (1, 2))
    turn = real_stacked(through)
    noise = stack.individual_output_covariance[drives] + turn @ stack.individual_load_covariance[
        drives
    ] @ turn.swapaxes(1, 2)
    noise = np.where(finite[:, :, None] & finite[:, None], noise, 0.0)
    return _Linear(
        residual=np.where(finite, real_stack(residual), 0.0),
        design=np.where(finite[:, :, None], real_stacked(rows.reshape(len(drives), channels, -1)), 0.0),
        through=turn,
        effects=np.where(finite[:, :, None], np.concatenate([effects.real, effects.imag], axis=1), 0.0),
        load_step=real_stacked(step),
        noise=noise + ~finite[:, :, None] * np.eye(finite.shape[1]),
    )


@dataclass(frozen=True)
class _White:
    """Readings of K lines, whitened by their individual errors.

    `turn` (K, 2C, 2C) whitens; `columns` (K, 2C, M + P): effects of up to M unknowns of a group, then of the wide
    unknowns, design, residual (P columns). `groups`: slice of the lines and number of unknowns of each group.
    """

    drives: IntArray
    linear: _Linear
    turn: FloatArray
    columns: FloatArray
    groups: tuple[tuple[slice, int], ...]

    def group(self, rows_of_group: slice, count: int, width: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Eliminate the `count` unknowns of a group from its `width` last columns.

        Of the system [L B; 1 0] of its rows: Q (n, count) of L, B (n, P) less its projection on Q, and the remaining
        rows for the system of all groups.
        """
        rows = self.columns[rows_of_group].reshape(-1, self.columns.shape[2])
        within, rest = rows[:, :count], rows[:, -width:]
        if not count:
            return within, rest, rest
        system = np.concatenate([np.concatenate([within, rest], axis=1), np.eye(count, count + width)])
        upper = np.asarray(np.linalg.qr(system, mode="r"))
        q = solve_triangular(upper[:count, :count], within.T, trans="T").T
        return q, rest - q @ upper[:count, count:], upper[count:, count:]


def _whitened(stack: Stack, point: LinearisationPoint, discrepancy: FloatArray) -> Iterator[_White]:
    """Yield the readings of all lines, linearised and whitened."""
    order, readings = stack.order, real_stack(stack.output)
    digits = (DIGITS * np.max(np.abs(readings[np.isfinite(readings)]))) ** 2
    extra = np.tile(discrepancy**2, 2)
    for chunk in order.chunks():
        drives = np.concatenate([members for members, _ in chunk])
        linear = _linearise(stack, point, drives)
        # Raised where it is far below the common errors, or below the digits of the readings.
        diagonal = np.diagonal(linear.noise, axis1=1, axis2=2) + extra[drives]
        floor = NOISE_FLOOR**2 * np.sum(linear.effects**2, axis=2) + digits
        raised = extra[drives] + np.maximum(floor - diagonal, 0.0)
        linear = replace(linear, noise=linear.noise + raised[:, :, None] * np.eye(raised.shape[1]))
        root = np.linalg.cholesky(linear.noise)
        alone = np.linalg.solve(root, np.where(order.single[drives][:, None], linear.effects, 0.0))
        one = np.broadcast_to(np.eye(raised.shape[1]), root.shape)
        upper = np.asarray(np.linalg.qr(np.concatenate([alone.swapaxes(1, 2), one], axis=1), mode="r"))
        turn = np.linalg.solve(upper.swapaxes(1, 2), np.linalg.solve(root, one))
        # Column of every unknown; individual and empty ones are last.
        most = max(len(within) for _, within in chunk)
        column = np.full(len(stack.unknowns) + 1, most + len(order.wide))
        column[order.wide] = most + np.arange(len(order.wide))
        for _, within in chunk:
            column[within] = np.arange(len(within))
        shared = np.zeros((len(drives), most + len(order.wide) + 1, raised.shape[1]))
        shared[np.arange(len(drives))[:, None], column[stack.acting[drives]]] = linear.effects.swapaxes(1, 2)
        parts = [shared[:, :-1].swapaxes(1, 2), linear.design, linear.residual[..., None]]
        ends = np.cumsum([len(members) for members, _ in chunk]).tolist()
        groups = [
            (slice(end - len(members), end), len(within)) for end, (members, within) in zip(ends, chunk, strict=True)
        ]
        yield _White(drives, linear, turn, turn @ np.concatenate(parts, axis=2), tuple(groups))


def _upper(stack: Stack, point: LinearisationPoint, discrepancy: FloatArray, width: int) -> FloatArray:
    """Return the triangular factor (P - 1, P) of the system of all lines.

    Its unknowns are the wide ones and the matrix.

    The right side is the last column. The system [A X y; 1 0 0], whitened, is equivalent to a covariance noise + A·Aᵀ
    but keeps its digits.
    """
    upper, pending = np.eye(len(stack.order.wide), width), list[FloatArray]()
    for white in _whitened(stack, point, discrepancy):
        for rows_of_group, count in white.groups:
            pending.append(white.group(rows_of_group, count, width)[2])
            if sum(map(len, pending)) > 4 * width:
                upper, pending = np.asarray(np.linalg.qr(np.concatenate([upper, *pending]), mode="r")), []
    return np.asarray(np.linalg.qr(np.concatenate([upper, *pending]), mode="r")[: width - 1])


def _step(stack: Stack, point: LinearisationPoint, discrepancy: FloatArray) -> MatrixSolution:
    """Return one Gauss-Newton step: generalised least squares for the matrix, then loads and errors."""
    drives, channels = stack.output.shape
    finite, shape, wide = np.tile(stack.usable, (1, 2)), (drives, 2 * channels, 2 * channels), len(stack.order.wide)
    width = wide + 2 * LOADS * channels + 1
    upper = _upper(stack, point, discrepancy, width)
    inverse = solve_triangular(upper[:, :-1], np.eye(width - 1))
    found, spread = inverse @ upper[:, -1], np.linalg.norm(inverse[wide:], axis=1)
    residual, size, projected_residual = (np.zeros(finite.shape) for _ in range(3))
    noise, projector = np.zeros(shape), np.zeros(shape)
    load_design, gain = np.zeros((*finite.shape, 2 * LOADS)), np.zeros((drives, 2 * LOADS * channels, 2 * channels))
    errors = np.zeros(len(stack.unknowns))
    steps = np.zeros((drives, 2 * LOADS, 2 * LOADS))
    for white in _whitened(stack, point, discrepancy):
        members, linear = white.drives, white.linear
        for rows_of_group, count in white.groups:
            q, rest, _ = white.group(rows_of_group, count, width)
            rows, turn = members[rows_of_group], white.turn[rows_of_group]
            common = rest[:, :-1] @ inverse
            q = np.concatenate([q, common], axis=1).reshape(len(rows), 2 * channels, -1)
            projector[rows] = turn.swapaxes(1, 2) @ (np.eye(2 * channels) - q @ q.swapaxes(1, 2)) @ turn
            common = common.reshape(len(rows), 2 * channels, -1)
            gain[rows] = inverse[wide:] @ common.swapaxes(1, 2) @ turn
            off = (rest[:, -1] - rest[:, :-1] @ found).reshape(len(rows), -1, 1)
            projected_residual[rows] = (turn.swapaxes(1, 2) @ off)[..., 0]
        residual[members], noise[members], load_design[members], steps[members] = (
            linear.residual, linear.noise, linear.through, linear.load_step,
        )  # fmt: skip
        size[members] = np.sqrt(np.diagonal(linear.noise, axis1=1, axis2=2) + np.sum(linear.effects**2, axis=2))
        np.add.at(
            errors,
            stack.acting[members],
            (linear.effects.swapaxes(1, 2) @ projected_residual[members][..., None])[..., 0],
        )
    # The residual of a line's outputs is shared with the noise of its load. Readings at the point,
    # l(L, e) = L + E(L)·e, leave l - l(L, e) - E·(e_new - e) - noise to the step of L.
    shared = (stack.individual_load_covariance @ (load_design.swapaxes(1, 2) @ projected_residual[..., None]))[..., 0]
    deviation = real_stack(stack.load - point.load) - real_stack(_shift(stack, point, errors)) + shared
    load = point.load + as_complex((steps @ deviation[..., None])[..., 0])
    return MatrixSolution(
        matrix=point.matrix + as_complex(found[wide:]).reshape(channels, LOADS),
        load=load,
        errors=errors,
        point=point,
        residual=residual,
        noise=noise,
        size=size,
        gain=gain,
        load_design=load_design,
        projected_residual=projected_residual,
        projector=projector,
        step=float(np.max(np.abs(found[wide:]) / spread)),
        chi2=float(np.sum(residual * projected_residual)),
        dof=int(np.count_nonzero(finite)) - 2 * LOADS * channels,
    )


def _shift(stack: Stack, point: LinearisationPoint, errors: FloatArray) -> ComplexArray:
    """Return the changes of the loads (R, 6) by errors (E,) at a point."""
    weight = stack.load.conj() / np.sum(np.abs(stack.load) ** 2, axis=1, keepdims=True)
    size = np.sum(weight * point.load, axis=1, keepdims=True)
    return np.asarray((errors[stack.acting][:, None] @ stack.load_effect)[:, 0] * size)
