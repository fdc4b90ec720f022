"""What recordings know together of unknowns they share, against one least squares of all their readings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated_phasors import CASES, case_setup, simulate_phasors

from fusion.campaign.campaign_notices import CONTRADICTING_RECORDINGS, JOINT_UNKNOWNS
from fusion.campaign.excited_line import SECOND_ORDER_U, ExcitedLine, Knowledge, UnknownDescription
from fusion.campaign.recording_results import RecordingResults
from fusion.campaign.unknowns import apply_joint_estimate
from fusion.estimation.fuse import fuse
from fusion.estimation.least_squares import build_system, solve
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty, as_complex, real_stack
from fusion.report.folder import Provenance
from fusion.simulate.world import Draws

Floats = NDArray[np.float64]
RIG, MOUNTING, LOCAL = 3, 2, 2
READINGS, LOADS = 30, 12


@dataclass
class Readings:
    """Readings of one recording: y = X A + E ε + n, of which E acts by unknowns of rig, mounting and recording."""

    name: str
    mounting: str
    design: Floats
    effects: Floats
    noise: Floats
    readings: Floats
    products: Floats


def drawn(rng: np.random.Generator, moved: float = 0.0, mountings: str = "aabc") -> list[Readings]:
    """Return recordings of some mountings; `moved`: by what the first unknown of the rig is off in the last."""
    rig, mounted, found = rng.standard_normal(RIG), {}, []
    for number, mounting in enumerate(mountings):
        of_mounting = mounted.setdefault(mounting, rng.standard_normal(MOUNTING))
        products = np.array([0.0, 0.4, 0.1, 0.0, 0.2, 0.0, 0.0])
        seen = np.concatenate([rig, of_mounting, rng.standard_normal(LOCAL)])
        seen[: RIG + MOUNTING] += np.hypot(SECOND_ORDER_U, products)[: RIG + MOUNTING] * rng.standard_normal(
            RIG + MOUNTING
        )
        seen[0] += moved if number == len(mountings) - 1 else 0.0
        design, effects = rng.standard_normal((READINGS, LOADS)), rng.standard_normal((READINGS, len(seen)))
        effects[:, 2] = design @ rng.standard_normal(LOADS)  # as motion: no recording tells of it
        noise = rng.uniform(0.1, 0.6, READINGS) ** 2
        readings = design @ rng.standard_normal(LOADS) + effects @ seen
        readings += np.sqrt(noise) * rng.standard_normal(READINGS)
        found.append(Readings(f"r{number}", mounting, design, effects, noise, readings, products))
    return found


def alone(one: Readings) -> RecordingResults:
    """Return what a program that knows this recording alone tells of it."""
    covariance = np.diag(one.noise) + one.effects @ one.effects.T
    weight = np.linalg.inv(covariance)
    gain = np.linalg.solve(one.design.T @ weight @ one.design, one.design.T @ weight)
    left = weight @ (np.eye(READINGS) - one.design @ gain)
    scopes = ["rig"] * RIG + ["mounting"] * MOUNTING + ["recording"] * LOCAL
    about: list[UnknownDescription] = [
        (f"{s} {n}", s, 1.0, "1", s, "B", np.inf, "normal") for n, s in enumerate(scopes)
    ]
    known = Knowledge(
        tuple(about),
        np.array([scope != "recording" for scope in scopes]),
        one.effects.T @ left @ one.readings,
        np.eye(len(scopes)) - one.effects.T @ left @ one.effects,
        one.products,
    )
    parts = np.arange(READINGS) % 2 == 0
    random = tuple(
        Contribution(f"noise {p}", "A", ((gain[:, rows] * one.noise[rows]) @ gain[:, rows].T)[None])
        for p, rows in enumerate((parts, ~parts))
    )
    effects = zip(about, (gain @ one.effects).T, strict=True)
    of_load = Uncertainty(random, tuple(Influence(*a[:4], effect[None], *a[4:]) for a, effect in effects))
    output = Uncertainty((Contribution("noise", "A", np.eye(2)[None]),))
    value, z = as_complex(gain @ one.readings), (0.0, 0.0, 1.0)
    drive = ExcitedLine(one.name, one.mounting, 80.0, 80.0, z, value, of_load, np.ones(1, complex), output, ("Fz",))
    origin = Provenance({}, {}, {}, ())
    empty = RecordingResults(one.name, one.name, one.mounting, "rig", "sine", z, (80.0,), None, (drive,), (), origin)
    return replace(empty, knowledge=partial(lambda found: found, known))


def together(recordings: list[Readings]) -> tuple[Floats, Floats]:
    """Return all loads (R, 12) and their covariance (12R, 12R) by one least squares of all readings and unknowns."""
    mountings = sorted({one.mounting for one in recordings})
    rows, sizes = len(recordings), (RIG, MOUNTING * len(mountings), RIG + MOUNTING, LOCAL)
    columns = LOADS * rows + sizes[0] + sizes[1] + rows * (sizes[2] + sizes[3])
    matrix, prior = np.zeros((READINGS * rows, columns)), np.zeros(columns)
    shared = LOADS * rows
    prior[shared : shared + RIG + sizes[1]] = 1.0
    for r, one in enumerate(recordings):
        block = slice(READINGS * r, READINGS * (r + 1))
        root = 1.0 / np.sqrt(one.noise)[:, None]
        matrix[block, LOADS * r : LOADS * (r + 1)] = root * one.design
        matrix[block, shared : shared + RIG] = root * one.effects[:, :RIG]
        at = shared + RIG + MOUNTING * mountings.index(one.mounting)
        matrix[block, at : at + MOUNTING] = root * one.effects[:, RIG : RIG + MOUNTING]
        at = shared + RIG + sizes[1] + r * (sizes[2] + sizes[3])
        matrix[block, at : at + sizes[2] + sizes[3]] = root * one.effects
        beyond = SECOND_ORDER_U**2 + one.products[: sizes[2]] ** 2
        prior[at : at + sizes[2] + sizes[3]] = np.concatenate([1.0 / beyond, np.ones(LOCAL)])
    right = np.concatenate([one.readings / np.sqrt(one.noise) for one in recordings])
    covariance = np.linalg.inv(matrix.T @ matrix + np.diag(prior))
    found = covariance @ (matrix.T @ right)
    return found[:shared].reshape(rows, LOADS), covariance[:shared, :shared]


def joint_covariance(recorded: tuple[RecordingResults, ...]) -> Floats:
    """Return the covariance of the loads of all recordings by the names of what is uncertain of them."""
    of_load = [entry.excited_lines[0].campaign_uncertainties()[0] for entry in recorded]
    names = {influence.name for one in of_load for influence in one.influences}
    total = np.zeros((LOADS * len(recorded),) * 2)
    for r, one in enumerate(of_load):
        block = slice(LOADS * r, LOADS * (r + 1))
        total[block, block] = np.sum([part.covariance[0] for part in one.random], axis=0)
    for name in names:
        effects = [[i.effect[0] for i in one.influences if i.name == name] or [np.zeros(LOADS)] for one in of_load]
        stacked = np.concatenate([effect[0] for effect in effects])
        total += np.outer(stacked, stacked)
    return total


@pytest.mark.parametrize("mountings", ["aabc", "aaaa", "abcd"])
def test_joint_estimate_is_one_least_squares_of_all_readings(mountings: str) -> None:
    """Loads, their covariances, and those between recordings."""
    measured = drawn(np.random.default_rng(3), mountings=mountings)
    recordings = tuple(alone(one) for one in measured)
    found, unknowns, notices = apply_joint_estimate("c", recordings, lambda drive: drive)
    value, covariance = together(measured)
    np.testing.assert_allclose([real_stack(entry.excited_lines[0].load) for entry in found], value, rtol=0, atol=1e-9)
    np.testing.assert_allclose(joint_covariance(found), covariance, rtol=0, atol=1e-9)
    before = joint_covariance(recordings)
    assert np.all(np.linalg.eigvalsh(before - joint_covariance(found))[-10:] > 0.0)
    by_name = {unknown.name: unknown for unknown in unknowns}
    assert by_name["rig 2"].is_as_stated
    assert not by_name["rig 0"].is_as_stated
    assert by_name["rig 0"].recordings == 4
    assert [notice.code for notice in notices] == [JOINT_UNKNOWNS.code]


def test_a_contradicting_recording_is_named_and_no_joint_estimate_is_used() -> None:
    """An unknown of the rig that moved by twenty times its u, which a single recording does not notice."""
    recordings = tuple(alone(one) for one in drawn(np.random.default_rng(3), moved=20.0))
    found, unknowns, (notice,) = apply_joint_estimate("c", recordings, lambda drive: drive)
    assert found == recordings
    assert not unknowns
    assert notice.code == CONTRADICTING_RECORDINGS.code
    assert "r3" in notice.values["recordings"].split(", ")


def test_agreeing_recordings_are_rarely_reported_as_contradicting() -> None:
    """At 1 % of the campaigns: of 100 no more than 5 (99.9 % point of the binomial distribution)."""
    reported = 0
    for seed in range(100):
        _, unknowns, _ = apply_joint_estimate(
            "c", [alone(one) for one in drawn(np.random.default_rng(seed))], lambda d: d
        )
        reported += not unknowns
    assert reported <= 5


def test_a_recording_estimates_its_unknowns_in_signs_and_units_of_the_fusion() -> None:
    """Posterior, its mean and influences on the acceleration from the readings as they stand in the linear system."""
    inputs, _ = simulate_phasors(case_setup(CASES[0]), Draws(5, True))
    recordings = [observation for observation in inputs.observations if observation.body == "load"]
    fused = fuse(recordings)
    assert fused.posterior is not None
    assert fused.products is not None
    assert fuse([replace(observation, common=()) for observation in recordings]).posterior is None
    system = build_system(recordings, inputs.unobserved_motion)
    solution = solve(system)
    design, effects, noise = system.design, solution.effects, np.linalg.inv(solution.noise)
    projector = noise - noise @ design @ np.linalg.solve(design.T @ noise @ design, design.T @ noise)
    posterior = np.linalg.inv(np.eye(effects.shape[1]) + effects.T @ projector @ effects)
    np.testing.assert_allclose(fused.posterior, posterior, rtol=1e-5, atol=1e-7)
    estimate = [unknown.estimate for unknown in fused.unknowns]
    np.testing.assert_allclose(estimate, posterior @ (effects.T @ projector @ system.readings), rtol=1e-4, atol=1e-5)
    plain = system.expand @ np.linalg.solve(design.T @ noise @ design, design.T @ noise)
    expected = (plain @ effects @ posterior).T.reshape(len(estimate), *fused.observed.shape[:1], 12)
    carried = np.array([influence.effect for influence in fused.uncertainty.influences])
    np.testing.assert_allclose(carried, expected, rtol=0, atol=1e-5 * np.abs(carried).max())
