"""Records of less than one beat: what clocks, triggers and lines leave open, through the fit that was made.

Poses and edges are simulated directly; the trigger is fitted to its edges between samples of 39 us, so the drawn error
of its rate is that of the fit.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from contracts import slow
from instrument_factory import stereo_entry
from scipy.stats import binom

from fusion.estimation.coverage import polar
from fusion.estimation.measurement_model import Deviates
from fusion.estimation.uncertainty import Contribution, Uncertainty, real_stack
from fusion.phasors.phasor_notices import HARMONIC_WITHOUT_FUNDAMENTAL, PERIODIC_JITTER, SHORT_BEAT
from fusion.phasors.stereo_motion import StereoMotion
from fusion.phasors.stereo_phasors import StereoPhasors, pairs_phasors, stereo_phasors
from fusion.phasors.timing import TimeBase, combine_timing_errors, frame_sight
from photogram.motion import Deformation, RigidMotion
from shaker.lines.frequencies import LineFrequencies, find_lines
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineModel
from shaker.timebase.edges import Edges
from shaker.timebase.tie import tie_clocks
from shaker.timebase.trigger import TriggerFit, fit_trigger
from shakercal._common.arrays import FloatArray

LINE_HZ, CAMERA_HZ, DAQ_HZ = 106.25, 52.874, 25_600.0
BEAT_HZ = LINE_HZ - 2.0 * CAMERA_HZ
SIZE = np.array([3e-7, 1e-7, 2e-6, 2e-8, 1e-8, 5e-9])  # turned so little that axes at rest and moved are the same
NOISE = 2e-4 * SIZE[[2, 2, 2, 3, 3, 3]]
EXPOSURE_S = 4e-5
HARMONIC = 1e-3  # of the displacement, which a channel shows


def latched(instants: FloatArray, rate_hz: float) -> TriggerFit:
    """What a digital input makes of edges."""
    upper = np.ceil(instants * rate_hz) / rate_hz
    length_s = float(upper[-1]) + 0.1
    return fit_trigger(Edges(upper - 1.0 / rate_hz, upper, upper - 0.5 / rate_hz, "sampled", 0.0, length_s, 0.5))


def time_base(triggers: dict[tuple[str, str], TriggerFit]) -> TimeBase:
    names = dict.fromkeys(daq for daq, _ in triggers)
    first = next(iter(names))
    ties = {n: None if n == first else tie_clocks(triggers[first, "camera"], triggers[n, "camera"], 0) for n in names}
    records = tuple(SimpleNamespace(entry=SimpleNamespace(name=name, clock_uncertainty=0.0)) for name in names)
    return TimeBase(records, triggers, ties)


def known_lines(frequency_hz: float, u_hz: float) -> LineFrequencies:
    """A fundamental and its harmonic, known to `u_hz`."""
    order = np.array([1, 2])
    return LineFrequencies(frequency_hz * order, u_hz * order, np.full(2, LINE_HZ), order, ("", ""), ())


def seen_pair(base: TimeBase, poses: FloatArray) -> StereoMotion:
    """A pair that measured these poses (F, 6), the first one its reference."""
    pair = stereo_entry(exposure=EXPOSURE_S)
    pair.model_copy = lambda update: stereo_entry(**update)
    entry = SimpleNamespace(
        stereo="top", trigger="camera", first_edge=0, exposure=EXPOSURE_S, delay=0.0, delay_uncertainty=0.0
    )
    manifest = SimpleNamespace(rig=SimpleNamespace(stereo={"top": pair}), path=Path("recording.toml"))
    sight = frame_sight(manifest, base, entry, len(poses))
    frames = len(poses)
    nothing = np.zeros((frames, 1, 3))
    motion = RigidMotion(
        poses - poses[0], np.tile(np.eye(6), (frames, 1, 1)), np.zeros(frames), np.ones(frames), np.zeros(3)
    )
    beside = Deformation(nothing[0], nothing, np.zeros((frames, 1, 3, 3)))
    return StereoMotion(sight, motion, (beside,), 0.0, None, ())


def recorded(
    truth: np.ndarray, instants: FloatArray, rng: np.random.Generator, noise: FloatArray = NOISE
) -> FloatArray:
    """Poses (F, 6) of a motion with phasors (K, 6) at multiples of the line, exposed from these instants on."""
    omega = 2.0 * np.pi * LINE_HZ * np.arange(1, len(truth) + 1)
    middle = np.exp(1j * np.multiply.outer(instants + EXPOSURE_S / 2.0, omega)) * np.sinc(
        omega * EXPOSURE_S / 2 / np.pi
    )
    return (middle @ truth).real + noise * rng.normal(size=(len(instants), 6))


def drawn_pair(beats: float, rng: np.random.Generator, noise: float = 1.0) -> tuple[StereoPhasors, np.ndarray]:
    """A record of so many beats with an error of its trigger's fit and of its line, and the true phasors (2, 6)."""
    frames, u_hz = round(beats * CAMERA_HZ / BEAT_HZ), 2e-5
    instants = rng.uniform(0.05, 0.4) + np.arange(frames) / (CAMERA_HZ * (1.0 + 1e-6 * rng.normal()))
    truth = SIZE * np.exp(2j * np.pi * rng.uniform(size=6)) * np.array([[1.0], [HARMONIC]])
    base = time_base({("daq", "camera"): latched(instants, DAQ_HZ)})
    lines = known_lines(LINE_HZ + u_hz * rng.normal(), u_hz)
    measured = seen_pair(base, recorded(truth, instants, rng, noise * NOISE))
    return stereo_phasors(base, measured, lines, base.line_errors(lines, ()), np.array([1.0, 4.0 * HARMONIC])), truth


def covered(seen: StereoPhasors, truth: np.ndarray) -> list[tuple[bool, bool]]:
    """Whether magnitude and phase of the fundamental's six components lie within U, the noise's dof its own."""
    reading = seen.reading
    value, observation = reading.phasors.value, reading.observation()
    motion = value / observation.design[:, :, :].diagonal(axis1=1, axis2=2)
    usable = np.isfinite(value).all(axis=1)
    noise = Contribution("noise", "A", reading.phasors.covariance[usable], reading.phasors.dof[usable])
    effects = [error.effect(np.nan_to_num(motion))[usable] for error in observation.common]
    covariance = noise.covariance + sum(np.einsum("ki,kj->kij", real_stack(e), real_stack(e)) for e in effects)
    total = Uncertainty((noise, Contribution("clock", "B", covariance - noise.covariance)))
    held = []
    for c in range(6):
        pair = np.ix_([c, c + 6], [c, c + 6])
        found = polar(complex(value[0, c]), covariance[0][pair], float(total.dof()[0, c]))
        turned = float(np.angle(value[0, c] / truth[0, c]))
        off = found.magnitude - abs(truth[0, c])
        held.append((abs(off) <= found.expanded_magnitude, abs(turned) <= found.expanded_phase_rad))
    return held


def held_over(beats: float, trials: int, noise: float, seed: int) -> tuple[FloatArray, list[StereoPhasors]]:
    """Coverage (6, 2) of magnitude and phase over drawn records."""
    rng, seen, held = np.random.default_rng(seed), [], []
    for _ in range(trials):
        found, truth = drawn_pair(beats, rng, noise)
        seen.append(found)
        held.append(covered(found, truth))
    return np.mean(held, axis=0), seen


def test_errors_of_a_clock_act_through_the_fit():
    # Truth: the fit made again at times, and with lines, that are off by one standard uncertainty.
    rng, instants = np.random.default_rng(5), 0.2 + np.arange(48) / CAMERA_HZ
    base, lines = time_base({("daq", "camera"): latched(instants, DAQ_HZ)}), known_lines(LINE_HZ, 2e-5)
    dated = seen_pair(base, np.zeros((48, 6))).sight.time_s - EXPOSURE_S / 2.0  # no error but those below
    measured = seen_pair(base, recorded(SIZE * np.exp(1j * np.arange(6.0))[None], dated, rng, 0.0 * NOISE))
    unknowns = combine_timing_errors([*base.sight_errors(measured.sight), *base.line_errors(lines, ())])
    assert [unknown.name for unknown in unknowns] == ["camera: time", "camera: rate", "frequency of 106.25 Hz"]
    found = stereo_phasors(base, measured, lines, base.line_errors(lines, ()))
    time_s, pose, value = found.result.time_s, found.result.motion_from_mean.pose, found.reading.phasors.value[0]
    for unknown, error in zip(unknowns, found.reading.errors, strict=True):
        late_s, stretch = unknown.offset_s + unknown.rate * time_s, np.ravel(unknown.frequency_error)[0]
        again = fit_sines(time_s + late_s, pose, LINE_HZ * np.ones(1) * (1.0 + stretch), list("abcdef"), ["m"] * 6)
        change = again.phasors.value[0] / np.sinc(LINE_HZ * EXPOSURE_S) - value
        first = (error.effect[0] - 2.0 * stretch) * value + error.additive[
            0
        ]  # as an acceleration it errs by 2 u(f)/f more
        np.testing.assert_allclose(first, change, rtol=0.01, atol=0.01 * np.abs(change).max())
    # Less than a beat makes amplitude of a rate: many times what the noise does.
    assert abs(found.reading.errors[1].additive[0, 2]) > 2e-4 * SIZE[2]


ANY_LENGTH = [(0.38, 1.0, 100), (0.46, 0.3, 100), (0.61, 1.0, 100), (0.91, 0.3, 100), (1.5, 1.0, 50), (3.0, 1.0, 50)]


@pytest.mark.parametrize(
    ("beats", "noise", "trials"),
    [(0.46, 0.3, 12), (2.0, 0.3, 12), *slow(*ANY_LENGTH)],
)
def test_records_of_any_length_err_as_they_state(beats, noise, trials):
    share, seen = held_over(beats, trials, noise, 1)
    assert share.min() >= binom.ppf(1e-3 / 12, trials, 0.95) / trials
    if noise == 1.0:
        return
    reported = [any(notice.code == SHORT_BEAT.code for notice in pair.notices) for pair in seen]
    assert np.mean(reported) > 0.5 if beats < 1.0 else not any(reported)


def test_less_than_a_third_of_a_beat_is_left_out_with_its_harmonics():
    base = time_base({("daq", "camera"): latched(0.1 + np.arange(30) / CAMERA_HZ, DAQ_HZ)})
    rng = np.random.default_rng(1)
    measured = seen_pair(base, recorded(SIZE + np.zeros((1, 6)), 0.1 + np.arange(30) / CAMERA_HZ, rng))
    found, notices, unfitted = pairs_phasors(base, [measured], known_lines(LINE_HZ, 0.0), (), None)
    assert not found
    assert not unfitted
    pair = f"stereo pair {measured.sight.name}"
    assert any("0.5022 Hz" in notice.text for notice in notices if notice.where.startswith(pair))
    harmonics = [notice.where for notice in notices if notice.code == HARMONIC_WITHOUT_FUNDAMENTAL.code]
    assert harmonics == [f"{pair}, 212.5 Hz"]


def test_a_line_found_in_the_motion_is_on_the_clock_of_its_trigger():
    # The trigger's rate stretches line and frames alike: what is left of it in this pair is a turn.
    instants = 0.2 + np.arange(211) / CAMERA_HZ
    base, rng = time_base({("daq", "camera"): latched(instants, DAQ_HZ)}), np.random.default_rng(3)
    measured = seen_pair(base, recorded(SIZE + np.zeros((1, 6)), instants, rng))
    clock = base.sight_errors(measured.sight)
    found = base.add_clock_uncertainty(find_lines(measured.sight.time_s, measured.motion.pose, [LINE_HZ]), clock)
    (rate,) = (e for e in combine_timing_errors([*clock, *base.line_errors(found, clock)]) if e.name == "camera: rate")
    assert rate.rate + float(rate.frequency_error) == 0.0
    seen = stereo_phasors(base, measured, found, base.line_errors(found, clock))
    (error,) = (e for e in seen.reading.errors if e.name == "camera: rate")
    assert np.all(error.additive == 0.0)
    (own,) = (e for e in seen.reading.errors if e.name.startswith("frequency"))
    assert own.u < found.u_frequency_hz[0]


@pytest.mark.parametrize(
    ("periods", "trials"),
    [(0.6, 12), *slow((0.6, 80), (1.3, 60), (3.0, 30))],
)
def test_channels_on_a_tied_clock_err_as_they_state(periods, trials):
    # A channel of another DAQ: its time axis is the tie's, whose rate is uncertain; a slow line of few periods.
    rng, frequency, line, held, seconds = np.random.default_rng(4), 0.7, np.array([0.7]), [], periods / 0.7
    frames = max(int(seconds * CAMERA_HZ), 8)
    for _ in range(trials):
        begin, ppm = rng.uniform(0.0, 0.05), 2e-5 * rng.normal()
        instants = rng.uniform(0.1, 0.2) + np.arange(frames) / CAMERA_HZ
        ends = latched(instants, 500.0), latched((instants - begin) * (1.0 + ppm), 700.0)
        base = time_base({("daq", "camera"): ends[0], ("bridge", "camera"): ends[1]})
        truth = np.array([[np.exp(2j * np.pi * rng.uniform())]])
        own_s = 0.1 + np.arange(int(seconds * 200.0)) / 200.0
        true_s = own_s / (1.0 + ppm) + begin
        values = (np.exp(2j * np.pi * frequency * true_s)[:, None] * truth).real + 1e-5 * rng.normal(
            size=(len(own_s), 1)
        )
        fit = fit_sines(base.to_base_s("bridge", own_s), values, line, ["F"], ["V"], model=SineModel(robust=True))
        errors = [
            e.effect_on_fit(fit, np.ones(1, np.bool_), 0).relative_to(fit.phasors) for e in base.tie_errors("bridge")
        ]
        assert [e.name for e in errors] == ["clock bridge: time", "clock bridge: rate"]
        value, covariance = fit.phasors.value[0, 0], fit.phasors.covariance[0].copy()
        for error in errors:
            change = real_stack(error.effect[0] * value)
            covariance += np.multiply.outer(change, change)
        stated = polar(complex(value), covariance)
        off = abs(value) - 1.0, float(np.angle(value / truth[0, 0]))
        held.append((abs(off[0]) <= stated.expanded_magnitude, abs(off[1]) <= stated.expanded_phase_rad))
    assert np.mean(held, axis=0).min() >= binom.ppf(1e-3 / 2, trials, 0.95) / trials


def test_draws_of_a_short_record_spread_as_its_uncertainty_says():
    found, _ = drawn_pair(0.46, np.random.default_rng(7), 0.3)
    observed = found.reading.observation()
    usable = np.isfinite(observed.phasors.value).all(axis=1)
    motion = np.nan_to_num(observed.phasors.value / observed.design.diagonal(axis1=1, axis2=2))
    drawn = observed.draw(motion, Deviates(1, 0, 4000), "noise").readings[:, 0, 2]
    effects = [e.effect(motion)[0, 2] for e in observed.common]
    noise = observed.phasors.covariance[usable][0]
    dof = observed.phasors.dof[0]
    for part, place in ((drawn.real, 2), (drawn.imag, 8)):
        own = noise[place, place] * dof / (dof - 2.0)
        predicted = own + sum((e.real if place == 2 else e.imag) ** 2 for e in effects)
        assert np.var(part) == pytest.approx(predicted, rel=0.15)


def test_periodic_jitter_is_told_with_what_it_does() -> None:
    """x(t + a·cos 2ωt) of x = cos ωt is off by ωa/2 at the line; random jitter as large averages out."""
    rng, frames, late_s = np.random.default_rng(8), 211, 2e-5
    even = 0.2 + np.arange(frames) / CAMERA_HZ
    truth = SIZE * np.array([[1.0], [0.0]])
    reported = {}
    for name, jitter in (
        ("periodic", late_s * np.cos(4.0 * np.pi * LINE_HZ * even)),
        ("quartz", 3e-8 * rng.normal(size=frames)),
    ):
        base = time_base({("daq", "camera"): latched(even + jitter, DAQ_HZ)})
        seen = stereo_phasors(base, seen_pair(base, recorded(truth, even + jitter, rng)), known_lines(LINE_HZ, 1e-6))
        reported[name] = [notice for notice in seen.notices if notice.code == PERIODIC_JITTER.code]
        off = abs(seen.reading.phasors.value[0, 2] / truth[0, 2] - 1.0)
        if name == "periodic":
            predicted = reported[name][0].values["change_percent"] / 100.0
            assert off == pytest.approx(np.pi * LINE_HZ * late_s, rel=0.6)  # some of it is seen of the edges
            assert predicted == pytest.approx(np.pi * LINE_HZ * late_s, rel=0.3)
    assert not reported["quartz"]
