"""Every checkable number of the publication on load characteristics (IEEE Access) from the program's functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
import papers_rows_load as rows
import published_load as paper
import pytest

from shaker.compensation.effects import residual_ringing
from shaker.compensation.filter import Compensation, Target, loaded_dynamics, single_mode
from shaker.lti.indices import Indices, indices
from shaker.lti.system import LinearSystem
from shaker.release.load_model import LoadModel, first_mode_hz, formula_limit, load_curve

OMEGA = np.sqrt(3.94e7)
NAN = float("nan")


class Number(NamedTuple):
    """A number, how the program computes it, what it must be, and within what."""

    name: str
    computed: Callable[[], float | None]
    expected: float
    within: float


@cache
def figures(name: str) -> Indices:
    """Indices of a printed or stated system."""
    systems = {
        "eq 11": paper.identified,
        "before": lambda: paper.TWO_MASS.system(0.151),
        "after": paper.compensated,
        "0.6": lambda: single_mode(OMEGA / (2 * np.pi), 0.6).system,
    }
    return indices(systems[name]())


@cache
def three_mass() -> LoadModel:
    """The three-mass model of the five printed resonances."""
    return rows.three_mass()


@cache
def spring_and_damper() -> tuple[float, float]:
    """Spring and damper of equation 11 and the weighed masses."""
    found = figures("eq 11")
    return rows.spring_and_damper(found.natural_hz or NAN, found.damping_ratio or NAN)


def damped_hz(omega: float) -> float:
    """Frequency of an oscillation of given angular frequency, lightly damped."""
    return (
        indices(LinearSystem(np.zeros(0, complex), np.array([-12.5 + 1j * omega, -12.5 - 1j * omega]), 1.0))
        .modes[0]
        .damped_hz
    )


def filtered() -> Compensation:
    """The filter of equations 15 to 17 by the program."""
    return Compensation(loaded_dynamics(paper.TWO_MASS, 0.151), Target(OMEGA / (2 * np.pi), 0.5))


def ringing(load_kg: float) -> float:
    """What is left ringing 2 ms after a step on another load than the filter was made for."""
    return residual_ringing(filtered(), paper.TWO_MASS.system(0.151 + load_kg), rows.AFTER_S)


def second_hz(place: int) -> float:
    """Second resonance of the three-mass model with the given load."""
    return float(load_curve(three_mass(), paper.LOADS_KG[place : place + 1]).frequency_hz[0, 1])


def gain(system: LinearSystem, hertz: float) -> float:
    """|H| at a frequency."""
    return float(np.abs(system.response(np.array([hertz]))[0]))


def target(place: int) -> float:
    """2ζω_n and ω_n² of 1000 Hz and 0.5."""
    pole = Compensation(loaded_dynamics(paper.TWO_MASS, 0.151), Target(1000.0, 0.5)).compensated.poles[0]
    return float((-2 * pole.real, abs(pole) ** 2)[place])


PRINTED = [
    Number("eq 7, Hz", lambda: damped_hz(3140.0), 500.0, 0.5),
    Number(
        "eq 11, ω_n² of 3140 rad/s, 1e6",
        lambda: (2 * np.pi * (figures("eq 11").natural_hz or NAN)) ** 2 / 1e6,
        9.86,
        1e-9,
    ),
    Number("eq 11, ω_n, rad/s", lambda: 2 * np.pi * (figures("eq 11").natural_hz or NAN), 3140.0, 0.5),
    Number("eq 11, ζ, printed 0.004", lambda: figures("eq 11").damping_ratio, 0.004, 5e-5),
    Number("eq 13, c", lambda: spring_and_damper()[1], 6.0, 0.005),
    Number("eq 13, k, 1e6, cut off", lambda: spring_and_damper()[0] / 1e6, 2.36, 0.01),
    Number("eq 15, 2ζω_n, printed 6280", lambda: target(0), 6280.0, 5.0),
    Number("eq 15, ω_n², 1e7, printed 3.94", lambda: target(1) / 1e7, 3.94, 0.01),
    Number("eq 17, factor", lambda: filtered().system.gain / paper.MOVING_KG, 16.7, 0.05),
    Number("step, settling before, ms", lambda: 1e3 * (figures("before").settling_2_s or NAN), 312.6, 0.05),
    Number("step, settling after, ms", lambda: 1e3 * (figures("after").settling_2_s or NAN), 1.29, 5e-3),
    Number("step, overshoot before, %", lambda: 100 * (figures("before").overshoot or NAN), 98.8, 0.05),
    Number("step, overshoot after, %", lambda: 100 * (figures("after").overshoot or NAN), 16.3, 0.05),
]
"""What the printed inputs give, and the print or its curves say."""

OTHERWISE = [
    Number("eq 7, Hz, fine", lambda: damped_hz(3140.0), 499.75, 5e-3),
    Number("ζ of 92.6 %, printed 0.004", lambda: rows.damping_of_overshoot(0.926), 0.0245, 5e-5),
    Number("overshoot of ζ = 0.004, %", lambda: 100 * rows.overshoot(single_mode(500.0, 0.004).system), 98.75, 5e-3),
    Number("release that makes 92.6 % of it, ms", lambda: 1e3 * rows.release_of_overshoot(0.926, 0.004), 0.39, 5e-3),
    Number("k of eq 11, 1e6 N/m", lambda: spring_and_damper()[0] / 1e6, 2.3664, 5e-5),
    Number("eq 17, factor, fine", lambda: filtered().system.gain / paper.MOVING_KG, 16.695, 5e-4),
    Number(
        "static gain of eqs 16, 17",
        lambda: paper.TWO_MASS.system(0.151).times(paper.filter_as_printed()).static_gain,
        1.0003,
        5e-5,
    ),
    Number("±10 % before, Hz, printed 490", lambda: figures("before").band_10_hz, 150.5, 0.05),
    Number("±10 % after, Hz, printed 1560", lambda: figures("after").band_10_hz, 472.8, 0.1),
    Number("±5 % before, Hz", lambda: figures("before").band_5_hz, 109.0, 0.5),
    Number("±5 % after, Hz", lambda: figures("after").band_5_hz, 322.0, 0.5),
    Number("-3 dB before, Hz", lambda: figures("before").half_power_hz, 775.0, 0.5),
    Number("-3 dB after, Hz", lambda: figures("after").half_power_hz, 1270.0, 0.5),
    Number("highest gain after", lambda: figures("after").peak_gain, 1.154, 5e-4),
    Number("its frequency, Hz", lambda: figures("after").peak_hz, 706.0, 0.5),
    Number("gain before at 490 Hz", lambda: gain(paper.TWO_MASS.system(0.151), 490.0), 27.0, 0.5),
    Number("gain after at 1560 Hz", lambda: gain(paper.compensated(), 1560.0), 0.47, 5e-3),
    Number("ζ 0.6, ±10 %, Hz", lambda: figures("0.6").band_10_hz, 916.0, 1.0),
    Number("ζ 0.6, ±5 %, Hz", lambda: figures("0.6").band_5_hz, 843.0, 0.5),
    Number("ζ 0.6, highest gain", lambda: figures("0.6").peak_gain, 1.042, 5e-4),
    Number("three masses, k, 1e6 N/m", lambda: three_mass().stiffness / 1e6, 2.355, 2e-3),
    Number("three masses, k_L, 1e6 N/m", lambda: (three_mass().coupling_stiffness or NAN) / 1e6, 1.892, 2e-3),
    Number("second resonance, 8 g, Hz", lambda: second_hz(1), 2490.0, 2.0),
    Number("second resonance, 48 g, Hz", lambda: second_hz(2), 1117.0, 1.0),
    Number("second resonance, 98 g, Hz", lambda: second_hz(3), 884.0, 1.0),
    Number("second resonance, 198 g, Hz", lambda: second_hz(4), 767.0, 1.0),
    Number("left ringing, 8 g", lambda: ringing(0.008), 0.035, 5e-4),
    Number("left ringing, 48 g", lambda: ringing(0.048), 0.18, 5e-3),
    Number("left ringing, 98 g", lambda: ringing(0.098), 0.31, 5e-3),
    Number("left ringing, 198 g", lambda: ringing(0.198), 0.47, 5e-3),
]
"""What the inputs give instead, or besides."""


@pytest.mark.parametrize("number", [*PRINTED, *OTHERWISE], ids=lambda number: number.name)
def test_number(number: Number) -> None:
    assert number.computed() == pytest.approx(number.expected, abs=number.within, rel=0.0)


@pytest.mark.parametrize(
    ("place", "hertz", "off"),
    [(0, 499.1, -0.2), (1, 491.0, 1.0), (2, 455.6, 1.2), (3, 420.6, 7.0), (4, 369.4, 15.4)],
)
def test_equation_14_over_the_load(place: int, hertz: float, off: float) -> None:
    """m_L of equation 14 holds cover and pillar."""
    assert first_mode_hz(paper.TWO_MASS, 0.151 + paper.LOADS_KG[place]) == pytest.approx(hertz, abs=0.05)
    assert rows.deviations(paper.TWO_MASS, 0.151)[place] == pytest.approx(off, abs=0.06)


def test_three_masses_explain_every_load_within_a_per_cent() -> None:
    assert np.abs(rows.deviations(three_mass())).max() < 1.0


def test_the_two_mass_formula_holds_to_5_per_cent_below_98_g() -> None:
    limit = formula_limit(three_mass(), 0.05)
    assert limit is not None
    assert limit.load_mass == pytest.approx(0.081, abs=2e-3)
    assert limit.load_mass < 0.098


def test_two_masses_do_not_explain_the_loads() -> None:
    assert np.abs(rows.deviations(paper.TWO_MASS, 0.151)).max() > 15.0


def test_equations_3_follow_from_equation_2() -> None:
    """Poles and static gain of the model against the matrices of equation 2."""
    k, c, kl, cl, load = 2.36e6, 6.0, 1.89e6, 4.0, 0.048
    model = LoadModel("Fy", "Fy", "V", 0.24, k, c, kl, cl, sensitivity=3.0)
    mass, damping, stiffness = (
        np.diag([load, 0.24]),
        np.array([[cl, -cl], [-cl, cl + c]]),
        np.array([[kl, -kl], [-kl, kl + k]]),
    )
    inverse = np.linalg.inv(mass)
    state = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ stiffness, -inverse @ damping]])
    assert np.allclose(np.sort_complex(np.linalg.eigvals(state)), np.sort_complex(model.system(load).poles), rtol=1e-8)
    assert model.system(load).static_gain == pytest.approx(3.0)
    assert rows.order_of_agreement() == 10


def test_a_stiff_coupling_is_equation_5() -> None:
    stiff = LoadModel("Fy", "Fy", "V", 0.24, 2.36e6, 6.0, 2.36e12, 0.0).system(0.05)
    rigid = LoadModel("Fy", "Fy", "V", 0.24, 2.36e6, 6.0).system(0.05)
    hertz = np.linspace(0.0, 900.0, 91)
    assert np.allclose(stiff.response(hertz), rigid.response(hertz), rtol=1e-3)


def test_a_release_changes_the_overshoot_and_not_the_decay() -> None:
    """Damping by the poles is the same however long the release takes: equation 9 reads the release as damping."""
    short, long = (rows.release_of_overshoot(value, 0.004) for value in (0.97, 0.90))
    assert short < 3.9e-4 < long
