"""Variance components: scatter of readings by their estimated noise, and beyond their stated uncertainty."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fusion.estimation.least_squares import FusionSolution, FusionSystem, RowIndex
from fusion.estimation.measurement_model import BODY_SIZE_M, SCALE, Observation
from shakercal._common.arrays import ComplexArray, FloatArray, IntArray

TEST_CONFIDENCE = 0.99
"""Confidence of all tests: their significance level is 1 %."""
EXACT_NOISE_SHARE = 1e-6
"""Share A₂/d below which the noise is treated as exact: far below any effect on the test."""
MAX_ESTIMATED_SHARE = 0.8
"""Largest share A₂/d that the test allows for: with noise known even less, chi-square has no expectation."""
TINY = 1e-300
MIN_TAIL_DOF = 4.0
"""Degrees of freedom of F below which the approximation is not followed."""
RANK_TOLERANCE = 1e-6
MIN_REMAINING_SHARE = 1e-4
"""Share of a component's variance in the contrasts below which the component is undetermined (chosen)."""
ITERATIONS = 100
ROUNDING = 1e-15
"""Relative precision of double numbers, about."""
NO_VALUES = np.zeros(0)
MIN_DIRECTED_SHARE = 0.1
"""Share of the motion below which a reading has no significant direction in the complex plane."""
INVERSE_VARIANCE_DOF = 2.0
"""Degrees of freedom that a variance has less as a weight: 1/s² is ν/(ν - 2) times 1/σ² on average."""
MIN_DISCREPANCY_DOF = 4.0
"""Fewest degrees of freedom of a difference between instruments (chosen). Two instruments that differ by D then get
u = D/2 about their mean and U = 1.4 D, which covers both."""


@dataclass(frozen=True)
class Scatter:
    """Scatter of the readings of one instrument beyond their stated uncertainties.

    `amplitude`, `phase` (K,): standard deviations of the parts in phase with the reading and in quadrature, relative to
    the motion at the line. `dof` (K,): degrees of freedom of both together.
    """

    instrument: str
    amplitude: FloatArray
    phase: FloatArray
    dof: FloatArray


@dataclass(frozen=True)
class AddedCovariance:
    """An additional covariance of a system's readings, with its label and degrees of freedom."""

    label: str
    covariance: FloatArray
    dof: FloatArray


@dataclass(frozen=True)
class Contrasts:
    """Combinations of readings of one line that no motion changes.

    `values` (n,), their `covariance` (n, n) as stated; `patterns` (C, n, n): covariance of each component of variance
    one; `coefficients` (N, n): values = coefficientsᵀ · readings, if they are those of a system.
    """

    values: FloatArray
    covariance: FloatArray
    patterns: FloatArray
    coefficients: FloatArray = field(default_factory=lambda: NO_VALUES)

    def chi2(self, components: FloatArray) -> float:
        """Return chi-square of n degrees of freedom, given the components (C,)."""
        return float(self.values @ np.linalg.solve(self._total_covariance(components), self.values))

    def deviance(self, components: FloatArray) -> float:
        """Return minus twice the restricted logarithmic likelihood of components (C,), up to a constant."""
        return self.chi2(components) + float(np.linalg.slogdet(self._total_covariance(components))[1])

    def _total_covariance(self, components: FloatArray) -> FloatArray:
        """Covariance with some components, (C,) or none."""
        if not len(components):
            return self.covariance
        total = self.covariance + np.tensordot(components, self.patterns, 1)
        # Next to a component a million times as large the stated part may vanish in rounding.
        return np.asarray(total + ROUNDING * np.max(np.diag(total)) * np.eye(len(total)))

    def normal_equations(self, components: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return F (C, C) and right side (C,) of the equations for the next components.

        F_cd = tr(P D_c P D_d), the right side's derivative; right side y^T P D_c P y - tr(P D_c P V_0). This is
        restricted maximum likelihood by iterated minimum norm estimates (Rao 1971; Searle, Casella, McCulloch, Variance
        Components, 1992, sec. 6.6). P is the inverse covariance of the contrasts.
        """
        inverse = np.linalg.inv(self._total_covariance(components))
        products = inverse @ self.patterns
        weighted = inverse @ self.values
        right = np.einsum("i,cij,j->c", weighted, self.patterns, weighted)
        right = right - np.einsum("cij,ji->c", products @ inverse, self.covariance)
        return np.einsum("cij,dji->cd", products, products), right


@dataclass(frozen=True)
class EstimatedNoise:
    """Covariances of a system's readings that were estimated, with their degrees of freedom.

    `blocks`: per instrument and line the rows (2m,), real before imaginary ones, the root (2m, 2m) of their covariance
    and its degrees of freedom ν. The covariance is S ⊗ G: S (m, m) of the readings is a Wishart matrix of ν, G that of
    real and imaginary part. `effects` (N, e): of unknowns of type A, with `dof` (e,).
    """

    blocks: tuple[tuple[IntArray, FloatArray, float], ...]
    effects: FloatArray
    dof: FloatArray

    @classmethod
    def from_system(cls, system: FusionSystem, effects: FloatArray) -> EstimatedNoise:
        """Return the estimated noise of a system with common `effects` (N, E)."""
        parts = []
        for index, observation in enumerate(system.observations):
            for k, dof in enumerate(observation.phasors.dof.tolist()):
                rows = np.flatnonzero((system.observation == index) & (system.line == k))
                parts.append((rows, system.noise[np.ix_(rows, rows)], dof))
        freedom = np.array([error.dof for error in system.common])
        finite = np.isfinite(freedom)
        return replace(
            cls.from_parts(parts, len(effects)), effects=effects[:, finite], dof=np.maximum(freedom[finite], 1.0)
        )

    @classmethod
    def from_parts(cls, parts: Iterable[tuple[IntArray, FloatArray, float]], count: int) -> EstimatedNoise:
        """Return the noise of `count` readings from parts: rows, their covariance, its degrees of freedom."""
        blocks = []
        for rows, covariance, dof in parts:
            if len(rows) and np.isfinite(dof):
                values, vectors = np.linalg.eigh(covariance)
                root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
                blocks.append((rows, np.asarray(root), max(dof, 1.0)))
        return cls(tuple(blocks), np.zeros((count, 0)), np.zeros(0))

    def moments(self, weights: FloatArray) -> tuple[float, float, float]:
        """Return the moments A₁ and A₂ of the covariance error, and the growth of χ².

        A₁ = E (tr Θ·δV)² and A₂ = E tr(Θ·δV·Θ·δV) with the error δV of the covariance and weights Θ: (N, N), or blocks
        (B, n, n) that no part of the noise exceeds. The expectation of χ² = yᵀ·Θ·y is d + A₂ to second order. For a
        block that contributes t of d, all orders together give A₂/(1 - A₂/t) if it is the only one (Hotelling); this is
        used for each block.
        """
        first = second = growth = 0.0
        for rows, root, dof in self.blocks:
            parts = self._real_imaginary_blocks(root @ _submatrix(weights, rows) @ root)
            traces, both = np.trace(parts, axis1=2, axis2=3), parts[0, 0] + parts[1, 1]
            of_block = float(np.sum(parts * parts.swapaxes(2, 3)) + np.sum(traces**2)) / dof
            first += 2.0 * float(np.sum(both * both.T)) / dof
            second += of_block
            growth += of_block / (1.0 - min(of_block / max(float(np.trace(traces)), TINY), MAX_ESTIMATED_SHARE))
        if not len(self.dof):
            return first, second, growth
        shares = np.einsum("ne,nm,me->e", self.effects, weights, self.effects)
        of_unknowns = 2.0 * shares**2 / self.dof
        more = of_unknowns / (1.0 - np.minimum(2.0 * shares / self.dof, MAX_ESTIMATED_SHARE))
        return first + float(np.sum(of_unknowns)), second + float(np.sum(of_unknowns)), growth + float(np.sum(more))

    def estimation_covariance(self, projector: FloatArray, gain: FloatArray, rows: IntArray) -> FloatArray:
        """Return the covariance (K, 12, 12) that estimated weights add to an estimate.

        The estimate is gain (K, 12, N) · readings. Λ = E gain·δV·P·δV·gainᵀ is its additional scatter relative to the
        best weights. (Xᵀ·V⁻¹·X)⁻¹ with an estimated V is on average too small by the same amount, hence 2Λ (Kackar &
        Harville 1984, J. Am. Stat. Assoc. 79, 853; Kenward & Roger 1997, Biometrics 53, 983, sec. 2). It is of first
        order in 1/ν, for which 1/(ν - 2) is used. U of means of two and three then covers 93.5 to 95.5 % from three
        degrees of freedom on (docs/uncertainty.md).
        """
        total = np.zeros((*gain.shape[:2], gain.shape[1]))
        for block_rows, root, dof in (block for block in self.blocks if np.isin(block[0][0], rows)):
            parts = self._real_imaginary_blocks(root @ projector[np.ix_(block_rows, block_rows)] @ root)
            traces = np.trace(parts, axis1=2, axis2=3)[:, :, None, None] * np.eye(parts.shape[2])
            square = (parts.swapaxes(2, 3) + traces).swapaxes(1, 2).reshape(len(block_rows), len(block_rows))
            square /= max(dof - INVERSE_VARIANCE_DOF, 1.0)
            rotated = gain[:, :, block_rows] @ root
            total += 2.0 * rotated @ square @ rotated.swapaxes(1, 2)
        return total

    @staticmethod
    def _real_imaginary_blocks(square: FloatArray) -> FloatArray:
        """Blocks (2, 2, m, m) between real and imaginary parts."""
        half = len(square) // 2
        return np.asarray(square.reshape(2, half, 2, half).swapaxes(1, 2))

    def reference_distribution(self, dof: int, weights: FloatArray) -> tuple[float, float]:
        """Return (λ, m) for which λ·χ²/d has the distribution F(d, m).

        χ² = yᵀ·Θ·y with weights Θ (N, N). Scaled F approximation of Kenward & Roger (1997, sec. 3.2), exact for
        Hotelling's T², for the hypothesis that no contrast has an expectation. m is infinite if all covariances are
        stated. With readings of exact noise the growth of the expectation is that of each block (`moments`), not that
        of its share in d.
        """
        first, second, growth = self.moments(weights)
        if second < EXACT_NOISE_SHARE * dof:
            return 1.0, np.inf
        # A₂ that with 1/(1 - A₂/d) makes this growth: the same where one instrument's noise is all there is.
        first, second = (moment / second * dof * growth / (dof + growth) for moment in (first, second))
        g = ((dof + 1.0) * first - (dof + 4.0) * second) / ((dof + 2.0) * second)
        c1, c2, c3 = (c / (3.0 * dof + 2.0 * (1.0 - g)) for c in (g, dof - g, dof + 2.0 - g))
        b = (first + 6.0 * second) / (2.0 * dof)
        expectation = 1.0 / (1.0 - second / dof)
        variance = 2.0 / dof * (1.0 + c1 * b) / ((1.0 - c2 * b) ** 2 * (1.0 - c3 * b))
        m = 4.0 + (dof + 2.0) / (dof * variance / (2.0 * expectation**2) - 1.0)
        # Where the approximation has no variance, or no more than chi-square, only the expectation is matched.
        m = max(m, MIN_TAIL_DOF) if variance > 0.0 and m > 0.0 else MIN_TAIL_DOF
        return m / (expectation * (m - 2.0)), m

    def p_value(self, chi2: float, dof: int, weights: FloatArray) -> float:
        """Return the probability of a chi-square yᵀ·Θ·y at least as large, or NaN."""
        from scipy.special import chdtrc, fdtrc

        if dof <= 0:
            return float("nan")
        factor, m = self.reference_distribution(dof, weights)
        return float(chdtrc(dof, chi2) if np.isinf(m) else fdtrc(dof, m, factor * chi2 / dof))

    def fails(self, chi2: float, dof: int, weights: FloatArray, confidence: float = TEST_CONFIDENCE) -> bool:
        """Return whether chi-square = yᵀ·Θ·y with weights Θ (N, N) is beyond its quantile."""
        # Estimated noise can only prevent a rejection, and only if its p-value is defined.
        return fails(chi2, dof, confidence) and not self.p_value(chi2, dof, weights) >= 1.0 - confidence

    def detectable_noncentrality(self, dof: int, weights: FloatArray, power: float) -> float:
        """Return the noncentrality that a test at 1 % detects with the probability `power`."""
        from scipy.special import chdtri, chndtrinc, fdtri, ncfdtrinc

        if dof <= 0:
            return float("inf")
        _, m = self.reference_distribution(dof, weights)
        if np.isinf(m):
            return float(chndtrinc(chdtri(dof, 1.0 - TEST_CONFIDENCE), dof, 1.0 - power))
        return float(ncfdtrinc(dof, m, 1.0 - power, fdtri(dof, m, TEST_CONFIDENCE)))


def _submatrix(weights: FloatArray, rows: IntArray) -> FloatArray:
    """Return weights between some readings, of all (N, N) or within blocks (B, n, n)."""
    if weights.ndim == 2:
        return np.asarray(weights[np.ix_(rows, rows)])
    block, within = divmod(rows, weights.shape[1])
    return np.asarray(weights[block[0]][np.ix_(within, within)])


def fails(chi2: float, dof: int, confidence: float = TEST_CONFIDENCE) -> bool:
    """Return whether chi-square by covariances that are known is beyond its quantile."""
    from scipy.special import chdtrc

    return dof > 0 and bool(chdtrc(dof, chi2) < 1.0 - confidence)


def variance_components(groups: Sequence[Contrasts]) -> tuple[FloatArray, FloatArray]:
    """Return non-negative variances (C,) common to independent groups, and their degrees of freedom (C,).

    An error that is the same at all lines appears at each of them. The groups together therefore do not have more
    degrees of freedom than the one with the most. 2 θ²/ν is the asymptotic variance of an estimate θ.
    """
    components = np.zeros(len(groups[0].patterns))
    for _ in range(ITERATIONS):
        parts = [group.normal_equations(components) for group in groups]
        estimate = _not_negative(np.sum([f for f, _ in parts], axis=0), np.sum([r for _, r in parts], axis=0))
        change, components = np.max(np.abs(estimate - components)), estimate
        if change <= 1e-6 * np.max(components):
            break
    dof = np.zeros(len(components))
    positive = components > 0.0
    for group in groups:
        information = group.normal_equations(components)[0][np.ix_(positive, positive)]
        scale = np.outer(components[positive], components[positive])
        variance = np.diag(np.linalg.pinv(information * scale, hermitian=True))
        dof[positive] = np.maximum(
            dof[positive], np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 1e-9)
        )
    return components, dof


def _not_negative(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Minimise x^T F x - 2 b^T x over x ≥ 0.

    Lawson and Hanson 1974, algorithm 23.10, on the normal equations. Components that the data do not determine are
    zero.
    """
    diagonal = np.diag(matrix)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, np.inf))
    square, target = matrix / np.outer(scale, scale), right / scale
    solution = np.zeros(len(right))
    free = np.zeros(len(right), dtype=np.bool_)

    def minimum() -> FloatArray:
        """Minimum over the free components alone, the others zero."""
        best = np.zeros(len(target))
        best[free] = np.linalg.lstsq(square[np.ix_(free, free)], target[free], rcond=1e-10)[0]
        return best

    for _ in range(ITERATIONS):
        slope = np.where(free, -np.inf, target - square @ solution)
        if np.max(slope) <= 1e-10 * np.max(np.abs(target)):
            break
        free[np.argmax(slope)] = True
        best = minimum()
        while np.any(best[free] <= 0.0):
            blocking = np.flatnonzero(free & (best <= 0.0))
            steps = solution[blocking] / np.maximum(solution[blocking] - best[blocking], 1e-300)
            solution = solution + np.min(steps) * (best - solution)
            free[blocking[steps <= np.min(steps)]] = False
            solution = np.where(free, solution, 0.0)
            best = minimum()
        solution = best
    return np.asarray(solution / scale)


def estimate_scatter(system: FusionSystem, solution: FusionSolution) -> tuple[Scatter, ...]:
    """Return the scatter of each instrument whose readings contradict a rigid motion.

    Each instrument is tested separately, line by line, against its stated uncertainties, before the readings are
    weighted. An instrument with no more readings than observed components cannot be tested and has no scatter. If one
    relative scatter explains all lines, it is estimated from all of them; otherwise every line has a separate one.
    """
    sizes, noise = motion_per_row(system, solution.acceleration), EstimatedNoise.from_system(system, solution.effects)
    lines, indices = range(len(system.observed)), range(len(system.observations))
    rows = [[np.flatnonzero((system.observation == index) & (system.line == k)) for k in lines] for index in indices]
    tests = [[_contrasts(system, solution, group_rows, sizes, None) for group_rows in rows[index]] for index in indices]
    count = sum(group is not None for groups in tests for group in groups)
    scatters = []
    for index, groups in zip(indices, tests, strict=True):
        if any(group is not None and _rejected(group, noise, count) for group in groups):
            patterns = _independent_error_patterns(system, solution.acceleration, sizes)
            whole = {
                k: _contrasts(system, solution, group_rows, sizes, patterns[:, group_rows[:, None], group_rows])
                for k, group_rows in enumerate(rows[index])
            }
            usable = {k: group for k, group in whole.items() if group is not None}
            scatters.append(_estimate_instrument_scatter(system.observations[index], usable, len(lines)))
    return tuple(scatters)


def _estimate_instrument_scatter(observation: Observation, groups: dict[int, Contrasts], lines: int) -> Scatter:
    """Estimate the scatter of one instrument, per line where lines differ by likelihood."""
    from scipy.special import chdtri

    components, dof = np.zeros((lines, 2)), np.zeros((lines, 2))
    pooled = variance_components(list(groups.values()))
    separate = {k: variance_components([group]) for k, group in groups.items()}
    gain = sum(group.deviance(pooled[0]) - group.deviance(separate[k][0]) for k, group in groups.items())
    together = gain <= chdtri(2 * len(groups) - 2, 1.0 - TEST_CONFIDENCE) if len(groups) > 1 else True
    for k in groups:
        components[k], dof[k] = pooled if together else separate[k]
    return Scatter(observation.title, np.sqrt(components[:, 0]), np.sqrt(components[:, 1]), _joint_dof(components, dof))


def _joint_dof(components: FloatArray, dof: FloatArray) -> FloatArray:
    """Return the degrees of freedom (K,) of two variances together, at most the larger."""
    total = np.sum(components, axis=1)
    weighted = np.sum(components**2 / np.maximum(dof, 1e-3), axis=1)
    joint = np.divide(total**2, weighted, out=np.full(len(total), np.inf), where=weighted > 0.0)
    return np.where(total > 0.0, np.minimum(joint, np.max(dof, axis=1)), np.inf)


def _rejected(group: Contrasts, noise: EstimatedNoise, tests: int) -> bool:
    """Return whether one of several chi-squares is too large, at 1 % for all."""
    confidence = 1.0 - (1.0 - TEST_CONFIDENCE) / tests
    weights = group.coefficients @ np.linalg.solve(group.covariance, group.coefficients.T)
    return noise.fails(group.chi2(NO_VALUES), len(group.values), weights, confidence)


def scatter_covariances(
    system: FusionSystem, acceleration: ComplexArray, scatters: Sequence[Scatter]
) -> list[AddedCovariance]:
    """Return the covariances that the scatter of instruments adds to the readings."""
    if not scatters:
        return []
    sizes, parts = motion_per_row(system, acceleration), []
    patterns = _independent_error_patterns(system, acceleration, sizes)
    titles = np.array([observation.title for observation in system.observations])[system.observation]
    for scatter in scatters:
        size = np.where(titles == scatter.instrument, sizes, 0.0)
        if np.any(size > 0.0):
            both = zip(patterns, (scatter.amplitude, scatter.phase), strict=True)
            covariance = np.sum([pattern * (u**2)[system.line] for pattern, u in both], axis=0) * np.outer(size, size)
            parts.append(AddedCovariance(f"{scatter.instrument}: unexplained scatter", covariance, scatter.dof))
    return parts


def contradictory_lines(system: FusionSystem, solution: FusionSolution) -> tuple[int, ...]:
    """Return the lines whose readings contradict each other, at 1 % for all lines together."""
    sizes, noise = motion_per_row(system, solution.acceleration), EstimatedNoise.from_system(system, solution.effects)
    every = [np.flatnonzero(system.line == k) for k in range(len(system.observed))]
    groups = [_contrasts(system, solution, rows, sizes, None) for rows in every]
    count = sum(group is not None for group in groups)
    return tuple(k for k, group in enumerate(groups) if group is not None and _rejected(group, noise, count))


def instrument_discrepancy(
    system: FusionSystem, solution: FusionSolution, lines: Sequence[int], label: str
) -> AddedCovariance:
    """Return the covariance of a motion that each instrument adds at some lines.

    It has a separate variance in every component, and for the parts in phase with the true motion and in quadrature.
    """
    sizes = motion_per_row(system, solution.acceleration)
    covariance, dof = np.zeros((len(sizes), len(sizes))), np.full(len(system.observed), np.inf)
    for k in (k for k in lines if np.any(system.line == k)):
        rows = np.flatnonzero(system.line == k)
        patterns = _instrument_motion_patterns(system, solution.acceleration, rows, sizes)
        group = _contrasts(system, solution, rows, sizes, patterns)
        if group is not None:
            components, freedom = variance_components([group])
            size = np.outer(sizes[rows], sizes[rows])
            covariance[np.ix_(rows, rows)] = np.tensordot(components, patterns, 1) * size
            dof[k] = max(float(_joint_dof(components[None], freedom[None])[0]), MIN_DISCREPANCY_DOF)
    return AddedCovariance(label, covariance, dof)


def motion_per_row(system: FusionSystem, acceleration: ComplexArray) -> FloatArray:
    """Return the motion (N,) of estimate or largest reading, in each row's unit."""
    size = np.linalg.norm(acceleration / SCALE, axis=1)
    factors = []
    for observation in system.observations:
        shift = np.linalg.norm(observation.design[..., :3], axis=2)
        turn = np.linalg.norm(observation.design[..., 3:], axis=2) / BODY_SIZE_M
        factors.append(np.where(shift > 0.0, shift, turn))
        readings = np.nan_to_num(np.abs(observation.phasors.value)) / factors[-1]
        size = np.maximum(size, np.max(readings, axis=1))
    size = np.where(size > 0.0, size, 1.0)
    return np.concatenate(
        [
            RowIndex.of(observation).rows(factor * size[:, None] * (1.0 + 1.0j))
            for observation, factor in zip(system.observations, factors, strict=True)
        ]
    )


def _contrasts(
    system: FusionSystem, solution: FusionSolution, rows: IntArray, sizes: FloatArray, patterns: FloatArray | None
) -> Contrasts | None:
    """Return combinations of a line's rows that no motion changes, or None."""
    if not len(rows):
        return None
    size = sizes[rows]
    design = system.design[rows][:, np.any(system.design[rows] != 0.0, axis=0)] / size[:, None]
    left, singular, _ = np.linalg.svd(design)
    across = left[:, np.count_nonzero(singular > RANK_TOLERANCE * singular[0]) :]
    if not across.shape[1]:
        return None
    effects = solution.effects[rows]
    covariance = (solution.noise[np.ix_(rows, rows)] + effects @ effects.T) / np.outer(size, size)
    rotated = np.zeros((0, 0, 0))
    if patterns is not None:
        # A component of which almost no part remains cannot be determined.
        rotated = across.T @ patterns @ across
        remaining = np.trace(rotated, axis1=1, axis2=2) > MIN_REMAINING_SHARE * np.trace(patterns, axis1=1, axis2=2)
        rotated = np.where(remaining[:, None, None], rotated, 0.0)
    coefficients = np.zeros((len(sizes), across.shape[1]))
    coefficients[rows] = across / size[:, None]
    return Contrasts(coefficients.T @ system.readings, across.T @ covariance @ across, rotated, coefficients)


def _independent_error_patterns(system: FusionSystem, acceleration: ComplexArray, sizes: FloatArray) -> FloatArray:
    """Return the patterns (2, N, N) of independent errors in phase and in quadrature."""
    predicted, coefficient = [], []
    for observation in system.observations:
        indices = RowIndex.of(observation)
        line, channel = indices.line[~indices.imaginary], indices.channel[~indices.imaginary]
        rows = observation.design[line, channel]
        predicted.append(np.einsum("nj,nj->n", rows, acceleration[line]))
        largest = rows[np.arange(len(rows)), np.argmax(np.abs(rows), axis=1)]
        coefficient.append(largest / np.abs(largest) * _motion_phase(acceleration)[line])
    # The direction of a reading is its prediction's, or the motion's where that is small.
    value, other = np.concatenate(predicted), np.concatenate(coefficient)
    significant = np.abs(value) > MIN_DIRECTED_SHARE * sizes[system.pairs[:, 0]]
    directions = np.where(significant, value / np.where(significant, np.abs(value), 1.0), other)
    patterns = np.zeros((2, len(sizes), len(sizes)))
    for number, turn in enumerate((1.0, 1.0j)):
        parts = np.stack([(directions * turn).real, (directions * turn).imag], axis=1)
        patterns[number, system.pairs[:, :, None], system.pairs[:, None, :]] = parts[:, :, None] * parts[:, None, :]
    return patterns


def _motion_phase(acceleration: ComplexArray) -> ComplexArray:
    """Direction (K,) along which the components of a line lie best in the complex plane."""
    squares = np.sum((acceleration / SCALE) ** 2, axis=1)
    return np.asarray(np.exp(0.5j * np.angle(squares)))


def _instrument_motion_patterns(
    system: FusionSystem, acceleration: ComplexArray, rows: IntArray, sizes: FloatArray
) -> FloatArray:
    """Return the patterns (12, n, n) of a motion that each instrument adds."""
    line = system.line[rows[0]]
    direction = _motion_phase(acceleration)[line]
    size = np.linalg.norm(acceleration[line] / SCALE)
    unit = np.concatenate([np.diag(SCALE * direction), np.diag(SCALE * direction * 1j)]) * size
    patterns = np.zeros((12, len(rows), len(rows)))
    start = 0
    for observation in system.observations:
        indices = RowIndex.of(observation)
        chosen = indices.line == line
        seen = indices.design(observation.design)[chosen] @ np.concatenate([unit.real, unit.imag], axis=1).T
        end = start + len(seen)
        scaled = seen / sizes[rows[start:end], None]
        patterns[:, start:end, start:end] = np.einsum("nc,mc->cnm", scaled, scaled)
        start = end
    return patterns
