"""Models of several releases as one: means, weights, scatter, coverage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from fusion.sensor.model_notices import SHAPE_OF_DEVICE_UNDETERMINED
from fusion.sensor.step.step_joint import averaged_model
from fusion.sensor.step.step_pool import (
    OF_SHAPES,
    HypothesisModel,
    PooledModel,
    of_models,
    pool_models,
    random_effects_mean,
    sorted_modes,
)
from fusion.sensor.step.step_releases import StepRelease, fit_common_shape, mean_with_scatter
from fusion.sensor.unmodelled_effects import NO_INFLUENCES
from shaker.lti.system import ModalModel, frame_of, from_coordinates, to_coordinates
from shaker.release.reading import read_release
from shaker.release.record import StepRecord
from shaker.release.step_fit import fit_shapes

FloatArray = NDArray[np.float64]
VECTOR = np.array([1700.0, 3000.0, 0.015, 0.02, 1.0, 2.0, -8000.0, -300.0, 6000.0, 7.0])
SPREAD = 1e-3 * np.array([0.1, 1.0, 1e-4, 1e-3, 0.01, 0.02, 1.0, 0.1, 10.0, 0.01])
BLANK = ModalModel(np.zeros(2), np.zeros(2), np.zeros(2, dtype=np.complex128), np.zeros(1), np.zeros(1))


def model(vector: FloatArray, u: FloatArray) -> ModalModel:
    """A model with two modes and a real pole, of independent parameters."""
    return replace(BLANK, covariance=np.diag(u**2)).with_vector(vector)


def test_equal_releases_halve_the_variance_of_two():
    pooled = pool_models(of_models([model(VECTOR, SPREAD)] * 2), ["1", "1"])
    assert pooled.model.vector == pytest.approx(VECTOR, rel=1e-10)
    unit = pooled.model.covariance / np.outer(SPREAD, SPREAD)
    assert unit == pytest.approx(np.eye(10) / 2, rel=1e-4, abs=1e-4)
    u, dof = pooled.spread(np.eye(10))
    assert u == pytest.approx(SPREAD / np.sqrt(2), rel=1e-4)
    assert np.all(np.isinf(dof))


def test_what_a_release_states_of_itself_does_not_weigh_its_model():
    pooled = pool_models(of_models([model(VECTOR, SPREAD), model(VECTOR + SPREAD, 3 * SPREAD)]), ["1", "1"])
    assert (pooled.model.vector - VECTOR) / SPREAD == pytest.approx(np.full(10, 0.5), rel=2e-2)


def test_what_all_releases_share_is_not_averaged_and_moves_residues_alone():
    pooled = pool_models(of_models([model(VECTOR, SPREAD)] * 10), ["1"] * 10, u_scale=2e-3)
    u, _ = pooled.spread(np.eye(10))
    residues = np.array([4, 5, 6, 7, 9])
    assert u[residues] == pytest.approx(2e-3 * np.abs(VECTOR[residues]), rel=1e-4)
    assert np.all(u[[0, 1, 2, 3, 8]] < SPREAD[[0, 1, 2, 3, 8]])
    static, _ = pooled.spread(pooled.model.jacobian(lambda at: np.array([at.static_gain]))[1])
    assert static[0] == pytest.approx(2e-3 * abs(pooled.model.static_gain), rel=1e-4)


def test_scatter_between_releases_enters_with_its_degrees_of_freedom():
    offsets = np.array([-1.0, 0.0, 1.0])
    moved = [model(VECTOR + off * 30 * SPREAD, SPREAD) for off in offsets]
    pooled = pool_models(of_models(moved), ["1"] * 3)
    u, dof = pooled.spread(np.eye(10))
    assert u == pytest.approx(30 * SPREAD / np.sqrt(3), rel=2e-2)  # s/√3 with s = 30 u
    assert dof == pytest.approx(2.0)
    assert np.sqrt(np.diag(pooled.model.covariance))[:4] == pytest.approx(u[:4], rel=1e-3)


def test_releases_of_one_mounting_do_not_count_as_mountings():
    moved = [model(VECTOR + off * 30 * SPREAD, SPREAD) for off in (-1.0, -1.0, -1.0, 1.0)]
    pooled = pool_models(of_models(moved), ["a", "a", "a", "b"])
    u, dof = pooled.spread(np.eye(10))
    assert dof == pytest.approx(1.0, rel=0.01)
    assert len(pooled.vectors) == 2
    assert np.all(u > 0.6 * 30 * SPREAD)


def test_the_effect_of_another_release_shape_does_not_average_out():
    """Of ten equal releases nine are by one device; their other shape is two standard uncertainties away."""
    distance = 4.0 * SPREAD
    others = of_models([model(VECTOR + distance, SPREAD)] * 9 + [model(VECTOR, SPREAD)])
    alternative = HypothesisModel(others.mean_model, 2.0)
    pooled = pool_models(of_models([model(VECTOR, SPREAD)] * 10), ["1"] * 10, 0.0, NO_INFLUENCES, [alternative])
    u, dof = pooled.spread(np.eye(10))
    assert u == pytest.approx(np.hypot(SPREAD / np.sqrt(10), 0.9 * distance / 2.0), rel=1e-2)
    assert np.sqrt(np.diag(pooled.model.covariance)) == pytest.approx(u, rel=1e-9)
    assert np.all(dof == np.inf)
    budget = pooled.budget(np.eye(10), NO_INFLUENCES)
    assert budget[OF_SHAPES] == pytest.approx(0.45 * distance, rel=1e-2)
    assert np.sqrt(np.sum(np.square([*budget.values()]), axis=0)) == pytest.approx(u)


def test_releases_by_one_device_determine_its_shape_together():
    """The sum decides where single records hardly do, or wrongly; the shape of another device is undetermined."""
    time_s, noise = np.arange(2000) / 10e3 - 0.05, 1e-3 * np.random.default_rng(0).standard_normal(2000)
    volts = np.where(time_s < 0.0, 2.0, 2.0 * np.exp(-40.0 * time_s) * np.cos(2 * np.pi * 310.0 * time_s)) + noise
    record = StepRecord("1", ("Fz",), "V", volts[None], 10e3, "Fz", -20.0)
    found = {fit.hypothesis: fit for fit in fit_shapes(record, "Fz", read_release(record, "Fz"))}
    ramp, smooth = (replace(found[shape], solution=None) for shape in ("ramp", "smooth"))  # one noise counts once
    smooth = replace(smooth, model=smooth.model.altered(0.01), release_s=ramp.release_s + 1e-3)

    def release(rope: str, of_ramp: float, of_smooth: float) -> StepRelease:
        fits = replace(ramp, excess=of_ramp), replace(smooth, excess=of_smooth)
        return StepRelease(None, replace(record, release=rope), "Fz", (), fits[0], fits)

    determined = fit_common_shape([release("line", 8.0, 0.0), release("line", 0.0, 2.0), release("line", 5.0, 0.0)])
    assert [one.fit.shape for one in determined] == ["smooth"] * 3
    assert [one.excess for one in determined] == [11.0] * 3
    assert not averaged_model(determined, "Fz").alternatives
    undetermined = fit_common_shape([*determined, release("rope", 0.0, 6.0)])
    ((alternative, notice),) = averaged_model(undetermined, "Fz").alternatives
    assert alternative.distance == pytest.approx(np.sqrt(6.0))
    assert alternative.model.vector == pytest.approx(smooth.model.vector, rel=1e-6)
    assert (notice.code, notice.where, notice.values["device"]) == (SHAPE_OF_DEVICE_UNDETERMINED.code, "Fz", "rope")
    assert undetermined[3].fit.u_release_s > 1e-3 / np.sqrt(6.0) > determined[0].fit.u_release_s


def test_modes_are_matched_in_rising_frequency():
    order = [1, 0, 3, 2, 5, 4, 7, 6, 8, 9]
    back = sorted_modes(model(VECTOR[order], SPREAD[order]))
    assert np.array_equal(back.vector, VECTOR)
    assert np.array_equal(np.diag(back.covariance), SPREAD**2)


@pytest.mark.parametrize(("between", "least"), [(0.5, 0.92), (5.0, 0.92)])
def test_intervals_of_three_releases_contain_the_truth(between, least):
    rng, size = np.random.default_rng(4), 10
    stated, blank = np.tile(np.eye(size), (3, 1, 1)), np.zeros((0, size))
    covered = []
    for _ in range(200):
        truth = rng.standard_normal(size)
        readings = truth + np.sqrt(1.0 + between**2) * rng.standard_normal((3, size))
        mean = random_effects_mean(readings, stated)
        rest = (np.zeros(size), blank, blank, np.zeros((size, size)))
        u, dof = PooledModel(BLANK, readings, stated, *rest).spread(np.eye(size))
        covered.append(np.abs(mean.value - truth) <= stats.t.ppf(0.975, np.minimum(dof, 1e9)) * u)
    assert np.mean(covered) > least


def test_the_mean_stays_between_the_vectors():
    rng = np.random.default_rng(5)
    vectors = rng.standard_normal((4, 6))
    halves = rng.standard_normal((4, 6, 6))
    mean = random_effects_mean(vectors, halves @ np.swapaxes(halves, 1, 2))
    assert np.all((mean.value >= vectors.min(axis=0)) & (mean.value <= vectors.max(axis=0)))
    assert np.all(np.linalg.eigvalsh(mean.covariance) > 0.0)


def test_birge_ratio_of_a_mean():
    mean, u, dof = mean_with_scatter(np.array([1.0, 2.0, 3.0]), np.full(3, 0.1))
    assert mean == pytest.approx(2.0)
    assert u == pytest.approx(1.0 / np.sqrt(3))  # s/√n
    assert dof == 2.0
    _, u, dof = mean_with_scatter(np.array([1.0, 1.01]), np.full(2, 0.1))
    assert u == pytest.approx(0.1 / np.sqrt(2))
    assert dof == np.inf


def test_two_releases_that_hardly_scatter_beyond_their_noise_do_not_lose_all_their_freedom():
    distance = 1.05 * np.sqrt(2.0) * SPREAD  # s = 1.05 u
    found = of_models([model(VECTOR, SPREAD), model(VECTOR + distance, SPREAD)])
    u, dof = pool_models(found, ["1", "1"]).spread(np.eye(10))
    assert u == pytest.approx(1.05 * SPREAD / np.sqrt(2), rel=1e-4)
    assert np.all(dof > 10.0)
    mean, u_mean, one = mean_with_scatter(np.array([0.0, 1.05 * np.sqrt(2.0)]), np.ones(2))
    assert mean == pytest.approx(0.742, rel=1e-3)
    assert u_mean == pytest.approx(1.05 / np.sqrt(2))
    assert one == pytest.approx(float(dof[0]), rel=1e-2)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 3), st.integers(0, 2), st.integers(0, 2**32 - 1))
def test_coordinates_lead_back_to_the_model(modes, reals, seed):
    rng = np.random.default_rng(seed)
    frequency = 300.0 * np.cumsum(1.0 + rng.random(modes))
    residue = rng.standard_normal(modes) + 1j * rng.standard_normal(modes)
    real_hz = 2e3 * np.cumsum(1.0 + rng.random(reals))
    drawn = ModalModel(frequency, rng.uniform(1e-3, 0.9, modes), residue, real_hz, rng.standard_normal(reals))
    frame = frame_of(drawn)
    coordinates = to_coordinates(drawn, frame)
    assert coordinates[2 * modes + reals] == pytest.approx(drawn.static_gain, rel=1e-9, abs=1e-15)
    assert from_coordinates(coordinates, modes, reals, frame) == pytest.approx(drawn.vector, rel=1e-7, abs=1e-9)


def second_order(frequency_hz: float, lag_s: float, gain: float) -> ModalModel:
    """gain/((1 + 2ζs/ω + s²/ω²)(1 + lag·s)), ζ = 0.015, from its partial fractions."""
    omega, zeta, pole = 2 * np.pi * frequency_hz, 0.015, -1.0 / lag_s
    upper = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    top = gain * omega**2 / lag_s
    residue = top / ((upper - upper.conjugate()) * (upper - pole))
    real = top / abs(pole - upper) ** 2
    lag_hz = np.array([1.0 / (2 * np.pi * lag_s)])
    return ModalModel(np.array([frequency_hz]), np.array([zeta]), np.array([residue]), lag_hz, np.array([real]))


def test_a_real_pole_that_hardly_shows_does_not_blur_static_gain_and_band():
    lags = np.array([10e-6, 27e-6, 44e-6])
    models = [second_order(1700.0, lag, 2e-6) for lag in lags]
    pooled = pool_models(of_models(models), ["1", "1", "1"])
    mean = second_order(1700.0, float(np.sqrt(np.mean(lags**2))), 2e-6)
    assert pooled.model.vector == pytest.approx(mean.vector, rel=1e-9)
    static = pooled.spread(pooled.model.jacobian(lambda at: np.array([at.static_gain]))[1])[0]
    assert static[0] < 1e-6 * pooled.model.static_gain
