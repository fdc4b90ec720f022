"""Simulated force feedback of a haptic handle with a force sensor.

A user pushes the handle against a virtual ball. Section VI of the publication on load characteristics of force sensors,
on simulated data. Compared are the applied and the fed-back force without compensation, with a compensation for no
load, and with one for the actual load.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker.compensation.effects import state_space
from shaker.compensation.filter import Sections
from shaker.lti.system import LinearSystem
from shakercal._common.arrays import Arrays, FloatArray, check_shape

RUNAWAY = 1e3
"""Force over the largest static force of the hand, above which a run is unstable."""
HIGHEST_GAIN = 1e4  # end of the search for the stability limit
GRID = 161  # gains over seven decades


@dataclass(frozen=True)
class HapticLoop:
    """Hand, device, ball and force control.

    The hand moves the handle of mass M at x through a spring and a damper, F_u = k_h(x_h - x) + b_h(v_h - v), with the
    motion x_h of the hand. M v' = F_u - F_a - B v. The ball pushes back with F_v = k·depth. The control makes the hand
    feel it: F_a = F_v + K(F_v - y) with the force y from the sensor and K = `force_gain`. The handle then feels like
    one of mass M/(1 + K). The actuator receives each F_a one sample late. Masses in kg, stiffnesses in N/m, dampings in
    N·s/m.
    """

    hand_stiffness: float
    hand_damping: float
    mass: float
    damping: float
    ball_stiffness: float
    force_gain: float
    sample_rate_hz: float

    def __post_init__(self) -> None:
        for name in ("hand_stiffness", "mass", "sample_rate_hz"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a positive number, found {getattr(self, name)}")
        for name in ("hand_damping", "damping", "ball_stiffness", "force_gain"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected 0 or more, found {getattr(self, name)}")


@dataclass(frozen=True, repr=False)
class FeedbackRun(Arrays):
    """Forces of user, sensor and ball.

    Samples (N,) in N; NaN after the loop became unstable. `applied` F_u, `indicated`: its value from the sensor,
    `fed_back` F_v of the ball. `tracking_error`: rms of F_u - F_v over rms of F_v during contact, infinite for an
    unstable run.
    """

    time_s: FloatArray
    applied: FloatArray
    indicated: FloatArray
    fed_back: FloatArray
    stable: bool
    tracking_error: float


@dataclass(frozen=True, repr=False)
class _Matrices(Arrays):
    """Sampled loop with states z and inputs [x_h, v_h, wall, noise]."""

    a: FloatArray
    b: FloatArray
    read: FloatArray
    feed: FloatArray


def push(time_s: FloatArray, depth_m: float, duration_s: float) -> FloatArray:
    """Return the position of the hand (N,) for one push: depth·(1 - cos 2πt/T)/2."""
    return np.asarray(0.5 * depth_m * (1.0 - np.cos(2 * np.pi * np.minimum(time_s / duration_s, 1.0))))


def simulate_feedback(
    loop: HapticLoop,
    sensor: LinearSystem,
    sections: Sections | None,
    hand_m: FloatArray,
    *,
    wall_m: float = 0.0,
    noise: FloatArray | None = None,
) -> FeedbackRun:
    """Return the forces as the hand moves along `hand_m` (N,) towards a ball at `wall_m`.

    `sensor`: output over force with its load, used over its static gain. `sections`: compensation with static gain 1,
    None without. `noise` (N,) in N is added to the force from the sensor.
    """
    check_shape("hand_m", hand_m, (None,))
    added = np.zeros(len(hand_m)) if noise is None else noise
    check_shape("noise", added, hand_m.shape)
    speed = np.gradient(hand_m) * loop.sample_rate_hz
    inputs = np.stack([hand_m, speed, np.full(len(hand_m), wall_m), added], axis=1)
    regimes = [_matrices(loop, sensor, sections, contact) for contact in (False, True)]
    limit = RUNAWAY * loop.hand_stiffness * float(np.max(np.abs(hand_m)) + 1e-12)
    forces, state = np.full((len(inputs), 3), np.nan), np.zeros(len(regimes[0].a))
    for sample, given in enumerate(inputs):
        now = regimes[int(state[0] > given[2])]
        forces[sample] = now.read @ state + now.feed @ given
        if not abs(forces[sample, 0]) < limit:
            forces[sample:] = np.nan
            break
        state = now.a @ state + now.b @ given
    applied, indicated, fed_back = forces.T
    touched, tracking_error = fed_back != 0.0, float("inf")
    if touched.any() and np.all(np.isfinite(forces)):
        error, size = (applied - fed_back)[touched], fed_back[touched]
        tracking_error = float(np.sqrt(np.mean(error**2) / np.mean(size**2)))
    time_s, stable = np.arange(len(hand_m)) / loop.sample_rate_hz, is_stable(loop, sensor, sections)
    return FeedbackRun(time_s, applied, indicated, fed_back, stable, tracking_error)


def is_stable(loop: HapticLoop, sensor: LinearSystem, sections: Sections | None) -> bool:
    """Return whether every eigenvalue of the sampled loop decays, with and without contact."""
    regimes = (_matrices(loop, sensor, sections, contact).a for contact in (False, True))
    return all(float(np.max(np.abs(np.linalg.eigvals(a)))) < 1.0 for a in regimes)


def largest_stable_gain(loop: HapticLoop, sensor: LinearSystem, sections: Sections | None) -> float:
    """Return the force gain at the limit of stability, from 0 to 10 000."""

    def stable(gain: float) -> bool:
        return is_stable(replace(loop, force_gain=gain), sensor, sections)

    if not stable(0.0):
        return 0.0
    grid = np.geomspace(1e-3, HIGHEST_GAIN, GRID)
    lost = next((index for index, gain in enumerate(grid) if not stable(float(gain))), None)
    if lost is None:
        return HIGHEST_GAIN
    low, high = (float(grid[lost - 1]) if lost else 0.0), float(grid[lost])
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def _matrices(loop: HapticLoop, sensor: LinearSystem, sections: Sections | None, contact: bool) -> _Matrices:
    """Return the sampled loop of z = [x, v, sensor, last F_a, filter]."""
    plant, drive, output = _plant(loop, sensor)
    size = len(plant)
    af, bf, cf, df = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    if sections is not None:
        af, bf, cf, df = state_space(replace(sections, gain=1.0))
    total = size + 1 + len(bf)
    output_row = np.concatenate([output, [0.0], np.zeros(len(bf))])
    indicated, indicated_feed = df * output_row, np.array([0.0, 0.0, 0.0, df])
    indicated[size + 1 :] += cf
    ball, ball_feed = np.zeros(total), np.zeros(4)
    if contact:
        ball[0], ball_feed[2] = loop.ball_stiffness, -loop.ball_stiffness
    gain = loop.force_gain
    a, b = np.zeros((total, total)), np.zeros((total, 4))
    a[:size, :size], a[:size, size], b[:size, :2] = plant, drive[:, 2], drive[:, :2]
    a[size], b[size] = (1.0 + gain) * ball - gain * indicated, (1.0 + gain) * ball_feed - gain * indicated_feed
    a[size + 1 :, size + 1 :] = af
    a[size + 1 :] += np.outer(bf, output_row)
    b[size + 1 :, 3] = bf
    hand, hand_feed = np.zeros(total), np.array([loop.hand_stiffness, loop.hand_damping, 0.0, 0.0])
    hand[:2] = -hand_feed[:2]
    return _Matrices(a, b, np.stack([hand, indicated, ball]), np.stack([hand_feed, indicated_feed, ball_feed]))


def _plant(loop: HapticLoop, sensor: LinearSystem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return handle and sensor over one sample: state matrix, input matrix, output in N."""
    from scipy.linalg import expm

    sensor_matrix, into, output = _modal(sensor)
    size = 2 + len(into)
    a, b = np.zeros((size, size)), np.zeros((size, 3))
    hand = np.array([loop.hand_stiffness, loop.hand_damping])
    a[0, 1], a[1, :2], b[1] = 1.0, -hand / loop.mass, np.array([*hand, -1.0]) / loop.mass
    a[1, 1] -= loop.damping / loop.mass
    a[2:, 2:], a[2:, :2], b[2:, :2] = sensor_matrix, -np.outer(into, hand), np.outer(into, hand)
    both = np.zeros((size + 3, size + 3))
    both[:size, :size], both[:size, size:] = a / loop.sample_rate_hz, b / loop.sample_rate_hz
    step = expm(both)
    return step[:size, :size], step[:size, size:], np.concatenate([[0.0, 0.0], output])


def _modal(sensor: LinearSystem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B, C of a sensor over its static gain as decoupled modes."""
    from scipy.linalg import block_diag

    if len(sensor.zeros) >= len(sensor.poles):
        raise ValueError("sensor: expected more poles than zeros, found as many")
    blocks: list[list[list[float]]] = []
    into: list[float] = []
    output: list[float] = []
    for pole, residue in zip(sensor.poles, sensor.residues() / sensor.static_gain, strict=True):
        if pole.imag > 0:
            blocks.append([[pole.real, -pole.imag], [pole.imag, pole.real]])
            into += [1.0, 0.0]
            output += [2.0 * residue.real, -2.0 * residue.imag]
        elif pole.imag == 0:
            blocks.append([[pole.real]])
            into.append(1.0)
            output.append(residue.real)
    return block_diag(*blocks), np.array(into), np.array(output)
