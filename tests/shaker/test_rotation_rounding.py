"""Rounding of readings: last digits, and errors that equal values share, against drawn sines."""

import numpy as np
import pytest

from shaker.static_rotation.harmonics import fit_angles
from shaker.static_rotation.rounding import last_digit

ANGLE = np.arange(17) * np.pi / 8.0
THERE_AND_BACK = np.concatenate([ANGLE, ANGLE[::-1]])


@pytest.mark.parametrize(
    ("column", "digit"),
    [
        ([0.1, 0.25, -0.3], 0.05),
        ([12.0, 14.0, 7.0], 1.0),
        ([0.0, 0.0], 0.0),
        (4.8828125e-3 * np.array([-7.0, 0.0, 3.0, 4.0, 9.0]), 4.8828125e-3),  # a converter of 12 bits
        ([np.pi, np.e, 1.0 / 3.0, np.sqrt(2.0)], 0.0),
        ([1e-320, 1.0, 2.5e-321, 3.0], 1.0),
    ],
)
def test_last_digits(column, digit):
    assert last_digit(np.array(column, np.float64)) == pytest.approx(digit, rel=1e-6)


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0], ids=["quiet", "a tenth of a digit", "a digit"])
def test_rounding_and_noise_make_the_scatter_of_amplitudes(noise):
    """Sines of 5 to 50 digits with any offset and phase of a few milliradians, read there and back."""
    rng, square, stated = np.random.default_rng(1), [], []
    for _ in range(150):
        amplitude, offset, phase = rng.uniform(5.0, 50.0), rng.uniform(0.0, 1.0), 0.01 * rng.standard_normal()
        values = amplitude * np.sin(THERE_AND_BACK + phase) + offset + noise * rng.standard_normal(34)
        fit = fit_angles(("F",), THERE_AND_BACK, np.round(values)[:, None], np.ones(1))
        square.append((-fit.amplitude()[0].imag - amplitude * np.cos(phase)) ** 2)
        effect = fit.rounding_effect()[1]
        stated.append(fit.covariance()[1, 1] + effect @ effect)
    assert np.sqrt(np.mean(stated) / np.mean(square)) == pytest.approx(1.15, abs=0.25)
