"""Every identification from a step response, on simulated records of a known sensor.

Usage: python benchmarks/steps.py [--seeds 50] [--evolutions 3] [--coverage 0] [--first 0]

The sensor: a mode at 1700 Hz, damping ratio 0.015, behind a low-pass filter of 6 kHz; 100 kHz, 10 ms before the release
and 30 ms after it, the release anywhere between two samples. The noise is stated over the oscillation: 40 dB is a
hundredth of the rms of what rings about the new level in the 30 ms. Printed: CPU time and errors of natural frequency
and damping ratio of every method at 60, 40 and 20 dB, all on the same records and with the same reading of the release;
how much faster and nearer the truth the default is than differential evolution with the published settings; and with
`--coverage N` how often the 95 % intervals of N trials hold the truth, for white noise, for noise behind an
anti-aliasing filter, and for a coarse converter; one reading of the release is the start of all of them. Differential
evolution takes some 10 s per record.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shaker.models.linear_system import LinearSystem
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step.release import read_release
from shaker.models.step_fit.compare import METHODS, compare
from shaker.models.step_fit.fit import fit_step
from shaker.models.step_fit.result import Method

FloatArray = NDArray[np.float64]
RATE_HZ, BEFORE_S, AFTER_S, AMPLITUDE_N = 100e3, 0.01, 0.03, 50.0
FREQUENCY_HZ, DAMPING, LOW_PASS_HZ = 1700.0, 0.015, 6000.0
LEVELS_DB = (60, 40, 20)
PUBLISHED: Method = "evolution_coefficients"
SLOW: tuple[Method, ...] = ("evolution", PUBLISHED)
Z_95 = 1.959964


@dataclass(frozen=True)
class Outcome:
    """CPU time and relative errors of frequency and damping, NaN where a method found no oscillating pole."""

    seconds: float
    frequency: float
    damping: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50, help="records per level for all but differential evolution")
    parser.add_argument("--evolutions", type=int, default=3, help="records per level for differential evolution")
    parser.add_argument("--coverage", type=int, default=0, help="trials of the intervals' coverage (default: none)")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    options = parser.parse_args()
    compare_all(options.seeds, options.evolutions, options.first)
    if options.coverage:
        coverage(options.coverage, options.first)


def truth() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return poles, residues of the response to a unit step, and the modal vector of the sensor."""
    from scipy.signal import residue

    omega, fall = 2 * np.pi * FREQUENCY_HZ, 2 * np.pi * LOW_PASS_HZ
    denominator = np.polymul([1.0, 2 * DAMPING * omega, omega**2], [1.0, fall])
    swing, poles, _ = residue([omega**2 * fall], denominator)
    upper, real = int(np.argmax(poles.imag)), int(np.argmin(np.abs(poles.imag)))
    vector = [FREQUENCY_HZ, DAMPING, swing[upper].real, swing[upper].imag, LOW_PASS_HZ, swing[real].real]
    return poles, swing / poles, np.array(vector)


def clean(onset_s: float) -> FloatArray:
    """Return the noiseless output, 1 V per load unit: 1 + Σ r/p exp(pτ) after the onset."""
    poles, swing, _ = truth()
    tau = np.arange(round((BEFORE_S + AFTER_S) * RATE_HZ)) / RATE_HZ - onset_s
    ring = np.real(np.exp(np.maximum(tau, 0.0)[:, None] * poles) @ swing)
    return np.where(tau > 0, 1.0 + ring, 0.0)


def record_of(level_db: float, seed: int, noise: Callable[[np.random.Generator, int], FloatArray]) -> StepRecord:
    """Return a record; `noise` draws samples of standard deviation 1."""
    rng = np.random.default_rng(seed)
    onset = BEFORE_S + rng.random() / RATE_HZ
    output = clean(onset)
    after = output[round(BEFORE_S * RATE_HZ) :]
    sigma = np.sqrt(np.mean((after - 1.0) ** 2)) * 10 ** (-level_db / 20)
    samples = AMPLITUDE_N * (output + sigma * noise(rng, len(output))) + 0.1
    return StepRecord(f"seed {seed}", ("Fz",), "mV", samples[None], RATE_HZ, "Fz", AMPLITUDE_N)


def white(rng: np.random.Generator, count: int) -> FloatArray:
    return rng.standard_normal(count)


def filtered(rng: np.random.Generator, count: int) -> FloatArray:
    """Return noise behind a Butterworth filter of fourth order at 10 kHz."""
    from scipy.signal import butter, sosfilt

    found = sosfilt(butter(4, 10e3, fs=RATE_HZ, output="sos"), rng.standard_normal(count + 1000))[1000:]
    return np.asarray(found / np.sqrt(0.2))


def outcomes(method: Method, level_db: float, seeds: range) -> list[Outcome]:
    """Return what one method makes of every record."""
    found = []
    for seed in seeds:
        record = record_of(level_db, seed, white)
        reading = read_release(record, "Fz")
        began = time.process_time()
        options = {"modes": 1, "real_poles": 1} if method in {"pencil", "arx"} else {}
        fit = compare(record, "Fz", rng=np.random.default_rng(seed), reading=reading, methods=(method,), **options)[0]
        found.append(Outcome(time.process_time() - began, *errors(fit.system)))
    return found


def errors(system: LinearSystem) -> tuple[float, float]:
    """Return relative errors of the natural frequency and damping ratio of the oscillating pole next to the truth."""
    poles = system.poles[system.poles.imag > 0]
    if system.sample_rate_hz is not None:
        poles = np.log(poles) * system.sample_rate_hz
    if not len(poles):
        return np.nan, np.nan
    omega = 2 * np.pi * FREQUENCY_HZ
    pole = poles[np.argmin(np.abs(poles - omega * 1j))]
    return abs(pole) / omega - 1.0, -pole.real / abs(pole) / DAMPING - 1.0


def compare_all(seeds: int, evolutions: int, first: int) -> None:
    """Print the table of all methods and the default's gain over the published one."""
    print("| method | level | records | CPU s | fn error: median, 95 % | ζ error: median, 95 % | no pole pair |")
    print("|---|---|---|---|---|---|---|")
    medians: dict[tuple[Method, int], Outcome] = {}
    compare(record_of(60, 0, white), "Fz", rng=np.random.default_rng(0), methods=("pencil", "sim"))
    for method in METHODS:
        for level in LEVELS_DB:
            count = evolutions if method in SLOW else seeds
            found = outcomes(method, level, range(first, first + count))
            seconds = float(np.median([one.seconds for one in found]))
            size = np.abs(np.array([[one.frequency, one.damping] for one in found]))
            seen = size[np.isfinite(size[:, 0])]
            middle = np.median(seen, axis=0) if len(seen) else np.full(2, np.nan)
            tail = np.quantile(seen, 0.95, axis=0) if len(seen) else np.full(2, np.nan)
            medians[method, level] = Outcome(seconds, float(middle[0]), float(middle[1]))
            parts = " | ".join(f"{100 * a:.2g} %, {100 * b:.2g} %" for a, b in zip(middle, tail, strict=True))
            print(f"| {method} | {level} dB | {count} | {seconds:.3g} | {parts} | {count - len(seen)} |", flush=True)
    print("\n| level | default s | published s | faster | fn nearer | ζ nearer |\n|---|---|---|---|---|---|")
    for level in LEVELS_DB:
        own, other = medians["pencil", level], medians[PUBLISHED, level]
        ratios = [other.seconds / own.seconds, other.frequency / own.frequency, other.damping / own.damping]
        print(
            f"| {level} dB | {own.seconds:.3g} | {other.seconds:.3g} | "
            + " | ".join(f"{r:.3g}×" for r in ratios)
            + " |"
        )


def coverage(trials: int, first: int) -> None:
    """Print how often the 95 % intervals of frequency, damping, residue, real pole, its residue and the onset hold."""
    _, _, vector = truth()
    print("\n| noise | level | trials | " + " | ".join(NAMES) + " |\n|---|---|---|" + "---|" * len(NAMES))
    for name, level, draw, bits, count in (
        ("white", 40, white, None, trials),
        ("white", 20, white, None, trials // 4),
        ("4th-order filter at 10 kHz", 40, filtered, None, trials // 4),
        ("white, converter of 10 bits", 60, white, 10, trials // 4),
    ):
        start = read_release(record_of(level, first, draw), "Fz")
        inside = [covered(record_of(level, seed, draw), bits, vector, start) for seed in range(first, first + count)]
        shares = " | ".join(f"{100 * share:.1f}" for share in np.mean(inside, axis=0))
        print(f"| {name} | {level} dB | {count} | {shares} |", flush=True)


NAMES = ("fn", "ζ", "Re residue", "Im residue", "real pole", "its residue", "static gain", "onset")


def covered(record: StepRecord, bits: int | None, vector: FloatArray, start: Reading) -> FloatArray:
    """Return for every figure (8,) whether its 95 % interval holds the truth; `start`: a reading to start from."""
    seed = int(record.name.split()[1])
    if bits is not None:
        step = 4.0 * AMPLITUDE_N / 2**bits
        record = StepRecord(
            record.name,
            record.channels,
            record.unit,
            step * np.round(record.samples / step),
            RATE_HZ,
            "Fz",
            AMPLITUDE_N,
        )
    fit = fit_step(record, "Fz", modes=1, real_poles=1, reading=start)
    assert fit.model is not None
    assert fit.model.covariance is not None
    gain, u_gain = fit.model.propagate(lambda model: np.array([model.static_gain]))
    onset = BEFORE_S + np.random.default_rng(seed).random() / RATE_HZ
    found = np.concatenate([fit.model.vector - vector, gain - 1.0, [fit.onset_s - onset]])
    u = np.concatenate([np.sqrt(np.diag(fit.model.covariance)), np.sqrt(u_gain[0]), [fit.u_onset_s]])
    return np.abs(found) < Z_95 * u


if __name__ == "__main__":
    main()
