"""Every checkable number of Nitsche, Kumme and Tutsch (J. Sens. Sens. Syst. 7, 2018) from the program's functions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import papers
import papers_rows
import pytest
from numpy.typing import NDArray
from published_formulas import (
    damping_from_phase,
    damping_from_sensitivity,
    damping_from_width,
    relative_sensitivity,
    sensitivity_phase_rad,
    width_from_damping,
)

from shaker.identification.measured import MeasuredCurve
from shaker.identification.readings import peak_readings
from shaker.identification.sensor import Chain
from shaker.mechanics import required_stiffness, shared_spring
from shaker.sine.phasor import derivative_factor
from shaker.static_rotation.harmonics import fit_angles
from shaker.static_rotation.masses import mass_of_weight

FloatArray = NDArray[np.float64]
PAGE = Path(__file__).resolve().parents[2] / "docs" / "papers.md"
M_I, G = 0.769, 9.8125  # m/s², Braunschweig: not printed
M1, M2 = 4.236, 8.798


class Number(NamedTuple):
    """A number, how the program computes it, what it must be, and within what."""

    name: str
    computed: Callable[[], float]
    expected: float
    within: float


def acceleration(frequency_hz: float, amplitude_m: float) -> float:
    """Eq. 6, amplitude of the second derivative."""
    return float(derivative_factor(np.array([frequency_hz]), 2)[0].real * amplitude_m)


def weight(column: int, loaded: bool) -> float:
    """Amplitude of Fx or Fy that a sine leaves in readings every 22.5 degrees, offsets included."""
    angle = np.deg2rad(22.5 * np.arange(16))
    x, y = (75.877, 75.736) if loaded else (7.558, 7.532)
    readings = np.stack([x * np.sin(angle + 0.02) + 0.31, y * np.cos(angle + 0.02) - 0.12], axis=1)
    return float(np.abs(fit_angles(("Fx", "Fy"), angle, readings).amplitude())[column])


def load_mass(column: int, gravity: float = G) -> float:
    """Eq. 7 for the load: difference of the amplitudes."""
    return mass_of_weight(weight(column, True) - weight(column, False), gravity)


def spring(frequency_hz: float, load: float) -> float:
    """Eq. 9 with the internal mass, in 1e8 N/m."""
    return required_stiffness(frequency_hz, load + M_I) / 1e8


def spread(one: float, other: float) -> float:
    """Difference in per cent of the larger."""
    return 100.0 * (1.0 - min(one, other) / max(one, other))


def width(damping: float, load: float) -> float:
    """The Δf of eq. 10 that a damping coefficient stands for."""
    return width_from_damping(damping, load + M_I)


def shared(first: float, second: float) -> tuple[float, float]:
    """One spring (1e8 N/m) and one internal mass for both loads."""
    k, mass = shared_spring(np.array([first, second]), np.array([M1, M2]))
    return k / 1e8, mass


K1, K2 = required_stiffness(1477.35, M1 + M_I), required_stiffness(1092.97, M2 + M_I)

PRINTED = [
    Number("eq 6, a1, m/s²", lambda: acceleration(106.2495, 0.4277e-3), -190.6131, 5e-5),
    Number("eq 6, a1 to vibrometer, %", lambda: 100 * (-acceleration(106.2495, 0.4277e-3) / 189.3217 - 1), 0.68, 5e-3),
    Number("eq 6, a2, m/s²", lambda: acceleration(424.9472, -0.0040e-3), 28.5161, 5e-5),
    Number("eq 7, m1 x, kg", lambda: mass_of_weight(weight(0, False), G), 0.770, 5e-4),
    Number("eq 7, m1 y, kg", lambda: mass_of_weight(weight(1, False), G), 0.768, 5e-4),
    Number("m1, x to y, %", lambda: spread(weight(0, False), weight(1, False)), 0.3, 0.05),
    Number("eq 7, mL x, kg", lambda: load_mass(0), 6.962, 5e-4),
    Number("eq 7, mL y, kg", lambda: load_mass(1), 6.951, 5e-4),
    Number("mL x to weighed, %", lambda: 100 * (load_mass(0) / 6.9605 - 1), 0.028, 5e-4),
    Number("eq 9, k of Fz, load 1", lambda: spring(1477.35, M1), 4.313, 6e-4),
    Number("eq 9, k of Fz, load 2", lambda: spring(1092.97, M2), 4.512, 5e-4),
    Number("k of Fz by load, %", lambda: spread(K1, K2), 4.4, 0.05),
    Number("Table 2, k 1x, load 1", lambda: spring(1864.8, M1), 6.872, 1e-3),  # 6.8711: printed from finer numbers
    Number("Table 2, k 1y, load 1", lambda: spring(1865.6, M1), 6.878, 1e-3),
    Number("Table 2, k 2x, load 1", lambda: spring(315.6, M1), 0.197, 5e-4),
    Number("Table 2, k 2y, load 1", lambda: spring(316.4, M1), 0.198, 5e-4),
    Number("Table 2, k 1x, load 2", lambda: spring(1359.4, M2), 6.980, 5e-4),
    Number("Table 2, k 1y, load 2", lambda: spring(1357.8, M2), 6.963, 5e-4),
    Number("Table 2, k 2x, load 2", lambda: spring(210.9, M2), 0.168, 5e-4),
    Number("Table 2, k 2y, load 2", lambda: spring(210.9, M2), 0.168, 5e-4),
    Number("k x to y, peak 1, load 2, below 0.5 %", lambda: spread(spring(1359.4, M2), spring(1357.8, M2)), 0.25, 0.25),
    Number("k x to y, peak 1, load 1, below 0.5 %", lambda: spread(spring(1864.8, M1), spring(1865.6, M1)), 0.25, 0.25),
    Number("k by load, peak 2 y, up to 15 %", lambda: spread(spring(316.4, M1), spring(210.9, M2)), 15.0, 0.5),
]
"""What the inputs give to the last printed digit."""

OTHERWISE = [
    Number("mL y to weighed, %, printed -0.139", lambda: 100 * (load_mass(1) / 6.9605 - 1), -0.1404, 1e-4),
    Number("mL x at 9.81 m/s², printed 6.962", lambda: load_mass(0, 9.81), 6.9642, 1e-4),
    Number("k x to y, peak 2, printed < 0.5 %", lambda: spread(spring(315.6, M1), spring(316.4, M1)), 0.505, 5e-3),
    Number("one k of Fz for both loads", lambda: shared(1477.35, 1092.97)[0], 4.753, 5e-4),
    Number("one m_i of Fz for both loads, kg", lambda: shared(1477.35, 1092.97)[1], 1.280, 5e-4),
    Number("one m_i of x, peak 1, kg", lambda: shared(1864.8, 1359.4)[1], 0.938, 5e-4),
    Number("one m_i of y, peak 1, kg", lambda: shared(1865.6, 1357.8)[1], 0.902, 5e-4),
    Number("one k of x, peak 1", lambda: shared(1864.8, 1359.4)[0], 7.10, 5e-3),
    Number("one k of y, peak 1", lambda: shared(1865.6, 1357.8)[0], 7.06, 5e-3),
    Number("one m_i of x, peak 2, kg: no single mass", lambda: shared(315.6, 210.9)[1], -0.56, 6e-3),
    Number("eq 10, width of b, Fz, load 1, Hz", lambda: width(699.18, M1), 22.23, 6e-3),
    Number("eq 10, width of b, Fz, load 2, Hz", lambda: width(1566.01, M2), 26.05, 6e-3),
    Number("Q of Fz, load 1", lambda: 1477.35 / width(699.18, M1), 66.45, 6e-3),
    Number("Q of Fz, load 2", lambda: 1092.97 / width(1566.01, M2), 41.95, 6e-3),
    Number("eq 10, width, 1x, load 1, Hz", lambda: width(144.5, M1), 4.60, 6e-3),
    Number("eq 10, width, 1y, load 1, Hz", lambda: width(75.5, M1), 2.40, 6e-3),
    Number("eq 10, width, 2x, load 1, Hz", lambda: width(58.58, M1), 1.86, 6e-3),
    Number("eq 10, width, 2y, load 1, Hz", lambda: width(57.61, M1), 1.83, 6e-3),
    Number("eq 10, width, 1x, load 2, Hz", lambda: width(390.16, M2), 6.49, 6e-3),
    Number("eq 10, width, 1y, load 2, Hz", lambda: width(521.88, M2), 8.68, 6e-3),
    Number("eq 10, width, 2x, load 2, Hz", lambda: width(1003.04, M2), 16.69, 6e-3),
    Number("eq 10, width, 2y, load 2, Hz", lambda: width(1026.59, M2), 17.08, 6e-3),
    Number("eq 10, b if read at half amplitude, load 1", lambda: damping_from_half_amplitude(699.18, M1), 403.7, 0.06),
    Number("eq 10, b if read at half amplitude, load 2", lambda: damping_from_half_amplitude(1566.01, M2), 904.1, 0.06),
    Number("eq 1 at 1000 Hz, load 1, printed 95.3 %", lambda: sensitivity(K1, 699.18), 99.995, 6e-4),
    Number("eq 1 at 1000 Hz, load 2, printed 95.3 %", lambda: sensitivity(K2, 1566.01), 99.976, 6e-4),
    Number("eq 2 at 800 Hz, load 1, printed -0.25 rad", lambda: phase(K1, 699.18), -0.0081, 6e-5),
    Number("eq 2 at 800 Hz, load 2, printed -0.25 rad", lambda: phase(K2, 1566.01), -0.0174, 6e-5),
    Number("b that 95.3 % needs, kg/s", lambda: damping_from_sensitivity(0.953, 1000.0, K1), 21800.0, 50.0),
    Number("b that -0.25 rad needs", lambda: damping_from_phase(-0.25, 800.0, K1, "series"), 21450.0, 10.0),
    Number("lag of 50 µs at 800 Hz, rad", lambda: float(np.angle(lag(800.0))), -0.25, 5e-3),
    Number("lag of 50 µs at 1000 Hz, %", lambda: 100.0 * abs(lag(1000.0)), 95.3, 0.15),
    Number("chain to the four frequencies, %", lambda: 100.0 * papers_rows.chain_misfit(), 9.9, 0.05),
]
"""What the inputs give instead, or besides."""


def damping_from_half_amplitude(damping: float, load: float) -> float:
    """The damping there is where eq. 10 was fed with the width at half the amplitude."""
    return damping_from_width(width(damping, load), load + M_I, "half_amplitude")


def sensitivity(k: float, b: float) -> float:
    """Eq. 1 at 1000 Hz in per cent, exact; the series must agree."""
    at = np.array([1000.0])
    exact, series = (float(relative_sensitivity(at, k, b, form)[0]) for form in ("exact", "series"))
    assert series == pytest.approx(exact, abs=1e-7)
    return 100.0 * exact


def phase(k: float, b: float) -> float:
    """Eq. 2 at 800 Hz."""
    return float(sensitivity_phase_rad(np.array([800.0]), k, b, "series")[0])


def lag(frequency_hz: float) -> complex:
    """First-order lag of 50 µs."""
    return complex(Chain("lag", np.array([50e-6])).response(np.array([frequency_hz]))[0])


@pytest.mark.parametrize("number", [*PRINTED, *OTHERWISE], ids=lambda number: number.name)
def test_number(number: Number) -> None:
    assert number.computed() == pytest.approx(number.expected, abs=number.within, rel=0.0)


def test_every_resonance_is_a_line_of_one_spacing() -> None:
    """51.2 kHz over 65536 samples; printed to 0.1 Hz but for the first two."""
    for frequency in (1477.35, 1092.97, 1864.8, 1865.6, 315.6, 316.4, 1359.4, 1357.8, 210.9):
        assert abs(frequency - 0.78125 * round(frequency / 0.78125)) < 0.0501


@pytest.mark.parametrize(("k", "b", "mass"), [(K1, 699.18, M1 + M_I), (K2, 1566.01, M2 + M_I)])
def test_equation_10_on_a_curve(k: float, b: float, mass: float) -> None:
    """An oscillator with the printed k, b, m at the paper's lines: b comes back from the right width only."""
    frequency = 0.78125 * np.arange(1100.0, 2200.0)
    s = 2j * np.pi * frequency
    value = np.asarray((k + b * s) / (mass * s**2 + b * s + k), dtype=np.complex128)
    covariance = (1e-4 * np.abs(value).max()) ** 2 * np.eye(2) * np.ones((len(s), 1, 1))
    found = peak_readings(MeasuredCurve(frequency, value, covariance))
    for reading in (found.half_power, found.circle):
        assert damping_from_width(reading.width_hz, mass) == pytest.approx(b, rel=1e-3)
        assert required_stiffness(reading.frequency_hz, mass) == pytest.approx(k, rel=1e-6)
    as_worded = damping_from_width(found.half_amplitude.width_hz, mass)
    assert as_worded == pytest.approx(np.sqrt(3.0) * b, rel=1e-3)


def test_the_page_holds_what_the_program_computes() -> None:
    """Rows by rows, so that a change of any of them is seen."""
    text = PAGE.read_text(encoding="utf-8")
    for name, lines in papers.tables().items():
        begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        assert text.count(begin) == text.count(end) == 1
        held = text.split(begin)[1].split(end)[0].strip().splitlines()
        assert held == lines, name
