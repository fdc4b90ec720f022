"""Numbers of three publications: every row of docs/papers.md, and what its words claim of formulas and systems."""

from pathlib import Path

import numpy as np
import papers
import published_wrist as wrist_paper
import pytest
from contracts import refused
from published_formulas import (
    damping_from_phase,
    damping_from_sensitivity,
    damping_from_width,
    relative_sensitivity,
    rounding_range,
    sensitivity_phase_rad,
    series_limits_hz,
)
from scipy import signal

from shaker.identification.measured_curves import MeasuredCurve
from shaker.identification.oscillator import peak_readings
from shaker.lti.system import LinearSystem
from shaker.mechanics import required_stiffness
from shaker.release.load_model import LoadModel

PAGE = Path(__file__).resolve().parents[2] / "docs" / "papers.md"
M_I, M1, M2 = 0.769, 4.236, 8.798
K1, K2 = required_stiffness(1477.35, M1 + M_I), required_stiffness(1092.97, M2 + M_I)
B1, B2 = 699.18, 1566.01


def test_the_page_contains_the_computed_numbers():
    """Row by row, so that a change of any of them is seen."""
    text = PAGE.read_text(encoding="utf-8")
    for name, lines in papers.tables().items():
        begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        assert text.count(begin) == text.count(end) == 1
        assert text.split(begin)[1].split(end)[0].strip().splitlines() == lines, name


@pytest.mark.parametrize(("k", "b", "mass"), [(K1, B1, M1 + M_I), (K2, B2, M2 + M_I)])
def test_equation_10_on_a_curve(k, b, mass):
    """An oscillator with the printed k, b, m at the paper's lines: b comes back from the right width only."""
    frequency = 0.78125 * np.arange(1100.0, 2200.0)
    s = 2j * np.pi * frequency
    value = np.asarray((k + b * s) / (mass * s**2 + b * s + k), dtype=np.complex128)
    covariance = (1e-4 * np.abs(value).max()) ** 2 * np.eye(2) * np.ones((len(s), 1, 1))
    read = peak_readings(MeasuredCurve(frequency, value, covariance))
    for reading in (read.half_power, read.circle):
        assert damping_from_width(reading.width_hz, mass) == pytest.approx(b, rel=1e-3)
        assert required_stiffness(reading.frequency_hz, mass) == pytest.approx(k, rel=1e-6)
    assert damping_from_width(read.half_amplitude.width_hz, mass, "half_amplitude") == pytest.approx(b, rel=2e-3)
    assert damping_from_width(read.half_amplitude.width_hz, mass) == pytest.approx(np.sqrt(3.0) * b, rel=1e-3)


@pytest.mark.parametrize("form", ["exact", "series"])
def test_equations_1_and_2_are_a_first_order_lag(form):
    """Neither the drop to 95.3 % nor the −0.25 rad: these would need 31 times the damping."""
    at = np.array([800.0, 1000.0])
    response = signal.freqs([K1], [B1, K1], 2.0 * np.pi * at)[1]
    np.testing.assert_allclose(relative_sensitivity(at, K1, B1, form), np.abs(response), rtol=1e-8)
    np.testing.assert_allclose(sensitivity_phase_rad(at, K1, B1, form), np.angle(response), rtol=1e-4)
    assert 100.0 * relative_sensitivity(at, K2, B2, form)[1] == pytest.approx(99.976, abs=6e-4)
    assert sensitivity_phase_rad(at, K2, B2, form)[0] == pytest.approx(-0.0174, abs=6e-5)
    size, turn = relative_sensitivity(at, K1, 2e4, form)[0], sensitivity_phase_rad(at, K1, 2e4, form)[0]
    assert damping_from_sensitivity(size, 800.0, K1, form) == pytest.approx(2e4)
    assert damping_from_phase(turn, 800.0, K1, form) == pytest.approx(2e4)
    assert damping_from_sensitivity(0.953, 1000.0, K1) / B1 == pytest.approx(31.0, abs=0.3)


def test_series_deviates_where_stated():
    magnitude, phase = series_limits_hz(K1, 21800.0)
    exact, series = (relative_sensitivity(np.array([magnitude]), K1, 21800.0, form)[0] for form in ("exact", "series"))
    assert series / exact == pytest.approx(0.99, abs=1e-9)
    exact, series = (sensitivity_phase_rad(np.array([phase]), K1, 21800.0, form)[0] for form in ("exact", "series"))
    assert series / exact == pytest.approx(1.01, abs=1e-9)
    assert series_limits_hz(K1, 0.0) == (np.inf, np.inf)


def test_equation_19_in_the_order_of_the_augmented_data_vector():
    """θ = [b3 a3 b2 a2 b1 a1 b0] is equation 20."""
    theta = [0.0083, 0.5841, 0.0047, -0.2608, -0.0011, -1.3076, 0.0037]
    numerator, denominator = np.array(theta[::-2]), np.array([1.0, *theta[-2::-2]])
    system = LinearSystem.from_coefficients(numerator, denominator, wrist_paper.RATE_HZ)
    assert np.allclose(system.coefficients(), wrist_paper.difference_equation().coefficients(), atol=1e-12)


def test_equations_3_follow_from_equation_2_and_a_stiff_coupling_is_equation_5():
    """Poles and static gain of the model against the matrices of equation 2."""
    k, c, kl, cl, load = 2.36e6, 6.0, 1.89e6, 4.0, 0.048
    model = LoadModel("Fy", "Fy", "V", 0.24, k, c, kl, cl, sensitivity=3.0)
    inverse = np.diag([1.0 / load, 1.0 / 0.24])
    damping, stiffness = np.array([[cl, -cl], [-cl, cl + c]]), np.array([[kl, -kl], [-kl, kl + k]])
    state = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ stiffness, -inverse @ damping]])
    assert np.allclose(np.sort_complex(np.linalg.eigvals(state)), np.sort_complex(model.system(load).poles), rtol=1e-8)
    assert model.system(load).static_gain == pytest.approx(3.0)
    stiff, rigid = LoadModel("Fy", "Fy", "V", 0.24, k, c, 2.36e12, 0.0), LoadModel("Fy", "Fy", "V", 0.24, k, c)
    hertz = np.linspace(0.0, 900.0, 91)
    assert np.allclose(stiff.system(0.05).response(hertz), rigid.system(0.05).response(hertz), rtol=1e-3)


# What rounded coefficients may stand for.


def test_rounding_ranges_in_closed_form():
    """z² - 2c z + 1 with |c - 0.9| ≤ 0.05 has z = exp(±j·arccos c); a first order never oscillates."""
    pair = rounding_range(np.array([1, -1.8, 1.0]), np.array([0, 0.2, 0]), 2 * np.pi)
    assert pair.natural_hz == pytest.approx([np.arccos(0.95), np.arccos(0.85)], rel=1e-12)
    first = rounding_range(np.array([1, -0.9]), np.array([0, 0.1]), 1e5)
    assert np.all(np.isnan(first.natural_hz))
    assert first.radius == pytest.approx(0.95)


def test_wrong_arguments_are_refused():
    refused("^k: .*0", relative_sensitivity, np.ones(1), 0.0, 1.0)
    refused("^relative: ", damping_from_sensitivity, 1.2, 1000.0, K1)
    refused("^phase_rad: ", damping_from_phase, -2.0, 800.0, K1)
    for arguments, name in (((np.ones(3), np.ones(2), 1e5), "last_digit"), ((np.ones(1), np.ones(1), 1e5), "denom")):
        refused(name, rounding_range, *arguments)
