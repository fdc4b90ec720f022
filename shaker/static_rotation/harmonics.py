"""Local gravity and air; harmonics of readings over the angle of an indexing head."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shaker.static_rotation.rounding import Rounding, last_digit
from shaker.static_rotation.series_noise import DriftingFit, coefficient_covariance, find_walks, walk_covariance
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, check_shape

# Ambient conditions of a weighing: gravity from latitude and height, density of the air.

GRS80_EQUATOR_MPS2 = 9.7803267715
GRS80_POLE_MPS2 = 9.8321863685
GRS80_SEMI_MAJOR_M = 6_378_137.0
GRS80_FLATTENING = 1.0 / 298.257222101
GRS80_ROTATION = 0.00344978600308
"""m = ω²a²b/(GM) of the Geodetic Reference System 1980."""
U_NORMAL_GRAVITY = 0.5e-4
"""Relative standard uncertainty of normal gravity as an estimate of local gravity.

Half of the 10⁻⁴ that PTB states for the same formula from latitude and height above the sea (g-Extractor of the gravity
information system). Measured gravity differs from it by some 35·10⁻⁵ m/s² on the global average; in high mountains, and
on ocean islands, it may differ by several times as much.
"""
LAYER_K, LAPSE_K_PER_M, SEA_PRESSURE_PA = 288.15, 0.0065, 101_325.0  # ISO 2533
STANDARD_EXPONENT = 5.255877  # g/(R·lapse rate), ISO 2533
AIR_GAS_CONSTANT = 3.483740e-3  # kg K/J, molar mass of dry air with 400 ppm CO2 over R, CIPM-2007 eq. 2
ABSOLUTE_ZERO_C = -273.15
U_FORMULA = 22e-6
"""Relative standard uncertainty of the CIPM-2007 formula itself."""
WEATHER_PA, UNKNOWN_HEIGHT_PA = 1000.0, 4000.0
"""Standard deviation of the pressure from the standard atmosphere: at a known height, and at an unknown one."""
USUAL_C, U_USUAL_C = 20.0, 3.0  # of a laboratory, assumed
HUMIDITY, U_HUMIDITY = 0.5, 0.2  # of a laboratory, assumed
U_MEASURED_PA, U_MEASURED_C, U_MEASURED_HUMIDITY = 100.0, 0.5, 0.05
"""Assumed standard uncertainties of measured pressure, temperature and humidity."""


class SourcedValue(NamedTuple):
    """A number with its standard uncertainty and its source in words."""

    value: float
    u: float
    source: str


def normal_gravity(latitude_rad: float, height_m: float) -> float:
    """Return normal gravity in m/s² at a height above the ellipsoid.

    Geodetic Reference System 1980. On the ellipsoid γ = (a γ_e cos²φ + b γ_p sin²φ)/√(a² cos²φ + b² sin²φ) (Somigliana
    1929; constants: Moritz 2000, J. Geodesy 74, 128), above it γ·(1 - 2(1 + f + m - 2f sin²φ)h/a + 3(h/a)²) (Heiskanen
    & Moritz 1967, eq. 2-123).
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


def gravity_at(latitude_rad: float, height_m: float) -> SourcedValue:
    """Return gravity in m/s² from latitude and height above the sea.

    That height replaces the height above the ellipsoid, as in PTB's g-Extractor; the uncertainty is that of anomalies.
    """
    value = normal_gravity(latitude_rad, height_m)
    source = f"normal gravity (GRS 80) at {np.degrees(latitude_rad):.6g}° and {height_m:g} m"
    return SourcedValue(value, U_NORMAL_GRAVITY * value, source)


def standard_pressure(height_m: float) -> float:
    """Return the air pressure in Pa of the standard atmosphere (ISO 2533) below 11 km."""
    return float(SEA_PRESSURE_PA * (1.0 - LAPSE_K_PER_M * height_m / LAYER_K) ** STANDARD_EXPONENT)


def moist_air_density(pressure_pa: float, temperature_c: float, humidity: float) -> float:
    """Return the density of air in kg/m³ with 400 ppm of CO2.

    `humidity`: relative, from 0 to 1. ρ = p M_a/(Z R T)·(1 - 0.3780 x_v) by CIPM-2007 (Picard et al. 2008, Metrologia
    45, 149). Its relative standard uncertainty is 22·10⁻⁶ within its range of 600 to 1100 hPa and 15 to 27 °C, and a
    few 10⁻⁵ outside.
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
) -> SourcedValue:
    """Return the density of air in kg/m³ from measured or usual conditions.

    Pressure: the standard atmosphere at the height, ±10 hPa for weather; at an unknown height ±40 hPa. 20 °C ± 3 K.
    Relative humidity 0.5 ± 0.2. Measured values have 1 hPa, 0.5 K and 0.05 (all k = 1).
    """
    u_weather = UNKNOWN_HEIGHT_PA if height_m is None else WEATHER_PA
    weather = SourcedValue(standard_pressure(height_m or 0.0), u_weather, "")
    parts = [
        weather if pressure_pa is None else SourcedValue(pressure_pa, U_MEASURED_PA, "pressure"),
        SourcedValue(USUAL_C, U_USUAL_C, "")
        if temperature_c is None
        else SourcedValue(temperature_c, U_MEASURED_C, "temperature"),
        SourcedValue(HUMIDITY, U_HUMIDITY, "")
        if humidity is None
        else SourcedValue(humidity, U_MEASURED_HUMIDITY, "humidity"),
    ]
    centre = np.array([part.value for part in parts])

    def density(conditions: FloatArray) -> float:
        """Return the density at pressure, temperature and a humidity limited to 0 … 1."""
        return moist_air_density(conditions[0], conditions[1], float(np.clip(conditions[2], 0.0, 1.0)))

    value = moist_air_density(*centre)
    half = [density(centre + step) - density(centre - step) for step in np.diag([part.u for part in parts])]
    u = float(np.hypot(np.linalg.norm(half) / 2.0, U_FORMULA * value))
    stated = [part.source for part in parts if part.source]
    stated += ["height"] if height_m is not None and pressure_pa is None else []
    return SourcedValue(value, u, f"CIPM-2007 from {', '.join(stated) or 'the usual conditions of a laboratory'}")


# Readings over the angle of an indexing head as harmonics: all channels together, significant terms only.

CHANCE = 1e-3
"""Probability of a false term in a fit."""
HIGHEST_ORDER = 8  # of a harmonic
MIN_DOF = 3  # of a fit with an additional term
LARGEST_CONDITION = 30.0  # of a design, above which angles do not separate the terms
SAME_ANGLE_RAD = 1e-3  # about 0.06°
STRONG = 2.0  # difference of the information criterion: positive evidence (Kass and Raftery 1995)
PRECISION = 1e-12  # relative, of computed numbers
Term = tuple[str, FloatArray]


class Reversal(NamedTuple):
    """Difference (K, C), forward minus backward, at angles read in both senses."""

    angle_rad: FloatArray
    difference: FloatArray


@dataclass(frozen=True, repr=False)
class AngleFit(
    Arrays,
    shapes="channels C; angle_rad N; terms P; reading N C; design N P; coefficient P C; spread C P N; noise C C; "
    "walk C",
):
    """Readings (N, C) at angles (N,) as a sum of terms.

    reading = design · coefficient + residual. `terms` (P,): names of the columns of `design` (N, P). They are offset,
    cos 1, sin 1, and if significant cos n, sin n, drift (over the order of the readings, from -1 to 1) and sense
    (difference between forward and backward rotation). `noise` (C, C): covariance of a reading with `dof` degrees
    of freedom, which includes its `rounding`. `walk` (C,): variance of a random walk over it. `estimator`, `spread` (C,
    P, N): coefficient per reading, and per unit of noise.
    """

    channels: tuple[str, ...]
    angle_rad: FloatArray
    reading: FloatArray
    terms: tuple[str, ...]
    design: FloatArray
    coefficient: FloatArray
    estimator: FloatArray
    spread: FloatArray
    noise: FloatArray
    dof: float
    rounding: Rounding
    walk: FloatArray

    @property
    def residual(self) -> FloatArray:
        """Residuals (N, C) of the readings."""
        return np.asarray(self.reading - self.design @ self.coefficient)

    @property
    def orders(self) -> tuple[int, ...]:
        """Harmonics in the fit, ascending."""
        return tuple(int(name[4:]) for name in self.terms if name.startswith("cos "))

    def amplitude(self, order: int = 1) -> ComplexArray:
        """Return A (C,) of a harmonic, so that the reading is Re{A exp(+j·order·angle)}."""
        cosine, sine = self._columns(order)
        return np.asarray(self.coefficient[cosine] - 1j * self.coefficient[sine])

    def covariance(self, order: int = 1) -> FloatArray:
        """Return the noise covariance (2C, 2C) of a harmonic's amplitude, without rounding.

        In the order [all Re, all Im].
        """
        signed = self.spread[:, self._columns(order)] * np.array([[1.0], [-1.0]])
        return coefficient_covariance(signed, self.rounding.without(self.noise))

    def combined(self, row: FloatArray) -> FloatArray:
        """Return the covariance (P, P) of coefficients of channels summed with factors (C,)."""
        terms = len(self.terms)
        whole = coefficient_covariance(self.spread, self.noise).reshape(terms, len(row), terms, len(row))
        return np.asarray(np.einsum("c,pcqd,d->pq", row, whole, row))

    def rounding_effect(self, order: int = 1) -> FloatArray:
        """Return the effect (2C, r) of rounding on a harmonic's amplitude, [all Re, all Im]."""
        columns = self._columns(order)
        effect = self.rounding.effect(self.estimator, self.design, self.reading, self.coefficient, self.noise, columns)
        return np.asarray(effect * np.repeat([1.0, -1.0], len(self.channels))[:, None])

    def loop(self) -> FloatArray:
        """Return the squared difference (C,) between both senses, and its variance.

        Of the first harmonic, amplitude.
        """
        sense, none = turning_sense(self.angle_rad), np.zeros((2, len(self.channels)))
        if np.ptp(sense) == 0.0:
            return none
        names = [name for name in self.terms if not name.startswith("sense")]
        design = np.stack([self.design[:, self.terms.index(name)] for name in names], axis=1)
        design = np.column_stack([design, *(0.5 * sense * _periodic(name, self.angle_rad) for name in names[:3])])
        if len(design) <= design.shape[1] or np.linalg.cond(design) > LARGEST_CONDITION:
            return none
        fit = DriftingFit.of(design, self.reading, self.walk, _walk(len(design)))
        variance = np.sum(fit.spread[:, -2:] ** 2, axis=(1, 2)) * np.diag(self.noise)
        return np.stack([np.sum(fit.coefficient[-2:] ** 2, axis=0), variance])

    def curve(self, angle_rad: FloatArray) -> FloatArray:
        """Return offset and harmonics at angles (M,) as (M, C), without drift and sense."""
        return np.asarray(np.stack([_periodic(name, angle_rad) for name in self.terms], axis=1) @ self.coefficient)

    def reversal(self) -> Reversal:
        """Return the differences between readings at angles that were read in both senses."""
        sense, angles = turning_sense(self.angle_rad), np.mod(self.angle_rad, 2.0 * np.pi)
        both, differences = [], []
        for angle in _distinct(angles):
            near = np.abs(np.angle(np.exp(1j * (angles - angle)))) < SAME_ANGLE_RAD
            forward, back = near & (sense > 0.0), near & (sense < 0.0)
            if forward.any() and back.any():
                both.append(angle)
                differences.append(self.reading[forward].mean(axis=0) - self.reading[back].mean(axis=0))
        return Reversal(np.array(both), np.reshape(differences, (len(both), len(self.channels))))

    def _columns(self, order: int) -> list[int]:
        if order not in self.orders:
            raise ValueError(f"order: expected one of {self.orders}, found {order}")
        return [self.terms.index(f"{part} {order}") for part in ("cos", "sin")]


def fit_angles(
    channels: tuple[str, ...], angle_rad: FloatArray, reading: FloatArray, digit: FloatArray | None = None
) -> AngleFit:
    """Fit offset, first harmonic and significant further terms to readings (N, C) at angles (N,).

    Further terms are harmonics as far as the angles resolve them, a linear drift and, if the head was rotated both
    ways, the difference between both senses. The most significant term enters first. It must be significant in an F
    test of one channel with a chance below 1 in 1000 for all channels together. The variance of a reading is at least
    a²/12 for its last `digit` a (C,), by default that of the readings. Equal readings share their rounding
    error. A random walk replaces terms that it explains with fewer parameters (Bayesian information criterion).
    """
    angle, values = np.asarray(angle_rad, np.float64), np.asarray(reading, np.float64)
    check_shape("angle_rad", angle, (None,))
    check_shape("reading", values, (len(angle), len(channels)))
    if not (np.isfinite(angle).all() and np.isfinite(values).all()):
        raise ValueError("reading: expected finite angles and readings, found others")
    terms, blocks = _offered(angle)
    design = np.stack([columns for _, columns in terms], axis=1)
    if len(angle) <= design.shape[1] or np.linalg.cond(design) > LARGEST_CONDITION:
        spread = f"{len(angle)} readings at {len(_distinct(np.mod(angle, 2.0 * np.pi)))} angles"
        raise ValueError(f"angle_rad: expected at least four angles over most of a revolution, found {spread}")
    rounding = Rounding(np.array([last_digit(column) for column in values.T]) if digit is None else digit)
    computed = (PRECISION * np.abs(values).max(axis=0)) ** 2
    repeats = len(angle) / np.array([len(np.unique(column)) for column in values.T])  # of one rounding error
    floor, names = rounding.variance + computed, [name for name, _ in terms]
    slow = [column for block in blocks for name, column in block if name.startswith(("drift", "sense"))]
    walks = find_walks(np.column_stack([design, *slow]), values, _walk(len(angle)), floor)
    start = names, design, blocks, values, repeats * floor
    names, fit = _selected(*start, 0.0 * walks)
    if walks.any():
        other_names, other = _selected(*start, walks)
        if other.criterion(floor) < fit.criterion(floor) - STRONG:
            names, fit = other_names, other
    noise = fit.noise + np.diag(np.maximum(0.0, floor - np.diag(fit.noise)))
    return AngleFit(
        channels, angle, values, tuple(names), fit.design, fit.coefficient, fit.estimator, fit.spread, noise, fit.dof,
        rounding, fit.walk,
    )  # fmt: skip


def _walk(count: int) -> FloatArray:
    """Return the covariance (N, N) of a random walk over the order of the readings."""
    return walk_covariance(np.arange(float(count)))


def _selected(
    names: list[str],
    design: FloatArray,
    blocks: list[list[Term]],
    values: FloatArray,
    floor: FloatArray,
    walk: FloatArray,
) -> tuple[list[str], DriftingFit]:
    """Return names and fit of the terms that enter with given random walks (C,)."""
    names, blocks = list(names), list(blocks)
    fit = DriftingFit.of(design, values, walk, _walk(len(values)))
    while (entering := _clearest(fit, blocks, values, floor)) is not None:
        block = blocks.pop(entering)
        names += [name for name, _ in block]
        design = np.column_stack([fit.design, *(column for _, column in block)])
        fit = DriftingFit.of(design, values, walk, _walk(len(values)))
    return names, fit


def turning_sense(angle_rad: FloatArray) -> FloatArray:
    """Return the sense ±1 (N,) of approach to each angle, by the shorter path."""
    step = np.angle(np.exp(1j * np.diff(angle_rad)))
    sense = np.where(np.abs(step) < SAME_ANGLE_RAD, 0.0, np.sign(step))
    for i in range(1, len(sense)):
        sense[i] = sense[i] or sense[i - 1]
    moved = sense[sense != 0.0]
    first = moved[0] if len(moved) else 0.0
    return np.concatenate([[first], np.where(sense == 0.0, first, sense)])


def _offered(angle: FloatArray) -> tuple[list[Term], list[list[Term]]]:
    """Return the terms of every fit, and blocks of further terms."""
    count = len(_distinct(np.mod(angle, 2.0 * np.pi)))
    always = [(name, _periodic(name, angle)) for name in ("offset", "cos 1", "sin 1")]
    highest = min(HIGHEST_ORDER, (count - 1) // 2)
    pairs = [(f"cos {order}", f"sin {order}") for order in range(2, highest + 1)]
    blocks = [[(name, _periodic(name, angle)) for name in pair] for pair in pairs]
    blocks.append([("drift", np.linspace(-1.0, 1.0, len(angle)))])
    sense = turning_sense(angle)
    if np.ptp(sense) > 0.0:
        blocks.append([(f"sense {name}".removesuffix(" offset"), sense * column) for name, column in always])
    return always, blocks


def _periodic(name: str, angle: FloatArray) -> FloatArray:
    """Return the column of a term that depends on the angle, else zeros."""
    kind, _, order = name.partition(" ")
    if kind in ("cos", "sin"):
        return np.asarray(getattr(np, kind)(int(order) * angle))
    return np.full(len(angle), float(name == "offset"))


def _distinct(angle: FloatArray) -> FloatArray:
    """Return the different angles within one revolution."""
    ordered = np.sort(angle)
    distinct = ordered[np.diff(ordered, prepend=-np.inf) > SAME_ANGLE_RAD]
    wraps = len(distinct) > 1 and distinct[0] + 2.0 * np.pi - distinct[-1] < SAME_ANGLE_RAD
    return np.asarray(distinct[:-1] if wraps else distinct)


def _clearest(fit: DriftingFit, blocks: list[list[Term]], values: FloatArray, floor: FloatArray) -> int | None:
    """Return the index of the most significant block, None without one."""
    least = CHANCE / max(1, len(floor))
    chances = np.ones(len(blocks))
    for walk in set(fit.walk.tolist()):
        group = np.flatnonzero(fit.walk == walk)
        root, columns = fit.roots[group[0]], [np.stack([column for _, column in block], axis=1) for block in blocks]
        if walk:
            white = [np.linalg.solve(root, each) for each in (fit.design, values[:, group], *columns)]
        else:
            white = [fit.design, values[:, group], *columns]
        chances = np.minimum(chances, _chances(white[0], white[2:], white[1], floor[group]))
    best = int(np.argmin(chances)) if len(blocks) else 0
    return best if len(blocks) and chances[best] < least else None


def _chances(design: FloatArray, blocks: list[FloatArray], values: FloatArray, floor: FloatArray) -> FloatArray:
    """Return the least chance of each block (N, B) by F tests of every channel.

    It is 1 of a block that is not separate from the design.
    """
    from scipy.special import fdtrc

    basis = np.linalg.qr(design)[0]
    left = values - basis @ (basis.T @ values)
    before = np.sum(left**2, axis=0)
    chances = np.ones(len(blocks))
    for index, columns in enumerate(blocks):
        orthogonal = columns - basis @ (basis.T @ columns)
        dof = len(design) - design.shape[1] - columns.shape[1]
        axes, size, _ = np.linalg.svd(orthogonal, full_matrices=False)
        if dof < MIN_DOF or size[-1] * LARGEST_CONDITION < np.linalg.norm(columns[:, 0]):
            continue
        gain = np.sum((axes.T @ left) ** 2, axis=0)
        noise = np.maximum((before - gain) / dof, floor)
        ratio = gain / columns.shape[1] / np.where(noise > 0.0, noise, 1.0)
        chances[index] = float(np.min(fdtrc(columns.shape[1], dof, ratio)))
    return chances
