"""Every checkable number of the wrist sensor's publication (J. Sensors 2018, 6216979) from the program's functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import papers_rows_wrist as rows
import published_wrist as paper
import pytest
from published_formulas import rounding_range, supported_deflection

from fusion.sensor.elastomer.evaluate import Column, spread
from shaker.compensation.filter import band_ratio
from shaker.elastomer.frame import fit_platform
from shaker.elastomer.geometry import PublishedStatics, beam_stiffness, guided_stiffness
from shaker.lti.indices import Indices, Mode, indices
from shaker.lti.system import LinearSystem
from shaker.mechanics import oscillator_hz, required_stiffness
from shaker.release.fit import fit_step
from shaker.release.sim import fit_sim

FORMULA = PublishedStatics(paper.BEAMS)
NAN = float("nan")


class Number(NamedTuple):
    """A number, how the program computes it, what it must be, and within what."""

    name: str
    computed: Callable[[], float | None]
    expected: float
    within: float


@cache
def figures(system: str) -> Indices:
    """Indices of equation 20, of equation 21 as printed, or of the equation of a component."""
    if system in paper.COMPONENTS:
        return indices(paper.evolved(system))
    return indices(paper.difference_equation() if system == "20" else paper.transfer_function())


def mode(system: str) -> Mode:
    """The oscillating mode of a printed equation."""
    found = figures(system).dominant
    assert found is not None
    return found


@cache
def converted() -> tuple[list[float], list[float]]:
    """Coefficients that the Tustin conversion of equation 20 gives."""
    above, below = paper.difference_equation().continuous("tustin").coefficients()
    return above.tolist(), below.tolist()


def apart(place: int) -> float:
    """Table 6, last row, in per cent."""
    columns = [Column(name, "stated", np.array([*f, NAN, NAN]), np.zeros(6)) for name, f in paper.MODELS.items()]
    return 100.0 * float(spread(columns)[place])


def finite_elements(place: int) -> float:
    """Table 2 over Table 3 less 1, in per cent, by the same function."""
    names = ("simplified dynamics", "finite elements")
    columns = [Column(name, "stated", np.array([*paper.MODELS[name], NAN, NAN]), np.zeros(6)) for name in names]
    return -100.0 * float(spread(columns)[place])


def box(component: str) -> tuple[float, float]:
    """Natural frequencies that the printed digits of a denominator permit."""
    low, high = rounding_range(*paper.evolved_digits(component), paper.RATE_HZ).natural_hz
    return float(low), float(high)


PRINTED = [
    Number("eq 4 at the support, 0", lambda: supported_deflection(FORMULA, 64e-3), 0.0, 1e-20),
    Number(
        "eq 4 at mid-span is eq 5", lambda: supported_deflection(FORMULA, 32e-3) / FORMULA.beam_compliance, 1.0, 1e-12
    ),
    Number("eq 11 from eqs 5, 10", lambda: 1.0 / FORMULA.stiffness() / FORMULA.beam_compliance, 0.8, 1e-12),
    Number("Table 6, difference of Fx, %", lambda: apart(0), 4.5, 0.05),
    Number("Table 6, difference of My, %", lambda: apart(1), 5.6, 0.0501),
    Number("Table 6, difference of Mz, %", lambda: apart(2), 4.0, 0.05),
    Number("Table 6, difference of Fz, %", lambda: apart(3), 2.6, 0.05),
    Number("Table 2 to 3, Fx, %", lambda: finite_elements(0), -1.1, 0.05),
    Number("Table 2 to 3, My, %", lambda: finite_elements(1), -5.6, 0.05),
    Number("Table 2 to 3, Mz, %", lambda: finite_elements(2), -4.0, 0.05),
    Number("Table 2 to 3, Fz, %", lambda: finite_elements(3), -2.6, 0.05),
    Number("eq 21, s³ above, 1e-4", lambda: 1e4 * converted()[0][0], 8.2, 0.05),
    Number("eq 21, s² above", lambda: converted()[0][1], 4430.0, 0.5),
    Number("eq 21, s above, 1e8", lambda: converted()[0][2] / 1e8, -5.36, 5e-3),
    Number("eq 21, 1 above, 1e13", lambda: converted()[0][3] / 1e13, 8.532, 5e-4),
    Number("eq 21, s² below, 1e5", lambda: converted()[1][1] / 1e5, 8.643, 5.1e-4),
    Number("eq 21, s below, 1e9", lambda: converted()[1][2] / 1e9, 5.494, 5e-4),
    Number("eq 21, 1 below, 1e13", lambda: converted()[1][3] / 1e13, 8.587, 5e-4),
    Number("±5 % of a gain of 1, Hz, printed 414", lambda: figures("21").band_5_nominal_hz, 414.0, 2.5),
    Number("±10 % of a gain of 1, Hz, printed 560", lambda: figures("21").band_10_nominal_hz, 560.0, 3.0),
    Number("±5 % over f of an oscillator", lambda: band_ratio(1e-6, 0.05), 0.2182, 5e-5),
    Number("±10 % over f of an oscillator", lambda: band_ratio(1e-6, 0.10), 0.3015, 5e-5),
]
"""What the printed inputs give, and the print says."""

OTHERWISE = [
    Number("G, GPa, printed E/(1+mu)", lambda: paper.BEAMS.material.shear_modulus_pa / 1e9, 27.7, 0.05),
    Number("G as printed, GPa", lambda: FORMULA.shear_modulus_pa / 1e9, 55.4, 0.05),
    Number("eq 10, F_Q/F_c, printed 8", lambda: FORMULA.force_ratio, 6.859, 5e-4),
    Number("eq 10, F_Q/F, printed 0.4", lambda: FORMULA.beam_share, 0.387, 5e-4),
    Number(
        "eq 10 with h = 4 mm", lambda: PublishedStatics(replace(paper.BEAMS, beam_width_m=4e-3)).force_ratio, 8.0, 1e-9
    ),
    Number("k, 1e5 N/m, printed 1.824", lambda: FORMULA.stiffness() / 1e5, 2.848, 5e-4),
    Number("side of square beams for eq 12, mm", rows.beam_width_needed, 3.39, 0.011),
    Number("k of guided compliant beams, 1e5 N/m", lambda: guided_stiffness(paper.BEAMS) / 1e5, 4.91, 0.05),
    Number("k of beams in space, 1e5 N/m", lambda: beam_stiffness(paper.BEAMS, rows.POINT_M).x / 1e5, 5.34, 5e-3),
    Number("f of k and 49 g, Hz, printed 1642", lambda: oscillator_hz(1.824e5, 0.049), 307.0, 0.5),
    Number("k of 1642 Hz and 49 g, 1e6 N/m", lambda: required_stiffness(1642.0, 0.049) / 1e6, 5.216, 5e-4),
    Number("eq 21, f, Hz, printed 1720", lambda: mode("21").natural_hz, 1592.0, 0.5),
    Number("eq 21, ζ", lambda: mode("21").damping_ratio, 0.314, 5e-4),
    Number("eq 21, damped, Hz", lambda: mode("21").damped_hz, 1512.0, 0.5),
    Number("eq 21, peak, Hz", lambda: figures("21").peak_hz, 1425.5, 0.5),
    Number("eq 21, -90°, Hz", lambda: figures("21").quadrature_hz, 1556.0, 0.5),
    Number("eq 21, overshoot, %", lambda: 100.0 * (figures("21").overshoot or NAN), 35.0, 0.5),
    Number("eq 21, static gain", lambda: figures("21").static_gain, 0.9936, 5e-5),
    Number("eq 21, ±5 % of the static gain, Hz", lambda: figures("21").band_5_hz, 391.5, 0.5),
    Number("eq 21, ±10 % of the static gain, Hz", lambda: figures("21").band_10_hz, 545.0, 0.5),
    Number("eq 21, third pole, 1e5 rad/s", lambda: paper.transfer_function().poles[-1].real / 1e5, -8.58, 5e-3),
    Number("eq 20, false pole", lambda: paper.difference_equation().poles[-1].real, -0.62, 5e-3),
    Number("eq 23, f, Hz, printed 1680", lambda: mode("Fx").natural_hz, 1901.0, 0.5),
    Number("eq 23, ζ", lambda: mode("Fx").damping_ratio, 0.221, 5e-4),
    Number("eq 23, static gain", lambda: figures("Fx").static_gain, 1.13, 5e-3),
    Number("eq 23, ±5 %, Hz, printed 395", lambda: figures("Fx").band_5_hz, 830.0, 0.5),
    Number("eq 23, ±10 %, Hz, printed 530", lambda: figures("Fx").band_10_hz, 1028.0, 0.5),
    Number("eq 24, f, Hz, printed 3460", lambda: mode("My").natural_hz, 1847.0, 0.5),
    Number("eq 24, ζ", lambda: mode("My").damping_ratio, 0.168, 5e-4),
    Number("eq 24, static gain", lambda: figures("My").static_gain, 1.315, 5e-4),
    Number("eq 24, ±5 %, Hz, printed 678", lambda: figures("My").band_5_hz, 449.0, 0.5),
    Number("eq 24, ±10 %, Hz, printed 980", lambda: figures("My").band_10_hz, 619.0, 0.5),
    Number("eq 25, f, Hz, printed 4910", lambda: mode("Mz").natural_hz, 159.8, 0.05),
    Number("eq 25, ζ", lambda: mode("Mz").damping_ratio, 0.196, 5e-4),
    Number("eq 25, false pole", lambda: paper.evolved("Mz").poles[-1].real, -0.987, 5e-4),
    Number("eq 25, ±5 %, Hz, printed 1285", lambda: figures("Mz").band_5_hz, 36.0, 0.5),
    Number("eq 25, ±10 %, Hz, printed 1610", lambda: figures("Mz").band_10_hz, 50.0, 0.5),
    Number("eq 26, f, Hz, printed 1986", lambda: mode("Fz").natural_hz, 457.0, 0.5),
    Number("eq 26, ζ", lambda: mode("Fz").damping_ratio, 0.046, 5e-4),
    Number("eq 26, false pole", lambda: min(paper.evolved("Fz").poles.real), -0.944, 5.1e-4),
    Number("eq 26, ±5 %, Hz, printed 466", lambda: figures("Fz").band_5_hz, 100.0, 0.5),
    Number("eq 26, ±10 %, Hz, printed 648", lambda: figures("Fz").band_10_hz, 138.0, 0.5),
    Number("eq 23, least f of its digits, Hz", lambda: box("Fx")[0], 1840.0, 3.0),
    Number("eq 23, greatest f of its digits, Hz", lambda: box("Fx")[1], 2133.0, 1.0),
    Number("eq 24, least f of its digits, Hz", lambda: box("My")[0], 1573.0, 6.0),
    Number("eq 24, greatest f of its digits, Hz", lambda: box("My")[1], 2194.0, 1.0),
    Number("eq 25, least f of its digits, Hz", lambda: box("Mz")[0], 31.0, 1.0),
    Number("eq 25, greatest f of its digits, Hz", lambda: box("Mz")[1], 320.0, 1.0),
    Number("eq 26, least f of its digits, Hz", lambda: box("Fz")[0], 268.0, 1.0),
    Number("eq 26, greatest f of its digits, Hz", lambda: box("Fz")[1], 588.0, 1.0),
]
"""What the inputs give instead, or besides."""


@pytest.mark.parametrize("number", [*PRINTED, *OTHERWISE], ids=lambda number: number.name)
def test_number(number: Number) -> None:
    assert number.computed() == pytest.approx(number.expected, abs=number.within, rel=0.0)


@pytest.mark.parametrize(("component", "kilohertz"), [("Fx", 88), ("My", 187), ("Mz", 3073), ("Fz", 435)])
def test_no_common_rate_gives_the_stated_frequencies(component: str, kilohertz: float) -> None:
    """The equation at the rate that would be needed has the stated frequency: four rates for one card."""
    stated = paper.MODELS["DE"][paper.COMPONENTS.index(component)]
    system = replace(paper.evolved(component), sample_rate_hz=1e3 * kilohertz)
    found = indices(system).natural_hz
    assert found == pytest.approx(stated, rel=6e-3)


@pytest.mark.parametrize("component", paper.COMPONENTS)
def test_the_stated_frequency_is_outside_what_the_digits_permit(component: str) -> None:
    low, high = box(component)
    assert not low <= paper.MODELS["DE"][paper.COMPONENTS.index(component)] <= high


def test_some_models_within_the_digits_of_equation_25_are_unstable() -> None:
    assert rounding_range(*paper.evolved_digits("Mz"), paper.RATE_HZ).radius == pytest.approx(1.012, abs=1e-3)
    assert rounding_range(*paper.evolved_digits("My"), paper.RATE_HZ).radius < 1


@pytest.mark.parametrize("component", ["Fx", "My"])
def test_no_band_about_a_gain_of_one(component: str) -> None:
    assert figures(component).band_5_nominal_hz is None
    assert figures(component).band_10_nominal_hz is None


def test_false_poles_are_told() -> None:
    assert any("turns its sign" in notice.text for notice in figures("20").notices)
    assert any("half the sampling rate" in n.text for n in indices(paper.transfer_function(), 1.0, 1e5).notices)
    assert figures("Fx").notices == ()


def test_equation_19_in_the_order_of_the_augmented_data_vector() -> None:
    """θ = [b3 a3 b2 a2 b1 a1 b0] is equation 20."""
    theta = [0.0083, 0.5841, 0.0047, -0.2608, -0.0011, -1.3076, 0.0037]
    numerator, denominator = np.array(theta[::-2]), np.array([1.0, *theta[-2::-2]])
    system = LinearSystem.from_coefficients(numerator, denominator, paper.RATE_HZ)
    assert np.allclose(system.coefficients(), paper.difference_equation().coefficients(), atol=1e-12)


@pytest.mark.parametrize(("half_size_m", "grams"), [(10e-3, 5.34), (18e-3, 16.6)])
def test_table_3_fits_any_platform(half_size_m: float, grams: float) -> None:
    fit = fit_platform(paper.BEAMS, half_size_m, {"Tx": 1660.0, "Tz": 2025.0, "Rx": 3577.0, "Rz": 5094.0})
    assert fit.misfit < 1e-6
    assert 1e3 * fit.platform.mass_kg == pytest.approx(grams, rel=0.01)


def test_how_equation_20_came_about() -> None:
    """Equation error at 100 kHz takes noise for damping and a false pole; output error does not."""
    record = rows.simulated_release()
    biased = fit_sim(record, "Fx", order=3)
    found = indices(biased.system).dominant
    assert found is not None
    assert found.damping_ratio > 10 * 0.02
    assert biased.system.sampled(paper.RATE_HZ, "tustin").poles[-1].real == pytest.approx(-0.65, abs=0.05)
    model = fit_step(record, "Fx").model
    assert model is not None
    assert model.frequency_hz[0] == pytest.approx(1720.0, rel=2e-4)
    assert model.damping_ratio[0] == pytest.approx(0.02, rel=1e-2)
