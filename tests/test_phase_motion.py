"""The benchmark of phase-based methods: its images, its bound and its filters against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from event_motion import amplitude_by_events, first_event_px, frames_bound_px
from phase_motion import light_gradient, phase_gabor, phase_monogenic
from poor_surfaces import RADIUS, SURFACES, Surface, X, bound_px
from scipy.integrate import dblquad

WAVE = np.array([[0.7, 0.3]])


def test_images_are_integrals_over_the_pixels():
    """A wave blurred by the lens, by quadrature over the pixel."""
    surface, moved = Surface(WAVE, np.array([0.2 - 0.1j])), np.array([0.3, -0.2])
    image, row, column = surface.image(moved), 40, 31
    blur = np.exp(-0.5 * float(np.sum(WAVE**2)) * 0.9**2)

    def value(y: float, x: float) -> float:
        phase = WAVE[0] @ (np.array([X[column] + x, X[row] + y]) - moved)
        return 0.5 + float(((0.2 - 0.1j) * np.exp(1j * phase)).real) * blur

    assert image[row, column] == pytest.approx(dblquad(value, -0.5, 0.5, -0.5, 0.5)[0], abs=1e-9)


def test_bound_of_a_wave_is_its_closed_form():
    """σ/(k·a)·√(2/P) along a wave of whole periods, which offset and gain do not touch; none across it."""
    points = np.arange(-RADIUS, RADIUS + 1)
    x = np.tile(points, len(points)).astype(float)
    wave, amplitude, noise = 2 * np.pi * 3 / len(points), 0.1, 0.004
    slopes = np.column_stack([-wave * amplitude * np.sin(wave * x), np.zeros_like(x)])
    bound, axes = bound_px(slopes, amplitude * np.cos(wave * x), np.full(len(x), noise**2))
    assert bound[0] == pytest.approx(noise / (wave * amplitude) * np.sqrt(2 / len(x)))
    assert bound[1] > 1e5
    np.testing.assert_allclose(np.abs(axes[0]), [1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("estimate", [light_gradient, phase_gabor, phase_monogenic])
def test_every_estimator_finds_the_motion_of_exact_images(estimate):
    surface = SURFACES["speckle of 5 px"](np.random.default_rng(3))
    moved = np.array([[0.0, 0.0], [0.1, -0.06], [-0.08, 0.02]])
    found = estimate(np.array([surface.image(one) for one in moved]))
    np.testing.assert_allclose(found - found[0], moved, atol=1.5e-3)


def test_events_of_equal_pixels_are_those_of_their_thresholds(monkeypatch):
    """Without noise ⌊2·A·s/C⌋ events per half period give the amplitude exactly; below the first there are none."""
    for name in ("MISMATCH", "EVENT_NOISE", "JITTER_S"):
        monkeypatch.setattr(f"event_motion.{name}", 0.0)
    slopes, rng = np.full(10, 0.2), np.random.default_rng(0)
    first = float(first_event_px(0.2))
    assert amplitude_by_events(slopes, 0.99 * first, rng)[1] == 0
    amplitude, events = amplitude_by_events(slopes, 3.5 * first, rng)
    assert amplitude == pytest.approx(3.5 * first)
    assert events == 10 * 16 * 3
    assert frames_bound_px(slopes, 0.5) == pytest.approx(np.sqrt(5064) / 5000 * np.sqrt(2 / 100) / 0.2 / np.sqrt(10))
