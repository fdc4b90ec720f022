"""What the steps of a converter do to a fitted sine, against the closed form of its Bessel series."""

from __future__ import annotations

import numpy as np
import pytest

from shaker.sine.sine_fit import fit_sines, quantisation_error

ORDERS = np.arange(1, 200)


@pytest.mark.parametrize("noise", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("steps", [2.5, 10.0, 60.0])
def test_the_largest_change_is_that_of_the_bessel_series(steps: float, noise: float) -> None:
    """ΔA = Σ (-1)^m 2q/(πm)·J1(2πmA/q)·cos(2πm·offset/q)·exp(-2π²m²σ²/q²), the largest over offsets and a step of A."""
    from scipy.special import jv

    rng, step, time = np.random.default_rng(1), 0.3, np.arange(8000) / 2000.3
    moved, errors = [], []
    for size in steps + np.linspace(-0.5, 0.5, 17):
        series = (-1.0) ** ORDERS * 2.0 / (np.pi * ORDERS) * jv(1, 2.0 * np.pi * ORDERS * size)
        series *= np.exp(-2.0 * (np.pi * ORDERS * noise) ** 2)
        moved.append(max(abs(float(series @ np.cos(2.0 * np.pi * ORDERS * o))) for o in np.linspace(0.0, 1.0, 65)))
    for offset, phase in rng.uniform(size=(2, 2)):
        true = step * steps * np.exp(1j * phase)
        signal = (true * np.exp(2j * np.pi * 106.25 * time)).real + step * (offset + noise * rng.standard_normal(8000))
        read = step * np.rint(signal / step)
        fit = fit_sines(time, read[:, None], np.array([106.25]), ["a"], ["V"])
        (bound,) = quantisation_error(fit, 0, time, step)
        if max(moved) > 1e-3:  # of the noise, what rounding may explain counts as none
            assert 0.6 * max(moved) / steps < bound.real < (1.3 if noise == 0.0 else 4.0) * max(moved) / steps
        else:
            assert bound.real < 2e-3 / steps
        noise_u = float(fit.phasors.u_re[0, 0]) / abs(true)
        errors.append((fit.phasors.value[0, 0] / true - 1.0).real / (bound.real + 3.0 * noise_u))
    assert max(map(abs, errors)) < 1.0


@pytest.mark.parametrize("samples_per_period", [10.0, 20.0, 320.0 / 17.0])
def test_synchronous_samples_do_not_determine_the_phase(samples_per_period: float) -> None:
    """A step is taken anywhere between two samples, in every period alike."""
    rng, time = np.random.default_rng(2), np.arange(20_000) / samples_per_period
    for size, offset, phase in rng.uniform((2.0, 0.0, -3.0), (3.0, 1.0, 3.0), size=(3, 3)):
        read = np.rint(size * np.cos(2.0 * np.pi * time + phase) + offset)
        fit = fit_sines(time, read[:, None], np.array([1.0]), ["a"], ["V"])
        (bound,) = quantisation_error(fit, 0, time, 1.0)
        error = fit.phasors.value[0, 0] / (size * np.exp(1j * phase)) - 1.0
        assert abs(error.real) < 1.2 * bound.real
        assert abs(error.imag) < 1.2 * bound.imag + 1e-4
