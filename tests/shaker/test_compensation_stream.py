"""The streaming filter, its noise and its uncertainty, against one-shot filtering and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from shaker.compensation.effects import CompensationWithUncertainty, filtered_noise, gain_band, white_noise_gain
from shaker.compensation.filter import (
    Compensation,
    CompensationFilter,
    Schedule,
    Sections,
    Target,
    parameter_sections,
    sampled,
    single_mode,
)
from shaker.release.load_model import LoadModel

RATE = 50e3
THREE_MASSES = LoadModel("Fy", "Fy", "V", 0.240, 2.36e6, 6.0, 1.89e6, 4.0)
SCHEDULE = Schedule(THREE_MASSES, Target(1000.0, 0.5, low_pass_hz=6000.0), modes=2)


def _uncertain(calibrated: bool = False) -> Compensation:
    sensor = single_mode(500.0, 0.004, static_gain=2.0, u_frequency_hz=0.05, u_damping_ratio=1e-4)
    return Compensation(sensor, Target(1000.0, 0.5), calibrated)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 400), max_size=8), st.integers(1, 3), st.booleans())
def test_any_split_into_blocks_gives_the_same_bits(seed: int, cuts: list[int], channels: int, settled: bool) -> None:
    data = np.random.default_rng(seed).normal(size=(channels, 400)).cumsum(axis=1)
    sections, level = SCHEDULE.sections(0.098, RATE), None if settled else 0.25
    whole = CompensationFilter(sections, channels, level)(data)
    stream = CompensationFilter(sections, channels, level)
    parts = [stream(block) for block in np.split(data, sorted(cuts), axis=1)]
    assert np.array_equal(np.concatenate(parts, axis=1), whole)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 299), max_size=5, unique=True))
def test_switching_does_not_depend_on_the_blocks_either(seed: int, cuts: list[int]) -> None:
    data = np.random.default_rng(seed).normal(size=(2, 300)).cumsum(axis=1)
    found = []
    for places in ([], cuts):
        stream, parts = CompensationFilter(SCHEDULE.sections(0.0, RATE), 2), []
        for number, half in enumerate(np.split(data, [150], axis=1)):
            if number:
                stream.switch(SCHEDULE.sections(0.198, RATE))
            inside = [place - 150 * number for place in sorted(places) if 0 < place - 150 * number < 150]
            parts += [stream(block) for block in np.split(half, inside, axis=1)]
        found.append(np.concatenate(parts, axis=1))
    assert np.array_equal(found[0], found[1])


def test_one_channel_of_many_is_that_channel_alone() -> None:
    data = np.random.default_rng(5).normal(size=(3, 500))
    sections = SCHEDULE.sections(0.048, RATE)
    together = CompensationFilter(sections, 3)(data)
    for row, alone in zip(together, data, strict=True):
        assert np.array_equal(row, CompensationFilter(sections)(alone[None])[0])
        np.testing.assert_array_equal(row, signal.sosfilt(sections.sos, alone))


def test_it_starts_settled() -> None:
    sections = SCHEDULE.sections(0.048, RATE)
    for level in (None, 3.5):
        out = CompensationFilter(sections, 2, level)(np.full((2, 200), 3.5))
        np.testing.assert_allclose(out, 3.5, rtol=1e-9)


def test_a_switch_leaves_a_constant_alone() -> None:
    stream = CompensationFilter(SCHEDULE.sections(0.0, RATE), level=2.0)
    before = stream(np.full((1, 50), 2.0))
    stream.switch(SCHEDULE.sections(0.198, RATE))
    np.testing.assert_allclose(np.concatenate([before, stream(np.full((1, 500), 2.0))], axis=1), 2.0, rtol=1e-9)


def test_a_switch_does_not_jump_and_comes_to_the_filter_of_the_new_load() -> None:
    """A slow sine: no step is larger than those of the signal itself; the bare old state would jump by far more."""
    time = np.arange(6000) / RATE
    data = 1.0 + np.sin(2 * np.pi * 40.0 * time)[None]
    old, new = SCHEDULE.sections(0.0, RATE), SCHEDULE.sections(0.198, RATE)
    stream = CompensationFilter(old, level=1.0)
    first = stream(data[:, :3000])
    stream.switch(new)
    out = np.concatenate([first, stream(data[:, 3000:])], axis=1)[0]
    usual = np.max(np.abs(np.diff(out[100:2990])))
    assert np.max(np.abs(np.diff(out[2995:]))) < 1.2 * usual
    naive, state = signal.sosfilt(old.sos, data[0, :3000] - 1.0, zi=np.zeros((3, 2)))
    carried = signal.sosfilt(new.sos, data[0, 3000:] - 1.0, zi=state)[0]
    assert abs(carried[0] - naive[-1]) > 50 * usual
    always = CompensationFilter(new, level=1.0)(data)[0]
    np.testing.assert_allclose(out[3000 + 300 :], always[3300:], atol=1e-6)


def test_white_noise_gain_is_the_energy_of_the_impulse_response() -> None:
    for load in (0.0, 0.198):
        sections = SCHEDULE.sections(load, RATE)
        impulse = np.zeros(20_000)
        impulse[0] = 1.0
        energy = np.sum((sections.gain * signal.sosfilt(sections.sos, impulse)) ** 2)
        assert white_noise_gain(sections) == pytest.approx(np.sqrt(energy), rel=1e-9)


def test_noise_density_and_white_noise_agree() -> None:
    sections = sampled(_uncertain(), RATE)
    frequency = np.linspace(0.0, RATE / 2, 20_001)
    density = np.full(frequency.shape, 1.0 / np.sqrt(RATE / 2))
    assert filtered_noise(sections, frequency, density).std == pytest.approx(white_noise_gain(sections), rel=1e-6)


def test_band_of_the_gain_is_that_of_drawn_sensors() -> None:
    compensation = _uncertain()
    frequency = np.array([50.0, 300.0, 450.0, 700.0, 1000.0])
    rng = np.random.default_rng(7)
    f, zeta = 500.0 + 0.05 * rng.normal(size=(4000, 1)), 0.004 + 1e-4 * rng.normal(size=(4000, 1))
    drawn, known = (1 - (frequency / a) ** 2 + 2j * b * frequency / a for a, b in ((f, zeta), (500.0, 0.004)))
    ratio = np.log(known / drawn)
    band = gain_band(compensation, frequency)
    np.testing.assert_allclose(band.u_gain, ratio.real.std(axis=0), rtol=0.05)
    np.testing.assert_allclose(band.u_phase_rad, ratio.imag.std(axis=0), rtol=0.05)


@pytest.mark.parametrize(("method", "corner"), [("matched", None), ("tustin", None), ("matched", 5000.0)])
def test_parameter_sections_are_the_derivatives(method: str, corner: float | None) -> None:
    plain = _uncertain(calibrated=True)
    compensation = Compensation(plain.sensor, Target(1000.0, 0.5, None, corner), calibrated=True)
    frequency = np.array([100.0, 480.0, 900.0])
    slopes = compensation.sensitivities(frequency)
    base = sampled(compensation, 1e6, method).response(frequency)  # type: ignore[arg-type]
    for place, one in enumerate(parameter_sections(compensation, 1e6, method)):  # type: ignore[arg-type]
        np.testing.assert_allclose(one.response(frequency), base * slopes[:, place], rtol=2e-3, atol=1e-9)


def test_every_sample_lies_within_its_uncertainty_as_often_as_it_should() -> None:
    """Drawn sensors and noise: the deviation from the load through the target is as large as u says."""
    compensation, rng = _uncertain(calibrated=True), np.random.default_rng(11)
    time = np.arange(400) / RATE
    noise = 2e-3
    aim = compensation.compensated.step(time)
    errors = []
    for _ in range(400):
        f, zeta = 500.0 + 0.05 * rng.normal(), 0.004 + 1e-4 * rng.normal()
        seen = single_mode(f, zeta, static_gain=2.0).system.step(time) + noise * rng.normal(size=400)
        errors.append(CompensationFilter(sampled(compensation, RATE))(seen[None])[0] - aim)
    clean = compensation.sensor.system.step(time)
    told = CompensationWithUncertainty(compensation, RATE, noise=noise)(clean[None])
    errors_ = np.array(errors) - (told.value[0] - aim)
    scatter = np.sqrt(np.mean(errors_**2, axis=0))[50:]
    np.testing.assert_allclose(scatter, told.u[0, 50:], rtol=0.15)


def test_a_block_of_gaps_is_refused() -> None:
    stream = CompensationFilter(sampled(_uncertain(), RATE), 2)
    with pytest.raises(ValueError, match="block: expected finite samples"):
        stream(np.array([[1.0, np.nan], [0.0, 0.0]]))
    with pytest.raises(ValueError, match="block: expected an array of shape"):
        stream(np.zeros((3, 5)))
    assert stream(np.zeros((2, 0))).shape == (2, 0)
    with pytest.raises(ValueError, match="sections: expected 1, found 3"):
        stream.switch(SCHEDULE.sections(0.1, RATE))
    with pytest.raises(ValueError, match="sections: expected a rate"):
        stream.switch(sampled(_uncertain(), 2 * RATE))
    with pytest.raises(ValueError, match="sos: expected sections with a0 = 1"):
        Sections(np.ones((1, 6)) * 2.0, 1.0, RATE)
