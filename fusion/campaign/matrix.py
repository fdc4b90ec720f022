"""Complex 6 x 6 sensitivity matrix at one frequency, and its cross-talk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.campaign.campaign_notices import INCONSISTENT_MATRIX, MISSING_MATRIX_ROW, UNTESTED_MATRIX
from fusion.campaign.excited_line import FREQUENCY_TOLERANCE, LOADS, ExcitedLine
from fusion.campaign.line_stack import Stack, stack_drives
from fusion.campaign.matrix_solve import (
    LoadExcitation,
    MatrixSolution,
    changes,
    drives_excite,
    estimated_noise,
    excitation,
    judge,
    require_six,
    solve,
)
from fusion.estimation.coverage import region
from fusion.estimation.instrument_consistency import leave_out_rows
from fusion.estimation.uncertainty import Contribution, Uncertainty, merge_contributions
from fusion.sensitivity.ratio import Sensitivity
from shaker.labels import LOAD_COMPONENTS
from shaker.sine.phasor import real_stacked, real_stacked_diagonal
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, check_shape
from shakercal._common.notices import Notice

# The complex matrix of sensitivities at one frequency, from several recordings, with all that makes it uncertain.


DISAGREEMENT = "disagreement of the recordings"
DISCREPANCY_RANGE = (1e-9, 10.0)
"""Range of the search for the relative disagreement of recordings."""
RANK_TOLERANCE = 1e-9
"""Relative tolerance for the rank of a projector, for rounding."""
REJECT_CHI2 = 100.0
"""Chi-square per degree of freedom above which the stated uncertainties do not describe the readings."""


@dataclass(frozen=True)
class Agreement:
    """Agreement of one line with the matrix of all others.

    `normalised_deviation`: root of chi-square per degree of freedom of its outputs (1 is expected; NaN if the others do
    not determine a matrix); `readings`: number of real readings in this test.
    """

    recording: str
    mounting: str
    frequency_hz: float
    normalised_deviation: float
    readings: int


@dataclass(frozen=True)
class MatrixFit:
    """Matrix `value` (C, 6) of outputs over loads at one frequency.

    `uncertainty` (K = 1) of its 6C elements, channel by channel, with unknowns under campaign-wide names. `load_size`
    (6,): largest loads of the lines; `excitation`: how well the lines separate the columns. `chi2` and `dof` are those
    with the stated uncertainties. `discrepancy`: additional standard deviation relative to the outputs, 0 if the
    recordings agree. `agreement` of every line.
    """

    frequency_hz: float
    channels: tuple[str, ...]
    value: ComplexArray
    uncertainty: Uncertainty
    load_size: FloatArray
    excitation: LoadExcitation
    chi2: float
    dof: int
    discrepancy: float
    agreement: tuple[Agreement, ...]
    notices: tuple[Notice, ...]

    @property
    def worst(self) -> Agreement | None:
        """Line that agrees least with the others; None if there is no test."""
        tested = [item for item in self.agreement if np.isfinite(item.normalised_deviation)]
        return max(tested, key=lambda item: item.normalised_deviation, default=None)

    def sensitivity(self, unit: str) -> Sensitivity:
        """Return the matrix as a sensitivity of one line; `unit` is that of the outputs."""
        return Sensitivity(
            frequency_hz=np.array([self.frequency_hz]),
            value=self.value[None],
            elements=tuple((c, j) for c in range(len(self.channels)) for j in range(LOADS)),
            uncertainty=self.uncertainty,
            channels=self.channels,
            components=LOAD_COMPONENTS,
            unit=unit,
            kind=("matrix",),
            notices=self.notices,
        )


def fit_matrix(drives: Sequence[ExcitedLine], channels: Sequence[str] | None = None) -> MatrixFit:
    """Return the 6 x 6 matrix of outputs over loads by maximum likelihood.

    Outputs are S · load. Both have errors; a shared error is one unknown for all lines
    (`fusion.campaign.matrix_solve`). Either all six columns are determined or none. If the lines do not excite six
    independent loads, `MissingExcitationError` names the missing ones.

    Recordings may disagree beyond the stated uncertainties (chi-square at 1 %, with estimated noise as in
    `estimated_noise`). Then every output gets the further standard deviation τ·max_j|S_ij|·|load| that makes chi-square
    equal its degrees of freedom (Paule & Mandel 1982, J. Res. NBS 87, 377). Within one mounting and direction it is one
    error, since a new mounting is its usual cause.

    `channels`: order of the outputs, by default that of the lines; an output with too few recordings has no row.
    """
    if not drives:
        raise ValueError("drives: expected at least one, found none")
    low, high = (limit(drive.frequency_hz for drive in drives) for limit in (min, max))
    if high > low * (1.0 + FREQUENCY_TOLERANCE):
        width = f"{100.0 * FREQUENCY_TOLERANCE:.2f} %"
        raise ValueError(f"drives: expected one frequency within {width}, found {low:g} Hz to {high:g} Hz")
    names = tuple(dict.fromkeys(name for drive in drives for name in drive.channels) if channels is None else channels)
    require_six(drives_excite(drives), len(drives))
    stack = stack_drives(drives, names)
    found = excitation(stack)
    require_six(found, len(drives))
    determined = [c for c in range(len(names)) if excitation(stack, np.flatnonzero(stack.usable[:, c])).determines]
    if not determined:
        raise ValueError("drives: expected an output recorded under six independent loads, found none")
    notices = []
    if len(determined) < len(names):
        left_out = ", ".join(name for c, name in enumerate(names) if c not in determined)
        notices.append(Notice(MISSING_MATRIX_ROW, "matrix", channels=left_out))
    stack = stack_drives(drives, [names[c] for c in determined])
    solution, first, tau = _solve(stack)
    agreement = _agreement(stack, first)
    fit = MatrixFit(
        frequency_hz=stack.frequency_hz,
        channels=stack.channels,
        value=solution.matrix * stack.output_size[:, None] / stack.load_size,
        uncertainty=_uncertainty(stack, solution, tau),
        load_size=stack.load_size,
        excitation=found,
        chi2=first.chi2,
        dof=first.dof,
        discrepancy=tau,
        agreement=agreement,
        notices=(),
    )
    worst = fit.worst
    if fit.dof == 0 or worst is None:
        numbers = {"count": len(agreement), "frequency_hz": fit.frequency_hz}
        notices.append(Notice(UNTESTED_MATRIX, "matrix", **numbers))
    elif tau > 0.0:
        notices.append(
            Notice(
                INCONSISTENT_MATRIX,
                "matrix",
                frequency_hz=fit.frequency_hz,
                chi2=fit.chi2,
                dof=fit.dof,
                recording=worst.recording,
                normalised_deviation=worst.normalised_deviation,
                discrepancy=tau,
            )
        )
    return replace(fit, notices=tuple(notices))


def _agreement(stack: Stack, solution: MatrixSolution) -> tuple[Agreement, ...]:
    """Return the agreement of every line's outputs with all others."""
    judged = []
    for r, (drive, usable) in enumerate(zip(stack.drives, np.tile(stack.usable, (1, 2)), strict=True)):
        rows, numbers = (
            np.flatnonzero(usable),
            (solution.projector[r], solution.projected_residual[r], solution.size[r]),
        )
        chi2, count, _ = leave_out_rows(*numbers, rows, RANK_TOLERANCE)
        deviation = float(np.sqrt(chi2 / count)) if count else np.nan
        judged.append(Agreement(drive.recording, drive.mounting, drive.frequency_hz, deviation, count))
    return tuple(judged)


def _solve(stack: Stack) -> tuple[MatrixSolution, MatrixSolution, float]:
    """Return the solution, that with stated uncertainties alone, and the relative disagreement (0: none)."""
    start = judge(stack)
    if start.chi2 < REJECT_CHI2 * max(start.dof, 1):
        plain = solve(stack)
        if not estimated_noise(stack, plain).fails(plain.chi2, plain.dof, plain.projector):
            return plain, plain, 0.0
    solution, tau = _disagreeing(stack)
    return solution, judge(stack, solution), tau


def _spread(stack: Stack, tau: float) -> FloatArray:
    """Return standard deviations (R, C) of both parts of the outputs for a relative disagreement."""
    matrix = judge(stack).matrix
    return np.asarray(tau * np.linalg.norm(stack.load, axis=1)[:, None] * np.max(np.abs(matrix), axis=1))


def _disagreeing(stack: Stack) -> tuple[MatrixSolution, float]:
    """Return the solution with the relative disagreement that makes chi-square equal its degrees of freedom."""
    unit = _spread(stack, 1.0)

    def excess(log_tau: float) -> float:
        found = solve(stack, float(np.exp(log_tau)) * unit)
        return found.chi2 - found.dof

    high, lowest = np.log(DISCREPANCY_RANGE[::-1])
    if excess(high) > 0.0:
        raise ValueError("drives: expected recordings of one sensor, found outputs that no matrix describes")
    low = high - 1.0
    while low > lowest and excess(low) < 0.0:
        low, high = low - 1.0, low
    if excess(low) < 0.0:
        return solve(stack), 0.0
    from scipy.optimize import brentq  # imported late: most lines agree

    tau = float(np.exp(brentq(excess, low, high, xtol=1e-2)))
    return solve(stack, tau * unit), tau


def _uncertainty(stack: Stack, solution: MatrixSolution, tau: float) -> Uncertainty:
    """Return the uncertainty of the 6C elements: individual errors, shared unknowns, disagreement."""
    random: tuple[Contribution, ...] = ()
    for r, gain in enumerate(solution.gain):
        parts = [*random, *stack.output_noise[r].transformed(gain[None]).random]
        parts += stack.load_noise[r].transformed(-(gain @ solution.load_design[r])[None]).random
        random = merge_contributions(parts)
    if tau > 0.0:
        # One error for lines of equal mounting and direction.
        spread = np.tile(_spread(stack, tau), (1, 2))
        same_setup: dict[tuple[str, tuple[float, ...]], list[int]] = {}
        for r, drive in enumerate(stack.drives):
            same_setup.setdefault((drive.mounting, drive.direction), []).append(r)
        effects = (np.sum(solution.gain[members] * spread[members, None], axis=0) for members in same_setup.values())
        covariance = sum(
            (effect @ effect.T for effect in effects), np.zeros((solution.gain.shape[1], solution.gain.shape[1]))
        )
        random += (Contribution(DISAGREEMENT, "A", covariance[None], np.array([float(max(solution.dof, 1))])),)
    pairs = zip(stack.unknowns, changes(stack, solution), strict=True)
    influences = tuple(unknown.acting(effect[None]) for unknown, effect in pairs)
    # Elements are brought to comparable sizes before contributions are joined, so that degrees of freedom are theirs.
    units = np.asarray((stack.output_size[:, None] / stack.load_size).reshape(1, -1), dtype=np.complex128)
    return Uncertainty(random, influences).transformed(real_stacked_diagonal(units))


# Cross-talk: response of each output to the other loads, at rated loads.


@dataclass(frozen=True)
class CrossTalk:
    """Output under another rated load, relative to that under the rated main load.

    `value` (C, 6) complex, 1 at the main elements; `main` (C,): component of each channel. `uncertainty` (K = 1) of the
    6C values, channel by channel. `half_axis` (C, 6): larger half axis of the 95 % region in the complex plane.
    `holds_zero` (C, 6): whether that region includes zero, so that no cross-talk has been shown.
    """

    frequency_hz: float
    channels: tuple[str, ...]
    components: tuple[str, ...]
    main: tuple[int, ...]
    value: ComplexArray
    uncertainty: Uncertainty
    half_axis: FloatArray
    holds_zero: BoolArray


def main_components(value: ComplexArray, capacity: FloatArray) -> tuple[int, ...]:
    """Return the main component (0..5) of every channel of a matrix (C, 6).

    It is the component whose rated load gives the largest output. If two channels have the same one, their order
    decides.
    """
    largest = np.argmax(np.abs(value) * capacity, axis=1)
    if len(set(largest.tolist())) == len(largest):
        return tuple(int(j) for j in largest)
    return tuple(range(len(value)))


def cross_talk(fit: MatrixFit, capacity: Sequence[float]) -> CrossTalk:
    """Return c_ij = S_ij·capacity_j/(S_im·capacity_m), m the main component of channel i, with its uncertainty.

    dc_ij = (capacity_j/capacity_m)·(dS_ij - S_ij·dS_im/S_im)/S_im: common errors of a row cancel.
    """
    rated = np.asarray(capacity, dtype=np.float64)
    check_shape("capacity", rated, (LOADS,))
    channels = len(fit.channels)
    main = main_components(fit.value, rated)
    main_values = fit.value[np.arange(channels), list(main)]
    ratio = rated / rated[list(main)][:, None]
    value = ratio * fit.value / main_values[:, None]
    jacobian = np.zeros((channels * LOADS, channels * LOADS), np.complex128)
    for i, j in np.ndindex(channels, LOADS):
        if j != main[i]:
            jacobian[i * LOADS + j, i * LOADS + j] = ratio[i, j] / main_values[i]
            jacobian[i * LOADS + j, i * LOADS + main[i]] = -value[i, j] / main_values[i]
    uncertainty = fit.uncertainty.transformed(real_stacked(jacobian)[None])
    matrices = uncertainty.regions(value.reshape(1, -1))[0]
    regions = [region(e, matrix) for e, matrix in zip(value.ravel().tolist(), matrices, strict=True)]
    half_axis = np.array([found.half_axes[0] for found in regions]).reshape(value.shape)
    holds_zero = np.array([found.holds_zero for found in regions]).reshape(value.shape)
    return CrossTalk(fit.frequency_hz, fit.channels, LOAD_COMPONENTS, main, value, uncertainty, half_axis, holds_zero)
