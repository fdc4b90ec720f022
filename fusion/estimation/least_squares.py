"""Readings of all lines as real rows, and their whitened least squares with common errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag, solve_triangular
from scipy.sparse import csr_array, diags_array

from fusion.errors import ComputeError
from fusion.estimation.estimation_notices import UNBOUNDED_READINGS
from fusion.estimation.measurement_model import SCALE, UnobservedMotion, relative_change
from fusion.estimation.uncertainty import as_complex, real_stack
from shaker.labels import MOTION_COMPONENTS
from shaker.sine.phasor import real_stacked
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

if TYPE_CHECKING:
    from fusion.estimation.measurement_model import CommonError, Observation

# The linear system of the fusion: readings of all lines as real rows, and the effects of their common errors.


RANK_TOLERANCE = 1e-6
RESOLUTION_TOLERANCE = 1e-6
ROUNDING = 1e-9
UNOBSERVED = "unobserved motion"
"""Label of effects of unobserved components on observed ones, through uncertain directions and positions."""
UNOBSERVED_ITSELF = tuple(f"unobserved {name}" for name in MOTION_COMPONENTS)
"""Labels of direct effects of such a component on readings and on the load."""


def row_space(observations: Sequence[Observation], line: int) -> ComplexArray:
    """Return a basis (6, R) of the accelerations that usable readings determine.

    At one line. Rows have equal length, and rotations are scaled by `BODY_SIZE_M`, so that only the geometry decides.
    Directions whose singular value is below 1e-6 of the largest are omitted. For beams that nearly follow an axis, the
    rows along that axis decide.
    """
    stacked = np.concatenate([o.main_design[line][np.isfinite(o.phasors.value[line])] * SCALE for o in observations])
    length = np.linalg.norm(stacked, axis=1, keepdims=True)
    stacked = stacked / np.where(length > 0.0, length, 1.0)
    if not len(stacked) or not np.any(stacked):
        return np.zeros((6, 0), np.complex128)
    _, singular, right = np.linalg.svd(stacked, full_matrices=False)
    return np.asarray(right[singular > RANK_TOLERANCE * singular[0]].conj().T)


def observed_components(basis: ComplexArray) -> BoolArray:
    """Return which components (6,) a basis spans: their resolution is 1 within 1e-6."""
    return np.asarray(np.sum(np.abs(basis) ** 2, axis=1) > 1.0 - RESOLUTION_TOLERANCE)


@dataclass(frozen=True)
class RowErrors:
    """Effects of the common errors of one observation on its real rows.

    `block`: these rows of the system. The effect (n, e) of one standard uncertainty is `slope` (n, e, 12) · [Re A, Im
    A] of the row's line + `offset` (n, e), for the system's errors `columns` (e,).
    """

    block: slice
    columns: IntArray
    slope: FloatArray
    offset: FloatArray


@dataclass(frozen=True)
class FusionSystem:
    """All usable readings of a set of observations as N real rows.

    `readings` (N,); `design` (N, P) on the reduced unknowns; `noise` (N, N); `size` (N,): largest reading of the row's
    instrument at its line. `line`, `observation`, `channel` (of the observation), `member` (N,): to which each row
    belongs. `pairs` (N/2, 2): rows of real and imaginary part of every reading. `member_names`. `expand` (12K, P): from
    the unknowns to [Re A_k, Im A_k] of all lines. `observed` (K, 6). `common`: the E common errors, each once;
    `errors`: their effects per observation.

    `unobserved_motion`: its assumed limits. `share` (K,): observed part of the driven motion (`driven_share`). `beyond`
    (N, 12): effect of [Re A, Im A] that are not among the unknowns on the rows. `couplings`: for each line its rows
    and, sparse, the effect of such motion through common errors, 12 columns for each.
    """

    observations: tuple[Observation, ...]
    readings: FloatArray
    design: FloatArray
    noise: FloatArray
    size: FloatArray
    line: IntArray
    observation: IntArray
    channel: IntArray
    member: IntArray
    pairs: IntArray
    member_names: tuple[str, ...]
    expand: FloatArray
    observed: BoolArray
    common: tuple[CommonError, ...]
    errors: tuple[RowErrors, ...]
    beyond: FloatArray
    unobserved_motion: UnobservedMotion = field(default_factory=UnobservedMotion)
    share: FloatArray | None = None
    couplings: tuple[tuple[IntArray, csr_array], ...] = ()

    def effects(self, acceleration: ComplexArray) -> FloatArray:
        """Return the changes (N, E) of the readings per standard uncertainty of each error."""
        effects = np.zeros((len(self.readings), len(self.common)))
        motion = real_stack(acceleration)[self.line]
        for part in self.errors:
            change = np.einsum("nej,nj->ne", part.slope, motion[part.block]) + part.offset
            effects[part.block, part.columns] = change
        return effects

    def driven_limit(self, acceleration: ComplexArray) -> FloatArray | None:
        """Return the largest amplitude (K,) of the driven motion, None without a stated drive."""
        if self.unobserved_motion.drive is None or self.share is None:
            return None
        return self.unobserved_motion.driven_amplitude(acceleration, self.share)

    def hidden(self, acceleration: ComplexArray) -> UnobservedEffects:
        """Return the effects of unobserved components on the readings.

        These components are zero in the estimate A (K, 6) and have the amplitudes of `unobserved_motion`; motions of
        different lines are independent. A laser beam 5 mrad off its axis measures that share of a transverse motion,
        and all beams of a tilted head measure the same. A product of two unknowns, error times motion, has the product
        of their variances. All readings that share the error share it.
        """
        amplitude = self.unobserved_motion.amplitude(acceleration, self.observed, self.share)
        # Unbounded motion reaches none of the remaining readings (`without_unbounded`).
        u = np.tile(np.where(np.isinf(amplitude), 0.0, amplitude) / np.sqrt(2.0), (1, 2))
        direct, count = self.beyond * u[self.line], len(self.readings)
        through, total = np.zeros((count, count)), np.zeros((count, count))
        for (rows, coupling), parts in zip(self.couplings, u, strict=True):
            if np.any(parts > 0.0):
                block, seen = np.ix_(rows, rows), coupling @ diags_array(np.tile(parts, coupling.shape[1] // 12))
                through[block] = (seen @ seen.T).toarray()
                total[block] = through[block] + direct[rows] @ direct[rows].T
        return UnobservedEffects(direct, through, total)

    def acceleration(self, unknowns: FloatArray) -> ComplexArray:
        """Return A (K, 6) from the reduced unknowns (P,), zero where no reading determines it."""
        return as_complex((self.expand @ unknowns).reshape(-1, 12))


@dataclass(frozen=True)
class UnobservedEffects:
    """Effects of unobserved components on the N readings of a system.

    `direct` (N, 12): effect on the row for one standard uncertainty of [Re, Im] of each component at the row's line.
    `through` (N, N): covariance of products with common errors. `covariance` (N, N): of both.
    """

    direct: FloatArray
    through: FloatArray
    covariance: FloatArray

    def carried(self, system: FusionSystem, gain: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the effects on an estimate of `gain` (K, 12, N).

        Two arrays (K, 12, 12): the change of [Re A, Im A] of a line for one standard uncertainty of each such [Re, Im],
        and the covariance from common errors and from other lines.
        """
        rest = np.asarray(gain @ self.through @ gain.swapaxes(1, 2))
        leaked = np.zeros_like(rest)
        for line, (rows, _) in enumerate(system.couplings):
            heard = gain[:, :, rows] @ self.direct[rows]
            leaked[line], heard[line] = heard[line], 0.0
            rest += heard @ heard.swapaxes(1, 2)
        return leaked, rest


@dataclass(frozen=True)
class RowIndex:
    """Line, channel and part (real or imaginary) of each real row of an observation."""

    line: IntArray
    channel: IntArray
    imaginary: BoolArray

    @classmethod
    def of(cls, observation: Observation) -> RowIndex:
        """Return the rows of all usable readings, line by line, real parts before imaginary ones."""
        line, part = np.nonzero(np.tile(np.isfinite(observation.phasors.value), (1, 2)))
        channels = observation.phasors.value.shape[1]
        return cls(line, part % channels, part >= channels)

    def rows(self, values: ComplexArray) -> FloatArray:
        """Return (..., K, M) complex values as (..., n) real rows."""
        chosen = values[..., self.line, self.channel]
        return np.where(self.imaginary, chosen.imag, chosen.real)

    def design(self, matrix: ComplexArray) -> FloatArray:
        """Return complex rows (..., 6) as real rows that act on [Re A, Im A]."""
        chosen = matrix[..., self.line, self.channel, :]
        rotated = np.where(self.imaginary[:, None], -1j * chosen, chosen)
        return np.concatenate([rotated.real, -rotated.imag], axis=-1)

    def covariance(self, covariance: FloatArray) -> FloatArray:
        """Return the covariance (n, n) of the rows from that of every line."""
        both = self.channel + self.imaginary * (covariance.shape[1] // 2)
        same = self.line[:, None] == self.line
        return np.where(same, covariance[self.line[:, None], both[:, None], both], 0.0)


def build_system(
    observations: Sequence[Observation], unobserved_motion: UnobservedMotion | None = None
) -> FusionSystem:
    """Collect the usable readings of observations that share their lines into one system."""
    lines = len(observations[0].phasors.frequency_hz)
    bases = [row_space(observations, line) for line in range(lines)]
    starts = np.concatenate([[0], np.cumsum([2 * basis.shape[1] for basis in bases])]).astype(np.int64)
    expand = np.zeros((12 * lines, starts[-1]))
    for k, basis in enumerate(bases):
        expand[12 * k : 12 * k + 12, starts[k] : starts[k + 1]] = real_stacked(SCALE[:, None] * basis)
    names = tuple(dict.fromkeys(name for o in observations for name in o.members))
    common: dict[str, CommonError] = {}
    for error in (error for observation in observations for error in observation.common):
        common.setdefault(error.name, error)
    columns = {name: column for column, name in enumerate(common)}
    indices = [RowIndex.of(observation) for observation in observations]
    both = list(zip(observations, indices, strict=True))
    line = np.concatenate([index.line for index in indices])
    where = np.repeat(np.arange(len(indices)), [len(index.line) for index in indices])
    imaginary = np.concatenate([index.imaginary for index in indices])
    readings = np.concatenate([index.rows(o.phasors.value) for o, index in both])
    motion = np.concatenate([index.design(o.design) for o, index in both])
    largest = np.zeros(len(indices) * lines)
    np.maximum.at(largest, where * lines + line, np.abs(readings))
    errors = []
    for number, (o, index) in enumerate(both):
        if o.common:
            slopes, rows = np.stack([error.slope for error in o.common]), np.flatnonzero(where == number)
            errors.append(
                RowErrors(
                    block=slice(rows[0], rows[-1] + 1) if len(rows) else slice(0, 0),
                    columns=np.array([columns[error.name] for error in o.common]),
                    slope=index.design(slopes).swapaxes(0, 1),
                    offset=index.rows(np.stack([error.offset for error in o.common])).T,
                )
            )
    return FusionSystem(
        observations=tuple(observations),
        readings=readings,
        design=np.einsum("nj,njp->np", motion, expand.reshape(lines, 12, -1)[line]),
        noise=block_diag(*(index.covariance(o.phasors.covariance) for o, index in both)),
        size=np.where(largest > 0.0, largest, 1.0)[where * lines + line],
        line=line,
        observation=where,
        channel=np.concatenate([index.channel for index in indices]),
        member=np.concatenate([np.array([names.index(m) for m in o.members])[index.channel] for o, index in both]),
        # In each line of an observation real and imaginary parts come in the same order.
        pairs=np.stack([np.flatnonzero(~imaginary), np.flatnonzero(imaginary)], axis=1),
        member_names=names,
        expand=expand,
        observed=np.array([observed_components(basis) for basis in bases]),
        common=tuple(common.values()),
        errors=tuple(errors),
        beyond=_beyond(motion, line, bases),
        unobserved_motion=unobserved_motion or UnobservedMotion(),
        share=np.array([driven_share(basis, unobserved_motion) for basis in bases]),
        couplings=tuple(_couplings(np.flatnonzero(line == k), errors, len(common)) for k in range(lines)),
    )


def driven_share(basis: ComplexArray, unobserved_motion: UnobservedMotion | None) -> float:
    """Return the observed part of the driven motion as a square, 1 without a drive."""
    drive = None if unobserved_motion is None else unobserved_motion.drive
    return 1.0 if drive is None else float(np.sum(np.abs(basis.conj().T @ np.array(drive)) ** 2))


def without_unbounded(
    observations: Sequence[Observation], unobserved_motion: UnobservedMotion | None
) -> tuple[Observation, ...]:
    """Return observations without the readings (NaN) that an unbounded motion reaches.

    If the driven motion is neither observed nor limited, motion related to it has no limit either. It reaches readings
    directly and through uncertain directions and positions. Rejected readings no longer observe a motion, which may
    make others unbounded.
    """
    remaining = tuple(observations)
    if unobserved_motion is None or unobserved_motion.drive is None or not remaining:
        return remaining
    lines = len(remaining[0].phasors.frequency_hz)
    while True:
        bases = [row_space(remaining, line) for line in range(lines)]
        lost = unobserved_motion.unbounded(np.array([driven_share(basis, unobserved_motion) for basis in bases]))
        reached = [np.isfinite(o.phasors.value) & lost[:, None] for o in remaining]
        for mask, o in zip(reached, remaining, strict=True):
            for line in np.flatnonzero(lost).tolist():
                mask[line] &= _reached(o, line, bases[line])
        if not any(mask.any() for mask in reached):
            return remaining
        remaining = tuple(drop_rows(o, mask) for o, mask in zip(remaining, reached, strict=True))


def _reached(observation: Observation, line: int, basis: ComplexArray) -> BoolArray:
    """Return which readings (M,) motion beyond a basis changes, directly or through common errors."""
    rows, hidden = observation.design[line] * SCALE, ~observed_components(basis)
    least = ROUNDING * np.abs(rows).max(axis=1)
    found = np.abs(rows - rows @ basis @ basis.conj().T).max(axis=1) > least
    for error in observation.common:
        found |= np.abs(error.slope[line] * SCALE)[:, hidden].max(axis=1, initial=0.0) > least
    return np.asarray(found)


def drop_rows(observation: Observation, gone: BoolArray) -> Observation:
    """Return an observation with the readings `gone` (K, M) replaced by NaN."""
    value, covariance = observation.phasors.value.copy(), observation.phasors.covariance.copy()
    value[gone] = complex(np.nan, np.nan)
    lost = np.tile(~np.isfinite(value), (1, 2))
    covariance[lost[:, :, None] | lost[:, None, :]] = np.nan
    return replace(observation, phasors=replace(observation.phasors, value=value, covariance=covariance))


def bounded_system(observations: Sequence[Observation], unobserved_motion: UnobservedMotion | None) -> FusionSystem:
    """Return the system of readings that no unbounded motion reaches; `Unbounded` where there are none."""
    left = without_unbounded(observations, unobserved_motion)
    if unobserved_motion is not None and not any(np.isfinite(o.phasors.value).any() for o in left):
        body = observations[0].body
        driven = unmeasured_drive(body, unobserved_motion, np.zeros(6, np.bool_))
        raise Unbounded(UNBOUNDED_READINGS, body, driven=driven, unused="")
    return build_system(left, unobserved_motion)


class Unbounded(ComputeError):
    """No reading is left, since each could contain a driven motion that no instrument observes."""


def unmeasured_drive(body: str, unobserved_motion: UnobservedMotion, observed: BoolArray) -> str:
    """Return the components of the driven motion that are not `observed` (6,), as text."""
    drive = unobserved_motion.drive or (0.0,) * 6
    named = [name for name, part, seen in zip(MOTION_COMPONENTS, drive, observed, strict=True) if part and not seen]
    return f"{' and '.join(named)} of the {body}"


def _beyond(motion: FloatArray, line: IntArray, bases: Sequence[ComplexArray]) -> FloatArray:
    """Return the effect (N, 12) of motion beyond each line's basis on all rows."""
    beyond = np.stack([real_stacked(np.eye(6) - SCALE[:, None] * (b @ b.conj().T) / SCALE) for b in bases])
    effect = np.einsum("nj,nji->ni", motion, beyond[line])
    # The remainder of a row that lies in the basis is rounding.
    return np.where(np.abs(effect) > ROUNDING * np.abs(motion).max(axis=1, keepdims=True), effect, 0.0)


def _couplings(rows: IntArray, errors: Sequence[RowErrors], count: int) -> tuple[IntArray, csr_array]:
    """Return the rows of one line and how motion acts on them by `count` errors."""
    coupling = np.zeros((len(rows), count, 12))
    for part in errors:
        inside = np.flatnonzero((rows >= part.block.start) & (rows < part.block.stop))
        coupling[np.ix_(inside, part.columns)] = part.slope[rows[inside] - part.block.start]
    return rows, csr_array(coupling.reshape(len(rows), 12 * count))


def products(system: FusionSystem, acceleration: ComplexArray) -> FloatArray:
    """Return (E,): second-order action of each common error relative to its first order.

    A relative error c multiplies the reading of a channel, which differs from the prediction r at A (K, 6) by the
    effects e_k of all other errors. The rms over all readings is √(Σ w|c|²Σ_k|e_k|² / Σ w|c|²|r|²), with w the inverse
    variance of the noise. Motion across the axis of a channel may be as large as the small motion along it. Zero for
    errors that are not relative; their products with relative errors are small.
    """
    changed, plain = (np.zeros(len(system.common)) for _ in range(2))
    columns = {error.name: column for column, error in enumerate(system.common)}
    for o in system.observations:
        usable = np.isfinite(o.phasors.value)
        both = o.phasors.covariance.diagonal(axis1=1, axis2=2)
        variance = np.where(usable, both[:, : usable.shape[1]] + both[:, usable.shape[1] :], 1.0)
        weight = np.divide(1.0, variance, out=np.zeros(usable.shape), where=usable & (variance > 0.0))
        reading = np.abs(np.einsum("kmj,kj->km", o.design, acceleration)) ** 2
        effects = {error.name: np.abs(error.effect(acceleration)) ** 2 for error in o.common}
        total = np.sum([np.zeros(usable.shape), *effects.values()], axis=0)
        for error in o.common:
            relative = relative_change(error, o.design)
            if relative is not None:
                share = weight * np.abs(relative) ** 2
                changed[columns[error.name]] += np.sum(np.nan_to_num(share * (total - effects[error.name])))
                plain[columns[error.name]] += np.sum(np.nan_to_num(share * reading))
    return np.asarray(np.sqrt(np.divide(changed, plain, out=np.zeros_like(plain), where=plain > 0.0)))


# Whitened least squares: accelerations and common errors estimated together, with all that follows from it.


NOISE_FLOOR = 1e-4
CONVERGED = 1e-10


@dataclass(frozen=True)
class FusionSolution:
    """Estimate of a system of readings.

    `acceleration` (K, 6); `errors` (E,) in standard uncertainties; `effects` (N, E) at this estimate. `remaining` (E,):
    standard uncertainty of the errors after the estimate over that before; `posterior` (E, E): their covariance, in
    standard uncertainties.

    `gain` (12K, N): estimate = gain · readings. `projector` (N, N) = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1 with the
    covariance V of noise and common errors, so that `chi2` = y^T P y; `dof`. `noise` (N, N): as used, with the
    discrepancy and the covariance of unobserved motion (`hidden`).
    """

    acceleration: ComplexArray
    errors: FloatArray
    remaining: FloatArray
    posterior: FloatArray
    effects: FloatArray
    gain: FloatArray
    projector: FloatArray
    chi2: float
    dof: int
    noise: FloatArray
    hidden: UnobservedEffects


def solve(system: FusionSystem, extra: FloatArray | None = None, iterations: int = 8) -> FusionSolution:
    """Estimate accelerations and common errors together by least squares.

    The augmented system [X S; 0 I] [A; e] = [y; 0], whitened by the noise, is equivalent to generalised least squares
    with the covariance N + S S^T. S is evaluated at the current estimate and the step repeated. A low reading therefore
    gains no weight (Peelle's puzzle; D'Agostini 1994, Nucl. Instrum. Methods A 346, 306). `extra` (N, N): covariance of
    the readings in addition to the stated one.
    """
    noise = system.noise if extra is None else system.noise + extra
    # To start with no common errors, every reading weighted by its noise and a hundredth of its size.
    weight = 1.0 / np.sqrt(np.diag(noise) + (1e-2 * system.size) ** 2)
    start = np.linalg.lstsq(system.design * weight[:, None], system.readings * weight, rcond=None)[0]
    acceleration = system.acceleration(np.asarray(start))
    for _ in range(iterations):
        step = _augmented(system, noise, acceleration)
        before, acceleration = acceleration, step.acceleration(system)
        change = np.max(np.abs(acceleration - before), initial=0.0)
        if change <= CONVERGED * np.max(np.abs(acceleration), initial=0.0):
            break
    return _solution(system, _augmented(system, noise, acceleration))


@dataclass(frozen=True)
class _Step:
    """The augmented system, whitened by the `root` of the `noise`, with column `scale`."""

    matrix: FloatArray
    readings: FloatArray
    scale: FloatArray
    root: FloatArray
    noise: FloatArray
    effects: FloatArray
    hidden: UnobservedEffects

    def acceleration(self, system: FusionSystem) -> ComplexArray:
        """Return the estimate alone."""
        unknowns = len(self.scale)
        right = np.zeros(len(self.matrix))
        right[: len(self.readings)] = self.readings
        triangle = np.asarray(np.linalg.qr(np.column_stack([self.matrix, right]), mode="r"))
        size = self.matrix.shape[1]
        unknown_values = solve_triangular(triangle[:size, :size], triangle[:size, -1], check_finite=False)
        return system.acceleration(unknown_values[:unknowns] / self.scale)


def _augmented(system: FusionSystem, noise: FloatArray, acceleration: ComplexArray) -> _Step:
    """Return the whitened system with the effects of errors and unobserved motion."""
    effects, hidden = system.effects(acceleration), system.hidden(acceleration)
    # Noise far below the common errors is raised to 1e-4 of them: invisible in U, and P keeps its digits.
    floor = (NOISE_FLOOR * np.linalg.norm(effects, axis=1)) ** 2 + (1e-12 * system.size) ** 2
    noise = noise + hidden.covariance
    variance = np.diag(noise)
    # A share of 1e-9 of the variances keeps covariances of channels with equal motion positive definite.
    noise = noise + np.diag(np.maximum(floor - variance, 0.0) + 1e-9 * variance)
    root = np.asarray(np.linalg.cholesky(noise))
    count, unknowns, errors = len(system.readings), system.design.shape[1], effects.shape[1]
    columns = np.column_stack([system.design, effects, system.readings])
    white = solve_triangular(root, columns, lower=True, check_finite=False)
    scale = np.asarray(np.linalg.norm(white[:, :unknowns], axis=0))
    matrix = np.zeros((count + errors, unknowns + errors))
    matrix[:count] = white[:, :-1]
    matrix[:count, :unknowns] /= scale
    matrix[count:, unknowns:] = np.eye(errors)
    return _Step(matrix, white[:, -1], scale, root, noise, effects, hidden)


def _solution(system: FusionSystem, step: _Step) -> FusionSolution:
    count, unknowns = len(system.readings), system.design.shape[1]
    q, r = np.linalg.qr(step.matrix)
    white_projector = np.eye(count) - q[:count] @ q[:count].T
    inverse = solve_triangular(r, q[:count].T, check_finite=False)
    left = solve_triangular(
        step.root, np.column_stack([white_projector, inverse.T]), lower=True, trans="T", check_finite=False
    )
    gain = left[:, count:].T
    after = solve_triangular(r[unknowns:, unknowns:], np.eye(len(r) - unknowns), check_finite=False)
    return FusionSolution(
        acceleration=system.acceleration(inverse[:unknowns] @ step.readings / step.scale),
        errors=inverse[unknowns:] @ step.readings,
        remaining=np.linalg.norm(after, axis=1),
        posterior=after @ after.T,
        effects=step.effects,
        gain=system.expand @ (gain[:unknowns] / step.scale[:, None]),
        projector=solve_triangular(step.root, left[:, :count].T, lower=True, trans="T", check_finite=False),
        chi2=float(step.readings @ white_projector @ step.readings),
        dof=count - unknowns,
        noise=step.noise,
        hidden=step.hidden,
    )
