"""Equations of motion of `other_physics.py`: linear plants by exact exponentials, two nonlinear springs, truths.

A plant is x' = A x + B u, y = C x. Loads let go by a system of their own (ramp, half cosine, exponential, stages),
so that plant and load together have an exact solution between any two instants.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, expm
from scipy.optimize import brentq
from scipy.signal import butter, zpk2ss

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Plant:
    """x' = A x + B u, y = C x."""

    a: FloatArray
    b: FloatArray
    c: FloatArray

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return y/u at frequencies, (F, outputs, inputs)."""
        s = 2j * np.pi * np.atleast_1d(frequency_hz)[:, None, None]
        return np.asarray(self.c @ np.linalg.solve(s * np.eye(len(self.a)) - self.a, self.b.astype(complex)))

    def modal(self) -> tuple[ComplexArray, ComplexArray]:
        """Return poles (N,) and residues (N, outputs, inputs)."""
        poles, right = np.linalg.eig(self.a)
        left = np.linalg.solve(right, self.b.astype(complex))
        return poles, np.einsum("on,ni->noi", self.c @ right, left)

    def into(self, after: Plant) -> Plant:
        """Return this plant with each of its outputs led through a plant of one input and output."""
        count, order = len(self.c), len(after.a)
        a = np.block(
            [
                [self.a, np.zeros((len(self.a), count * order))],
                [np.kron(np.eye(count), after.b) @ self.c, np.kron(np.eye(count), after.a)],
            ]
        )
        b = np.vstack([self.b, np.zeros((count * order, self.b.shape[1]))])
        return Plant(a, b, np.hstack([np.zeros((count, len(self.a))), np.kron(np.eye(count), after.c)]))


@dataclass(frozen=True)
class Filtered:
    """A plant of one input and output followed by a filter of as many zeros as poles."""

    plant: Plant
    zeros: ComplexArray
    poles: ComplexArray
    gain: float

    def _gain(self, s: ComplexArray) -> ComplexArray:
        above, below = (np.prod(s[:, None] - roots, axis=-1) for roots in (self.zeros, self.poles))
        return np.asarray(self.gain * above / below)

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return y/u at frequencies, (F, 1, 1)."""
        s = 2j * np.pi * np.atleast_1d(frequency_hz)
        return np.asarray(self.plant.response(frequency_hz) * self._gain(np.asarray(s))[:, None, None])

    def modal(self) -> tuple[ComplexArray, ComplexArray]:
        """Return poles and residues: of the plant by the filter there, of the filter by the plant there."""
        poles, residues = self.plant.modal()
        found = [residues * self._gain(poles)[:, None, None]]
        for index, pole in enumerate(self.poles):
            others = np.delete(self.poles, index)
            factor = self.gain * np.prod(pole - self.zeros) / np.prod(pole - others)
            found.append(factor * self.plant.response(np.array([pole / (2j * np.pi)])))
        return np.concatenate([poles, self.poles]), np.concatenate(found)


def modes(figures: Sequence[tuple[float, float, float]], gain: float = 1.0) -> Plant:
    """Return modes of natural frequency (Hz), damping ratio and share of the static gain, driven by one load."""
    blocks, inputs, outputs = [], [], []
    for frequency_hz, damping_ratio, share in figures:
        w = 2.0 * np.pi * frequency_hz
        blocks.append(np.array([[0.0, w], [-w, -2.0 * damping_ratio * w]]))
        inputs += [0.0, w]
        outputs += [gain * share, 0.0]
    return Plant(block_diag(*blocks), np.array(inputs)[:, None], np.array(outputs)[None])


def mechanical(mass: FloatArray, damping: FloatArray, stiffness: FloatArray, reads: FloatArray) -> Plant:
    """Return M q'' + D q' + K q = u with outputs `reads` · q; velocities are scaled to the size of displacements."""
    count = len(mass)
    w = float(np.sqrt(np.max(np.abs(np.linalg.eigvals(np.linalg.solve(mass, stiffness))))))
    inverse = np.linalg.inv(mass)
    a = np.block([[np.zeros((count, count)), w * np.eye(count)], [-inverse @ stiffness / w, -inverse @ damping]])
    return Plant(
        a, np.vstack([np.zeros((count, count)), inverse / w]), np.hstack([reads, np.zeros((len(reads), count))])
    )


def lag(corner_hz: float) -> Plant:
    """Return a low-pass of first order."""
    w = 2.0 * np.pi * corner_hz
    return Plant(np.array([[-w]]), np.array([[w]]), np.array([[1.0]]))


def butterworth(order: int, corner_hz: float) -> Plant:
    """Return a Butterworth low-pass, whose states are scaled to be of one size."""
    a, b, c, _ = zpk2ss(*butter(order, 1.0, analog=True, output="zpk"))
    w = 2.0 * np.pi * corner_hz
    return Plant(w * np.asarray(a), w * np.asarray(b), np.asarray(c))


# How a load lets go: the share u(t) that is gone, from 0 to 1, as the output of its own system.


@dataclass(frozen=True)
class Stage:
    """(u, v, 1)' = S (u, v, 1) for a time, v starting at `rate`; the last stage lasts for ever."""

    last_s: float
    system: FloatArray
    rate: float


def _hold() -> Stage:
    return Stage(np.inf, np.zeros((3, 3)), 0.0)


def _straight(last_s: float, share: float) -> Stage:
    system = np.zeros((3, 3))
    system[0, 1] = 1.0
    return Stage(last_s, system, share / last_s)


def release(shape: str, time_s: float) -> list[Stage]:
    """Return the stages of a release that takes `time_s` (`exponential`: its time constant)."""
    if shape == "ramp":
        return [_straight(time_s, 1.0), _hold()]
    if shape == "cosine":
        w2 = (np.pi / time_s) ** 2
        return [Stage(time_s, np.array([[0.0, 1.0, 0.0], [-w2, 0.0, 0.5 * w2], [0.0, 0.0, 0.0]]), 0.0), _hold()]
    if shape == "exponential":
        system = np.zeros((3, 3))
        system[0, 0], system[0, 2] = -1.0 / time_s, 1.0 / time_s
        return [Stage(np.inf, system, 0.0)]
    if shape == "two stages":  # strands part one after the other: 60 % in a third of the time, rest, 40 % in a third
        third = time_s / 3.0
        return [_straight(third, 0.6), _straight(third, 1e-12), _straight(third, 0.4), _hold()]
    raise ValueError(f"shape: expected ramp, cosine, exponential or two stages, found {shape}")


def respond(
    plant: Plant, drive: FloatArray, stages: Sequence[Stage], times_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return outputs (outputs, N) and load (N,) at uniform times after load `drive`·u(t) begins at time 0."""
    order, step = len(plant.a), times_s[1] - times_s[0]
    out, gone = np.zeros((len(plant.c), len(times_s))), np.zeros(len(times_s))
    state, begun = np.zeros(order + 3), 0.0
    state[-1] = 1.0
    index = int(np.searchsorted(times_s, 0.0))
    for stage in stages:
        state[-2] = stage.rate
        joint = np.zeros((order + 3, order + 3))
        joint[:order, :order], joint[:order, order] = plant.a, plant.b @ drive
        joint[order:, order:] = stage.system
        end = begun + stage.last_s
        until = len(times_s) if np.isinf(end) else int(np.searchsorted(times_s, end))
        if index < until:
            one, each = expm(joint * (times_s[index] - begun)) @ state, expm(joint * step)
            course = np.empty((until - index, order + 3))
            for row in course:
                row[:] = one
                one = each @ one
            out[:, index:until], gone[index:until] = plant.c @ course[:, :order].T, course[:, order]
            index = until
        if not np.isinf(end):
            state, begun = expm(joint * stage.last_s) @ state, end
    return out, gone


# Springs that are not linear: displacement over that of the static load, before the amplifier.


@dataclass(frozen=True)
class Spring:
    """q'' + 2ζω q' + ω² q (1 − softening·q²) + ω²·friction·sign(q') = ω² u, u = 1 before the release, 0 after it."""

    frequency_hz: float
    damping_ratio: float
    softening: float = 0.0
    friction: float = 0.0


def rest_of(softening: float) -> float:
    """Return the displacement under the static load, over that of a linear spring."""
    return float(brentq(lambda q: q * (1.0 - softening * q**2) - 1.0, 0.5, 1.5))


def ring(spring: Spring, ramp_s: float, corner_hz: float, times_s: FloatArray) -> FloatArray:
    """Return the displacement behind a lag (0: none), at times after a ramp of the load that begins at time 0."""
    if spring.friction:
        return _ring_with_friction(spring, ramp_s, corner_hz, times_s)
    w, lag_w = 2.0 * np.pi * spring.frequency_hz, 2.0 * np.pi * corner_hz
    rest = rest_of(spring.softening)

    def motion(t: float, x: FloatArray) -> list[float]:
        force = max(0.0, 1.0 - t / ramp_s) - x[0] * (1.0 - spring.softening * x[0] ** 2)
        moved = [w * x[1], w * force - 2.0 * spring.damping_ratio * w * x[1]]
        return [*moved, lag_w * (x[0] - x[2])] if lag_w else moved

    out, state = np.full(len(times_s), rest), np.array([rest, 0.0, rest] if lag_w else [rest, 0.0])
    for begin, end in ((0.0, ramp_s), (ramp_s, float(times_s[-1]) + 1e-9)):
        inside = (times_s >= begin) & (times_s < end)
        found = solve_ivp(motion, (begin, end), state, "DOP853", np.append(times_s[inside], end), rtol=1e-9, atol=1e-12)
        out[inside], state = found.y[2 if lag_w else 0, :-1], found.y[:, -1]
    return out


def _ring_with_friction(spring: Spring, ramp_s: float, corner_hz: float, times_s: FloatArray) -> FloatArray:
    """Step from grid point to grid point exactly with the friction's sign held; it may stick where velocity turns."""
    step, w = 1e-6, 2.0 * np.pi * spring.frequency_hz
    a = np.array([[0.0, w, 0.0], [-w, -2.0 * spring.damping_ratio * w, w], [0.0, 0.0, 0.0]])
    (a11, a12, b1), (a21, a22, b2) = (row.tolist() for row in expm(a * step)[:2])
    count = int(np.ceil(times_s[-1] / step)) + 2
    course = np.empty(count)
    q, v, sense = 1.0, 0.0, 0.0
    for index in range(count):
        course[index] = q
        u = max(0.0, 1.0 - (index + 0.5) * step / ramp_s)
        if sense == 0.0 and abs(u - q) > spring.friction:
            sense = 1.0 if u > q else -1.0
        if sense:
            force, before = u - sense * spring.friction, (q, v)
            q, v = a11 * q + a12 * v + b1 * force, a21 * q + a22 * v + b2 * force
            if v * sense < 0.0:  # it turned within the step: to the turning point, and from it with the other sign
                early = before[1] / (before[1] - v)
                q, v, late = before[0] + 0.5 * w * step * early * before[1], 0.0, (1.0 - early) * step
                sense = 0.0 if abs(u - q) <= spring.friction else 1.0 if u > q else -1.0
                if sense:
                    v = w * late * (u - sense * spring.friction - q)
                    q += 0.5 * w * late * v
    if not corner_hz:
        return np.asarray(np.interp(times_s, np.arange(count) * step, course, left=1.0))
    lagged, keep, one = np.empty(count), np.exp(-2.0 * np.pi * corner_hz * step), 1.0
    for index in range(count):
        lagged[index] = one
        one = keep * one + (1.0 - keep) * 0.5 * (course[index] + course[min(index + 1, count - 1)])
    return np.asarray(np.interp(times_s, np.arange(count) * step, lagged, left=1.0))


# Truths of a plant with one load and one output, on dense grids.


def _first_crossing(excess: Callable[[float], float], grid: FloatArray, values: FloatArray) -> float:
    above = np.flatnonzero((values[:-1] <= 0.0) & (values[1:] > 0.0))
    return float(brentq(excess, grid[above[0]], grid[above[0] + 1], xtol=1e-14)) if len(above) else np.nan


def frequency_truths(plant: Plant | Filtered, top_hz: float = 30e3) -> dict[str, float]:
    """Return static gain, bands, half power, quadrature and peak of |H|."""
    grid = np.geomspace(1.0, top_hz, 40_000)
    static = float(plant.response(np.zeros(1))[0, 0, 0].real)

    def ratio(frequency_hz: float) -> complex:
        return complex(plant.response(np.array([frequency_hz]))[0, 0, 0]) / static

    def outside(limit: float, frequency_hz: float) -> float:
        return abs(abs(ratio(frequency_hz)) - 1.0) - limit

    values = plant.response(grid)[:, 0, 0] / static
    size, found = np.abs(values), {"static_gain": static}
    for name, limit in (("band_5_hz", 0.05), ("band_10_hz", 0.10)):
        found[name] = _first_crossing(partial(outside, limit), grid, np.abs(size - 1.0) - limit)
    found["half_power_hz"] = _first_crossing(lambda f: 0.5**0.5 - abs(ratio(f)), grid, 0.5**0.5 - size)
    found["quadrature_hz"] = _first_crossing(lambda f: -ratio(f).real, grid, -values.real)
    top = int(np.argmax(size))
    fine = np.linspace(grid[top - 1], grid[top + 1], 4001)
    peak = np.abs(plant.response(fine)[:, 0, 0]) / abs(static)
    return found | {"peak_hz": float(fine[np.argmax(peak)]), "peak_gain": float(peak.max())}


def step_truths(plant: Plant | Filtered) -> dict[str, float]:
    """Return the mode that swings most after a step, and overshoot, rise and settling of an ideal step."""
    poles, residues = plant.modal()
    weights = residues[:, 0, 0] / poles
    final = -float(np.sum(weights).real)
    swings = np.where(poles.imag > 0.0, np.abs(weights), 0.0)
    main = poles[np.argmax(swings)]

    def step(time_s: FloatArray) -> FloatArray:
        total = np.zeros(np.shape(time_s))
        for pole, weight in zip(poles, weights, strict=True):
            total = total + np.real(weight * np.exp(pole * time_s)) / final
        return 1.0 + total

    ringing = np.abs(weights) > 1e-4 * abs(final)
    end = 6.0 / float(np.min(np.abs(poles[ringing].real)))
    grid = np.linspace(0.0, end, int(end * 80.0 * float(np.max(np.abs(poles[ringing]))) / (2.0 * np.pi)) + 1000)
    values = step(grid)
    top = int(np.argmax(values))
    fine = np.linspace(grid[max(top - 1, 0)], grid[min(top + 1, len(grid) - 1)], 2001)

    def above(level: float, time_s: float) -> float:
        return float(step(np.array(time_s))) - level

    def away(limit: float, time_s: float) -> float:
        return abs(above(1.0, time_s)) - limit

    found = {
        "natural_hz": abs(main) / (2.0 * np.pi),
        "damped_hz": main.imag / (2.0 * np.pi),
        "damping_ratio": -main.real / abs(main),
        "overshoot": float(step(fine).max()) - 1.0,
    }
    ten, ninety = (_first_crossing(partial(above, level), grid, values - level) for level in (0.1, 0.9))
    for name, limit in (("settling_5_s", 0.05), ("settling_2_s", 0.02)):
        last = int(np.flatnonzero(np.abs(values - 1.0) > limit)[-1])
        found[name] = float(brentq(partial(away, limit), grid[last], grid[last + 1], xtol=1e-12))
    return found | {"rise_s": ninety - ten}


# Noise, hum and converters.


def noise(kind: str, count: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Return noise of standard deviation 1: `white`, `filtered` (8 kHz, fourth order) or `pink` (1/f)."""
    white = rng.standard_normal(2 * count)
    if kind == "white":
        return white[:count]
    frequency = np.fft.rfftfreq(2 * count, 1.0 / rate_hz)
    if kind == "filtered":
        shape = 1.0 / np.sqrt(1.0 + (frequency / 8e3) ** 8)
    else:
        shape = 1.0 / np.sqrt(np.maximum(frequency, frequency[1]))
        shape[0] = 0.0
    shaped = np.fft.irfft(np.fft.rfft(white) * shape, 2 * count)
    return np.asarray(shaped[:count] / np.sqrt(np.mean(shape**2)))


def hum(count: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Return mains hum of 50, 150 and 250 Hz with an amplitude of 1 at 50 Hz."""
    time_s = np.arange(count) / rate_hz
    lines = ((50.0, 1.0), (150.0, 0.4), (250.0, 0.2))
    return np.asarray(sum(a * np.sin(2.0 * np.pi * f * time_s + rng.uniform(0.0, 2.0 * np.pi)) for f, a in lines))


def converted(values: FloatArray, step: float) -> FloatArray:
    """Return values as a converter of that step rounds them."""
    return np.asarray(step * np.round(values / step))
