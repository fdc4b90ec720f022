"""Load models fitted to simulated records; the truth is integrated by scipy from the equations of motion."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from contracts import coverage_contract
from release_factory import two_masses
from scipy.signal import StateSpace, lsim

from shaker.release.load_fit import stated_masses
from shaker.release.load_model import other_numbers
from shaker.release.load_modes import FreeDecay, as_resonances, coloured, free_decay, projected, record_modes
from shaker.release.load_series import LoadIdentification, Output, identify_loads
from shaker.release.record import Reading, StepRecord

TRUE = np.array([2.36e6, 6.0, 1.89e6, 4.0])
MOVING, LOADS = 0.240, (0.0, 0.008, 0.048, 0.098, 0.198)
RATE, DURATION, ONSET, RELEASE = 25e3, 0.5, 0.02, 0.4e-3
LEVEL = 4.0


@cache
def clean(load: float, smooth: bool = False) -> np.ndarray:
    """Output in V while a force vanishes from the load: 4 V before, 0 V at the end."""
    k, c = TRUE[:2]
    a = two_masses(MOVING, load, TRUE) if load else np.array([[0.0, 1.0], [-k / MOVING, -c / MOVING]])
    b, row = np.zeros((len(a), 1)), np.eye(1, len(a))
    b[-1] = 1.0 / (load or MOVING)
    t = np.arange(round(RATE * DURATION)) / RATE
    done = np.clip((t - ONSET) / RELEASE, 0.0, 1.0)
    gone = 0.5 - 0.5 * np.cos(np.pi * done) if smooth else done
    change = lsim(StateSpace(a, b, row * k, np.zeros((1, 1))), gone, t)[1]
    return np.asarray(LEVEL * (1.0 - change))


def record(load: float, snr_db: float, rng: np.random.Generator, smooth: bool = False) -> StepRecord:
    """One record with noise and a 16-bit converter of ±10 V."""
    y = clean(load, smooth)
    y = y + LEVEL * 10.0 ** (-snr_db / 20.0) * rng.standard_normal(len(y))
    volts = np.round(y / (20.0 / 2**16)) * (20.0 / 2**16)
    return StepRecord(f"{1e3 * load:g} g", ("Fy",), "V", volts[None], RATE, "Fy", -10.0)


def reading() -> Reading:
    """What is known of the release, which is the same in all records."""
    return Reading(
        record="one",
        channel="Fy",
        component="Fy",
        unit="V",
        release="fishing line",
        onset_s=ONSET,
        u_onset_s=1e-4,
        sign=-1,
        baseline=LEVEL,
        u_baseline=1e-3,
        steady=0.0,
        u_steady=1e-3,
        rise_s=RELEASE,
        u_rise_s=1e-4,
        shape="ramp",
        release_s=RELEASE,
        u_release_s=1e-4,
        static_gain=-LEVEL / 10.0,
        u_static_gain=1e-4,
        noise=0.04,
        clipped=False,
    )


def identified(
    loads: tuple[float, ...], snr_db: float, seed: int, smooth: bool = False, stated: tuple[float, ...] | None = None
) -> LoadIdentification:
    """The whole way from records to the model; `stated`: masses that are taken for the true ones."""
    rng = np.random.default_rng(seed)
    decays, modes = [], []
    for load in loads:
        one = record(load, snr_db, rng, smooth)
        decays.append(free_decay(one, "Fy", reading()))
        modes.append(record_modes(decays[-1]))
    masses = stated_masses(MOVING, 0.0, np.array(stated or loads))
    noise = np.array([item.noise for item in modes])
    return identify_loads(as_resonances(modes), masses, Output("Fy", "Fy", "V"), tuple(decays), noise)


def test_five_loads_jointly() -> None:
    found = identified(LOADS, 40.0, 1)
    assert found.from_records
    assert found.model.solutions == 1
    error = np.abs(found.model.vector / TRUE - 1.0)
    assert np.all(error < [2e-5, 2e-3, 1e-4, 1e-2])


def test_the_shape_of_the_release_does_not_matter() -> None:
    error = np.abs(identified((0.048, 0.198), 40.0, 1, smooth=True).model.vector / TRUE - 1.0)
    assert np.all(error < [5e-5, 5e-3, 2e-4, 2e-2])


def test_records_that_contradict_the_model() -> None:
    loads = (0.0, 0.048, 0.098, 0.198)
    found = identified(loads, 40.0, 5, stated=(0.0, 0.048, 0.0990, 0.198))
    assert not found.from_records
    assert found.chosen[0].scatter[0] > 1e-4
    assert any("scatter about the model" in notice.text for notice in found.notices)
    covariance = found.model.covariance
    assert covariance is not None
    assert np.all(np.abs(found.model.vector - TRUE)[::2] < 4.0 * np.sqrt(np.diag(covariance))[::2])


def test_noisy_records() -> None:
    error = np.abs(identified(LOADS, 20.0, 2).model.vector / TRUE - 1.0)
    assert np.all(error < [2e-4, 2e-2, 1e-3, 1e-1])


@pytest.mark.parametrize("load", [0.048, 0.198])
def test_one_load(load: float) -> None:
    found = identified((load,), 40.0, 3)
    expected = [TRUE, other_numbers(TRUE, MOVING, load)]
    expected.sort(key=lambda numbers: -numbers[2])
    assert len(found.models) == 2
    for model, numbers in zip(found.models, expected, strict=True):
        np.testing.assert_allclose(model.vector, numbers, rtol=2e-2)
        np.testing.assert_allclose(model.vector[::2], numbers[::2], rtol=1e-4)


def test_a_bare_sensor_has_two_masses() -> None:
    found = identified((0.0,), 40.0, 4)
    assert found.model.is_rigid
    np.testing.assert_allclose(found.model.vector, TRUE[:2], rtol=2e-3)


def test_projection_leaves_nothing_of_its_own_modes() -> None:
    t = np.arange(400) / 8e3
    poles = np.array([-30.0 + 2j * np.pi * 400.0, -80.0 + 2j * np.pi * 900.0])
    amplitude = np.array([1.0 - 0.4j, 0.2 + 0.3j])
    decay = FreeDecay("sum", t, 0.7 + (np.exp(t[:, None] * poles) @ amplitude).real, 1)
    residual, slope = projected(decay, poles)
    assert np.max(np.abs(residual)) < 1e-12
    shifts = ((0, 1e-3), (1, 1e-3j), (2, 1e-3), (3, 1e-3j))
    for place, shift in shifts:
        moved = poles + np.where(np.arange(2) == place // 2, shift, 0.0)
        np.testing.assert_allclose(projected(decay, moved)[0] / 1e-3, slope[:, place], atol=2e-6)


def test_coloured_noise_is_weighed_by_its_spectrum() -> None:
    rng = np.random.default_rng(6)
    t = np.arange(4096)
    slope = np.stack([np.cos(0.1 * t), np.cos(2.0 * t)], axis=1)
    noise = np.convolve(rng.standard_normal(4100), np.full(5, 0.2), mode="valid")
    gain = np.abs([np.mean(np.exp(1j * w * np.arange(5))) for w in (0.1, 2.0)])
    expected = gain**2 * np.sum(slope**2, axis=0)
    np.testing.assert_allclose(np.diag(coloured(slope, noise)), expected, rtol=0.35)


def test_a_record_without_ringing_is_refused() -> None:
    t = np.arange(40) / RATE
    short = StepRecord("short", ("Fy",), "V", np.tile(t, (1, 1)), RATE, "Fy", 1.0)
    with pytest.raises(ValueError, match="samples of short after the release"):
        free_decay(short, "Fy", reading())


@pytest.mark.slow
def test_intervals_hold_the_truth() -> None:
    def estimate(trial: int) -> tuple[np.ndarray, np.ndarray]:
        model = identified((0.008, 0.048, 0.198), 40.0, 100 + trial).model
        assert model.covariance is not None
        return model.vector, model.covariance

    alone = [estimate(trial) for trial in range(16)]
    coverage_contract(lambda trial: alone[trial], TRUE, 16)
    coverage_contract(lambda trial: (alone[trial][0], 1.96 * np.sqrt(np.diag(alone[trial][1]))), TRUE, 16)
