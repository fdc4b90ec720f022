"""The matrix from several recordings: likelihood against an oracle, York's line, rank, disagreement, cross-talk."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from excited_line_factory import make_excited_line, uncertainty
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.stats import binom, chi2
from simulated_drives import CAPACITY, DriveErrors, drive_setup, eight_setups, simulate_drives, true_matrix
from support import region_distance

from fusion.campaign import line_stack, matrix_solve
from fusion.campaign.campaign_notices import INCONSISTENT_MATRIX, MISSING_MATRIX_ROW, UNTESTED_MATRIX
from fusion.campaign.excited_line import ExcitedLine
from fusion.campaign.line_stack import LINE_SPACING, Stack, stack_drives
from fusion.campaign.matrix import MatrixFit, cross_talk, fit_matrix, main_components
from fusion.campaign.matrix_solve import (
    HOW,
    MatrixSolution,
    MissingExcitationError,
    changes,
    solve,
)
from fusion.estimation.uncertainty import Uncertainty
from shaker.labels import LOAD_COMPONENTS

AnyArray = NDArray[Any]
MAIN = np.eye(6, dtype=np.bool_)


def eight_drives(seed: int, *, systematic: bool = True) -> tuple[tuple[ExcitedLine, ...], AnyArray]:
    rng = np.random.default_rng(seed)
    truth = true_matrix(rng)
    return simulate_drives(eight_setups(rng), truth, DriveErrors(rng, systematic)), truth


def noise_only(drive: ExcitedLine) -> ExcitedLine:
    load, outputs = (Uncertainty(part.random) for part in (drive.load_uncertainty, drive.outputs_uncertainty))
    return replace(drive, load_uncertainty=load, outputs_uncertainty=outputs)


def normalised(fit: MatrixFit, truth: AnyArray) -> AnyArray:
    error = (fit.value - truth).ravel()
    return np.concatenate([error.real, error.imag]) / np.sqrt(np.diag(fit.uncertainty.covariance[0]))


def distances(fit: MatrixFit, truth: AnyArray) -> list[float]:
    """How far out every element is, over the edge of its 95 % region."""
    return region_distance(fit.value, truth, fit.uncertainty)


def whitening(parts: tuple[Uncertainty, ...]) -> list[AnyArray]:
    return [np.linalg.inv(np.linalg.cholesky(noise.covariance[0])) for noise in parts]


def likelihood(stack: Stack, roots: tuple[list[AnyArray], list[AnyArray]], unknowns: AnyArray) -> AnyArray:
    """Whitened residuals of the whole nonlinear model: S, every load and every unknown as parameters."""
    drives, channels = stack.output.shape
    halves = unknowns[: 2 * (6 * channels + 6 * drives)].reshape(2, -1)
    values = halves[0] + 1j * halves[1]
    matrix, load = values[: 6 * channels].reshape(channels, 6), values[6 * channels :].reshape(drives, 6)
    errors = unknowns[2 * len(values) :]
    found = [errors]
    for r in range(drives):
        size = np.vdot(stack.load[r], load[r]) / np.vdot(stack.load[r], stack.load[r])
        own = errors[stack.acting[r]]
        left = stack.load[r] - load[r] - size * (own @ stack.load_effect[r])
        above = stack.output[r] - (1.0 + own @ stack.output_effect[r]) * (matrix @ load[r])
        for rest, root in ((left, roots[0][r]), (above, roots[1][r])):
            found.append(root @ np.concatenate([rest.real, rest.imag]))
    return np.concatenate(found)


def covariance_of(stack: Stack, found: MatrixSolution) -> AnyArray:
    """Covariance (12C, 12C) of the matrix from every reading's noise and every unknown."""
    effect = changes(stack, found)
    return np.sum(found.gain @ found.noise @ found.gain.swapaxes(1, 2), axis=0) + effect.T @ effect


def test_the_fit_is_the_maximum_of_the_nonlinear_likelihood():
    # scipy minimises the same likelihood over all parameters at once: one row, eight loads, every unknown.
    drives = [
        replace(d, outputs=d.outputs[3:4], outputs_uncertainty=d.outputs_uncertainty.at([3]), channels=("Mx",))
        for d in eight_drives(5)[0]
    ]
    stack = stack_drives(drives, ("Mx",))
    found = solve(stack)
    row, loads = 1.01 * found.matrix.ravel(), stack.load.ravel()
    start = np.concatenate([row.real, loads.real, row.imag, loads.imag, 0.0 * found.errors])
    u = np.sqrt(np.diag(covariance_of(stack, found)))
    noise = np.sqrt([part.covariance[0].diagonal() for part in stack.load_noise]).reshape(8, 2, 6)
    scale = np.concatenate([u[:6], noise[:, 0].ravel(), u[6:], noise[:, 1].ravel(), np.ones(len(found.errors))])

    roots = whitening(stack.load_noise), whitening(stack.output_noise)

    def residual(x: AnyArray) -> AnyArray:
        return likelihood(stack, roots, start + scale * x)

    def jacobian(x: AnyArray) -> AnyArray:
        step = 0.1 * np.eye(len(x))
        return np.array([(residual(x + h) - residual(x - h)) / 0.2 for h in step]).T

    oracle = least_squares(residual, np.zeros(len(start)), jac=jacobian, xtol=1e-12, ftol=1e-12, gtol=1e-9)
    assert 2.0 * oracle.cost == pytest.approx(found.chi2, rel=1e-6)
    halves = (start + scale * oracle.x)[: 2 * len(loads) + 12].reshape(2, -1)
    fitted = np.concatenate([found.matrix[0].real, found.matrix[0].imag])
    assert np.max(np.abs(halves[:, :6].ravel() - fitted) / u) < 1e-5
    np.testing.assert_allclose((halves[0] + 1j * halves[1])[6:], found.load.ravel(), atol=1e-5 * np.min(noise))
    np.testing.assert_allclose((start + scale * oracle.x)[-len(found.errors) :], found.errors, atol=1e-5)
    # The curvature of the likelihood is the covariance.
    spread = np.sqrt(np.diag(np.linalg.inv(oracle.jac.T @ oracle.jac))) * scale
    np.testing.assert_allclose(spread[: 2 * len(loads) + 12].reshape(2, -1)[:, :6].ravel(), u, rtol=1e-3)


def mounted(count: int) -> tuple[ExcitedLine, ...]:
    """Eight excitations again and again, two recordings of each in one mounting."""
    rng = np.random.default_rng(17)
    setups = [
        replace(s, recording=f"{s.recording} {n}", mounting=f"{s.mounting} {n // 2}")
        for n in range(count // 8)
        for s in eight_setups(rng)
    ]
    return simulate_drives(setups, true_matrix(rng), DriveErrors(rng))


@pytest.mark.parametrize(("chunk", "local"), [(512, 256), (3, 4), (3, 2)])
def test_eliminating_unknowns_by_groups_of_drives_is_least_squares_with_one_dense_covariance(monkeypatch, chunk, local):
    monkeypatch.setattr(line_stack, "CHUNK", chunk)
    monkeypatch.setattr(line_stack, "MOST_LOCAL", local)
    drives = list(mounted(32))
    dumb = np.where(np.arange(6) == 2, complex(np.nan, np.nan), drives[5].outputs)
    drives[5] = replace(drives[5], outputs=dumb)
    stack = stack_drives(drives, LOAD_COMPONENTS)
    found = solve(stack)
    grouped = sum(len(within) for _, within in stack.order.groups)
    assert stack.order.single.sum() == 32
    assert grouped == 16 * min(local, 3)
    linear = matrix_solve._linearise(stack, found.point, np.arange(32))
    known = np.tile(stack.usable, (1, 2)).ravel()
    effects = np.zeros((len(known), len(stack.unknowns)))
    for r, (own, acting) in enumerate(zip(linear.effects, stack.acting, strict=True)):
        effects[12 * r : 12 * r + 12, acting[acting >= 0]] = own[:, acting >= 0]
    effects, design = effects[known], linear.design.reshape(len(known), -1)[known]
    residual = linear.residual.ravel()[known]
    covariance = block_diag(*found.noise)[np.ix_(known, known)] + effects @ effects.T
    weight = np.linalg.inv(covariance)
    curvature = design.T @ weight @ design
    gain = np.linalg.solve(curvature, design.T @ weight)
    projector = weight - weight @ design @ gain
    spread = np.sqrt(np.diag(np.linalg.inv(curvature)))
    each, between = np.repeat(np.arange(32), 12)[known], np.sqrt(np.diag(covariance))
    # Inverse and products of dense matrices lose six digits; sizes are those of the readings and of the result.
    flat = found.gain.swapaxes(0, 1).reshape(72, -1)[:, known]
    np.testing.assert_allclose(flat * between / spread[:, None], gain * between / spread[:, None], atol=1e-6)
    np.testing.assert_allclose(
        found.projected_residual.ravel()[known] * between, projector @ residual * between, rtol=1e-6, atol=1e-6
    )
    for r, own in enumerate(found.projector):
        inside = np.ix_(each == r, each == r)
        usable = known[12 * r : 12 * r + 12]
        np.testing.assert_allclose(own[np.ix_(usable, usable)], projector[inside], rtol=1e-6, atol=1e-6 * own.max())
    assert found.chi2 == pytest.approx(residual @ projector @ residual, rel=1e-7)
    np.testing.assert_allclose(found.errors, effects.T @ projector @ residual, atol=1e-6)
    np.testing.assert_allclose(changes(stack, found) / spread, effects.T @ gain.T / spread, atol=1e-6)
    assert found.dof == len(residual) - 72


def test_memory_of_the_fit_grows_as_the_recordings():
    peaks = []
    for count in (16, 96):
        drives = mounted(count)
        tracemalloc.start()
        fit_matrix(drives)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 6.6 * peaks[0]


def test_a_line_with_errors_in_both_coordinates_is_yorks():
    # Pearson's data with York's weights: slope -0.480533407, intercept 5.47991022 (York et al. 2004, Table II).
    x = np.array([0.0, 0.9, 1.8, 2.6, 3.3, 4.4, 5.2, 6.1, 6.5, 7.4])
    y = np.array([5.9, 5.4, 4.4, 4.6, 3.5, 3.7, 2.8, 2.8, 2.4, 1.5])
    weight_x = np.array([1000.0, 1000, 500, 800, 200, 80, 60, 20, 1.8, 1.0])
    weight_y = np.array([1.0, 1.8, 4, 8, 20, 20, 70, 70, 100, 500])
    drives = []
    for k in range(10):
        noise = np.array([weight_x[k] ** -0.5, 0, 0, 0, 0, 0])
        load = np.array([x[k], 1.0, 0, 0, 0, 0])
        drives.append(
            make_excited_line(load, y[k : k + 1], uncertainty(noise), uncertainty(weight_y[k : k + 1] ** -0.5))
        )
    for j in range(2, 6):
        drives.append(make_excited_line(np.eye(6)[j], np.zeros(1), uncertainty(np.zeros(6)), uncertainty(np.ones(1))))
    found = solve(stack_drives(drives, ("U0",)))
    physical = found.matrix[0] * stack_drives(drives, ("U0",)).output_size[0] / stack_drives(drives, ("U0",)).load_size
    np.testing.assert_allclose(physical[:2], [-0.480533407, 5.47991022], rtol=1e-7)
    assert found.chi2 == pytest.approx(11.8663531, rel=1e-7)


def test_with_systematic_errors_uncertainties_hold():
    fits = [(fit_matrix(drives), truth) for drives, truth in (eight_drives(seed) for seed in range(20, 26))]
    z = np.abs(np.array([normalised(fit, truth) for fit, truth in fits]))
    assert z.max() < 4.5
    assert np.mean(z < 2.0) > 0.9
    assert 0.6 < np.mean([fit.chi2 / fit.dof for fit, _ in fits]) < 1.4
    assert all(fit.dof == 24 for fit, _ in fits)
    assert all(not fit.notices for fit, _ in fits)


@pytest.mark.slow
def test_regions_hold_the_matrix_95_times_in_100():
    inside = [np.less(distances(fit_matrix(d), truth), 1.0) for d, truth in map(eight_drives, range(100, 200))]
    assert 0.93 < np.mean(inside) < 0.97


def test_the_covariance_is_that_of_least_squares_with_everything_correlated():
    drives, _ = eight_drives(1)
    fit, stack = fit_matrix(drives), stack_drives(drives, LOAD_COMPONENTS)
    units = np.tile((stack.output_size[:, None] / fit.load_size).ravel(), 2)
    whole = covariance_of(stack, solve(stack))
    np.testing.assert_allclose(fit.uncertainty.covariance[0], whole * np.outer(units, units), rtol=1e-6, atol=1e-30)
    names = [influence.name for influence in fit.uncertainty.influences]
    assert "load: mass" in names
    assert "clock bridge: time [3 z]" in names
    assert any(name.startswith("cross at 0.15 0 0.08: centre of mass x [2]") for name in names)


@settings(max_examples=4, deadline=None)
@given(st.permutations(range(8)), st.floats(1e-3, 1e3), st.floats(0.0, 6.2))
def test_order_units_and_start_of_recordings_do_not_matter(order, unit, phase):
    drives, _ = eight_drives(2)
    first = fit_matrix(drives)
    turn = np.exp(1j * phase)
    changed = [
        replace(
            drives[n],
            outputs=drives[n].outputs * unit * turn,
            outputs_uncertainty=drives[n].outputs_uncertainty.scaled(np.full((1, 6), unit * turn)),
            load=drives[n].load * turn,
            load_uncertainty=drives[n].load_uncertainty.scaled(np.full((1, 6), turn)),
        )
        for n in order
    ]
    second = fit_matrix(changed)
    u = np.sqrt(np.diag(first.uncertainty.covariance[0])).reshape(2, 6, 6)
    assert np.max(np.abs(second.value / unit - first.value) / u[0]) < 1e-4
    assert second.chi2 == pytest.approx(first.chi2, rel=1e-4)


def estimated(rng: np.random.Generator, drive: ExcitedLine, dof: int) -> ExcitedLine:
    """The same drive, noise alone, its covariances estimated: Re and Im with one Wishart matrix."""

    def known(part: Uncertainty) -> Uncertainty:
        noise = part.random[0]
        samples = np.linalg.cholesky(noise.covariance[0, :6, :6]) @ rng.standard_normal((6, dof))
        covariance = np.kron(np.eye(2), samples @ samples.T / dof)[None]
        return Uncertainty((replace(noise, covariance=covariance, dof=np.array([float(dof)])),))

    return replace(
        drive,
        load_uncertainty=known(drive.load_uncertainty),
        outputs_uncertainty=known(drive.outputs_uncertainty),
    )


@pytest.mark.slow
def test_noise_that_was_estimated_is_no_disagreement():
    """As if it were known, recordings would be told to disagree in one of seven campaigns, not in one of a hundred."""
    rng, plain, reported = np.random.default_rng(12), 0, 0
    for seed in range(60):
        drives, _ = eight_drives(seed, systematic=False)
        fit = fit_matrix([estimated(rng, drive, 8) for drive in drives])
        plain += chi2.sf(fit.chi2, fit.dof) < 0.01
        reported += fit.discrepancy > 0.0
    assert plain > 4
    assert reported <= binom.isf(1e-3, 60, 0.01)


def pure(rng: np.random.Generator, name: str, axis: str, height: float = 0.05) -> Any:
    setup = drive_setup(rng, name, axis, (0.0, 0.0, height))
    return replace(setup, acceleration=np.where(np.arange(6) == "xyz".index(axis), setup.acceleration, 0.0))


def test_dependent_excitations_are_refused_by_name():
    rng = np.random.default_rng(3)
    truth = true_matrix(rng)
    alike = [pure(rng, f"{n}", axis) for n, axis in enumerate("xyzxyz")]
    with pytest.raises(MissingExcitationError, match=r"^drives: .*Mz") as refused:
        fit_matrix(simulate_drives(alike, truth, DriveErrors(rng)))
    assert refused.value.missing == (("Mz",), ("Fx", "My"), ("Fy", "Mx"))
    assert refused.value.additions.startswith(HOW["Mz"])
    axial = [pure(rng, f"{n}", "z") for n in range(8)]
    with pytest.raises(MissingExcitationError) as refused:
        fit_matrix(simulate_drives(axial, truth, DriveErrors(rng)))
    assert refused.value.missing == tuple((name,) for name in ("Fx", "Fy", "Mx", "My", "Mz"))


def test_five_recordings_are_refused_and_six_are_reported_as_untested():
    drives, truth = eight_drives(4)
    with pytest.raises(MissingExcitationError):
        fit_matrix(drives[:5])
    chosen = [drives[n] for n in (0, 1, 3, 4, 5, 7)]
    fit = fit_matrix(chosen)
    assert fit.dof == 0
    assert [notice.code for notice in fit.notices] == [UNTESTED_MATRIX.code]
    assert fit.notices[0].values["count"] == 6
    assert np.max(np.abs(normalised(fit, truth))) < 4.5
    assert fit.worst is None


@pytest.mark.parametrize("wrong", [0, 3, 6])
def test_a_recording_that_disagrees_is_named_and_covered(wrong):
    rng = np.random.default_rng(40 + wrong)
    truth = true_matrix(rng)
    setups = [*eight_setups(rng), drive_setup(rng, "9 z", "z", (0.0, -0.15, 0.08), "9")]
    setups[wrong] = replace(setups[wrong], step=0.03)
    fit = fit_matrix(simulate_drives(setups, truth, DriveErrors(rng)))
    assert fit.worst.recording == setups[wrong].recording
    assert fit.notices[-1].code == INCONSISTENT_MATRIX.code
    assert fit.notices[-1].values["recording"] == setups[wrong].recording
    assert fit.notices[-1].values["discrepancy"] == fit.discrepancy
    assert 1e-3 < fit.discrepancy < 0.03
    assert np.mean(np.less(distances(fit, truth), 1.0)) > 0.8
    assert fit.uncertainty.random[-1].label == "disagreement of the recordings"


def test_outputs_that_are_not_always_recorded():
    drives, truth = eight_drives(6)
    silent = np.where(np.arange(6) == 2, complex(np.nan, np.nan), drives[2].outputs)
    some = [*drives[:2], replace(drives[2], outputs=silent), *drives[3:]]
    fit = fit_matrix(some)
    assert fit.channels == LOAD_COMPONENTS
    assert np.max(np.abs(normalised(fit, truth))) < 4.5
    few = [replace(drive, outputs=silent) if n % 2 else drive for n, drive in enumerate(drives)]
    fit = fit_matrix(few)
    assert fit.channels == ("Fx", "Fy", "Mx", "My", "Mz")
    assert fit.notices[0].code == MISSING_MATRIX_ROW.code
    assert fit.notices[0].values["channels"] == "Fz"
    one = fit_matrix(drives, channels=["My"])
    assert one.value.shape == (1, 6)
    assert one.sensitivity("V/V").observed.tolist() == [[True] * 6]


def test_lines_of_similar_frequency_add_the_uncertainty_between_them():
    rng = np.random.default_rng(8)
    truth = true_matrix(rng)
    setups = [replace(s, frequency_hz=100.0 + 0.1 * n) for n, s in enumerate(eight_setups(rng))]
    fit = fit_matrix(simulate_drives(setups, truth, DriveErrors(rng)))
    assert fit.frequency_hz == pytest.approx(100.35)
    labels = {part.label for part in fit.uncertainty.grouped()}
    assert LINE_SPACING in labels
    assert np.max(np.abs(normalised(fit, truth))) < 4.5
    with pytest.raises(ValueError, match=r"^drives: "):
        fit_matrix(simulate_drives([*setups[:7], replace(setups[7], frequency_hz=140.0)], truth, DriveErrors(rng)))
    assert LINE_SPACING not in {part.label for part in fit_matrix(eight_drives(8)[0]).uncertainty.grouped()}


def test_cross_talk_is_free_of_common_errors_of_a_row():
    drives, truth = eight_drives(9)
    fit = fit_matrix(drives)
    found = cross_talk(fit, CAPACITY.tolist())
    assert found.main == (0, 1, 2, 3, 4, 5)
    true = truth * CAPACITY / (np.diag(truth) * CAPACITY)[:, None]
    covariance = found.uncertainty.covariance[0]
    u = np.sqrt(np.diag(covariance)).reshape(2, 6, 6)
    assert np.all(np.abs(np.diag(found.value) - 1.0) < 1e-12)
    assert np.all(u[:, MAIN] == 0.0)
    assert np.max(np.abs((found.value - true).real / np.where(MAIN, 1.0, u[0]))) < 4.5
    assert np.all(found.holds_zero == (found.holds_zero & ~MAIN))
    effects = {influence.name: influence.effect for influence in found.uncertainty.influences}
    assert np.max(np.abs(effects["bridge: scale"])) < 1e-3 * 1e-4
    # Monte Carlo through the exact ratio.
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(np.zeros(72), fit.uncertainty.covariance[0], 4000, method="eigh")
    values = CAPACITY * (fit.value.ravel() + draws[:, :36] + 1j * draws[:, 36:]).reshape(-1, 6, 6)
    spread = np.std((values / values[:, range(6), range(6)][..., None]).real, axis=0)
    np.testing.assert_allclose(spread[~MAIN], u[0][~MAIN], rtol=0.06)
    # Main components go by size, or, where two outputs answer most to one load, by order.
    swapped = np.eye(6, dtype=np.complex128)[[1, 0, 2, 3, 4, 5]]
    assert main_components(swapped, np.ones(6)) == (1, 0, 2, 3, 4, 5)
    assert main_components(np.ones((6, 6), np.complex128), np.ones(6)) == (0, 1, 2, 3, 4, 5)
