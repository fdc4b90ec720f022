"""Every identification from a step response, on simulated records of a known sensor.

Usage: python benchmarks/steps.py [--seeds 50] [--evolutions 3] [--coverage 0] [--campaigns 0]
           [--decouplings 0] [--first 0]

The sensor: a mode at 1700 Hz, damping ratio 0.015, behind a low-pass filter of 6 kHz; 100 kHz, 10 ms before the release
and 30 ms after it, the release anywhere between two samples. The noise is stated over the oscillation: 40 dB is a
hundredth of the rms of what rings about the new level in the 30 ms. Printed: CPU time and errors of natural frequency
and damping ratio of every method at 60, 40 and 20 dB, all on the same records and with the same reading of the release;
how much faster and nearer the truth the default is than differential evolution with the published settings; and with
`--coverage N` how often the 95 % intervals of N trials hold the truth, each record read and its structure chosen by the
program, for several releases, white noise, noise behind an anti-aliasing filter, and a coarse converter. With
`--campaigns N` preset `steps` is simulated N times, evaluated and compensated: how often U of the ±10 % band and of the
overshoot holds the truth, before and after the filter; with `--decouplings N` how far the model of `decouple` is off in
standard uncertainties, and how often releases of another length are told. Differential evolution takes a second per
record, a campaign some 10 s.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion import (
    DecoupleSettings,
    StepSettings,
    evaluate_compensation,
    evaluate_decoupling,
    evaluate_steps,
    load_for_command,
    simulate_preset,
)
from fusion.sensor.compensate.compensation_subjects import CompensationSettings, read_sources
from fusion.sensor.model_files import MODELS_FILE, ModelsFile, models_text
from shaker.lti.indices import indices
from shaker.lti.system import LinearSystem, ModalModel
from shaker.model_notices import DURATION_AMBIGUOUS
from shaker.release.reading import read_release
from shaker.release.record import ReleaseShape, StepRecord
from shaker.release.step_fit import Method, fit_step
from shaker.release.step_methods import METHODS, fit_all_methods

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
    parser.add_argument("--seeds", type=int, default=50, help="records per level; 0: differential evolution alone")
    parser.add_argument("--evolutions", type=int, default=3, help="the same for differential evolution; 0: without it")
    parser.add_argument("--coverage", type=int, default=0, help="trials of the intervals' coverage (default: none)")
    parser.add_argument("--campaigns", type=int, default=0, help="campaigns of preset steps (default: none)")
    parser.add_argument("--decouplings", type=int, default=0, help="the same for decouple (default: none)")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    options = parser.parse_args()
    compare_all(options.seeds, options.evolutions, options.first)
    if options.coverage:
        coverage(options.coverage, options.first)
    if options.campaigns:
        campaigns(options.campaigns, options.first)
    if options.decouplings:
        decouplings(range(options.first, options.first + options.decouplings))


def truth() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return poles, residues of the response to a unit step, and the modal vector of the sensor."""
    from scipy.signal import residue

    omega, fall = 2 * np.pi * FREQUENCY_HZ, 2 * np.pi * LOW_PASS_HZ
    denominator = np.polymul([1.0, 2 * DAMPING * omega, omega**2], [1.0, fall])
    swing, poles, _ = residue([omega**2 * fall], denominator)
    upper, real = int(np.argmax(poles.imag)), int(np.argmin(np.abs(poles.imag)))
    vector = [FREQUENCY_HZ, DAMPING, swing[upper].real, swing[upper].imag, LOW_PASS_HZ, swing[real].real]
    return poles, swing / poles, np.array(vector)


def clean(onset_s: float, length_s: float = 0.0, shape: ReleaseShape = "ramp") -> FloatArray:
    """Return the noiseless output for a load of 1 that goes at once, or in a shape: the mean of 1 + Σ r/p exp(pτ).

    Along half a cosine that mean is taken at 48 nodes of Gauss and Legendre.
    """
    if shape == "smooth":
        nodes, share = np.polynomial.legendre.leggauss(48)
        weight = 0.25 * np.pi * share * np.cos(0.5 * np.pi * nodes)
        middles = onset_s + 0.5 * length_s * (1.0 + nodes)
        return np.asarray(weight @ np.array([clean(middle_s) for middle_s in middles.tolist()]))
    poles, swing, _ = truth()
    tau = np.arange(round((BEFORE_S + AFTER_S) * RATE_HZ)) / RATE_HZ - onset_s
    if not length_s:
        return np.where(tau > 0, 1.0 + np.real(np.exp(np.maximum(tau, 0.0)[:, None] * poles) @ swing), 0.0)

    def area(since: FloatArray) -> FloatArray:
        past = np.maximum(since, 0.0)
        return np.asarray(past + np.real(np.expm1(past[:, None] * poles) @ (swing / poles)))

    return np.asarray((area(tau) - area(tau - length_s)) / length_s)


def record_of(
    level_db: float,
    seed: int,
    noise: Callable[[np.random.Generator, int], FloatArray],
    length_s: float = 0.0,
    shape: ReleaseShape = "ramp",
) -> StepRecord:
    """Return a record; `noise` draws samples of standard deviation 1. The level is that over the ringing of a step."""
    rng = np.random.default_rng(seed)
    onset = BEFORE_S + rng.random() / RATE_HZ
    sigma = np.sqrt(np.mean((clean(onset)[round(BEFORE_S * RATE_HZ) :] - 1.0) ** 2)) * 10 ** (-level_db / 20)
    output = clean(onset, length_s, shape)
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
        fit = fit_all_methods(record, "Fz", rng=np.random.default_rng(seed), reading=reading, methods=(method,))[0]
        found.append(Outcome(time.process_time() - began, *errors(fit.system)))
    return found


def errors(system: LinearSystem) -> tuple[float, float]:
    """Return relative errors of the natural frequency and damping ratio of the oscillating pole next to the truth."""
    poles = system.poles[system.poles.imag > 0]
    if system.sample_rate_hz is not None:
        poles = np.asarray(np.log(poles) * system.sample_rate_hz)
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
    fit_all_methods(record_of(60, 0, white), "Fz", rng=np.random.default_rng(0), methods=("pencil", "sim"))
    counts: dict[Method, int] = {method: evolutions if method in SLOW else seeds for method in METHODS}
    for method in (method for method in METHODS if counts[method]):
        for level in LEVELS_DB:
            count = counts[method]
            found = outcomes(method, level, range(first, first + count))
            seconds = float(np.median([one.seconds for one in found]))
            size = np.abs(np.array([[one.frequency, one.damping] for one in found]))
            seen = size[np.isfinite(size[:, 0])]
            middle = np.median(seen, axis=0) if len(seen) else np.full(2, np.nan)
            tail = np.quantile(seen, 0.95, axis=0) if len(seen) else np.full(2, np.nan)
            medians[method, level] = Outcome(seconds, float(middle[0]), float(middle[1]))
            parts = " | ".join(f"{100 * a:.2g} %, {100 * b:.2g} %" for a, b in zip(middle, tail, strict=True))
            print(f"| {method} | {level} dB | {count} | {seconds:.3g} | {parts} | {count - len(seen)} |", flush=True)
    if not (seeds and evolutions):
        return
    print("\n| level | default s | published s | faster | fn nearer | ζ nearer |\n|---|---|---|---|---|---|")
    for level in LEVELS_DB:
        own, other = medians["pencil", level], medians[PUBLISHED, level]
        ratios = [other.seconds / own.seconds, other.frequency / own.frequency, other.damping / own.damping]
        print(
            f"| {level} dB | {own.seconds:.3g} | {other.seconds:.3g} | "
            + " | ".join(f"{r:.3g}×" for r in ratios)
            + " |"
        )


class Case(NamedTuple):
    """Records of a level in dB; `share`: one of so many trials; `length_s` of the release; `bits` of the converter."""

    name: str
    level_db: float
    share: int
    length_s: float = 0.0
    shape: ReleaseShape = "ramp"
    noise: Callable[[np.random.Generator, int], FloatArray] = white
    bits: int | None = None


CASES = (
    Case("white noise, step", 40, 1),
    Case("white noise, step", 20, 4),
    Case("white noise, line of 0.15 ms", 40, 4, 1.5e-4),
    Case("white noise, line of 0.4 ms", 40, 8, 4e-4),
    Case("white noise, half a cosine of 0.15 ms", 60, 8, 1.5e-4, "smooth"),
    Case("white noise, half a cosine of 0.4 ms", 40, 8, 4e-4, "smooth"),
    Case("white noise, half a cosine of 0.8 ms", 40, 8, 8e-4, "smooth"),
    Case("4th-order filter at 10 kHz, step", 40, 8, noise=filtered),
    Case("white noise, converter of 10 bits, step", 60, 8, bits=10),
)
NAMES = ("fn", "ζ", "static gain", "±5 % band")


def coverage(trials: int, first: int) -> None:
    """Print how often the 95 % intervals of resonance, damping, static gain and working band hold."""
    true = np.array([FREQUENCY_HZ, DAMPING, 1.0, band_hz(model_of(truth()[2]))])
    print("\n| record | level | trials | " + " | ".join(NAMES) + " |\n|---|---|---|" + "---|" * len(NAMES))
    for case in CASES:
        seeds = range(first, first + trials // case.share)
        inside = []
        for seed in seeds:
            record = record_of(case.level_db, seed, case.noise, case.length_s, case.shape)
            inside.append(covered(record if case.bits is None else rounded(record, case.bits), true))
        shares = " | ".join(f"{100 * found:.1f}" for found in np.mean(inside, axis=0))
        print(f"| {case.name} | {case.level_db:g} dB | {len(seeds)} | {shares} |", flush=True)


def model_of(vector: FloatArray) -> ModalModel:
    """Return the sensor's modal vector as a model."""
    hertz, zeta, re, im, real, real_residue = (np.array([value]) for value in vector)
    return ModalModel(hertz, zeta, re + 1j * im, real, real_residue)


def band_hz(model: ModalModel) -> float:
    """Return where the gain first leaves 1.05 times that at rest, below the resonance."""
    from scipy.optimize import brentq

    def beyond(hertz: float) -> float:
        return float(abs(model.response(np.array([hertz]))[0] / model.static_gain)) - 1.05

    return float(brentq(beyond, 10.0, 0.9 * float(model.frequency_hz[0])))


def figures(model: ModalModel) -> FloatArray:
    """Return resonance, damping, static gain and band (4,) of the mode next to the sensor's."""
    place = int(np.argmin(np.abs(model.frequency_hz - FREQUENCY_HZ)))
    return np.array([model.frequency_hz[place], model.damping_ratio[place], model.static_gain, band_hz(model)])


def rounded(record: StepRecord, bits: int) -> StepRecord:
    """Return a record behind a converter with a range of four times the step."""
    step = 4.0 * AMPLITUDE_N / 2**bits
    return replace(record, samples=step * np.round(record.samples / step))


def covered(record: StepRecord, true: FloatArray) -> NDArray[np.bool_]:
    """Return for every figure (4,) whether its 95 % interval holds the truth."""
    model = fit_step(record, "Fz").model
    assert model is not None
    found, covariance = model.propagate(figures)
    return np.abs(found - true) < Z_95 * np.sqrt(np.diag(covariance))


OF_CAMPAIGNS = {"band_10_hz": "±10 % band", "overshoot": "overshoot"}
OF_MODES = ("frequency_hz", "damping_ratio")
RAISED = 1.5  # wanted natural frequency over the sensor's own


def errors_over_u(seed: int) -> dict[str, FloatArray]:
    """Return errors over their U (3, 2) of a campaign of preset steps, by component.

    Rows: of step, of compensate before and after the filter; columns: `OF_CAMPAIGNS`. The filter raises the sensor's
    frequency `RAISED` times. The truth after it is that of the true sensor, all its modes and its amplifier, behind
    the filter that was made.
    """
    found: dict[str, FloatArray] = {}
    with TemporaryDirectory() as place:
        folder = Path(place) / "steps"
        simulate_preset(folder, "steps", seed)
        evaluation = evaluate_steps("steps", load_for_command([folder], "step"), StepSettings(), {})
        entries = tuple(one.entry for one in evaluation.components if one.entry is not None)
        (folder / MODELS_FILE).write_text(models_text(ModelsFile("steps", "", "", entries)), encoding="utf-8")
        sources, true = read_sources([folder / MODELS_FILE]), true_sensors(folder / "truth.json")
    for component in evaluation.components:
        frequency = component.find("natural_hz")
        if frequency is None:
            continue
        wish = CompensationSettings(frequency_hz=RAISED * frequency.value, channels=(component.channel,))
        (made,) = evaluate_compensation(sources, wish, None, {}).filters
        sensor = true[component.channel].system
        truths = [wanted(indices(one).figures()) for one in (sensor, sensor.times(made.compensation.system))]
        rows = []
        for figures, held in zip((made.before, made.after), truths, strict=True):
            u = wanted({name: figures.expanded(name) for name in OF_CAMPAIGNS})
            rows.append((wanted(figures.indices.figures()) - held) / u)
        of_step = zip(map(component.find, OF_CAMPAIGNS), truths[0], strict=True)
        errors = [(one.value - held) / one.expanded for one, held in of_step if one is not None]
        found[component.channel] = np.array([errors, *rows])
    return found


def wanted(figures: Mapping[str, float | None]) -> FloatArray:
    """Return those `OF_CAMPAIGNS` (2,), NaN where there is none."""
    return np.array([figures[name] for name in OF_CAMPAIGNS], dtype=np.float64)


def true_sensors(path: Path) -> dict[str, ModalModel]:
    """Return the model of every output for the load of its own name that a simulated campaign has."""
    told = json.loads(path.read_text(encoding="utf-8"))
    hertz, zeta = (np.array(told[name]) for name in OF_MODES)
    residue = np.array(told["residue"]["re"]) + 1j * np.array(told["residue"]["im"])
    real_hz, real_residue = np.array(told["real_hz"]), np.array(told["real_residue"])
    return {
        name: ModalModel(hertz, zeta, residue[place, place], real_hz, real_residue[place, place])
        for place, name in enumerate(told["channels"])
    }


def campaigns(count: int, first: int) -> None:
    """Print how often U held the truth over all components of some campaigns, and the median error over U."""
    found = [errors_over_u(seed) for seed in range(first, first + count)]
    ratio = np.abs(np.array([one for campaign in found for one in campaign.values()]))
    print(f"\n{len(ratio)} models of {count} campaigns")
    print("| | " + " | ".join(f"{label}: held, median error over U" for label in OF_CAMPAIGNS.values()) + " |")
    print("|---|" + "---|" * len(OF_CAMPAIGNS))
    for row, name in enumerate(("step", "compensate, before the filter", "compensate, after it")):
        parts = [f"{np.mean(own <= 1.0):.1%}, {np.median(own):.2f}" for own in ratio[:, row].T]
        print(f"| {name} | {' | '.join(parts)} |", flush=True)


def decouplings(seeds: range) -> None:
    """Print how far the models of some campaigns of preset steps are off, over u of all their parameters."""
    scores, largest, told = [], [], 0
    for seed in seeds:
        with TemporaryDirectory() as place:
            folder = Path(place) / "steps"
            simulate_preset(folder, "steps", seed)
            found = evaluate_decoupling("steps", load_for_command([folder], "decouple"), DecoupleSettings(), {}).fit
            true = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        model, u = found.model, found.model.u
        if len(model.frequency_hz) != len(true["frequency_hz"]) or len(model.real_hz) != 1:
            print(f"seed {seed}: {len(model.frequency_hz)} modes and {len(model.real_hz)} lags, not counted")
            continue
        order = np.argsort(model.frequency_hz)
        modes = [(getattr(model, name)[order] - true[name]) / getattr(u, name)[order] for name in OF_MODES]
        re, im = np.moveaxis(np.array([true["residue"]["re"], true["residue"]["im"]]), 3, 1)
        own, spread = model.residue[order], u.residue[order]
        parts = (own.real - re) / spread.real, (own.imag - im) / spread.imag
        lag = (model.real_hz - true["real_hz"]) / u.real_hz
        real = (model.real_residue[0] - np.array(true["real_residue"])[:, :, 0]) / u.real_residue[0]
        scores.append(np.concatenate([part.ravel() for part in (*modes, *parts, lag, real)]))
        largest.append(float(np.abs(scores[-1]).max()))
        told += any(notice.code == DURATION_AMBIGUOUS.code for notice in found.notices)
    score = np.abs(np.concatenate(scores))
    print(f"\n{len(scores)} models, {len(score)} parameters: rms {np.sqrt(np.mean(score**2)):.2f} u")
    print(f"beyond 2 u {np.mean(score > 2.0):.2%}, beyond 3 u {np.mean(score > 3.0):.2%}")
    print(f"largest of a model: median {np.median(largest):.1f} u, of all {max(largest):.1f} u")
    print(f"releases that may have lasted longer or shorter are told in {told}")


if __name__ == "__main__":
    main()
