"""Transfer functions of a simulated oscillator (Q = 66, f0 = 1477.35 Hz): chirp, noise and blows; beside pyFRF.

Usage: python benchmarks/signals_transfer.py [--trials 200]

The responses are exact: spectra of the excitation times the oscillator's frequency response, or the sum of the
harmonics of a chirp at the times of the samples. White noise on both channels, of the rms of each (chirp, noise) or of
its peak (blows). Printed: rms errors of f0 and damping, over the Cramér-Rao bound where it is known, how often their
95 % intervals hold the truth, and how often the 95 % regions of the transfer function do, between the half-power
points and elsewhere. pyFRF (pip install pyFRF; left out where it is not installed) gets the same samples; its
transfer function goes through the same fit with equal weights, through the same fit with the weights that its
coherence states, and through peak picking with half-power points.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shaker.frf.impact import transfer_impact
from shaker.frf.periodic import transfer_periodic
from shaker.frf.random import transfer_random
from shaker.frf.result import TransferFunction, TransferRecord
from shaker.identification.measured_curves import MeasuredCurve
from shaker.identification.oscillator import Resonance, ResonanceKind, fit_resonance

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
F0_HZ, Q = 1477.35, 66.0
ZETA = 0.5 / Q
HAS_PYFRF = importlib.util.find_spec("pyFRF") is not None
FIT_HZ = (1000.0, 2000.0)


@dataclass(frozen=True)
class Peer:
    """What pyFRF made of a record: frequencies, ratio, coherence, averages, and the decay of its response window."""

    frequency_hz: NDArray[Any]
    ratio: ComplexArray
    coherence: NDArray[Any]
    averages: float
    decay_per_s: float = 0.0


@dataclass(frozen=True)
class Case:
    """A kind of record: how to make one, how we estimate, and how pyFRF does."""

    name: str
    kind: ResonanceKind
    make: Callable[[np.random.Generator], TransferRecord]
    estimate: Callable[[TransferRecord], TransferFunction]
    peer: Callable[[TransferRecord], Peer] | None = None
    bound: FloatArray | None = None


def response(kind: ResonanceKind, frequency_hz: NDArray[Any], decay_per_s: float = 0.0) -> ComplexArray:
    """Return the oscillator's transfer function at s = a + jω, of stiffness 1e8 N/m where driven by a force."""
    s = decay_per_s + 2j * np.pi * frequency_hz
    p = s / (2.0 * np.pi * F0_HZ)
    pole = 1.0 + 2.0 * ZETA * p + p * p
    return np.asarray((1.0 + 2.0 * ZETA * p) / pole if kind == "transmissibility" else 1e-8 * s * s / pole)


def recorded(
    pair: tuple[FloatArray, FloatArray],
    rate: float,
    noise: tuple[float, float],
    rng: np.random.Generator,
    names: tuple[str, str] = ("base", "top"),
    units: tuple[str, str] = ("m/s^2", "m/s^2"),
) -> TransferRecord:
    """Return a record of two channels with white noise of the standard deviations given."""
    noisy = [x + u * rng.standard_normal(len(x)) for x, u in zip(pair, noise, strict=True)]
    return TransferRecord(noisy[0], noisy[1][:, None], rate, names[0], units[0], (names[1],), (units[1],))


def chirp_case(name: str, noise: float, seconds: float = 1.0, ppm: float = 0.0, rate: float = 51_200.0) -> Case:
    """A chirp of 4 periods from 100 to 3000 Hz, recorded in steady state by a clock that is `ppm` off."""
    length = round(rate * seconds)
    period = length * (1.0 + 1e-6 * ppm)
    harmonic = np.arange(int(100.0 * seconds), int(3000.0 * seconds) + 1)
    count = len(harmonic)
    base = np.sqrt(2.0 / count) * np.exp(-1j * np.pi * (harmonic - harmonic[0]) ** 2 / count)
    top = base * response("transmissibility", harmonic * (rate / period))
    pair = tuple(harmonic_sum(harmonic, phasor, period, 4 * length) for phasor in (base, top))
    spread = noise * pair[0].std(), noise * pair[1].std()
    truth = top / base
    variance = 2.0 / (4 * length) * (spread[1] ** 2 + np.abs(truth) ** 2 * spread[0] ** 2) / np.abs(base) ** 2
    return Case(
        name,
        "transmissibility",
        lambda rng: recorded((pair[0], pair[1]), rate, spread, rng),
        lambda record: transfer_periodic(record, seconds),
        lambda record: peer_of(record, 4, length),
        bound_of("transmissibility", harmonic * rate / period, truth, variance),
    )


def harmonic_sum(harmonic: NDArray[np.int64], phasor: ComplexArray, period: float, samples: int) -> FloatArray:
    """Return Σ Re{X exp(2πjkn/P)} for n = 0, 1 … in blocks."""
    signal = np.zeros(samples)
    for start in range(0, samples, 1024):
        n = np.arange(start, min(samples, start + 1024))
        first = np.exp(2j * np.pi / period * start * harmonic) * phasor
        if start == 0 or len(n) < 1024:
            turns = np.exp(2j * np.pi / period * np.multiply.outer(n - start, harmonic))
        signal[n] = (turns @ first).real
    return signal


def bound_of(kind: ResonanceKind, frequency: NDArray[Any], truth: ComplexArray, variance: NDArray[Any]) -> FloatArray:
    """Return the Cramér-Rao bound of f0 and damping from lines inside the fitted band; gain and phase are unknown."""
    inside = (frequency >= FIT_HZ[0]) & (frequency <= FIT_HZ[1])
    covariance = variance[inside, None, None] * np.eye(2)
    fit = fit_resonance(MeasuredCurve(frequency[inside], truth[inside], covariance), kind)
    return np.array([fit.u("frequency_hz"), fit.u("damping_ratio")])


def noise_case(name: str, noise: float, resolution: float, seconds: float = 20.0, rate: float = 12_800.0) -> Case:
    """Stationary noise from 50 to 4000 Hz, a piece of a periodic record twice as long."""
    samples = round(seconds * rate)

    def make(rng: np.random.Generator) -> TransferRecord:
        frequency = np.fft.rfftfreq(2 * samples, 1.0 / rate)
        spectrum = rng.standard_normal(len(frequency)) + 1j * rng.standard_normal(len(frequency))
        spectrum *= np.sqrt(samples) * ((frequency > 50.0) & (frequency < 4000.0))
        driven = spectrum * response("transmissibility", frequency)
        base, top = (np.fft.irfft(part, 2 * samples)[:samples] for part in (spectrum, driven))
        return recorded((base, top), rate, (noise * base.std(), noise * top.std()), rng)

    return Case(
        name,
        "transmissibility",
        make,
        lambda record: transfer_random(record, resolution),
        lambda record: peer_of(record, 1, len(record.reference), nperseg=round(rate / resolution)),
    )


def blow_case(name: str, noise: float, hits: int, window_s: float, rate: float = 51_200.0) -> Case:
    """Blows of a hammer, one per second, of different height and width."""
    samples, before = round(rate), round(0.1 * rate)

    def make(rng: np.random.Generator) -> TransferRecord:
        through = response("accelerance", np.fft.rfftfreq(samples, 1.0 / rate))
        forces = []
        for _ in range(hits):
            width = 8e-5 * rng.uniform(0.9, 1.2)
            time = (np.arange(samples) - before) / rate
            forces.append(100.0 * rng.uniform(0.6, 1.2) * np.exp(-0.5 * (time / width - 3.5) ** 2))
        responses = [np.fft.irfft(np.fft.rfft(force) * through, samples) for force in forces]
        pair = np.concatenate(forces), np.concatenate(responses)
        spread = 100.0 * noise, noise * float(np.abs(pair[1]).max())
        return recorded(pair, rate, spread, rng, ("force", "top"), ("N", "m/s^2"))

    def peer(record: TransferRecord) -> Peer:
        # The windows begin where the blows are known to be, which pyFRF leaves to its user.
        length = round(window_s * rate)
        index = (np.arange(hits) * samples + before - 64)[:, None] + np.arange(length)
        cut = TransferRecord(
            record.reference[index].ravel(),
            record.responses[index, 0].reshape(-1, 1),
            rate,
            "force",
            "N",
            ("top",),
            ("",),
        )
        return peer_of(cut, hits, length, window=(f"force:{160 / length}", "exponential:0.01"))

    return Case(name, "accelerance", make, lambda record: transfer_impact(record, window_s), peer)


def peer_of(
    record: TransferRecord, blocks: int, length: int, nperseg: int | None = None, window: str | tuple[str, str] = "none"
) -> Peer:
    """Return pyFRF's H1 of a record cut into blocks, or of Hann segments of a length."""
    exc = record.reference[: blocks * length].reshape(blocks, length)
    resp = record.responses[: blocks * length, 0].reshape(blocks, length)
    rate = round(record.sample_rate_hz)
    size = nperseg or length
    chosen = "hann" if nperseg else window
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = importlib.import_module("pyFRF").FRF(
            rate, exc, resp, exc_type="f", resp_type="d", window=chosen, fft_len=size, nperseg=nperseg
        )
        ratio, coherence = np.ravel(made.get_H1()), np.ravel(made.get_coherence()).real
    averages = blocks if nperseg is None else 2.0 * length / nperseg
    decay = np.log(100.0) / (length - 1) * rate if isinstance(window, tuple) else 0.0
    return Peer(np.asarray(np.fft.rfftfreq(size, 1.0 / rate)), ratio, coherence, averages, decay)


def peer_results(kind: ResonanceKind, peer: Peer) -> FloatArray:
    """Return f0 and damping (3, 2) from pyFRF's ratio: equal weights, weights of its coherence, peak picking."""
    inside = (peer.frequency_hz >= FIT_HZ[0]) & (peer.frequency_hz <= FIT_HZ[1])
    frequency, ratio, coherence = peer.frequency_hz[inside], peer.ratio[inside], peer.coherence[inside]
    missing = np.clip(1.0 - coherence, 1e-15, 1.0)
    stated = np.abs(ratio) ** 2 * missing / (2.0 * peer.averages * np.clip(coherence, 1e-15, 1.0))
    found = []
    for variance in (np.full(len(ratio), np.mean(np.abs(ratio) ** 2)), stated):
        fit = fit_resonance(MeasuredCurve(frequency, ratio, variance[:, None, None] * np.eye(2)), kind)
        # The textbook correction for a window on the response alone.
        found.append([fit.frequency_hz, fit.damping_ratio - peer.decay_per_s / (2.0 * np.pi * fit.frequency_hz)])
    magnitude = np.abs(ratio)
    top = int(np.argmax(magnitude))
    half = magnitude[top] / np.sqrt(2.0)
    left = np.interp(half, *_rising(magnitude[: top + 1], frequency[: top + 1]))
    right = np.interp(half, *_rising(magnitude[top:][::-1], frequency[top:][::-1]))
    damping = 0.5 * (right - left) / frequency[top] - peer.decay_per_s / (2.0 * np.pi * frequency[top])
    return np.array([*found, [frequency[top], damping]])


def _rising(magnitude: FloatArray, frequency: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the last stretch over which a flank rises to the peak."""
    down = np.flatnonzero(np.diff(magnitude) <= 0.0)
    start = int(down[-1]) + 1 if len(down) else 0
    return magnitude[start:], frequency[start:]


@dataclass(frozen=True)
class Trial:
    """Errors and uncertainties of f0 and damping (2,), regions that hold on and off resonance (2,), pyFRF's (3, 2)."""

    error: FloatArray
    u: FloatArray
    held: FloatArray
    peer: FloatArray


def run(case: Case, seed: int) -> Trial:
    """Return what one record of a case gives."""
    from scipy.stats import f as fisher

    record = case.make(np.random.default_rng(seed))
    found = case.estimate(record)
    fit: Resonance = fit_resonance(MeasuredCurve.of(found, "top", FIT_HZ), case.kind)
    part = found.between(FIT_HZ).ratio
    error = part.value[:, 0] - response(case.kind, part.frequency_hz, found.added_decay_per_s)
    both = np.stack([error.real, error.imag], axis=1)
    lengths = np.einsum("ki,kij,kj->k", both, np.linalg.inv(part.covariance), both) / 2.0
    inside = lengths < fisher.ppf(0.95, 2, part.dof)
    near = np.abs(part.frequency_hz - F0_HZ) < 0.5 * F0_HZ / Q
    truth = np.array([F0_HZ, ZETA])
    peer = np.full((3, 2), np.nan)
    if HAS_PYFRF and case.peer is not None:
        peer = peer_results(case.kind, case.peer(record)) - truth
    return Trial(
        np.array([fit.frequency_hz, fit.damping_ratio]) - truth,
        np.array([fit.u("frequency_hz"), fit.u("damping_ratio")]),
        np.array([inside[near].mean(), inside[~near].mean()]),
        peer,
    )


def row(case: Case, trials: int) -> str:
    """Return the row of a case."""
    done = [run(case, seed) for seed in range(trials)]
    error, u, peer = (np.array([getattr(t, name) for t in done]) for name in ("error", "u", "peer"))
    held = 100.0 * np.mean([t.held for t in done], axis=0)
    covered = 100.0 * np.mean(np.abs(error) < 1.96 * u, axis=0)
    rms = np.sqrt(np.mean(error**2, axis=0))
    theirs = np.sqrt(np.mean(peer**2, axis=0)) / rms
    bound = "–" if case.bound is None else " / ".join(f"{value:.2f}" for value in rms / case.bound)
    beside = " | ".join("–" if np.isnan(pair).any() else f"{pair[0]:.3g} / {pair[1]:.3g}" for pair in theirs)
    return (
        f"| {case.name} | {1e6 * rms[0] / F0_HZ:.3g} | {100.0 * rms[1] / ZETA:.3g} | {bound} "
        f"| {covered[0]:.1f} / {covered[1]:.1f} | {held[0]:.1f} / {held[1]:.1f} | {beside} |"
    )


def main(trials: int = 200) -> None:
    """Print the table."""
    if not HAS_PYFRF:
        print("pyFRF is not installed (pip install pyFRF): its columns stay empty.\n")
    print(
        "| record | f0 rms, ppm | damping rms, % | over the bound | intervals hold, % | regions hold, "
        "on / off resonance, % "
        "| pyFRF, same fit, over ours | with its coherence | peak picking |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    cases: tuple[tuple[int, Callable[[], Case]], ...] = (
        (1, lambda: chirp_case("chirp, 4 × 1 s at 51.2 kHz, 60 dB", 1e-3)),
        (1, lambda: chirp_case("the same, 40 dB", 1e-2)),
        (1, lambda: chirp_case("the same, 20 dB", 1e-1)),
        (1, lambda: chirp_case("chirp, 4 × 0.25 s, 60 dB", 1e-3, 0.25)),
        (2, lambda: chirp_case("the same, clocks 17 ppm apart", 1e-3, 0.25, 17.0)),
        (2, lambda: noise_case("noise, 20 s, lines 1 Hz apart, 60 dB", 1e-3, 1.0)),
        (2, lambda: noise_case("the same, 20 dB", 1e-1, 1.0)),
        (2, lambda: noise_case("the same, lines 4 Hz apart", 1e-1, 4.0)),
        (2, lambda: noise_case("the same, lines 4 Hz apart, 60 dB", 1e-3, 4.0)),
        (2, lambda: blow_case("5 blows, 0.5 s each, 60 dB", 1e-3, 5, 0.5)),
        (2, lambda: blow_case("the same, windows of 50 ms", 1e-3, 5, 0.05)),
        (2, lambda: blow_case("one blow, 0.5 s, 60 dB", 1e-3, 1, 0.5)),
    )
    for share, build in cases:
        print(row(build(), max(1, trials // share)), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    main(parser.parse_args().trials)
