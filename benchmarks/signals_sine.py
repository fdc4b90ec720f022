"""Sine approximation against the Cramér-Rao bound, with spikes, on a large record, and beside numpy and scipy.

Usage: python benchmarks/signals_sine.py [--trials 20000] [--seconds 60] [--only TABLE]

A trial is one channel of white noise of its own; CHANNELS of them are fitted at a time. The bound is the inverse of a
Fisher matrix made here of analytic derivatives. Some 4 minutes on one core; the large record takes 0.5 GB.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import curve_fit
from scipy.stats import f as f_distribution

from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineFit, SineModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
CHANNELS = 8
SIGMA = 0.1
START_BINS = 0.1  # by which the frequencies a four-parameter fit starts from are off
FUNDAMENTAL_HZ = 106.25
SPIKE = 30.0  # standard deviations
LARGE_RATE_HZ, LARGE_CHANNELS = 51_200.0, 16


@dataclass(frozen=True)
class Case:
    """Lines sampled `samples` times at `rate_hz`, fitted with `model`; decay and share of spikes in the data."""

    name: str
    lines: int
    rate_hz: float
    samples: int
    model: SineModel = field(default_factory=SineModel)
    decay_per_s: float = 0.0
    spikes: float = 0.0
    robust: bool = False

    @property
    def frequency_hz(self) -> FloatArray:
        """Frequencies (K,) of the lines."""
        return FUNDAMENTAL_HZ * np.arange(1.0, self.lines + 1.0)

    @property
    def time_s(self) -> FloatArray:
        """Sampling times (S,)."""
        return np.arange(self.samples) / self.rate_hz


ABOVE, BELOW = (2500.0, 400), {1: (10.8088, 211), 2: (21.6176, 211), 5: (52.874, 211)}
NAMES = {True: "known", False: "unknown"}
CASES = [
    Case(
        f"{lines} line{'s' * (lines > 1)}, {where}, frequency {NAMES[known]}",
        lines,
        *(ABOVE if where == "above Nyquist" else BELOW[lines]),
        model=SineModel(free=None if known else tuple(range(lines)) if lines == 2 else (0,) * lines),
    )
    for known in (True, False)
    for where in ("above Nyquist", "at 0.05 of it")
    for lines in (1, 2, 5)
]
OTHERS = [
    Case("2 lines with drift", 2, *ABOVE, model=SineModel(drift=True)),
    Case("2 lines decaying, frequency unknown", 2, *ABOVE, SineModel(free=(0, 0), decay="common"), 8.0),
    Case("2 lines, robust, no spikes", 2, *ABOVE, robust=True),
    Case("2 lines, robust, 1 % spikes of 30 σ", 2, *ABOVE, spikes=0.01, robust=True),
    Case("2 lines, robust, 10 % spikes of 30 σ", 2, *ABOVE, spikes=0.1, robust=True),
    Case("2 lines, least squares, 1 % spikes of 30 σ", 2, *ABOVE, spikes=0.01),
]


def truth(case: Case) -> ComplexArray:
    """Phasors (K, C) of a case: falling amplitudes, all phases."""
    k, c = np.arange(case.lines)[:, None], np.arange(CHANNELS)
    return np.asarray(np.exp(1j * (0.7 + 1.9 * k + 0.8 * c)) / (1.0 + k))


def curve(case: Case, value: ComplexArray) -> FloatArray:
    """Return the noise-free samples (S, C)."""
    exponent = 2j * np.pi * case.frequency_hz - case.decay_per_s
    return np.asarray((np.exp(np.multiply.outer(case.time_s, exponent)) @ value).real)


def bound(case: Case, value: ComplexArray) -> FloatArray:
    """Return the Cramér-Rao covariances (K, C, 2, 2) of Re X and Im X at time zero, from the Fisher matrix."""
    time_s, channels = case.time_s, value.shape[1]
    turns = np.exp(np.multiply.outer(time_s, 2j * np.pi * case.frequency_hz - case.decay_per_s))
    own = np.stack([turns.real, -turns.imag], axis=2).reshape(len(time_s), -1)
    constant = [np.ones(len(time_s))] + ([time_s] if case.model.drift else [])
    linear = np.column_stack([own, *constant])
    labels = np.array(case.model.free if case.model.free is not None else [-1] * case.lines)
    steps = [(labels == label) * 2j * np.pi * case.frequency_hz for label in np.unique(labels[labels >= 0])]
    steps += [-np.ones(case.lines)] if case.model.decay == "common" else []
    common = [
        np.concatenate([(time_s[:, None] * turns * step @ value[:, [c]]).real[:, 0] for c in range(channels)])
        for step in steps
    ]
    jacobian = np.column_stack([block_diag(*[linear] * channels), *common])
    # Scaled columns keep the inverse accurate.
    size = np.linalg.norm(jacobian, axis=0)
    covariance = SIGMA**2 * np.linalg.inv((jacobian / size).T @ (jacobian / size)) / np.multiply.outer(size, size)
    blocks = np.empty((case.lines, channels, 2, 2))
    for k in range(case.lines):
        for c in range(channels):
            pick = c * linear.shape[1] + 2 * k + np.arange(2)
            blocks[k, c] = covariance[np.ix_(pick, pick)]
    return blocks


def statistics(case: Case, trials: int, seed: int) -> tuple[float, float, float, float, float]:
    """Return variance over bound, coverage, largest bias over deviation, its standard error, and ms per fit."""
    rng, value = np.random.default_rng(seed), truth(case)
    clean, limit, names = curve(case, value), bound(case, value), [str(c) for c in range(CHANNELS)]
    unknown = case.model.free is not None
    off_hz = START_BINS * case.rate_hz / case.samples if unknown else 0.0
    start = case.frequency_hz * (1.0 + off_hz / case.frequency_hz[-1])
    errors, inside, spent = [], [], 0.0
    for _ in range(-(-trials // CHANNELS)):
        data = clean + SIGMA * rng.standard_normal(clean.shape)
        hit = rng.random(len(data)) < case.spikes
        data[hit] += SPIKE * SIGMA * rng.choice([-1.0, 1.0], size=(int(hit.sum()), CHANNELS))
        begin = time.perf_counter()
        fit = fit_sines(case.time_s, data, start, names, names, model=replace(case.model, robust=case.robust))
        spent += time.perf_counter() - begin
        delta = fit.phasors.value - value
        errors.append(np.stack([delta.real, delta.imag], axis=-1))
        inside.append(covered(fit, errors[-1]))
    error = np.array(errors)
    ratio = float(np.mean(error**2 / np.diagonal(limit, axis1=2, axis2=3)))
    bias = float(np.max(np.abs(error.mean(axis=0)) / error.std(axis=0)))
    return ratio, float(np.mean(inside)), bias, 1.0 / float(np.sqrt(len(error))), 1e3 * spent / len(error)


def covered(fit: SineFit, error: FloatArray) -> NDArray[np.bool_]:
    """Tell for each line and channel whether the 95 % region of its phasor holds the truth."""
    channel = np.arange(error.shape[1])
    pick = np.stack([channel, channel + len(channel)], axis=1)
    covariance = fit.phasors.covariance[:, pick[:, :, None], pick[:, None, :]]
    squares = np.einsum("kci,kci->kc", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    return np.asarray(squares / 2.0 < f_distribution.ppf(0.95, 2, fit.phasors.dof)[:, None])


def print_cases(cases: list[Case], trials: int) -> None:
    """Print a Markdown row per case."""
    print("| case | variance / bound | coverage of 95 % | largest bias / deviation (its own) | ms per fit |")
    print("|---|---|---|---|---|")
    for seed, case in enumerate(cases):
        ratio, coverage, bias, own, spent = statistics(case, trials, seed)
        print(
            f"| {case.name} | {ratio:.3f} | {100 * coverage:.1f} % | {bias:.3f} ({own:.3f}) | {spent:.2f} |", flush=True
        )


def print_peers(trials: int) -> None:
    """Compare single fits with numpy's least squares at known, and scipy's at unknown frequency."""
    print("| fit of 1 channel, 400 samples | scatter of amplitude / this program's | time / this program's |")
    print("|---|---|---|")
    case, rng = Case("", 1, *ABOVE), np.random.default_rng(0)
    clean, time_s, start = curve(case, truth(case))[:, :1], case.time_s, case.frequency_hz + 0.1 * 2500.0 / 400.0
    columns = np.column_stack(
        [np.cos(2.0 * np.pi * FUNDAMENTAL_HZ * time_s), np.sin(2.0 * np.pi * FUNDAMENTAL_HZ * time_s), np.ones(400)]
    )

    def four(t: FloatArray, a: float, b: float, offset: float, frequency: float) -> FloatArray:
        angle = 2.0 * np.pi * frequency * t
        return np.asarray(a * np.cos(angle) + b * np.sin(angle) + offset)

    def by_scipy(y: FloatArray) -> complex:
        found = curve_fit(four, time_s, y, [0.5, 0.5, 0.0, start[0]])[0]
        return complex(found[0], -found[1])

    def by_numpy(y: FloatArray) -> complex:
        found = np.linalg.lstsq(columns, y, rcond=None)[0]
        return complex(found[0], -found[1])

    def ours(y: FloatArray, frequency_hz: FloatArray, model: SineModel) -> complex:
        return complex(fit_sines(time_s, y[:, None], frequency_hz, ["a"], ["1"], model=model).phasors.value[0, 0])

    programs: dict[str, tuple[Callable[[FloatArray], complex], Callable[[FloatArray], complex]]] = {
        "numpy.linalg.lstsq, frequency known, no uncertainty": (
            by_numpy,
            lambda y: ours(y, case.frequency_hz, SineModel()),
        ),
        "scipy.optimize.curve_fit, frequency unknown": (by_scipy, lambda y: ours(y, start, SineModel(free=(0,)))),
    }
    for name, pair in programs.items():
        found, spent = np.empty((2, trials), dtype=np.complex128), np.zeros(2)
        for i in range(trials):
            y = clean[:, 0] + SIGMA * rng.standard_normal(400)
            for which, program in enumerate(pair):
                begin = time.perf_counter()
                found[which, i] = program(y)
                spent[which] += time.perf_counter() - begin
        scatter = np.std(np.abs(found), axis=1)
        print(f"| {name} | {scatter[0] / scatter[1]:.4f} | {spent[0] / spent[1]:.2f} |", flush=True)


def print_large(seconds: float) -> None:
    """Fit 5 lines to a large record in a process of its own for each way."""
    print(
        f"| {LARGE_RATE_HZ:g} Hz, {seconds:g} s, {LARGE_CHANNELS} channels, 5 lines | s | CPU s | peak memory / data |"
    )
    print("|---|---|---|---|")
    for way in ("known", "unknown", "robust", "lstsq"):
        command = [sys.executable, __file__, "--large", way, "--seconds", str(seconds)]
        print(subprocess.run(command, check=True, capture_output=True, text=True).stdout, end="", flush=True)


def large(way: str, seconds: float) -> None:
    """Make the record, fit it one way, and print a Markdown row."""
    rng, samples = np.random.default_rng(0), int(seconds * LARGE_RATE_HZ)
    frequency = FUNDAMENTAL_HZ * np.arange(1.0, 6.0) + 0.0137
    names = [str(c) for c in range(LARGE_CHANNELS)]
    values = np.empty((samples, LARGE_CHANNELS))
    for first in range(0, samples, 1 << 15):
        last = min(samples, first + (1 << 15))
        line = np.cos(2.0 * np.pi * np.mod(frequency[0] * np.arange(first, last) / LARGE_RATE_HZ, 1.0))
        values[first:last] = line[:, None] + SIGMA * rng.standard_normal((last - first, LARGE_CHANNELS))
    time_s = np.arange(samples) / LARGE_RATE_HZ
    begin, worked = time.perf_counter(), time.process_time()
    if way == "lstsq":
        angle = 2.0 * np.pi * np.multiply.outer(time_s, frequency)
        np.linalg.lstsq(np.column_stack([np.cos(angle), np.sin(angle), np.ones(samples)]), values, rcond=None)
    else:
        model = SineModel(free=(0,) * 5) if way == "unknown" else SineModel()
        start = frequency * (1.0 + (START_BINS / seconds / frequency[-1] if way == "unknown" else 0.0))
        fit_sines(time_s, values, start, names, names, model=replace(model, robust=way == "robust"))
    spent, worked = time.perf_counter() - begin, time.process_time() - worked
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0 / values.nbytes
    name = {"known": "frequencies known", "unknown": "frequencies unknown", "lstsq": "numpy.linalg.lstsq"}.get(way, way)
    print(f"| {name} | {spent:.2f} | {worked:.2f} | {peak:.2f} |")


def main(trials: int = 20_000, seconds: float = 60.0, only: str = "") -> None:
    """Print the tables."""
    tables: dict[str, Callable[[], None]] = {
        "large": lambda: print_large(seconds),
        "peers": lambda: print_peers(max(trials // 20, 20)),
        "others": lambda: print_cases(OTHERS, trials // 2),
        "bound": lambda: print_cases(CASES, trials),
    }
    for name, show in tables.items():
        if only in name:
            show()
            print()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20_000)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the large record")
    parser.add_argument("--only", default="", choices=("", "large", "peers", "others", "bound"))
    parser.add_argument("--large", default="", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.large:
        large(options.large, options.seconds)
    else:
        main(options.trials, options.seconds, options.only)
