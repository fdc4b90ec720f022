"""What a contradiction puts in doubt where nothing can contradict: closed forms, and coverage of drawn errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_factory import TRUTH, beam, camera, lasers, measured, triaxial, turned
from scipy.stats import binom

from fusion.estimation.consistency import Acceleration, not_allowed_for
from fusion.estimation.fuse import INCONSISTENCY, fuse
from fusion.estimation.uncertainty import region_factor

TURN_RAD = 5e-3


def both_parts(component: int) -> np.ndarray:
    """Places of a component's real and imaginary part, for rows and columns."""
    return np.ix_([component, component + 6], [component, component + 6])


def disagreement(result: Acceleration) -> np.ndarray:
    """Covariance (12, 12) at the first line of what instruments differ by."""
    return np.asarray(next(c.covariance[0] for c in result.uncertainty.random if c.label == INCONSISTENCY))


def covered(result: Acceleration) -> np.ndarray:
    """Which components' 95 % regions hold the truth at the first line."""
    covariance, dof = result.uncertainty.covariance[0], result.uncertainty.dof()[0]
    error = result.phasors.value[0] - TRUTH[0]
    parts = np.stack([error.real, error.imag], axis=1)
    squares = [p @ np.linalg.solve(covariance[both_parts(c)], p) for c, p in enumerate(parts)]
    return np.array([square <= region_factor(float(nu)) ** 2 for square, nu in zip(squares, dof, strict=True)])


@pytest.mark.parametrize("axis", [0, 1])
def test_a_camera_that_may_be_turned_is_so_in_rotations_too(axis: int) -> None:
    """Two instruments that differ by 5 mrad as one of 1 mrad would: half of the excess variance is each one's."""
    seen = measured([camera(), lasers(3), triaxial()], np.random.default_rng(1), drawn=False)
    result = fuse([turned(seen[0], axis, TURN_RAD), *seen[1:]])
    # The camera states 0.5 mrad, the accelerometer 0.5 mrad and 1 mrad / √2 across its axis.
    stated = 0.5e-3**2 + 0.5e-3**2 + 1e-3**2 / 2.0
    turn = np.sqrt((TURN_RAD**2 - stated) / 2.0)
    # A turn about x takes ry into rz, a turn about y takes rx into rz, of which only the camera tells.
    across = TRUTH[0, 4 - axis]
    along = np.array([across.real, across.imag]) / abs(across)
    found = float(along @ disagreement(result)[both_parts(5)] @ along)
    assert np.sqrt(found) == pytest.approx(turn * abs(across), rel=0.15)
    assert np.all(covered(result))


def test_an_instrument_that_two_others_contradict_is_alone_in_doubt() -> None:
    seen = measured([camera(), lasers(3), beam(), triaxial()], np.random.default_rng(2), drawn=False)
    found = disagreement(fuse([turned(seen[0], 1, TURN_RAD), *seen[1:]]))
    # All of the excess is the camera's; what the other two state between them is 0.43 mrad.
    turn = np.sqrt(TURN_RAD**2 - 0.5e-3**2 - 0.43e-3**2)
    assert np.sqrt(found[11, 11]) == pytest.approx(turn * abs(TRUTH[0, 3]), rel=0.15)


@given(st.integers(0, 10_000), st.integers(2, 4))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_what_is_missing_is_the_least_that_makes_up_for_what_is_wanted(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-6, 6, (2, 3, 1))
    half = rng.normal(size=(2, 6, rank)) * np.concatenate([size, size], axis=1)
    wanted = half @ half.swapaxes(1, 2)
    scale = np.sqrt(np.einsum("kii->ki", wanted))
    scale = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(not_allowed_for(wanted, 0.0 * wanted) / scale, wanted / scale, atol=1e-6)
    assert np.max(np.abs(not_allowed_for(wanted, 1.001 * wanted) / scale)) <= 1e-9
    # Real and imaginary part of each value, allowed for in one direction of the plane only.
    angle = rng.uniform(0.0, np.pi)
    direction, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    allowed = np.zeros((2, 6, 6))
    blocks = [np.ix_([0, 1], [value, value + 3], [value, value + 3]) for value in range(3)]
    for both in blocks:
        allowed[both] = 1e3 * np.trace(wanted[both], axis1=1, axis2=2)[:, None, None] * np.outer(direction, direction)
    missing = not_allowed_for(wanted, allowed)
    for both in blocks:
        some = np.trace(wanted[both], axis1=1, axis2=2)[:, None]
        made_up = np.linalg.eigvalsh(missing[both] + allowed[both] - wanted[both]) / some
        assert min(np.min(np.linalg.eigvalsh(missing[both]) / some), np.min(made_up)) >= -1e-6
        least = np.einsum("i,kij,j->k", across, missing[both] - wanted[both], across)
        assert np.max(np.abs(least) / some[:, 0]) < 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
def test_where_a_turn_is_noticed_every_component_is_covered(axis: int) -> None:
    rng = np.random.default_rng(3)
    clean, held = [camera(), lasers(3), triaxial()], []
    for _ in range(60):
        seen = measured(clean, rng)
        result = fuse([turned(seen[0], axis, TURN_RAD), *seen[1:]])
        if any(notice.severity == "warning" for notice in result.notices):
            held.append(covered(result))
    # Of a 5 σ contradiction 7 in 10 or more are beyond the limit for all unknowns together.
    assert len(held) >= 42
    assert np.all(np.sum(held, axis=0) >= binom.ppf(0.001, len(held), 0.95))
