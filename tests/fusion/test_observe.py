"""Design rows against instruments on a body that is really moved, common errors against rows really disturbed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.estimation.measurement_model import ChainUncertainty, Reading, observe_channels, observe_stereo
from shaker.sine.phasor import Phasors

FREQUENCY = np.array([25.0, 50.0])
GRAVITY = np.array([0.0, 0.0, -9.8125])


def phasors(value: Any, unit: str = "m/s", sigma: float = 1e-6) -> Phasors:
    value = np.asarray(value, dtype=np.complex128)
    count = value.shape[1]
    covariance = np.repeat(sigma**2 * np.eye(2 * count)[None], len(value), axis=0)
    names = tuple(f"c{i}" for i in range(count))
    return Phasors(FREQUENCY, value, covariance, names, (unit,) * count, np.full(len(value), 100.0))


def channel(**changes: Any) -> Any:
    base = {
        "name": "v", "quantity": "velocity", "body": "load", "point": (0.0, 0.0, 0.0), "point_uncertainty": (0.0,) * 3,
        "direction": (0.0, 0.0, 1.0), "direction_uncertainty": 0.0, "scale_uncertainty": 0.0, "common": None,
        "individual_uncertainty": 0.0, "transverse_sensitivity": 0.0, "delay_uncertainty": 0.0, "channel": None,
    }  # fmt: skip
    return SimpleNamespace(**(base | changes))


def stereo(**changes: Any) -> Any:
    base = {"body": "load", "scale_uncertainty": 0.0, "pose_uncertainty": (0.0,) * 6, "delay_uncertainty": 0.0}
    return SimpleNamespace(**(base | changes))


def reading(chain: ChainUncertainty | None = None, **changes: Any) -> Reading:
    return Reading(channel(**changes), phasors(np.ones((2, 1))), chain or ChainUncertainty())


def first_harmonic(series: np.ndarray, omega: float, times: np.ndarray) -> complex:
    return complex(2 / len(times) * np.exp(-1j * omega * times) @ series)


@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration", "angular_velocity"])
def test_rows_read_a_really_tilting_body(quantity: str) -> None:
    point, direction = np.array([0.03, -0.02, 0.05]), np.array([1.0, 2.0, -2.0]) / 3
    shift, turn = np.array([1.0, 2.0, -1.0]) * 1e-6, np.array([3.0, -1.0, 2.0]) * 1e-5
    omega, step = 2 * np.pi * FREQUENCY[0], 1e-5
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


def test_stereo_rows_are_displacements() -> None:
    observation = observe_stereo("top", stereo(), phasors(np.ones((2, 6)), "m"))
    motion = np.arange(1.0, 7.0) + 1j
    omega = 2 * np.pi * FREQUENCY
    np.testing.assert_allclose(observation.design @ motion, -motion / omega[:, None] ** 2, rtol=1e-14)
    assert not observation.stated
    assert observation.common == ()


def test_stereo_pose_errors_are_those_of_a_wrong_frame() -> None:
    # Rotation vector and translation of the same motion, referred to another origin and turned axes.
    u = 1e-4
    observation = observe_stereo("top", stereo(pose_uncertainty=(u,) * 6), phasors(np.ones((2, 6)), "m"))
    shift, turn = np.array([1.0, -2.0, 3.0]) * 1e-7, np.array([2.0, 1.0, -1.0]) * 1e-7
    motion = -((2 * np.pi * FREQUENCY[:, None]) ** 2) * np.concatenate([shift, turn])
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


def test_channels_of_one_instrument_share_scale_and_delay() -> None:
    common = {"common": "laser", "scale_uncertainty": 1e-3, "delay_uncertainty": 1e-6, "individual_uncertainty": 1e-4}
    items = [reading(name="a", **common), reading(name="b", point=(0.05, 0.0, 0.0), **common)]
    (observation,) = observe_channels(items)
    names = [error.name for error in observation.common]
    assert names == ["laser: scale", "laser: delay", "laser: individual scale a", "laser: individual scale b"]
    motion = np.array([[0, 0, 1, 0, 2, 0]] * 2, dtype=complex)
    true = np.einsum("kmj,kj->km", observation.design, motion)
    np.testing.assert_allclose(observation.common[0].effect(motion), 1e-3 * true)
    late = np.exp(-2j * np.pi * FREQUENCY[:, None] * 1e-6) * true - true
    np.testing.assert_allclose(observation.common[1].effect(motion), late, rtol=1e-3)
    assert np.all(observation.common[2].effect(motion)[:, 1] == 0.0)


def test_placement_errors_are_those_of_a_channel_really_misplaced() -> None:
    item = reading(
        quantity="acceleration", point=(0.03, 0.0, 0.04), point_uncertainty=(1e-4, 2e-4, 3e-4),
        direction=(0.0, 3.0, 4.0), direction_uncertainty=1e-4,
    )  # fmt: skip
    (observation,) = observe_channels([item], GRAVITY)
    motion = np.array([[1, -2, 3, 40, 50, -60]] * 2, dtype=complex)
    base = np.einsum("kmj,kj->km", observation.design, motion)
    for error in observation.common:
        axis = error.name.split()[-1]
        changed = channel(**vars(item.entry))
        if "point" in error.name:
            place = "xyz".index(axis)
            changed.point = tuple(np.array(changed.point) + np.eye(3)[place] * changed.point_uncertainty[place])
        else:
            across = np.linalg.svd(np.array([[0.0, 0.6, 0.8]]))[2][1 + int(axis)]
            changed.direction = tuple(np.array([0.0, 0.6, 0.8]) + 1e-4 * across)
        (moved,) = observe_channels([Reading(changed, item.phasors, item.chain)], GRAVITY)
        expected = np.einsum("kmj,kj->km", moved.design, motion) - base
        np.testing.assert_allclose(error.effect(motion), expected, atol=2e-6, err_msg=error.name)


def test_clock_tie_alone_does_not_count_as_a_stated_uncertainty() -> None:
    chain = ChainUncertainty(clock="bridge", u_clock_s=1e-6)
    (observation,) = observe_channels([reading(chain)], clock_uncertainty=1e-6)
    assert [error.name for error in observation.common] == ["clock bridge: time", "clock rate"]
    assert not observation.stated


def test_groups_split_by_body_and_skip_other_quantities() -> None:
    items = [reading(common="laser"), reading(name="b", common="laser", body="base"), reading(quantity="force")]
    found = observe_channels(items)
    assert [(o.name, o.body) for o in found] == [("laser", "load"), ("laser", "base")]
