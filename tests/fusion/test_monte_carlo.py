"""Propagation of distributions against closed forms, first-order propagation and the exact simulator."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import h5py
import numpy as np
import pytest
from evaluation_factory import make_evaluation
from scipy.stats import binom, norm
from simulated_phasors import CASES, case_setup, lines_at, simulate_phasors

from fusion.base import Settings
from fusion.cli import main
from fusion.estimation.coverage import region_factor, region_matrix
from fusion.estimation.least_squares import build_system, solve
from fusion.estimation.measurement_model import Deviates
from fusion.estimation.uncertainty import polar_elements
from fusion.instruments.channel import ChainUncertainty, ChannelReading, observe_channels
from fusion.instruments.stereo import StereoReading
from fusion.recording.manifest import ChannelEntry
from fusion.recording.rig import Stereo
from fusion.report.recording_report import write_h5
from fusion.report.uncertainty_tables import monte_carlo_tables
from fusion.sensitivity.analyse import Analysis, Inputs, analyse
from fusion.sensitivity.distributions import FirstOrder, MonteCarlo, Propagated, shortest_interval, summarise, tolerance
from fusion.sensitivity.monte_carlo import Estimator, propagate
from fusion.sensitivity.moving_body import Body, make_joint, make_moving_part
from fusion.sensitivity.sensitivity_notices import FIRST_ORDER_TOO_LARGE
from fusion.simulate.world import Draws
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.phasor import Phasors

LINES = lines_at([100.0], [1])
OMEGA = 2.0 * np.pi * LINES.frequency_hz
DRAWS = 4000


def channel(quantity: str, direction: tuple[float, ...], **stated: Any) -> ChannelEntry:
    text = {"name": f"c{direction}", "quantity": quantity, "body": "load", "point": [0.0, 0.0, 0.0]}
    return ChannelEntry.model_validate(text | {"direction": list(direction)} | stated)


def reading(entry: ChannelEntry, value: complex, u: float, dof: float = 1e6) -> ChannelReading:
    covariance = u**2 * np.eye(2)[None]
    phasors = Phasors(LINES.frequency_hz, np.array([[value]]), covariance, (entry.name,), ("m/s^2",), np.array([dof]))
    return ChannelReading(entry, phasors, ChainUncertainty())


def inputs_of(readings: tuple[ChannelReading, ...] = (), pairs: tuple[StereoReading, ...] = ()) -> Inputs:
    seen = (*(pair.observation() for pair in pairs), *observe_channels(readings))
    return Inputs(LINES, seen)


def run(inputs: Inputs, draws: int = DRAWS) -> tuple[Analysis, MonteCarlo]:
    found = analyse(inputs)
    return found, propagate(inputs, found, draws, 1)


def element(result: Propagated, name: str) -> int:
    return result.elements.index(name)


@cache
def simulated(case: int) -> tuple[Inputs, Analysis, MonteCarlo]:
    known, _ = simulate_phasors(case_setup(CASES[case]), Draws(3, True))
    return known, *run(known)


def test_shortest_interval_of_a_skew_distribution_starts_at_its_mode():
    # Exponential: the density falls from 0, so the shortest 95 % interval is [0, -ln 0.05].
    low, high = shortest_interval(np.random.default_rng(1).exponential(size=(200_000, 1)))
    assert low[0] == pytest.approx(0.0, abs=1e-3)
    assert high[0] == pytest.approx(-np.log(0.05), rel=0.01)


def test_tolerances_of_the_guide():
    # JCGM 101, 7.9.2: u = 0.35 mg to two digits 35e-5 g, delta = 0.5e-5 g; u = 2 K to one digit, delta = 0.5 K.
    np.testing.assert_allclose(tolerance(np.array([0.00035]), 2), 0.5e-5)
    np.testing.assert_allclose(tolerance(np.array([2.0]), 1), 0.5)
    assert np.isnan(tolerance(np.array([0.0, np.nan]), 2)).all()


def normal_draws(value: complex, spread: np.ndarray) -> Propagated:
    parts = np.random.default_rng(2).multivariate_normal(np.zeros(2), spread, 100_000)
    draws = (value + parts[:, 0] + 1j * parts[:, 1])[:, None, None]
    first = FirstOrder(
        "load",
        np.array([1.0]),
        ("Fz",),
        ("N",),
        np.array([[value]]),
        spread[None, None],
        region_matrix(np.array([[value]]), spread[None, None]),
        np.full((2, 1, 1), norm.ppf(0.975)),
    )
    return summarise(first, draws)


def test_normal_draws_far_from_zero_confirm_first_order_propagation():
    found = normal_draws(3000.0 - 4000.0j, np.array([[1.0, 0.3], [0.3, 0.5]]))
    assert found.first_holds[0, 0] == pytest.approx(0.95, abs=0.003)
    assert found.factor[0, 0] == pytest.approx(region_factor(np.inf), rel=0.01)
    along = np.array([0.6, -0.8])
    expected = np.sqrt(along @ np.array([[1.0, 0.3], [0.3, 0.5]]) @ along)
    assert found.magnitude.u[0, 0] == pytest.approx(expected, rel=0.01)
    half = norm.ppf(0.975) * expected
    assert found.magnitude.high[0, 0] - found.magnitude.low[0, 0] == pytest.approx(2.0 * half, rel=0.02)
    assert found.magnitude.digits[0, 0] >= 1
    assert not found.weak[0, 0]
    assert found.rejected_parts(100_000, 0, 0) == ()


def test_of_a_value_near_zero_only_the_region_is_judged_and_a_magnitude_across_a_long_ellipse_is_refuted():
    found = normal_draws(0.5 + 0.0j, np.eye(2))
    assert found.weak[0, 0]
    # Rice distribution: the mean magnitude of X = 0.5 + noise is 1.33, not 0.5.
    assert found.magnitude.mean[0, 0] == pytest.approx(1.3304, rel=0.01)
    assert found.magnitude.rejected[0, 0]
    assert found.rejected_parts(100_000, 0, 0) == ()
    # 8 u across, 0.01 u along: second order adds u_across²/2|X| to the magnitude, many times u_along.
    found = normal_draws(8.0 + 0.0j, np.diag([1e-4, 1.0]))
    assert found.rejected_parts(100_000, 0, 0) == found.rejected_parts(100_000, 0, 0, too_small=True) == ("magnitude",)


def test_few_degrees_of_freedom_give_students_distribution():
    entry = channel("acceleration", (0.0, 0.0, 1.0), scale_uncertainty=1e-9)
    found, drawn = run(inputs_of((reading(entry, 100.0, 0.01, 6.0),)), 20_000)
    (result,) = drawn.results
    spread = np.sqrt(result.covariance[0, 0].diagonal())
    np.testing.assert_allclose(spread, 0.01 * np.sqrt(6.0 / 4.0), rtol=0.05)
    assert result.magnitude.high[0, 0] - 100.0 == pytest.approx(2.447 * 0.01, rel=0.06)
    assert found.accelerations[0].uncertainty.dof()[0, 2] == pytest.approx(6.0, rel=1e-3)


@pytest.mark.parametrize(("dof", "least"), [(4.0, 0.8), (8.0, 0.9), (20.0, 0.95)])
def test_noise_that_was_estimated_is_in_draws_as_in_first_order(dof, least):
    """U of a mean of three readings: by t-distributions as by 2Λ, which alone makes it hold with few degrees."""
    entries = [channel("acceleration", (0.0, 0.0, 1.0), name=name, scale_uncertainty=1e-9) for name in "abc"]
    found, drawn = run(inputs_of(tuple(reading(entry, 10.0 + 0.0j, 1e-3, dof) for entry in entries)), 20_000)
    (result,) = drawn.results
    u = found.accelerations[0].phasors.u_re[0, 2]
    assert u > (1.0 + 0.5 / dof) * 1e-3 / np.sqrt(3.0)
    half = (result.magnitude.high[0, 0] - result.magnitude.low[0, 0]) / 2.0
    assert least < half / (result.k_polar[0, 0, 0] * u) < 1.03
    assert not any(notice.severity == "warning" for notice in drawn.notices)


@pytest.mark.parametrize(
    ("count", "dof", "trials"), [(3, 4.0, 120), pytest.param(2, 3.0, 1000, marks=pytest.mark.slow)]
)
def test_a_mean_weighted_by_estimated_noise_holds(count, dof, trials):
    """True noise of 1e-3, estimated with few degrees of freedom."""
    rng = np.random.default_rng(12)
    entries = [channel("acceleration", (0.0, 0.0, 1.0), name=name, scale_uncertainty=1e-9) for name in "abc"[:count]]
    held = []
    for _ in range(trials):
        noise = 1e-3 * rng.standard_normal((2, count))
        u = 1e-3 * np.sqrt(rng.chisquare(dof, count) / dof)
        values = 10.0 + noise[0] + 1j * noise[1]
        readings = tuple(reading(*one, dof) for one in zip(entries, values.tolist(), u.tolist(), strict=True))
        (fused, *_) = analyse(inputs_of(readings)).accelerations
        found = polar_elements(fused.phasors.value, fused.uncertainty)[0][2]
        held += [
            abs(found.magnitude - 10.0) < found.expanded_magnitude,
            abs(found.phase_rad) < found.expanded_phase_rad,
        ]
    assert binom.ppf(1e-3, len(held), 0.94) < np.sum(held) <= binom.isf(1e-3, len(held), 0.96)


def test_a_transverse_sensitivity_of_unknown_direction_is_arc_sine_distributed():
    # The z channel leaks 5 % of a sideways motion from an angle of which nothing is known: error = 0.05·a_x·cos(angle).
    tiny = {"scale_uncertainty": 1e-9}
    entries = [channel("acceleration", tuple(axis), **tiny) for axis in np.eye(3)[:2].tolist()]
    entries.append(channel("acceleration", (0.0, 0.0, 1.0), **tiny, transverse_sensitivity=0.05))
    values = (20.0, 0.0, 100.0)
    known = inputs_of(tuple(reading(e, v, 1e-6) for e, v in zip(entries, values, strict=True)))
    found, drawn = run(known, 20_000)
    (result,) = drawn.results
    z = element(result, "z")
    assert result.magnitude.u[0, z] == pytest.approx(1.0 / np.sqrt(2.0), rel=0.02)
    # The shortest interval leaves out the thinner 5 % at one end: from -1 to cos(0.05π).
    length = result.magnitude.high[0, z] - result.magnitude.low[0, z]
    assert length == pytest.approx(1.0 + np.cos(0.05 * np.pi), abs=2e-3)
    first = np.sqrt(found.accelerations[0].uncertainty.covariance[0, 2, 2])
    assert first == pytest.approx(1.0 / np.sqrt(2.0), rel=1e-3)
    # ±1.96 u is wider than all there is, and the larger u makes the first digit of U wrong by 0.39 u.
    assert result.magnitude.first_high[0, z] == pytest.approx(101.386, abs=0.01)
    assert "magnitude" in result.rejected_parts(20_000, 0, z)
    assert result.rejected_parts(20_000, 0, z, too_small=True) == ()
    large = [n for n in drawn.notices if n.code == FIRST_ORDER_TOO_LARGE.code]
    assert any("magnitude of the acceleration" in n.values["quantities"] for n in large)


def test_a_frame_turned_by_finite_angles_shortens_what_it_shows():
    # Rotations of 0.1 rad about x and y: mean of cos is 1 - u² to second order, first order knows nothing of it.
    pair = Stereo.model_validate(
        {
            "body": "load", "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.3], "exposure": 4e-5,
            "pose_uncertainty": [0.0, 0.0, 0.0, 0.1, 0.1, 0.1],
        }
    )  # fmt: skip
    motion = np.array([[0.0, 0.0, 100.0, 0.0, 0.0, 0.0]], dtype=complex)
    value, covariance, dof = -motion / OMEGA[:, None] ** 2, 1e-20 * np.eye(12)[None], np.array([1e6])
    phasors = Phasors(LINES.frequency_hz, value, covariance, MOTION_COMPONENTS, component_units(0), dof)
    _, drawn = run(inputs_of(pairs=(StereoReading("top", pair, phasors),)), 20_000)
    (result,) = drawn.results
    z = element(result, "z")
    # The mean of cos φ + (1 - cos φ)·n_z² over isotropic rotation vectors φ·n is 1 - u² to fourth order.
    assert result.mean[0, z].real == pytest.approx(100.0 * (1.0 - 0.1**2), abs=0.06)
    length = np.sqrt(np.sum(np.abs(result.mean[0]) ** 2) + np.trace(result.covariance[0].sum(axis=0)))
    assert length == pytest.approx(100.0, rel=1e-4)  # a rotation keeps the length


@pytest.mark.parametrize("case", [0, 2])
def test_first_order_propagation_holds_for_a_whole_recording(case):
    _, _, drawn = simulated(case)
    assert [result.name for result in drawn.results] == ["acceleration of the load", "load", "sensitivity"]
    for result in drawn.results:
        total = [np.sqrt(np.trace(c, axis1=-2, axis2=-1)) for c in (result.covariance, result.first_covariance)]
        np.testing.assert_allclose(total[0], total[1], rtol=0.06)
        # 4.6 standard deviations of 4000 draws, and the second order of a tilt that points share beside their own.
        assert np.all(np.abs(result.first_holds - 0.95) < 0.016 + 0.005)
        assert np.all(np.abs(result.mean - result.value) < 0.1 * total[1])


def test_draws_are_what_fusing_them_anew_gives():
    known, found, _ = simulated(2)
    fused = found.accelerations[0]
    system = build_system(known.observations)
    estimator = Estimator.of(known.observations, system.expand, solve(system))
    drawn = [
        seen.draw(fused.phasors.value, Deviates(11, 0, 5), f"noise of instrument {place}")
        for place, seen in enumerate(known.observations)
    ]
    none = np.zeros((5, *fused.observed.shape), dtype=complex)
    estimates = estimator.acceleration(drawn, fused.phasors.value, none)
    u = np.sqrt(fused.phasors.u_re**2 + fused.phasors.u_im**2)
    for number in range(5):
        again = [
            replace(seen, phasors=replace(seen.phasors, value=one.readings[number]), design=one.design[number])
            for seen, one in zip(known.observations, drawn, strict=True)
        ]
        value = solve(build_system(again)).acceleration
        assert np.all(np.abs(value - fused.phasors.value).max(axis=0) > 0.0)
        # The weights follow the draw in one and not in the other, which the small harmonic shows a little.
        assert np.all(np.abs(value - estimates[number]) < np.array([[0.1], [0.2]]) * u)


def test_an_error_that_outputs_and_load_share_cancels():
    own, shared = (simulated(case)[2].results for case in (0, 3))
    place = element(own[2], "Fz per Fz")
    assert shared[1].phase.u[0, 2] == pytest.approx(own[1].phase.u[0, 2], rel=0.7)
    assert shared[2].phase.u[0, place] < 0.9 * own[2].phase.u[0, place]
    first = np.abs(shared[2].phase.u / shared[2].phase.first_u - 1.0)
    assert first[0, place] < 0.06


def test_the_same_seed_gives_the_same_numbers_and_another_others():
    known, found, drawn = simulated(0)
    again, other = propagate(known, found, DRAWS, 1), propagate(known, found, DRAWS, 2)
    for first, second, third in zip(drawn.results, again.results, other.results, strict=True):
        np.testing.assert_array_equal(first.mean, second.mean)
        assert not np.any(first.mean == third.mean)


def test_equal_names_are_the_same_unknown_whatever_else_is_drawn():
    first, second = Deviates(5, 0, 10), Deviates(5, 0, 10)
    second.normal("something else")
    np.testing.assert_array_equal(first.normal("laser: scale"), second.normal("laser: scale"))
    assert not np.any(first.normal("laser: scale") == Deviates(5, 1, 10).normal("laser: scale"))


def test_rows_without_errors_are_those_of_the_fusion():
    known, _, _ = simulated(0)
    exact = {"point_uncertainty": (0.0,) * 3, "direction_uncertainty": 0.0, "transverse_sensitivity": 0.0}
    for seen in known.observations[1:]:
        entries = tuple(entry.model_copy(update=exact) for entry in seen.geometry.entries)
        rows = replace(seen.geometry, entries=entries).rows(seen.design, Deviates(1, 0, 2))
        np.testing.assert_allclose(rows[1], seen.design, rtol=1e-12, atol=1e-15)


def test_load_matrices_are_those_of_bodies_with_the_drawn_numbers():
    frequency, gravity = np.array([80.0, 300.0]), np.array([0.1, -0.2, -9.8])
    inertia = np.array([[0.02, 1e-3, 0.0], [1e-3, 0.03, 2e-3], [0.0, 2e-3, 0.01]])
    u = (0.1, np.array([1e-2, 2e-2, 3e-2]), np.full((3, 3), 1e-3))
    upper = make_moving_part("upper", 3.0, (0.01, 0.02, 0.05), inertia, u, air_share=0.2)
    lower = make_moving_part("lower", 1.0, (0.0, 0.01, 0.01), inertia / 9.0, u, below_joint=True)
    joint = make_joint(900.0, 0.0, 0.02)
    deviates = Deviates(7, 0, 3)
    body = Body((upper, lower), joint, gravity)
    drawn = body.draw_load_matrices(frequency, deviates)
    for number in range(3):
        parts = []
        for part in (upper, lower):
            six = deviates.normal(f"{part.name}: inertia", 6)[number] * 1e-3
            change = np.array([[six[0], six[3], six[4]], [six[3], six[1], six[5]], [six[4], six[5], six[2]]])
            mass = part.mass_kg + 0.1 * deviates.normal(f"{part.name}: mass")[number]
            centre = part.centre_of_mass_m + u[1] * deviates.normal(f"{part.name}: centre of mass", 3)[number]
            parts.append(replace(part, mass_kg=mass, centre_of_mass_m=centre, inertia_kgm2=part.inertia_kgm2 + change))
        expected = replace(body, parts=tuple(parts)).load_matrix(frequency)
        for change in body.matrix_changes(frequency):
            if change.label in ("upper: air moved along", "joint of the load"):
                expected = expected - deviates.normal(change.name)[number] * change.effect
        np.testing.assert_allclose(drawn[number], expected, rtol=1e-10, atol=1e-10)


def test_report_and_result_file_hold_the_run(tmp_path):
    _, _, drawn = simulated(0)
    evaluation = replace(make_evaluation(tmp_path), monte_carlo=drawn)
    tables = monte_carlo_tables(evaluation)
    assert [table.caption.partition(":")[0] for table in tables] == ["Sensitivity", "Load", "Acceleration of the load"]
    assert all(len(row) == len(table.head) == len(table.align) for table in tables for row in table.rows)
    assert monte_carlo_tables(make_evaluation(tmp_path)) == []
    write_h5(tmp_path / "result.h5", evaluation, [])
    with h5py.File(tmp_path / "result.h5") as file:
        group = file["monte_carlo"]
        assert group.attrs["draws"] == DRAWS
        stored = group["results/sensitivity/magnitude/low"][()]
    np.testing.assert_array_equal(stored, drawn.results[2].magnitude.low)


def test_settings_know_the_run_only_where_there_is_one(capsys):
    assert "seed" not in Settings().as_dict()
    reported = Settings(monte_carlo=5000, seed=3).as_dict()
    assert (reported["monte_carlo"], reported["seed"]) == (5000, 3)
    with pytest.raises(ValueError, match=r"^monte_carlo: .*1000 to 1000000"):
        Settings(monte_carlo=10)
    with pytest.raises(SystemExit, match="2"):
        main(["run", "nowhere", "--monte-carlo", "10"])
    assert "1000 to 1000000" in capsys.readouterr().err
