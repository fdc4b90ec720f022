"""Instruments as rows of a linear model, and their fusion: bodies really moved, dense generalised least squares."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from contracts import coverage_contract, refused
from instrument_factory import (
    FREQUENCY,
    GRAVITY,
    OMEGA,
    TRUTH,
    camera,
    channel_entry,
    drop_readings,
    lasers,
    phasors,
    simulated_readings,
    stereo_entry,
    with_values,
)
from scipy.spatial.transform import Rotation
from support import region_distance

from fusion.estimation.estimation_notices import GROSS_ERROR, INSTRUMENTS_DISPUTED, NOISE_ONLY, UNOBSERVED_COMPONENTS
from fusion.estimation.fuse import fuse, fuse_sources
from fusion.estimation.least_squares import build_system, solve
from fusion.estimation.measurement_model import Deviates
from fusion.instruments.channel import ChainUncertainty, ChannelReading, delay_errors, observe_channels
from fusion.instruments.stereo import StereoReading
from fusion.recording.transducer import TRANSDUCERS


def reading(**changes: Any) -> ChannelReading:
    return ChannelReading(channel_entry(**changes), phasors(np.ones((2, 1)), 1e-6), ChainUncertainty())


def first_harmonic(series: np.ndarray, omega: float, times: np.ndarray) -> complex:
    return complex(2 / len(times) * np.exp(-1j * omega * times) @ series)


@pytest.mark.parametrize("quantity", TRANSDUCERS)
def test_rows_read_a_really_tilting_body(quantity):
    point, direction = np.array([0.03, -0.02, 0.05]), np.array([1.0, 2.0, -2.0]) / 3
    shift, turn = np.array([1.0, 2.0, -1.0]) * 1e-6, np.array([3.0, -1.0, 2.0]) * 1e-5
    omega, step = OMEGA[0], 5e-6
    times = np.arange(64) / 64 / FREQUENCY[0]

    def pose(t: np.ndarray) -> tuple[np.ndarray, Rotation]:
        rotation = Rotation.from_rotvec(turn * np.sin(omega * t)[:, None])
        return shift * np.cos(omega * t)[:, None] + rotation.apply(point), rotation

    (back, _), (here, rotation), (ahead, _) = pose(times - step), pose(times), pose(times + step)
    body_reading = rotation.inv().apply((ahead - 2 * here + back) / step**2 - GRAVITY)
    series = {
        "displacement": (here - point) @ direction,
        "velocity": (ahead - back) / (2 * step) @ direction,
        "acceleration": body_reading @ direction,
        "angular_velocity": turn @ direction * omega * np.cos(omega * times),
    }[quantity]
    item = reading(quantity=quantity, point=tuple(point), direction=tuple(direction))
    (observation,) = observe_channels([item], GRAVITY)
    motion = -(omega**2) * np.concatenate([shift, -1j * turn])
    expected = first_harmonic(series, omega, times)
    assert observation.design[0, 0] @ motion == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("quantity", TRANSDUCERS)
def test_draws_of_a_misplaced_channel_scatter_as_its_errors_say(quantity):
    item = reading(
        quantity=quantity, point=(0.03, 0.0, 0.04), point_uncertainty=(1e-4, 2e-4, 3e-4),
        direction=(0.0, 3.0, 4.0), direction_uncertainty=1e-3, transverse_sensitivity=2e-3,
    )  # fmt: skip
    (observation,) = observe_channels([item], GRAVITY)
    drawn = np.einsum("nkmj,kj->nk", observation.geometry.rows(observation.design, Deviates(1, 0, 20_000)), TRUTH)
    effects = np.stack([error.effect(TRUTH)[:, 0] for error in observation.common])
    for line in range(len(TRUTH)):
        parts = np.stack([effects[:, line].real, effects[:, line].imag])
        expected, found = parts @ parts.T, np.cov(drawn[:, line].real, drawn[:, line].imag)
        np.testing.assert_allclose(found, expected, atol=0.04 * np.trace(expected))


def test_stereo_rows_are_displacements():
    observation = StereoReading("top", stereo_entry(), phasors(np.ones((2, 6)), 1e-6)).observation()
    motion = np.arange(1.0, 7.0) + 1j
    np.testing.assert_allclose(observation.design @ motion, -motion / OMEGA[:, None] ** 2, rtol=1e-14)
    assert not observation.stated
    assert observation.common == ()


def test_stereo_pose_errors_are_those_of_a_wrong_frame():
    # Rotation vector and translation of the same motion, referred to another origin and turned axes.
    u = 1e-4
    observation = StereoReading(
        "top", stereo_entry(pose_uncertainty=(u,) * 6), phasors(np.ones((2, 6)), 1e-6)
    ).observation()
    shift, turn = np.array([1.0, -2.0, 3.0]) * 1e-7, np.array([2.0, 1.0, -1.0]) * 1e-7
    motion = -(OMEGA[:, None] ** 2) * np.concatenate([shift, turn])
    matrix = Rotation.from_rotvec(turn).as_matrix()
    for place, error in enumerate(observation.common):
        change = error.effect(motion.astype(complex))[0]
        axis = np.eye(3)[place // 2]
        if "position" in error.name:
            expected = np.concatenate([matrix @ (u * axis) + shift - u * axis - shift, np.zeros(3)])
        else:
            wrong = Rotation.from_rotvec(u * axis)
            expected = np.concatenate([wrong.apply(shift) - shift, wrong.apply(turn) - turn])
        np.testing.assert_allclose(change, expected, atol=2e-15, err_msg=error.name)


def test_channels_of_one_instrument_share_scale_and_delay():
    common = {"common": "laser", "scale_uncertainty": 1e-3, "delay_uncertainty": 1e-6, "individual_uncertainty": 1e-4}
    items = [reading(name="a", **common), reading(name="b", point=(0.05, 0.0, 0.0), **common)]
    (observation,) = observe_channels(items)
    names = [error.name for error in observation.common]
    assert names == ["laser: scale", "laser: delay", "laser: individual scale a", "laser: individual scale b"]
    motion = np.array([[0, 0, 1, 0, 2, 0]] * 2, dtype=complex)
    true = np.einsum("kmj,kj->km", observation.design, motion)
    np.testing.assert_allclose(observation.common[0].effect(motion), 1e-3 * true)
    late = np.exp(-1j * OMEGA[:, None] * 1e-6) * true - true
    np.testing.assert_allclose(observation.common[1].effect(motion), late, rtol=1e-3)
    assert np.all(observation.common[2].effect(motion)[:, 1] == 0.0)


def test_placement_errors_are_those_of_a_channel_really_misplaced():
    item = reading(
        quantity="acceleration", point=(0.03, 0.0, 0.04), point_uncertainty=(1e-4, 2e-4, 3e-4),
        direction=(0.0, 3.0, 4.0), direction_uncertainty=1e-4,
    )  # fmt: skip
    (observation,) = observe_channels([item], GRAVITY)
    motion = np.array([[1, -2, 3, 40, 50, -60]] * 2, dtype=complex)
    base = np.einsum("kmj,kj->km", observation.design, motion)
    for error in observation.common:
        axis = error.name.split()[-1]
        changed = channel_entry(**vars(item.entry))
        if "point" in error.name:
            place = "xyz".index(axis)
            changed.point = tuple(np.array(changed.point) + np.eye(3)[place] * changed.point_uncertainty[place])
        else:
            across = np.linalg.svd(np.array([[0.0, 0.6, 0.8]]))[2][1 + int(axis)]
            changed.direction = tuple(np.array([0.0, 0.6, 0.8]) + 1e-4 * across)
        (moved,) = observe_channels([ChannelReading(changed, item.phasors, item.chain)], GRAVITY)
        expected = np.einsum("kmj,kj->km", moved.design, motion) - base
        np.testing.assert_allclose(error.effect(motion), expected, atol=2e-6, err_msg=error.name)


def test_clock_tie_alone_does_not_count_as_a_stated_uncertainty():
    item = reading()
    tied = replace(item, further_errors=delay_errors("clock bridge: time", item.phasors.frequency_hz, 1e-6))
    (observation,) = observe_channels([tied], clock_uncertainty=1e-6)
    assert [error.name for error in observation.common] == ["clock bridge: time", "clock rate"]
    assert not observation.stated


def test_groups_split_by_body_and_skip_other_quantities():
    items = [reading(common="laser"), reading(name="b", common="laser", body="base"), reading(quantity="force")]
    found = observe_channels(items)
    assert [(o.name, o.body) for o in found] == [("laser", "load"), ("laser", "base")]


def test_without_errors_the_truth_comes_back():
    result = fuse([camera(), lasers(8, 1e-6)])
    np.testing.assert_allclose(result.phasors.value, TRUTH, rtol=1e-9, atol=1e-9)
    assert result.chi2 < 1e-9
    assert result.observed.all()
    total = np.sum([c.covariance for c in result.uncertainty.grouped()], axis=0)
    np.testing.assert_allclose(total, result.phasors.covariance)
    assert result.dof == 2 * (2 * 14 - 12)


def test_equals_generalised_least_squares_with_the_common_errors_in_the_covariance():
    rng = np.random.default_rng(1)
    system = build_system(simulated_readings([camera(), lasers(8, 1e-4)], rng))
    solution = solve(system)
    spread = system.noise + solution.effects @ solution.effects.T
    weight = np.linalg.inv(spread)
    design = system.design
    covariance = np.linalg.inv(design.T @ weight @ design)
    estimate = covariance @ design.T @ weight @ system.readings
    np.testing.assert_allclose(solution.acceleration, system.acceleration(estimate), rtol=1e-7, atol=1e-7)
    residual = system.readings - design @ estimate
    assert solution.chi2 == pytest.approx(residual @ weight @ residual, rel=1e-6)
    expected = system.expand @ covariance @ system.expand.T
    np.testing.assert_allclose(solution.gain @ spread @ solution.gain.T, expected, rtol=1e-5, atol=1e-12)


def test_leave_one_out_equals_a_fit_without_the_instrument():
    rng = np.random.default_rng(2)
    stated = {"individual_uncertainty": 1e-3, "scale_uncertainty": 1e-3}
    (every,) = simulated_readings([lasers(8, 1e-3, TRUTH[:1], **stated)], rng, TRUTH[:1])
    result = fuse([every])
    less = with_values(every, np.where(np.arange(8) > 0, every.phasors.value, np.nan))
    others = fuse([less])
    system = build_system([less])
    solution = solve(system)
    row = build_system([every])
    first = row.member == 0
    predicted = row.design[first] @ np.linalg.lstsq(row.expand, np.concatenate(
        [solution.acceleration[0].real, solution.acceleration[0].imag]), rcond=None)[0]  # fmt: skip
    effects = row.effects(solution.acceleration)
    gain = row.design[first] @ np.linalg.pinv(row.expand) @ solution.gain
    # Every error acts on both sides of the difference: reading 0 and its prediction from the rest.
    through = effects[first] - gain @ effects[~first]
    spread = row.noise[np.ix_(first, first)] + gain @ solution.noise @ gain.T + through @ through.T
    difference = row.readings[first] - predicted
    expected = np.sqrt(difference @ np.linalg.solve(spread, difference) / 2)
    assert others.dof == result.dof - 2
    assert result.consistency[0].normalised_deviation == pytest.approx(expected, rel=1e-3)


def test_peelles_puzzle_is_no_trap():
    # Eight lasers, noise 2e-7, common scale 2.5e-4, scatter 1e-3 that nobody stated: a covariance built from the
    # readings gives a mean tens of per cent low.
    rng = np.random.default_rng(3)
    truth = np.array([[0, 0, 189.0, 0, 0, 0]], dtype=complex)
    errors = []
    for _ in range(8):
        clean = lasers(8, 2e-7, truth, scale_uncertainty=2.5e-4)
        scatter = 1e-3 * rng.normal(size=8)
        result = fuse([with_values(clean, clean.phasors.value * (1 + scatter))])
        value = result.phasors.value[0, 2] / 189.0
        assert value == pytest.approx(1 + scatter.mean(), abs=2e-5)
        assert result.phasors.u_re[0, 2] / 189.0 == pytest.approx(np.hypot(2.5e-4, 1e-3 / np.sqrt(8)), rel=0.6)
        errors.append(value - 1)
    assert abs(np.mean(errors)) < 3 * 1e-3 / np.sqrt(8 * 8)


@pytest.mark.parametrize("laser", [0, 5])
def test_one_laser_three_per_cent_off_is_left_out_by_name(laser):
    rng = np.random.default_rng(4)
    array = simulated_readings([lasers(8, 1e-5)], rng)[0]
    gain = np.where(np.arange(8) == laser, 1.03, 1.0)
    result = fuse([with_values(array, array.phasors.value * gain)])
    worst = max(result.consistency, key=lambda test: test.normalised_deviation)
    assert worst.instrument == f"p{laser}"
    assert worst.left_out
    assert abs(worst.ratio) == pytest.approx(1.03, abs=2e-3)
    warning = next(notice for notice in result.notices if notice.severity == "warning")
    assert (warning.code, warning.where) == (GROSS_ERROR.code, f"p{laser}")
    assert warning.values["deviation"] == pytest.approx(worst.normalised_deviation)
    # Nothing of the 0.4 % that it would move the mean of eight, in value or U.
    gone = drop_readings(array, np.tile(np.arange(8) == laser, (2, 1)))
    np.testing.assert_allclose(result.phasors.value[:, 2:5], fuse([gone]).phasors.value[:, 2:5], rtol=1e-9)
    u = np.hypot(result.phasors.u_re[0, 2], result.phasors.u_im[0, 2])
    assert abs(result.phasors.value[0, 2] - TRUTH[0, 2]) < 2 * u
    assert u < 1e-3 * 189.0


def test_an_artefact_at_a_harmonic_leaves_the_fundamental_alone():
    rng = np.random.default_rng(8)
    false = simulated_readings([camera()], rng)[0]
    value = false.phasors.value.copy()
    value[1, 2] *= 30.0
    seen = [with_values(false, value), simulated_readings([lasers(8, 1e-5)], rng)[0]]
    result = fuse(seen)
    error = np.abs(result.phasors.value[0, 2] - TRUTH[0, 2])
    u = np.hypot(result.phasors.u_re, result.phasors.u_im)[0, 2]
    assert error < 3 * u < 1.5e-3 * 189.0
    # Nothing decides at the harmonic: there remains what both see alike; what the camera alone sees is in doubt too.
    assert result.observed.tolist() == [[True] * 6, [False, False, False, True, True, False]]
    warning = next(notice for notice in result.notices if notice.severity == "warning")
    assert warning.code == INSTRUMENTS_DISPUTED.code
    assert {"stereo top", "laser as a whole"} <= {one.suspect for one in result.explanations}
    assert all(name in warning.values["suspects"] for name in ("stereo top", "laser as a whole"))


def test_errors_of_one_instrument_are_known_from_all_lines():
    # A laser's delay of 2.5 standard uncertainties shows against an exact camera at both lines and is taken off.
    exact = camera(1e-13, scale_uncertainty=1e-9)
    late = lasers([(0.0, 0.0, 0.04)], 5e-6, delay_uncertainty=5e-7)
    late = with_values(late, late.phasors.value * np.exp(-2j * np.pi * FREQUENCY[:, None] * 1.25e-6))
    result = fuse([exact, late])
    delay = next(unknown for unknown in result.unknowns if unknown.name == "laser: delay")
    assert delay.estimate == pytest.approx(2.5, rel=1e-2)
    assert (delay.u, delay.unit) == (5e-7, "s")
    assert delay.remaining < 0.1


def test_regions_cover_and_tests_pass_as_often_as_they_claim():
    rng, warned = np.random.default_rng(5), []
    clean = [camera(), lasers(3)]

    def estimate(_: int) -> tuple[list[float], np.ndarray]:
        result = fuse(simulated_readings(clean, rng))
        warned.append(any(notice.severity == "warning" for notice in result.notices))
        return region_distance(result.phasors.value[0], TRUTH[0], result.uncertainty), np.ones(6)

    coverage_contract(estimate, np.zeros(6), 60)
    assert sum(warned) <= 5


def test_transverse_motion_that_nobody_sees_is_in_the_uncertainty():
    # Eight lasers in z that point up to 5 mrad aside, on a body that also moves 0.3 % sideways.
    rng = np.random.default_rng(9)
    clean = lasers(8, 1e-6)
    for _ in range(12):
        result = fuse(simulated_readings([clean], rng))
        assert not any(notice.severity == "warning" for notice in result.notices)
    hidden = next(entry for entry in result.uncertainty.grouped() if entry.label == "unobserved motion")
    # 10 % of z in x and in y, each half real and half imaginary, times 5 mrad: of every laser by itself and of all.
    assert np.sqrt(hidden.covariance[0, 2, 2]) == pytest.approx(0.1 * 189.0 * 5e-3 * np.sqrt(1 + 1 / 8), rel=0.05)


def test_fused_is_no_worse_than_the_best_instrument():
    rng = np.random.default_rng(6)
    sources = fuse_sources(simulated_readings([camera(), lasers(8, 1e-5)], rng), "load")
    assert [found.source for found in sources] == ["fused", "photogrammetry", "vibrometer"]
    fused, optical, laser = (found.phasors.u_re[0, 2] for found in sources)
    assert fused <= min(optical, laser) * (1 + 1e-6)
    np.testing.assert_array_equal(sources[2].observed[0], [False, False, True, True, True, False])
    assert np.isnan(sources[2].phasors.value[0, 0])
    assert sources[2].notices[0].code == UNOBSERVED_COMPONENTS.code
    assert sources[2].notices[0].values["components"] == "x, y, rz"
    alone = fuse_sources(simulated_readings([lasers(8)], rng), "load")
    assert [found.source for found in alone] == ["fused", "vibrometer"]
    np.testing.assert_array_equal(alone[0].phasors.value, alone[1].phasors.value)


@pytest.mark.parametrize(
    ("points", "observed"),
    [
        ([(0.0, 0.0, 0.04)], "z"),
        ([(0.03, 0.0, 0.04)], ""),
        ([(0.03, 0.0, 0.0), (-0.03, 0.0, 0.0)], "z ry"),
        ([(0.03, 0.0, 0.0), (-0.03, 0.0, 0.0), (0.0, 0.03, 0.0)], "z rx ry"),
    ],
)
def test_only_what_the_geometry_determines_is_given(points, observed):
    result = fuse([lasers(points, 1e-5, scale_uncertainty=1e-3)])
    names = [name for name, seen in zip(result.phasors.channels, result.observed[0], strict=True) if seen]
    assert " ".join(names) == observed
    np.testing.assert_allclose(result.phasors.value[0, result.observed[0]], TRUTH[0, result.observed[0]], rtol=1e-9)


def test_lines_that_a_camera_cannot_use_are_left_to_the_others():
    dropped = drop_readings(camera(), np.array([[False] * 6, [True] * 6]))
    result = fuse([dropped, lasers(8, 1e-6)])
    assert result.observed.tolist() == [[True] * 6, [False, False, True, True, True, False]]
    assert np.isfinite(result.phasors.covariance[0]).all()
    nothing = fuse([dropped])
    assert not nothing.observed[1].any()


def test_an_instrument_without_stated_uncertainty_is_compared_not_fused():
    silent = lasers([(0.0, 0.0, 0.04)], 1e-7, common="laser")
    biased = with_values(silent, silent.phasors.value * 1.01)
    result = fuse([camera(), biased])
    assert result.instruments == ("stereo top",)
    np.testing.assert_allclose(result.phasors.value, TRUTH, rtol=1e-9, atol=1e-9)
    test = next(test for test in result.consistency if not test.used)
    assert abs(test.ratio) == pytest.approx(1.01, rel=1e-6)
    assert test.normalised_deviation > 10
    alone = fuse([biased])
    assert NOISE_ONLY.code in {notice.code for notice in alone.notices}


def test_channels_whose_noise_is_one_and_the_same_are_no_obstacle():
    array = lasers(8, 1e-5)
    size = array.phasors.covariance[:, :1, :1]
    one = np.kron(np.eye(2), np.ones((8, 8)))
    result = fuse([replace(array, phasors=replace(array.phasors, covariance=size * one))])
    np.testing.assert_allclose(result.phasors.value[0, 2], TRUTH[0, 2], rtol=1e-9)


def test_effects_of_another_shape_and_a_body_without_instruments_are_refused():
    effects = {"calibration": np.zeros((3, 1, 6), complex)}
    pair = StereoReading("top", stereo_entry(scale_uncertainty=None), camera().phasors, effects)
    refused(r"^offset of stereo top: calibration 0: .*\(2, 6\)", pair.observation)
    refused("^observations: .*base", fuse, [camera()], "base")
