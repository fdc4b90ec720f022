"""Frames that tell the motion unlike each other: in another light, half hidden, or by points alone."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fusion.phasors.image_effects import fit_about_mean
from fusion.phasors.phasor_notices import UNEQUAL_FRAMES
from photogram.motion import RigidMotion

FREQUENCY_HZ, RATE_HZ, FRAMES = np.array([106.25]), 83.1, 60
SIZE = np.array([3e-7, 1e-7, 2e-6, 2e-8, 1e-8, 5e-9])
NOISE = np.array([2e-9, 2e-9, 1e-9, 2e-8, 2e-8, 1e-8])
DIM = np.where(np.arange(FRAMES) % 2, 4.0, 1.0)  # the noise of every other frame


def seen(rng, noise, stated):
    """A pair whose frames have so many times the noise, and state so many times of it; its phasors."""
    time_s = 0.3 + np.arange(FRAMES) / RATE_HZ
    truth = SIZE * np.exp(2j * np.pi * rng.uniform(size=6))
    pose = (np.exp(2j * np.pi * FREQUENCY_HZ * time_s[:, None]) * truth).real
    pose += noise[:, None] * NOISE * rng.normal(size=pose.shape)
    covariance = stated[:, None, None] ** 2 * np.diag(NOISE**2)
    motion = RigidMotion(pose, covariance, np.zeros(FRAMES), np.ones(FRAMES), np.zeros(3))
    return SimpleNamespace(sight=SimpleNamespace(name="top", time_s=time_s), motion=motion, view=None), truth


def errors(noise, stated, trials=24):
    """Errors and standard uncertainties (trials, 12) of both parts over NOISE, and all notices."""
    rng, found, notices = np.random.default_rng(11), [], []
    for _ in range(trials):
        measured, truth = seen(rng, noise, stated)
        _, _, fit = fit_about_mean(measured, FREQUENCY_HZ)
        off = (fit.phasors.value[0] - truth) / NOISE
        u = np.concatenate([fit.phasors.u_re[0], fit.phasors.u_im[0]]) / np.tile(NOISE, 2)
        found.append((np.concatenate([off.real, off.imag]), u))
        notices += [notice for notice in fit.notices if notice.code == UNEQUAL_FRAMES.code]
    off, u = np.swapaxes(np.array(found), 0, 1)
    return off, u, notices


def test_each_frame_counts_by_its_own_noise():
    # Gauss and Markov: the best linear estimate of a part has the variance 2/Σ(1/σ²).
    off, u, notices = errors(DIM, DIM)
    best = np.sqrt(2.0 / np.sum(DIM**-2.0))
    rms = np.sqrt(np.mean(off**2))
    assert rms == pytest.approx(best, rel=0.13)  # 288 numbers: three standard deviations are 13 %
    assert np.sqrt(np.mean(u**2)) == pytest.approx(rms, rel=0.13)
    assert len(notices) == 24
    assert notices[0].values["factor"] == pytest.approx(16.0)
    equal, _, silent = errors(DIM, np.ones(FRAMES), trials=12)
    assert np.sqrt(np.mean(equal**2)) > 1.8 * rms  # what equal weights make: √((1 + 16)/2 · (1 + 1/16)/2) = 2.1
    assert not silent


def test_pixels_do_not_count_where_the_motion_is_noisy_for_other_reasons():
    off, _, notices = errors(5.0 * np.ones(FRAMES), DIM, trials=16)
    assert len(notices) < 3
    assert np.sqrt(np.mean(off**2)) == pytest.approx(5.0 * np.sqrt(2.0 / FRAMES), rel=0.16)


def test_frames_that_are_nearly_alike_count_alike():
    fits = []
    for stated in (np.ones(FRAMES), np.linspace(0.9, 1.2, FRAMES)):
        measured, _ = seen(np.random.default_rng(3), np.ones(FRAMES), stated)
        fits.append(fit_about_mean(measured, FREQUENCY_HZ)[2])
    np.testing.assert_array_equal(fits[0].phasors.value, fits[1].phasors.value)


def test_a_frame_without_a_motion_has_no_weight():
    measured, _ = seen(np.random.default_rng(4), DIM, DIM)
    measured.motion.pose[7], measured.motion.covariance[7] = np.nan, np.nan
    _, _, fit = fit_about_mean(measured, FREQUENCY_HZ)
    assert np.isfinite(fit.phasors.value).all()
    assert UNEQUAL_FRAMES.code in {notice.code for notice in fit.notices}
