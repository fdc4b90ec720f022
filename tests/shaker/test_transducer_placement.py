"""Places and directions that are not quite those stated: derivatives, which unknowns act, coverage of pitching."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from contracts import refused
from identification_factory import ALONG_Z, FloatArray, X, oscillator, recording, rigid_mass
from identification_factory import pitching as shifted

from shaker.identification.identification_problem import displacements, effective_placement_errors
from shaker.identification.measured_curves import REFERENCE_INDEX, MeasuredTransfer, Placement, PlacementError
from shaker.identification.structure_fit import Identification, identify
from shaker.identification.structures import ChainStructure, SpringSuspension
from shaker.mechanics import respond

K_X, K_RY, B_X, B_RY, M_I, J_I = 7.0e8, 1.07e6, 2500.0, 4.0, 0.9, 1.5e-3
TRUTH = {"stiffness_x": K_X, "stiffness_ry": K_RY, "internal_mass": M_I}
LOADS = ((4.236, 0.012, 0.0182), (6.962, -0.012, 0.0118))  # kg, height of the centre of mass in m, kg·m²
POINTS = np.array([[0.05, 0.0, 0.06], [0.05, 0.0, -0.03]])
U_POINT, U_TILT = 1e-3, 2e-3
PITCHING, BASE = SpringSuspension((0, 4)), Placement(np.array([-0.12, 0.0, 0.0]), X)


def errors_of(name: str, response: int, point: FloatArray) -> list[PlacementError]:
    """Three coordinates and two tilts of a transducer that looks along x, rows written out."""
    x, y, z = point
    rows = {
        "y": U_POINT * np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1.0]),
        "z": U_POINT * np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
        "towards y": U_TILT * np.array([0.0, 1.0, 0.0, -z, 0.0, x]),
        "towards z": U_TILT * np.array([0.0, 0.0, 1.0, y, -x, 0.0]),
    }
    return [PlacementError(f"{name} {what}", response, row) for what, row in rows.items()]


def pitching(draws, load=LOADS[0], *, noise=0.002, rng=None):
    """A load that shifts and pitches, seen by transducers that are off by `draws` (2, 4), in standard deviations."""
    true = []
    for point, (_, by_z, to_y, to_z) in zip(POINTS, draws, strict=True):
        direction = np.array([1.0, U_TILT * to_y, U_TILT * to_z])
        true.append(Placement(point + np.array([0.0, 0.0, U_POINT * by_z]), direction / np.linalg.norm(direction)))
    springs, internal, frequency = (K_X, K_RY, B_X, B_RY), (M_I, J_I), np.arange(500.0, 3000.0, 12.5)
    stated = {"tops": tuple(Placement(point, X) for point in POINTS), "base": BASE}
    record = shifted(load, springs, internal, frequency, true, noise=noise, rng=rng, **stated)
    errors = [error for c, point in enumerate(POINTS) for error in errors_of(f"top {c + 1}", c, point)]
    return replace(record, placement_errors=(*errors, *errors_of("base", REFERENCE_INDEX, BASE.point_m)))


def fitted(records: Sequence[MeasuredTransfer]) -> Identification:
    """Both loads, the moment of inertia inside the sensor stated."""
    return identify(records, PITCHING, stated_values={"internal_inertia_ry": (J_I, 0.0)})


def deviations(found: Identification) -> list[float]:
    """How far the parameters are from the truth, in standard uncertainties."""
    return [(found.value(name) - true) / found.u(name) for name, true in TRUTH.items()]


def test_derivatives_of_the_ratio_by_a_row_are_those_of_differences():
    rng = np.random.default_rng(1)
    drive = rng.standard_normal(6)
    s = np.asarray(2j * np.pi * np.linspace(500.0, 2500.0, 9), dtype=np.complex128)
    change = 1e-5 * rng.standard_normal((3, 6))
    record = replace(
        pitching(np.zeros((2, 4))),
        drive=drive,
        placement_errors=tuple(
            PlacementError(f"{c}", response, change[c]) for c, response in enumerate((0, 1, REFERENCE_INDEX))
        ),
    )
    for structure in (PITCHING, ChainStructure(4)):
        count = len(structure.parameters)
        weights = np.array([1.0, K_X, 1.3 * K_X, B_X, B_RY, M_I, J_I])[: 1 + count]
        found = displacements(record, structure.body, {f"error: {c}": c for c in range(3)})
        mechanics = structure.mechanics(record)
        slope = found.derivatives(respond(mechanics, weights, s))
        for unknown in range(3):
            off = np.eye(3)[unknown]
            ahead, behind = (respond(found.moved(mechanics, sign * off), weights, s).value for sign in (1.0, -1.0))
            np.testing.assert_allclose(slope[:, :, unknown], 0.5 * (ahead - behind), rtol=1e-6, atol=1e-12)
        ratio = respond(mechanics, weights, s).value
        np.testing.assert_allclose(  # -H · change · X_base / (row · X_base), the base's motion being the drive
            slope[:, :, 2], -ratio * (change[2] @ drive) / (record.base.row @ drive), rtol=1e-12
        )
        np.testing.assert_array_equal(slope[:, 1, 0], 0.0)


def test_only_what_changes_a_reading_becomes_an_unknown():
    record = pitching(np.zeros((2, 4)))
    expected = [f"top {c} {what}" for c in (1, 2) for what in ("z", "towards z")]
    assert [error.name for error in effective_placement_errors(record, PITCHING.body)] == expected
    turning = replace(record, drive=np.eye(6)[4], base=Placement(np.array([0.0, 0.0, 0.1]), X))
    names = [error.name for error in effective_placement_errors(turning, SpringSuspension((4,)).body)]
    assert names == [*expected, "base z", "base towards z"]
    nowhere = (PlacementError("a", 2, np.ones(6)),)
    refused("^placement_errors: .*2", replace, record, placement_errors=nowhere)


def test_one_translation_does_not_see_where_it_is_measured():
    frequency = np.linspace(1000.0, 1800.0, 200)
    placement = Placement(np.array([0.03, -0.02, 0.1]), np.array([0.0, 0.0, 1.0]))
    bare = recording(
        "a",
        frequency,
        oscillator(2j * np.pi * frequency, 5.0, 4.5e8, 900.0),
        rigid_mass(5.0),
        ALONG_Z,
        noise=1e-3,
        rng=np.random.default_rng(3),
        tops=[placement],
        base=placement,
    )
    changes = [U_POINT * np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0]), U_TILT * np.array([1.0, 0.0, 0.0, 0.0, 0.1, 0.02])]
    unsure = replace(bare, placement_errors=tuple(PlacementError(f"{c}", 0, row) for c, row in enumerate(changes)))
    first, second = (
        identify([r], SpringSuspension((2,)), stated_values={"internal_mass": (0.0, 0.0)}) for r in (bare, unsure)
    )
    assert second.unknowns == ()
    assert first.estimates == second.estimates
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_a_displaced_transducer_is_found_and_one_in_all_recordings():
    draws = np.array([[0.0, 1.5, 0.0, -1.0], [0.0, -1.0, 0.0, 0.5]])
    records = [pitching(draws, load, noise=1e-4, rng=np.random.default_rng(4)) for load in LOADS]
    found = fitted(records)
    names = [unknown.name for unknown in found.unknowns]
    assert len(names) == len(set(names)) == 4
    assert {"top 1 z", "top 2 towards z"} <= set(found.budget)
    taken_as_stated = fitted([replace(record, placement_errors=()) for record in records])
    for name, true in TRUTH.items():
        assert abs(found.value(name) - true) < 3.5 * found.u(name)
        assert abs(taken_as_stated.value(name) - true) > 3.5 * found.u(name)
    assert taken_as_stated.chi_squared > 4.0 * taken_as_stated.dof
    squares = np.sum([change**2 for change in found.budget.values()], axis=0)
    np.testing.assert_allclose(squares, found.covariance.diagonal(), rtol=1e-6)


@pytest.mark.slow
def test_intervals_cover_the_truth_with_displaced_transducers():
    rng = np.random.default_rng(22)
    trials, few = 125, 15
    deviation, trusting = np.zeros((trials, len(TRUTH))), np.zeros((few, len(TRUTH)))
    for trial in range(trials):
        draws = rng.standard_normal((2, 4))
        records = [pitching(draws, load, rng=rng) for load in LOADS]
        deviation[trial] = deviations(fitted(records))
        if trial < few:
            trusting[trial] = deviations(fitted([replace(record, placement_errors=()) for record in records]))
    # 125 trials of 95 %: 0.95 ± 0.0195, three parameters.
    inside = np.mean(np.abs(deviation) < 1.96, axis=0)
    assert np.all(np.abs(inside - 0.95) < 0.054), inside
    assert np.std(deviation, axis=0) == pytest.approx([1.0] * 3, abs=0.2)
    assert np.all(np.mean(np.abs(trusting) < 1.96, axis=0) < 0.8), trusting
