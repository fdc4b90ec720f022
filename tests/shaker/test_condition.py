"""The condition of samples: lost stretches, clipping and converter steps found where they are, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from contracts import slow

from shaker.io.condition import converter_step, examine_samples
from shakercal._common.arrays import FloatArray

RATE_HZ, LINE_HZ, SIZE = 2000.0, 106.25, 50.0


def _sine(rate_hz: float = RATE_HZ, noise: float = 1e-3, samples: int = 20_000) -> FloatArray:
    rng, time = np.random.default_rng(1), np.arange(samples) / rate_hz
    return np.asarray(SIZE * np.cos(2.0 * np.pi * LINE_HZ * time + 0.4) + noise * rng.standard_normal(samples))


def _read(samples: FloatArray, step: float, offset: float = 0.0) -> FloatArray:
    return np.asarray(step * np.rint((samples - offset) / step) + offset) if step else samples


def _kinds(samples: FloatArray, rate_hz: float = RATE_HZ, size: float | None = SIZE) -> dict[str, tuple[float, ...]]:
    return {d.kind: d.levels for d in examine_samples(samples, rate_hz, size, LINE_HZ if size else None)}


@pytest.mark.parametrize("step", [0.0, 0.01, 1.0, *slow(1e-4, 0.1)])
@pytest.mark.parametrize("rate_hz", [300.0, 500.0, 2000.0, 637.5, 850.0, 1062.5, 2125.0, 4250.0, 106_250.0])
def test_sound_sines_are_sound_however_they_are_sampled(rate_hz: float, step: float) -> None:
    """Rates that are small multiples of the line sample its crest at few phases, whose values are equal by nature."""
    for offset in (0.0, 0.25, 0.5):
        assert not _kinds(_read(_sine(rate_hz), step, offset * step), rate_hz)
        assert not _kinds(_read(_sine(rate_hz), step, offset * step), rate_hz, None)


@pytest.mark.parametrize("step", [0.0, 1e-3, 0.1])
@pytest.mark.parametrize(
    ("low", "high", "later"),
    [
        (-40.0, 40.0, 0.0),
        (-60.0, 40.0, 0.0),
        (-40.0, 60.0, 0.0),
        (-49.0, 49.0, 0.0),
        (-15.0, 15.0, 0.0),
        (-60.0, -15.0, 0.0),
        (-40.0, 40.0, 0.05),
        (-40.0, 40.0, 0.5),
    ],
)
def test_clipping_is_found_at_its_limits(low: float, high: float, later: float, step: float) -> None:
    noise = later * np.random.default_rng(2).standard_normal(20_000)
    found = _kinds(_read(np.clip(_sine(), low, high) + noise, step))
    assert list(found) == ["clipped"]
    for level, limit in zip(found["clipped"], (low, high), strict=True):
        assert not np.isfinite(level) if abs(limit) > SIZE else abs(level - limit) <= step + 6.0 * later


@pytest.mark.parametrize(("step", "steps"), [(1.7, 50 / 1.7), (5.0, 10.0), (20.0, 2.5), (40.0, 1.25)])
def test_few_steps_are_counted(step: float, steps: float) -> None:
    (found,) = examine_samples(_read(_sine(), step), RATE_HZ, SIZE, LINE_HZ)
    assert (found.kind, found.step, found.steps) == ("steps", pytest.approx(step), pytest.approx(steps))
    text = found.text(np.arange(20_000) / RATE_HZ, "V")
    assert f"{steps:.2g} " in text
    assert f"{step:g} V" in text


def test_converter_steps_are_visible_in_scaled_noise_and_absent_otherwise() -> None:
    assert converter_step(_sine()) == 0.0
    noisy = _read(_sine(noise=0.5), 1.0)
    assert converter_step((noisy * 0.0137).astype(np.float32).astype(np.float64)) == pytest.approx(0.0137, rel=1e-4)
    lost = _read(_sine(), 0.1)
    lost[100:140:7] = 9.9e37  # what some programs write for samples that they have lost
    assert converter_step(lost) == pytest.approx(0.1, rel=1e-6)


@pytest.mark.parametrize("value", [0.0, None, 80.0, np.nan])
@pytest.mark.parametrize("spans", [[(4.0, 5.0)], [(0.0, 0.5)], [(9.5, 10.0)], [(k + 0.3, k + 0.35) for k in range(9)]])
@pytest.mark.parametrize("step", [0.0, 1.0])
def test_stretches_without_signal_are_found(spans: list[tuple[float, float]], value: float | None, step: float) -> None:
    samples, at = _read(_sine(), step), [(round(a * RATE_HZ), round(b * RATE_HZ)) for a, b in spans]
    for a, b in at:
        samples[a:b] = samples[a] if value is None else value
    (found,) = examine_samples(samples, RATE_HZ, SIZE, LINE_HZ)
    assert found.kind == "lost"
    assert np.max(np.abs(found.spans - at)) <= 1  # a sample more may be equal by chance
    assert found.count == np.count_nonzero(found.mask(len(samples)))


def _release(noise: float, step: float) -> FloatArray:
    time = np.arange(20_000) / 1e4 - 0.7
    ringing = -40.0 * np.exp(-3.0 * np.maximum(time, 0.0)) * np.cos(2.0 * np.pi * 80.0 * time)
    return _read(np.where(time < 0.0, 100.0, ringing) + noise * np.random.default_rng(3).standard_normal(20_000), step)


def _blows(noise: float, step: float) -> FloatArray:
    time = (np.arange(50_000) / 1e4) % 1.0 - 0.5
    force = np.where((time > 0.0) & (time < 4e-3), 500.0 * np.sin(np.pi * time / 4e-3), 0.0)
    return _read(force + noise * np.random.default_rng(4).standard_normal(50_000), step)


@pytest.mark.parametrize(("noise", "step"), [(1e-6, 0.0), (0.01, 0.0), (0.01, 0.01), (0.01, 1.0), (0.3, 1.0)])
def test_signals_that_rest_are_clipped_only_if_their_peaks_are(noise: float, step: float) -> None:
    release, blows = _release(noise, step), _blows(noise, step)
    assert not _kinds(release, 1e4, None)
    assert not _kinds(np.tile(release, 4), 1e4, None)
    assert not _kinds(blows, 1e4, None)
    assert _kinds(np.minimum(blows, 400.0), 1e4, None) == {"clipped": (-np.inf, 400.0)}
    if step < 1.0:
        low, high = _kinds(np.maximum(release, -20.0), 1e4, None)["clipped"]
        assert (low, high) == (pytest.approx(-20.0, abs=0.01), np.inf)


def test_several_lines_and_noise() -> None:
    rng, time = np.random.default_rng(5), np.arange(40_000) / 5000.0
    lines = sum(10.0 * np.cos(2.0 * np.pi * f * time + f) for f in (40.0, 73.0, 110.0, 151.0, 230.0))
    beat = 10.0 * np.cos(2.0 * np.pi * 100.0 * time) + 10.0 * np.cos(2.0 * np.pi * 101.0 * time)
    noise = rng.standard_normal(40_000)
    for samples in (lines, noise, beat):
        for step in (0.0, 0.003):
            read = _read(np.asarray(samples), step)
            assert not examine_samples(read, 5000.0, 10.0, 100.0)
            limit = 0.6 * float(read.max())
            (clipped,) = examine_samples(np.clip(read, -np.inf, limit), 5000.0, 10.0, 100.0)
            assert (clipped.kind, clipped.levels[1]) == ("clipped", pytest.approx(limit, abs=step))
    # Between two steps of a converter a beat rests at its nodes, which is no loss of signal.
    assert [d.kind for d in examine_samples(_read(beat, 4.0), 5000.0, 10.0, 100.0)] == ["steps"]
