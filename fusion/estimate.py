"""The linear system behind the fusion: readings of all lines, explicit common errors, whitened least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from fusion.observe import CommonError, Observation

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

BODY_SIZE_M = 0.1
"""Length that compares rotations with translations where ranks are decided: a body of the size of a hand."""
RANK_TOLERANCE = 1e-6
RESOLUTION_TOLERANCE = 1e-6
NOISE_FLOOR = 1e-4
UNOBSERVED_MOTION = 0.02
"""Standard uncertainty of a component nobody observes, relative to the observed motion (rotations: over 0.1 m)."""
SCALE = np.array([1.0, 1.0, 1.0, 1.0 / BODY_SIZE_M, 1.0 / BODY_SIZE_M, 1.0 / BODY_SIZE_M])


def real_design(matrix: ComplexArray) -> FloatArray:
    """Return the real (2M, 2J) form of a complex (M, J) matrix that acts on [Re, Im]."""
    return np.block([[matrix.real, -matrix.imag], [matrix.imag, matrix.real]])


def real_stack(values: ComplexArray) -> FloatArray:
    """Return [Re, Im] along the last axis."""
    return np.concatenate([values.real, values.imag], axis=-1)


def row_space(observations: Sequence[Observation], line: int) -> ComplexArray:
    """Return a basis (6, R) of the accelerations that the usable readings of one line determine.

    Rows are brought to equal length and rotations measured by `BODY_SIZE_M`, so that only the geometry decides;
    directions whose singular value is below 1e-6 of the largest are left out.
    """
    rows = [o.design[line][np.isfinite(o.phasors.value[line])] * SCALE for o in observations]
    stacked = np.concatenate(rows) if rows else np.zeros((0, 6), np.complex128)
    length = np.linalg.norm(stacked, axis=1, keepdims=True)
    stacked = stacked / np.where(length > 0.0, length, 1.0)
    if not len(stacked) or not np.any(stacked):
        return np.zeros((6, 0), np.complex128)
    _, singular, right = np.linalg.svd(stacked, full_matrices=False)
    return np.asarray(right[singular > RANK_TOLERANCE * singular[0]].conj().T)


def observed_components(basis: ComplexArray) -> BoolArray:
    """Return which components (6,) lie in the row space: diagonal of the resolution matrix equal to 1 (within 1e-6)."""
    return np.asarray(np.sum(np.abs(basis) ** 2, axis=1) > 1.0 - RESOLUTION_TOLERANCE)


@dataclass(frozen=True)
class System:
    """All usable readings of a set of observations as N real rows.

    `readings` (N,), `design` (N, P) on the reduced unknowns, `noise` (N, N), `line`, `observation`, `member` (N,):
    where each row belongs; `member_names`; `expand` (12K, P) from the unknowns to [Re A_k, Im A_k] of all lines;
    `observed` (K, 6); `common`: the E common errors, each once (their effects are those of all observations).
    """

    observations: tuple[Observation, ...]
    readings: FloatArray
    design: FloatArray
    noise: FloatArray
    line: IntArray
    observation: IntArray
    member: IntArray
    member_names: tuple[str, ...]
    expand: FloatArray
    observed: BoolArray
    common: tuple[CommonError, ...]

    def effects(self, acceleration: ComplexArray) -> FloatArray:
        """Return (N, E): change of the readings for one standard uncertainty of each common error, at A (K, 6)."""
        effects = np.zeros((len(self.readings), len(self.common)))
        columns = {error.name: column for column, error in enumerate(self.common)}
        for place, observation in enumerate(self.observations):
            for error in observation.common:
                values = real_rows(observation, error.effect(acceleration))
                effects[self.observation == place, columns[error.name]] += values
        return effects

    def hidden_variances(self, acceleration: ComplexArray) -> FloatArray:
        """Return (N,): variance of the readings from components nobody observes, through uncertain design rows.

        A laser that may point 5 mrad aside sees that share of a transverse motion. Such components, zero in the
        estimate A (K, 6), are given the standard uncertainty `hidden_motion`.
        """
        motion = hidden_motion(acceleration, self.observed)
        rows = []
        for observation in self.observations:
            through = [np.abs(error.slope) ** 2 @ motion[:, :, None] ** 2 / 2.0 for error in observation.common]
            total = np.sum(through, axis=0)[:, :, 0] if through else np.zeros(observation.phasors.value.shape)
            rows.append(real_rows(observation, np.asarray(total * (1.0 + 1.0j), dtype=np.complex128)))
        return np.concatenate(rows)

    def acceleration(self, unknowns: FloatArray) -> ComplexArray:
        """Return A (K, 6) from the reduced unknowns (P,); what no reading determines is zero."""
        stacked = (self.expand @ unknowns).reshape(-1, 12)
        return np.asarray(stacked[:, :6] + 1j * stacked[:, 6:])


def hidden_motion(acceleration: ComplexArray, observed: BoolArray) -> FloatArray:
    """Return (K, 6) standard uncertainties assumed of unobserved amplitudes: 2 % of the observed motion, else zero."""
    size = np.max(np.where(observed, np.abs(acceleration / SCALE), 0.0), axis=1, keepdims=True)
    return np.asarray(np.where(observed, 0.0, UNOBSERVED_MOTION * size * SCALE))


def real_rows(observation: Observation, values: ComplexArray) -> FloatArray:
    """Return (K, M) values as real rows in the system's order: line by line, usable channels, Re then Im."""
    usable = np.isfinite(observation.phasors.value)
    return np.concatenate([real_stack(row[mask]) for row, mask in zip(values, usable, strict=True)])


def build_system(observations: Sequence[Observation]) -> System:
    """Collect the usable readings of observations that share their lines into one system."""
    lines = len(observations[0].phasors.frequency_hz)
    bases = [row_space(observations, line) for line in range(lines)]
    starts = np.concatenate([[0], np.cumsum([2 * basis.shape[1] for basis in bases])]).astype(np.int64)
    expand = np.zeros((12 * lines, starts[-1]))
    for k, basis in enumerate(bases):
        expand[12 * k : 12 * k + 12, starts[k] : starts[k + 1]] = real_design(SCALE[:, None] * basis)
    names = tuple(dict.fromkeys(name for o in observations for name in o.members))
    readings, design, blocks, where = [], [], [], []
    for place, observation in enumerate(observations):
        for k in range(lines):
            usable = np.flatnonzero(np.isfinite(observation.phasors.value[k]))
            both = np.concatenate([usable, usable + len(observation.members)])
            readings.append(real_stack(observation.phasors.value[k, usable]))
            design.append(real_design(observation.design[k, usable]) @ expand[12 * k : 12 * k + 12])
            blocks.append(observation.phasors.covariance[k][np.ix_(both, both)])
            where += [(k, place, names.index(observation.members[m])) for m in np.tile(usable, 2)]
    index = np.array(where, dtype=np.int64).reshape(-1, 3)
    common = {error.name: error for o in reversed(observations) for error in reversed(o.common)}
    return System(
        observations=tuple(observations),
        readings=np.concatenate(readings),
        design=np.concatenate(design),
        noise=_block_diagonal(blocks),
        line=index[:, 0],
        observation=index[:, 1],
        member=index[:, 2],
        member_names=names,
        expand=expand,
        observed=np.array([observed_components(basis) for basis in bases]),
        common=tuple(reversed(common.values())),
    )


def _block_diagonal(blocks: Sequence[FloatArray]) -> FloatArray:
    """Square blocks along the diagonal of one matrix."""
    ends = np.cumsum([len(block) for block in blocks])
    matrix = np.zeros((ends[-1], ends[-1]))
    for block, end in zip(blocks, ends, strict=True):
        matrix[end - len(block) : end, end - len(block) : end] = block
    return matrix


@dataclass(frozen=True)
class Solution:
    """Estimate of a system: `acceleration` (K, 6), `errors` (E,) in standard uncertainties, `effects` (N, E) there.

    `remaining` (E,): standard uncertainty of the errors after the estimate over that before.
    `gain` (12K, N): estimate = gain · readings; `projector` (N, N) = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1 with V the
    covariance of noise and common errors, so that `chi2` = y^T P y; `dof`; `noise` (N, N) as it was used, with the
    discrepancy and the `hidden` (N,) variances in it.
    """

    acceleration: ComplexArray
    errors: FloatArray
    remaining: FloatArray
    effects: FloatArray
    gain: FloatArray
    projector: FloatArray
    chi2: float
    dof: int
    noise: FloatArray
    hidden: FloatArray


def solve(system: System, discrepancy: FloatArray | None = None, iterations: int = 6) -> Solution:
    """Estimate accelerations and common errors together by least squares.

    The augmented system [X S; 0 I] [A; e] = [y; 0], whitened by the noise, is equivalent to generalised least squares
    with the covariance N + S S^T. S is taken at the current estimate and the step repeated, so that no reading that
    happens to be low gains weight by it (Peelle's puzzle; D'Agostini 1994, Nucl. Instrum. Methods A 346, 306).
    `discrepancy` (N,): additional standard deviations of the readings.
    """
    noise = system.noise + (0.0 if discrepancy is None else np.diag(discrepancy**2))
    acceleration = system.acceleration(_starting_point(system, noise))
    for _ in range(iterations):
        solution = _step(system, noise, system.effects(acceleration), system.hidden_variances(acceleration))
        change = np.max(np.abs(solution.acceleration - acceleration), initial=0.0)
        acceleration = solution.acceleration
        if change <= 1e-12 * np.max(np.abs(acceleration), initial=0.0):
            break
    return solution


def _starting_point(system: System, noise: FloatArray) -> FloatArray:
    """Unknowns without common errors, every reading weighted by its noise and a hundredth of its size."""
    weight = 1.0 / np.sqrt(np.diag(noise) + (1e-2 * _reading_size(system)) ** 2)
    return np.asarray(np.linalg.lstsq(system.design * weight[:, None], system.readings * weight, rcond=None)[0])


def _reading_size(system: System) -> FloatArray:
    """Largest reading of each row's instrument at its line, (N,)."""
    size = np.zeros(len(system.readings))
    for line, place in set(zip(system.line.tolist(), system.observation.tolist(), strict=True)):
        rows = (system.line == line) & (system.observation == place)
        size[rows] = np.max(np.abs(system.readings[rows]))
    return np.where(size > 0.0, size, 1.0)


def _step(system: System, noise: FloatArray, effects: FloatArray, hidden: FloatArray) -> Solution:
    """One linear solve at given effects (N, E) and variances from unobserved motion (N,)."""
    noise = noise + np.diag(hidden)
    # Noise far below the common errors is raised to 1e-4 of them: invisible in U, and P keeps its digits.
    floor = (NOISE_FLOOR * np.linalg.norm(effects, axis=1)) ** 2 + (1e-12 * _reading_size(system)) ** 2
    # A share of 1e-9 of the variances keeps covariances of channels that move alike positive definite.
    noise = noise + np.diag(np.maximum(floor - np.diag(noise), 0.0) + 1e-9 * np.diag(noise))
    root = np.linalg.cholesky(noise)
    count, unknowns, errors = len(system.readings), system.design.shape[1], effects.shape[1]
    white = solve_triangular(root, np.column_stack([system.design, effects, system.readings]), lower=True)
    scale = np.linalg.norm(white[:, :unknowns], axis=0)
    augmented = np.zeros((count + errors, unknowns + errors))
    augmented[:count] = white[:, :-1]
    augmented[:count, :unknowns] /= scale
    augmented[count:, unknowns:] = np.eye(errors)
    q, r = np.linalg.qr(augmented)
    readings = white[:, -1]
    white_projector = np.eye(count) - q[:count] @ q[:count].T
    inverse = solve_triangular(r, q[:count].T, lower=False)
    half = solve_triangular(root, white_projector, lower=True, trans="T")
    gain = solve_triangular(root, inverse.T, lower=True, trans="T").T
    return Solution(
        acceleration=system.acceleration(inverse[:unknowns] @ readings / scale),
        errors=inverse[unknowns:] @ readings,
        remaining=np.linalg.norm(solve_triangular(r[unknowns:, unknowns:], np.eye(errors)), axis=1),
        effects=effects,
        gain=system.expand @ (gain[:unknowns] / scale[:, None]),
        projector=solve_triangular(root, half.T, lower=True, trans="T"),
        chi2=float(readings @ white_projector @ readings),
        dof=count - unknowns,
        noise=noise,
        hidden=hidden,
    )
