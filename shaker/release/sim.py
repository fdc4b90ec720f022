"""Step responses identified as published: all orders in one factorisation (SIM)."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker.arrays import Brief, FloatArray, Notice, check_shape
from shaker.lti.indices import pole_notices
from shaker.lti.system import LinearSystem, ModalModel
from shaker.release.reading import read_release
from shaker.release.record import Reading, Shape, StepRecord

# What an identification from a step response returns, whatever the method.


Method = Literal["pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients"]


@dataclass(frozen=True, repr=False)
class StepFit(Brief):
    """A model of one output for one load component.

    `model`: continuous, in output unit per load unit, None where the poles of `system` have no modal form; `system`:
    the same, or what the method itself yields, at full precision; `sample_rate_hz`, `decimation`: of the samples that
    were fitted; `fitted`, `residual` (N,) over `time_s` (N,) in output units; `onset_s`, `u_onset_s`, `release_s`,
    `u_release_s`: begin and length of the release, taken for one of `shape`; `variance_accounted`:
    1 - |residual|²/|y - mean|²; `convergence`: loss over iterations or generations, or over the order 1, 2, …;
    `order`: number of poles; `duration_s`: time taken.
    """

    method: Method
    channel: str
    component: str
    unit: str
    model: ModalModel | None
    system: LinearSystem
    time_s: FloatArray
    fitted: FloatArray
    residual: FloatArray
    sample_rate_hz: float
    decimation: int
    order: int
    variance_accounted: float
    convergence: FloatArray
    duration_s: float
    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float
    shape: Shape = "step"
    notices: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        check_shape("time_s", self.time_s, (None,))
        check_shape("fitted", self.fitted, self.time_s.shape)
        check_shape("residual", self.residual, self.time_s.shape)
        check_shape("convergence", self.convergence, (None,))


# Difference equations of every order from one factorisation of the data.


_BEND = 0.15  # share of the whole fall of ln J that may be left beyond the order chosen


@dataclass(frozen=True, repr=False)
class EveryOrder(Brief):
    """Least-squares difference equations of order 0 … n at once.

    `triangle` (2n + 2, 2n + 2): R of the QR factorisation of the rows [u(k-n) y(k-n) … u(k-1) y(k-1) u(k) y(k)] over
    `rows` instants k; the interleaved order makes every leading part the data of a lower order (augmented UD
    identification, also called simultaneous identification of order and parameters). `sample_rate_hz` of the samples.
    """

    triangle: FloatArray
    rows: int
    sample_rate_hz: float

    def __post_init__(self) -> None:
        check_shape("triangle", self.triangle, (None, self.triangle.shape[0]))

    @property
    def most(self) -> int:
        """The highest order n."""
        return len(self.triangle) // 2 - 1

    def loss(self, direct: bool = True) -> FloatArray:
        """Return J (n,): the sum of squared equation errors of order 1 … n, with or without a term b0·u(k)."""
        last = 2 * np.arange(1, self.most + 1) + 1
        own = self.triangle[last, last] ** 2
        return np.asarray(own if direct else own + self.triangle[last - 1, last] ** 2)

    def parameters(self, order: int, direct: bool = True) -> FloatArray:
        """Return [b_n, -a_n, …, b_1, -a_1, b_0] (2·order + 1,), without b_0 where not `direct`, of one order."""
        if not 1 <= order <= self.most:
            raise ValueError(f"order: expected 1 to {self.most}, found {order}")
        size = 2 * order + direct
        return np.asarray(
            np.linalg.lstsq(self.triangle[:size, :size], self.triangle[:size, 2 * order + 1], rcond=None)[0]
        )

    def system(self, order: int, direct: bool = True) -> LinearSystem:
        """Return the difference equation y(k) = Σ b_i u(k-i) - Σ a_i y(k-i) of one order as a sampled system."""
        found = self.parameters(order, direct)
        load, past = found[: 2 * order : 2][::-1], found[1 : 2 * order : 2][::-1]
        numerator = np.concatenate([found[-1:] if direct else [0.0], load])
        return LinearSystem.from_coefficients(numerator, np.concatenate([[1.0], -past]), self.sample_rate_hz)

    def bend(self, direct: bool = True) -> int:
        """Return the order at which the loss bends: the first that leaves 15 % of the fall of ln J to higher ones.

        A test of significance is no help here: with noise on the output every further order lowers the loss.
        """
        loss = np.log(np.maximum(self.loss(direct), 1e-300))
        left = (loss - loss.min()) / max(1e-12, loss[0] - loss.min())
        return int(np.argmax(left <= _BEND)) + 1


def every_order(load: FloatArray, output: FloatArray, sample_rate_hz: float, most: int = 9) -> EveryOrder:
    """Return the difference equations of order 0 … `most` between a load (N,) and an output (N,)."""
    check_shape("output", output, load.shape)
    if len(load) < 4 * most + 4:
        raise ValueError(f"load: expected at least {4 * most + 4} samples for order {most}, found {len(load)}")
    windows = [np.lib.stride_tricks.sliding_window_view(part, most + 1) for part in (load, output)]
    rows = np.stack(windows, axis=2).reshape(len(windows[0]), 2 * most + 2)
    triangle = np.asarray(np.linalg.qr(rows)[1])
    return EveryOrder(triangle, len(rows), sample_rate_hz)


# Simultaneous identification of order and parameters, as the published work does it.


def fit_sim(
    record: StepRecord,
    channel: str,
    *,
    reading: Reading | None = None,
    order: int | None = None,
    conversion: Literal["tustin", "zoh"] = "tustin",
    decimation: int = 1,
    most: int = 9,
) -> StepFit:
    """Return the difference equation of one output, made continuous, without covariance.

    `order`: number of poles, by the bend of the loss over order 1 … `most` where None; `conversion` to continuous
    time: "tustin", as the published model of 100 kHz samples, or "zoh", exact for a load that holds between samples;
    `decimation`: samples to a mean before anything else. `system.sampled(sample_rate_hz, conversion)` is the
    difference equation. Least squares of the equation error is biased by output noise, the more the faster the
    sampling: at 100 kHz and 40 dB a mode of ζ = 0.015 comes out with a multiple of its damping.
    """
    began = time.perf_counter()
    reading = reading or read_release(record, channel)
    load, output, _ = signals = constructed(record, reading, decimation)
    orders = every_order(load, output, record.sample_rate_hz / decimation, most)
    direct = conversion == "tustin"
    chosen = order or orders.bend(direct)
    fit = difference_fit(record, reading, orders.system(chosen, direct), conversion, signals, orders.loss(direct))
    return replace(fit, method="sim" if direct else "sim_zoh", order=chosen, duration_s=time.perf_counter() - began)


def difference_fit(
    record: StepRecord,
    reading: Reading,
    sampled: LinearSystem,
    conversion: Literal["tustin", "zoh"],
    signals: tuple[FloatArray, FloatArray, FloatArray],
    convergence: FloatArray,
) -> StepFit:
    """Return what a difference equation makes of load, output and times, as `constructed`, with its continuous system.

    Where a pole has no continuous counterpart the sampled system stays, with a notice.
    """
    from scipy.signal import sosfilt

    (load, output, time_s), where = signals, f"{record.name}, {reading.channel}"
    decimation = record.samples.shape[1] // len(time_s)
    rate = record.sample_rate_hz / decimation
    system = sampled
    notices: tuple[Notice, ...] = ()
    try:
        system = sampled.continuous(conversion)
    except ValueError as error:
        notices = (Notice("warning", f"no continuous model: {error}", where),)
    notices += pole_notices(system, rate)
    with np.errstate(over="ignore", invalid="ignore"):
        fitted = np.asarray(sosfilt(sampled.sections(), load))
    if not np.all(np.isfinite(fitted)):
        notices += (Notice("warning", "the model's output grows without bound: shown is the output's mean", where),)
        fitted = np.full_like(output, output.mean())
    with np.errstate(over="ignore"):
        accounted = 1.0 - float(np.sum((output - fitted) ** 2) / np.sum((output - output.mean()) ** 2))
    return StepFit(
        method="evolution_coefficients",
        channel=reading.channel,
        component=record.component,
        unit=record.unit,
        model=modal_form(system),
        system=system,
        time_s=time_s,
        fitted=fitted + reading.baseline,
        residual=output - fitted,
        sample_rate_hz=rate,
        decimation=decimation,
        order=len(sampled.poles),
        variance_accounted=accounted,
        convergence=convergence,
        duration_s=0.0,
        onset_s=reading.onset_s,
        u_onset_s=reading.u_onset_s,
        release_s=0.0,
        u_release_s=0.0,
        notices=notices,
    )


def constructed(record: StepRecord, reading: Reading, decimation: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return load, output above its baseline and time (N,): the load measured, or a step at the onset that was read."""
    value = record.samples[record.channels.index(reading.channel)] - reading.baseline
    load = record.amplitude * (record.time_s >= reading.onset_s) if record.force is None else record.force
    if record.force is not None:
        load = load - np.mean(load[record.time_s < reading.onset_s])
    size = len(value) // decimation
    parts = (part[: size * decimation].reshape(size, decimation).mean(axis=1) for part in (load, value, record.time_s))
    first, second, third = parts
    return first, second, third


def modal_form(system: LinearSystem) -> ModalModel | None:
    """Return a continuous system as a sum of modes, None where it has a direct term, double poles or is sampled."""
    if system.sample_rate_hz is not None or len(system.zeros) == len(system.poles):
        return None
    gaps = np.abs(system.poles[:, None] - system.poles) + np.diag(np.full(len(system.poles), np.inf))
    if np.min(gaps, initial=np.inf) < 1e-6 * np.max(np.abs(system.poles)) or np.any(system.poles == 0):
        return None
    residues = system.residues()
    upper, real = system.poles.imag > 0, system.poles.imag == 0
    omega = np.abs(system.poles[upper])
    return ModalModel(
        omega / (2 * np.pi),
        -system.poles[upper].real / omega,
        residues[upper],
        -system.poles[real].real / (2 * np.pi),
        residues[real].real,
    )
