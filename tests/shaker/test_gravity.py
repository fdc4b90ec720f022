"""Gravity of a place and density of the air against published values and other formulas."""

from __future__ import annotations

import numpy as np
import pytest

from shaker.static_rotation.harmonics import (
    air_density_at,
    gravity_at,
    moist_air_density,
    normal_gravity,
    standard_pressure,
)


@pytest.mark.parametrize(
    ("latitude_deg", "height_m", "expected", "tolerance"),
    [
        (0.0, 0.0, 9.7803267715, 1e-10),  # GRS 80, Moritz 2000
        (90.0, 0.0, 9.8321863685, 1e-10),
        (45.0, 0.0, 9.806199203, 1e-8),  # GRS 80 at 45 degrees, Moritz 2000
        (52.296, 79.0, 9.8125, 5e-5),  # PTB, Braunschweig
        (51.03361, 149.0, 9.811161, 3e-6),  # geodetic laboratory of HTW Dresden, normal gravity of WGS 84
        (-45.0, 0.0, 9.806199203, 1e-8),
    ],
)
def test_normal_gravity_is_the_published_one(
    latitude_deg: float, height_m: float, expected: float, tolerance: float
) -> None:
    assert normal_gravity(np.radians(latitude_deg), height_m) == pytest.approx(expected, abs=tolerance)


def test_gravity_falls_with_height_as_outside_a_sphere() -> None:
    latitude = np.radians(50.0)
    ground = normal_gravity(latitude, 0.0)
    gradient = (normal_gravity(latitude, 1000.0) - ground) / 1000.0
    assert gradient == pytest.approx(-3.086e-6, rel=1e-3)
    assert normal_gravity(latitude, 8000.0) == pytest.approx(ground / (1.0 + 8000.0 / 6_356_800.0) ** 2, rel=2e-5)


@pytest.mark.parametrize(
    ("latitude_deg", "height_m", "measured"),
    [(51.03361, 114.0, 9.811193), (52.29, 80.0, 9.812524), (48.15, 515.0, 9.80723), (46.95, 540.0, 9.80588)],
)
def test_measured_gravity_lies_within_u(latitude_deg: float, height_m: float, measured: float) -> None:
    known = gravity_at(np.radians(latitude_deg), height_m)
    assert abs(known.value - measured) < 2.0 * known.u
    assert known.u == pytest.approx(0.5e-4 * known.value)
    assert "GRS 80" in known.source


def test_a_latitude_beyond_the_pole_is_refused() -> None:
    with pytest.raises(ValueError, match="latitude_rad: expected an angle"):
        normal_gravity(52.3, 0.0)


@pytest.mark.parametrize("pressure_pa", [95e3, 101.325e3, 105e3])
@pytest.mark.parametrize("temperature_c", [15.0, 20.0, 25.0])
@pytest.mark.parametrize("humidity", [0.2, 0.5, 0.7])
def test_air_is_that_of_the_shorter_formula_of_oiml(pressure_pa: float, temperature_c: float, humidity: float) -> None:
    """OIML R 111-1 (2004), E.3.1: relative uncertainty 2e-4 against the formula of 1981, 6e-5 below that of 2007."""
    h, t = 100.0 * humidity, temperature_c
    short = (0.34848 * pressure_pa / 100.0 - 0.009 * h * np.exp(0.061 * t)) / (273.15 + t)
    assert moist_air_density(pressure_pa, temperature_c, humidity) == pytest.approx(short, rel=4e-4)


def test_dry_air_is_nearly_an_ideal_gas() -> None:
    ideal = 101_325.0 * 28.96546e-3 / (8.314472 * 293.15)
    assert moist_air_density(101_325.0, 20.0, 0.0) == pytest.approx(ideal / 0.99963, rel=5e-5)  # Z at 20 °C, 1 atm


def test_the_standard_atmosphere_is_that_of_iso_2533() -> None:
    assert standard_pressure(0.0) == 101_325.0
    assert standard_pressure(1000.0) == pytest.approx(89_874.6, rel=2e-5)
    assert standard_pressure(5000.0) == pytest.approx(54_019.9, rel=5e-5)


def test_what_is_measured_makes_air_better_known() -> None:
    nothing = air_density_at(None, None, None, None)
    height = air_density_at(500.0, None, None, None)
    everything = air_density_at(500.0, 95_500.0, 21.0, 0.4)
    assert nothing.u > height.u > everything.u > 22e-6 * everything.value
    assert everything.source == "CIPM-2007 from pressure, temperature, humidity"
    assert height.source == "CIPM-2007 from height"


def test_u_of_air_is_that_of_drawn_conditions() -> None:
    rng = np.random.default_rng(5)
    drawn = [
        moist_air_density(95_500.0 + 100.0 * a, 21.0 + 0.5 * b, 0.4 + 0.05 * c)
        for a, b, c in rng.standard_normal((3000, 3))
    ]
    assert air_density_at(None, 95_500.0, 21.0, 0.4).u == pytest.approx(float(np.std(drawn)), rel=0.05)


def test_a_humidity_in_percent_is_refused() -> None:
    with pytest.raises(ValueError, match="humidity: expected a number from 0 to 1, found 50"):
        moist_air_density(101_325.0, 20.0, 50.0)
