"""What a weighing needs of its surroundings: gravity from latitude and height, density of the air."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shaker._checks import FloatArray

GRS80_EQUATOR_MPS2 = 9.7803267715
GRS80_POLE_MPS2 = 9.8321863685
GRS80_SEMI_MAJOR_M = 6_378_137.0
GRS80_FLATTENING = 1.0 / 298.257222101
GRS80_ROTATION = 0.00344978600308
"""m = ω²a²b/(GM) of the Geodetic Reference System 1980."""
U_NORMAL_GRAVITY = 0.5e-4
"""Relative standard uncertainty with which normal gravity stands for gravity at a place.

Half of the 10⁻⁴ that PTB states for the same formula from latitude and height above the sea (g-Extractor of the gravity
information system). Measured gravity differs from it by some 35·10⁻⁵ m/s² on the global average; in high mountains, and
on ocean islands, it may differ by several times as much.
"""
LAYER_K, LAPSE_K_PER_M, SEA_PRESSURE_PA = 288.15, 0.0065, 101_325.0
STANDARD_EXPONENT = 5.255877
AIR_GAS_CONSTANT = 3.483740e-3  # kg K/J, molar mass of dry air with 400 ppm CO2 over R, CIPM-2007 eq. 2
ABSOLUTE_ZERO_C = -273.15
U_FORMULA = 22e-6
"""Relative standard uncertainty of the CIPM-2007 formula itself."""
WEATHER_PA, ANY_PLACE_PA = 1000.0, 4000.0
"""Standard deviation of the pressure about the standard atmosphere's: at a known height, and where none is known."""
ROOM_C, U_ROOM_C = 20.0, 3.0
HUMIDITY, U_HUMIDITY = 0.5, 0.2
U_MEASURED_PA, U_MEASURED_C, U_MEASURED_HUMIDITY = 100.0, 0.5, 0.05
"""Standard uncertainties that are taken for pressure, temperature and humidity where somebody has measured them."""


class Known(NamedTuple):
    """A number with its standard uncertainty, and where it comes from in words."""

    value: float
    u: float
    source: str


def normal_gravity(latitude_rad: float, height_m: float) -> float:
    """Return gravity in m/s² of the Geodetic Reference System 1980 at a height above its ellipsoid.

    On the ellipsoid γ = (a γ_e cos²φ + b γ_p sin²φ)/√(a² cos²φ + b² sin²φ) (Somigliana 1929; constants: Moritz 2000, J.
    Geodesy 74, 128), above it γ·(1 - 2(1 + f + m - 2f sin²φ)h/a + 3(h/a)²) (Heiskanen & Moritz 1967, eq. 2-123).
    """
    if not abs(latitude_rad) <= np.pi / 2.0 + 1e-12:
        raise ValueError(f"latitude_rad: expected an angle from -pi/2 to pi/2, found {latitude_rad}")
    a, f = GRS80_SEMI_MAJOR_M, GRS80_FLATTENING
    b = a * (1.0 - f)
    square = np.sin(latitude_rad) ** 2
    above = a * GRS80_EQUATOR_MPS2 * (1.0 - square) + b * GRS80_POLE_MPS2 * square
    ground = above / np.sqrt(a * a * (1.0 - square) + b * b * square)
    share = height_m / a
    lapse = 2.0 * (1.0 + f + GRS80_ROTATION - 2.0 * f * square) * share
    return float(ground * (1.0 - lapse + 3.0 * share * share))


def gravity_at(latitude_rad: float, height_m: float) -> Known:
    """Return gravity in m/s² at a place by its latitude and its height above the sea, with its standard uncertainty.

    The height above the sea stands for that above the ellipsoid, as in PTB's g-Extractor: the anomalies that make up
    the uncertainty are those about this value.
    """
    value = normal_gravity(latitude_rad, height_m)
    source = f"normal gravity (GRS 80) at {np.degrees(latitude_rad):.6g}° and {height_m:g} m"
    return Known(value, U_NORMAL_GRAVITY * value, source)


def standard_pressure(height_m: float) -> float:
    """Return the air pressure in Pa of the standard atmosphere (ISO 2533) below 11 km."""
    return float(SEA_PRESSURE_PA * (1.0 - LAPSE_K_PER_M * height_m / LAYER_K) ** STANDARD_EXPONENT)


def moist_air_density(pressure_pa: float, temperature_c: float, humidity: float) -> float:
    """Return the density of air in kg/m³ with 400 ppm of CO2; `humidity`: relative, from 0 to 1.

    ρ = p M_a/(Z R T)·(1 - 0.3780 x_v) by CIPM-2007 (Picard et al. 2008, Metrologia 45, 149), relative standard
    uncertainty 22·10⁻⁶ within 600 to 1100 hPa and 15 to 27 °C, where it was made; a few 10⁻⁵ further off.
    """
    if not 0.0 <= humidity <= 1.0:
        raise ValueError(f"humidity: expected a number from 0 to 1, found {humidity}")
    p, t = pressure_pa, temperature_c
    kelvin = t - ABSOLUTE_ZERO_C
    saturated = np.exp(1.2378847e-5 * kelvin**2 - 1.9121316e-2 * kelvin + 33.93711047 - 6.3431645e3 / kelvin)
    enhancement = 1.00062 + 3.14e-8 * p + 5.6e-7 * t * t
    x = humidity * enhancement * saturated / p
    first = 1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t * t
    first += (5.707e-6 - 2.051e-8 * t) * x + (1.9898e-4 - 2.376e-6 * t) * x * x
    compressibility = 1.0 - p / kelvin * first + (p / kelvin) ** 2 * (1.83e-11 - 0.765e-8 * x * x)
    return float(AIR_GAS_CONSTANT * p / (compressibility * kelvin) * (1.0 - 0.3780 * x))


def air_density_at(
    height_m: float | None, pressure_pa: float | None, temperature_c: float | None, humidity: float | None
) -> Known:
    """Return the density of air in kg/m³ from what is known of it; what is not is a laboratory's usual condition.

    Pressure: of the standard atmosphere at the height, ±10 hPa of weather, without a height that at sea level ±40 hPa;
    20 °C ± 3 K; relative humidity 0.5 ± 0.2. Measured values count as known to 1 hPa, 0.5 K and 0.05 (all k = 1).
    """
    weather = Known(standard_pressure(height_m or 0.0), ANY_PLACE_PA if height_m is None else WEATHER_PA, "")
    parts = [
        weather if pressure_pa is None else Known(pressure_pa, U_MEASURED_PA, "pressure"),
        Known(ROOM_C, U_ROOM_C, "") if temperature_c is None else Known(temperature_c, U_MEASURED_C, "temperature"),
        Known(HUMIDITY, U_HUMIDITY, "") if humidity is None else Known(humidity, U_MEASURED_HUMIDITY, "humidity"),
    ]
    centre = np.array([part.value for part in parts])
    steps = np.diag([part.u for part in parts])
    value = moist_air_density(*centre)
    half = [_density(centre + step) - _density(centre - step) for step in steps]
    u = float(np.hypot(np.linalg.norm(half) / 2.0, U_FORMULA * value))
    stated = [part.source for part in parts if part.source]
    stated += ["height"] if height_m is not None and pressure_pa is None else []
    return Known(value, u, f"CIPM-2007 from {', '.join(stated) or 'the usual conditions of a laboratory'}")


def _density(conditions: FloatArray) -> float:
    """Density at pressure, temperature and a humidity kept within its limits."""
    return moist_air_density(conditions[0], conditions[1], float(np.clip(conditions[2], 0.0, 1.0)))
