"""Every printed number of Nitsche, Kumme and Tutsch (2018) beside what the program makes of its inputs."""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

import numpy as np
import published_paper as paper
from numpy.typing import NDArray
from published_formulas import (
    damping_from_phase,
    damping_from_sensitivity,
    damping_from_width,
    relative_sensitivity,
    sensitivity_phase_rad,
    width_from_damping,
)
from scipy.optimize import least_squares

from shaker.identification.measured_curves import MeasuredCurve
from shaker.identification.oscillator import PeakReadings, peak_readings
from shaker.identification.sensor import ChainModel
from shaker.mechanics import MassChain, required_stiffness, shared_spring
from shaker.sine.phasor import derivative_factor
from shaker.static_rotation.harmonics import fit_angles
from shaker.static_rotation.masses import mass_of_weight

FloatArray = NDArray[np.float64]
HOLDS, ROUNDED, NOT = "reproduced", "within rounding", "not reproduced"
WRONG, EXPLAINED = "wrong as printed", "explained"
OPEN = "cannot be checked"
AIR_OVER_STEEL = 1.2 / 8000.0


class Row(NamedTuple):
    """One printed number beside what the program makes of its inputs."""

    where: str
    published: str
    inputs: str
    program: str
    verdict: str
    remark: str = ""


def acceleration(frequency_hz: float, amplitude_m: float) -> float:
    """Return the amplitude of the second derivative in m/s² (equation 6)."""
    return float(abs(derivative_factor(np.array([frequency_hz]), 2)[0]) * amplitude_m)


def motion() -> list[Row]:
    """Section 3.3: sine approximation of displacements and its acceleration."""
    first, second = (acceleration(f, s) for f, s in zip(paper.CAMERA_HZ, paper.CAMERA_M, strict=True))
    least, most = (acceleration(paper.CAMERA_HZ[1], s) for s in (3.95e-6, 4.05e-6))
    seen_m = paper.VIBROMETER_MPS2[1] / acceleration(paper.VIBROMETER_HZ[1], 1.0)
    beat = [f - round(f / paper.CAMERA_RATE_HZ) * paper.CAMERA_RATE_HZ for f in (106.25, 212.5, 318.75, 425.0)]
    pictures, length_s = paper.FRAMES - 1, (paper.FRAMES - 1) / paper.CAMERA_RATE_HZ
    u_amplitude = paper.RESIDUAL_M[1] * sqrt(2 / pictures)
    u_frequency = sqrt(6 / pictures) * paper.RESIDUAL_M[1] / (pi * length_s * paper.CAMERA_M[1])
    off_hz = paper.CAMERA_HZ[1] - 425.0
    gained = sqrt(paper.RESIDUAL_M[0] ** 2 - paper.RESIDUAL_M[1] ** 2)
    late = paper.VIBROMETER_RAD[0] - paper.CAMERA_RAD[0]
    deviation = 100 * (first / paper.VIBROMETER_MPS2[0] - 1)
    return [
        Row("a₁, eq. 6", "-190.6131 m/s²", "0.4277 mm, 106.2495 Hz", f"-{first:.4f} m/s²", HOLDS),
        Row("cameras to vibrometer", "0.68 %", "189.3217 m/s²", f"{deviation:.4f} %", HOLDS),
        Row(
            *("a₂, eq. 6", "28.5161 m/s²", "-0.0040 mm, 424.9472 Hz", f"{second:.4f} m/s²", HOLDS),
            f"two digits of s: anything from {least:.2f} to {most:.2f}",
        ),
        Row(
            *("motion at 425 Hz", "4.0 µm", "0.9596 m/s² of the vibrometer", f"{1e6 * seen_m:.3f} µm", EXPLAINED),
            f"the cameras' 4.0 µm are {paper.CAMERA_M[1] / seen_m:.0f} times too large and "
            f"{paper.CAMERA_M[1] / u_amplitude:.0f} standard deviations of the fit: not the harmonic",
        ),
        Row(
            *("frequency of component 2", "424.9472 Hz", "residual 2.3 µm, 3.97 s", f"{off_hz:+.4f} Hz", EXPLAINED),
            f"from 425 Hz, {abs(off_hz) / u_frequency:.1f} standard deviations: a motion of 1.96 to 2.01 Hz in the "
            f"cameras' data, where 425 Hz aliases to {beat[3]:.3f} Hz",
        ),
        Row("beat", "0.502 Hz", "106.25 Hz, 52.874 Hz", f"{beat[0]:.3f} Hz", HOLDS),
        Row(
            *("residual with a second sine", "3.6 → 2.3 µm", "4.0 µm", f"{1e6 * gained:.2f} µm taken off", HOLDS),
            f"4.0/√2 = {4 / sqrt(2):.2f} µm",
        ),
        Row("210 displacements", "3.97 s", "52.874 Hz", f"{length_s:.4f} s", HOLDS),
        Row(
            *("phases of Table 1", "0.369, 0.208 rad", "106.25 Hz", f"{1e3 * late / (2 * pi * 106.25):.3f} ms", NOT),
            f"{late:.3f} rad apart, modulo the sign of z: a delay that is not discussed",
        ),
    ]


def turned(x: float, y: float) -> FloatArray:
    """Return the amplitudes (2,) in N that `fit_angles` finds in readings every 22.5 degrees."""
    angle = np.deg2rad(22.5 * np.arange(16))
    readings = np.round(np.stack([x * np.sin(angle), y * np.cos(angle)], axis=1), 6)
    return np.asarray(np.abs(fit_angles(("Fx", "Fy"), angle, readings).amplitude()))


def masses_of(weights_n: FloatArray, gravity: float = paper.GRAVITY, air_share: float = 0.0) -> FloatArray:
    """Return the masses (2,) in kg of weights (equation 7)."""
    return np.array([mass_of_weight(float(weight), gravity, air_share) for weight in weights_n])


def rotation() -> list[Row]:
    """Section 5.1: internal mass and load mass from the rotation test."""
    own, both = turned(7.558, 7.532), turned(75.877, 75.736)
    internal, load = masses_of(own), masses_of(both - own)
    off = 100 * (load / paper.WEIGHED_KG - 1)
    rough = masses_of(both - own, 9.81)
    floating = 100 * (masses_of(both - own, air_share=AIR_OVER_STEEL) / paper.WEIGHED_KG - 1)
    apart = 100 * (1 - internal[1] / internal[0])
    return [
        Row("m₁ of x and y, eq. 7", "0.770, 0.768 kg", "7.558, 7.532 N", _pair(internal, ".4f", "kg"), HOLDS),
        Row("m₁, x to y", "0.3 %", "", f"{apart:.2f} %", HOLDS, "0.26 % of the rounded masses"),
        Row(
            *("m_L of x and y, eq. 7", "6.962, 6.951 kg", "75.877, 75.736 N", _pair(load, ".4f", "kg"), HOLDS),
            f"amplitudes less those without load, at 9.8125 m/s² (Braunschweig; not stated); at 9.81 "
            f"{_pair(rough, '.4f', 'kg')}",
        ),
        Row(
            *("to the weighed mass", "+0.028, -0.139 %", "6.9605 kg", _pair(off, "+.4f", "%"), ROUNDED),
            f"{(off[0] - off[1]) / (100 * 0.0010 / paper.WEIGHED_KG):.0f} times the stated ±0.0010 kg apart",
        ),
        Row(
            *("air buoyancy", "left out", "1.2 and 8000 kg/m³", _pair(floating, "+.3f", "%"), EXPLAINED),
            "from the weighed mass, if that is a true mass; the program corrects it",
        ),
    ]


def _pair(values: FloatArray, form: str, unit: str) -> str:
    """Return two numbers and their unit."""
    return f"{', '.join(format(value, form) for value in values)} {unit}"


def oscillator(f0: float, zeta: float, shift: float = 0.0, noise: float = 1e-5) -> PeakReadings:
    """Return the readings of an exact oscillator at lines of 0.78125 Hz, the nearest `shift` lines from f₀."""
    spacing = paper.LINE_HZ
    count = int(max(12.0, 5.0 * zeta * f0 / spacing))
    frequency = np.asarray(f0 + spacing * (np.arange(-count, count + 1) + shift), dtype=np.float64)
    r = frequency / f0
    value = (1 + 2j * zeta * r) / (1 - r**2 + 2j * zeta * r)
    covariance = (noise * np.abs(value).max()) ** 2 * np.eye(2) * np.ones((len(r), 1, 1))
    return peak_readings(MeasuredCurve(frequency, value, covariance))


def both_loads(resonance_hz: tuple[float, float]) -> tuple[float, float, float, float]:
    """Return k, its U, m_i and its U (95 %) of two resonances that are uncertain by half a line (equal density)."""
    loads, hertz = np.array(paper.LOADS_KG), np.array(resonance_hz)
    k, mass = shared_spring(hertz, loads)
    step = 1e-3 * np.eye(2)
    slope = np.array([np.subtract(shared_spring(hertz + d, loads), (k, mass)) for d in step]) / 1e-3
    expanded = 2.0 * paper.LINE_HZ / sqrt(12) * np.sqrt(np.sum(slope**2, axis=0))
    return k, float(expanded[0]), mass, float(expanded[1])


def resonance() -> list[Row]:
    """Section 5.2: spring and damping coefficient of Fz."""
    masses = np.array(paper.LOADS_KG) + paper.INTERNAL_KG
    k = np.array([required_stiffness(f, m) for f, m in zip(paper.RESONANCE_HZ, masses, strict=True)])
    quality = np.sqrt(k * masses) / paper.DAMPING_KG_PER_S
    width = [width_from_damping(b, m) for b, m in zip(paper.DAMPING_KG_PER_S, masses, strict=True)]
    read = [oscillator(f, 0.5 / q) for f, q in zip(paper.RESONANCE_HZ, quality, strict=True)]
    over = np.array([r.half_amplitude.damping_ratio / r.half_power.damping_ratio for r in read])
    lower = [damping_from_width(w, m, "half_amplitude") for w, m in zip(width, masses, strict=True)]
    lines = [f / paper.LINE_HZ for f in paper.RESONANCE_HZ]
    shared = both_loads(paper.RESONANCE_HZ)
    kg = "4.236, 8.798 and 0.769 kg"
    return [
        Row("k of Fz, eq. 9", "4.313, 4.512·10⁸ N/m", kg, _pair(k / 1e8, ".4f", "10⁸ N/m"), HOLDS),
        Row("k by load", "4.4 %", "", f"{100 * (1 - k[0] / k[1]):.2f} %", HOLDS, "of the larger"),
        Row(
            *(
                "one k for both loads",
                "",
                "1477.35, 1092.97 Hz",
                f"({shared[0] / 1e8:.3f} ± {shared[1] / 1e8:.3f})·10⁸ N/m",
            ),
            *(
                EXPLAINED,
                f"and m_i = {shared[2]:.3f} ± {shared[3]:.3f} kg: 0.51 kg more than weighed, which the mass of the "
                "adapting elements m_a, part of m in Sect. 2 and not in eq. 9, would be",
            ),
        ),
        Row(
            *(
                "line of the maximum",
                "not stated",
                "51.2 kHz / 65536",
                f"{lines[0]:.2f}, {lines[1]:.2f} lines",
                EXPLAINED,
            ),
            f"every printed resonance is a whole number of {paper.LINE_HZ} Hz: "
            f"±{100 * paper.LINE_HZ / paper.RESONANCE_HZ[0]:.2f} % of k; see the last table",
        ),
        Row(
            *(
                "eq. 10, width",
                "at half the amplitude",
                "b = 699.18, 1566.01 kg/s",
                _pair(over, ".3f", "times b"),
                WRONG,
            ),
            "f₀/Δf = √(km)/b holds for the width at 1/√2 of the amplitude; at half of it Δf is √3 as wide",
        ),
        Row(
            *("b, eq. 10", "699.18, 1566.01 kg/s", "k, m", _pair(np.array(width), ".2f", "Hz"), EXPLAINED),
            f"the widths that give b (not printed), Q = {_pair(quality, '.2f', '')[:-1]}; if they were read at half "
            f"the amplitude, b = {_pair(np.array(lower), '.1f', 'kg/s')}",
        ),
    ]


def table_2() -> list[Row]:
    """Table 2 and figure 13: excitation in x and y."""
    k = np.array([[required_stiffness(f, m + paper.INTERNAL_KG) for f in hertz] for m, hertz, _, _ in paper.TABLE_2])
    width = [[width_from_damping(b, m + paper.INTERNAL_KG) for b in damping] for m, _, _, damping in paper.TABLE_2]
    rows = []
    for row, (load, hertz, stated, damping) in enumerate(paper.TABLE_2):
        printed, found = (
            ", ".join(f"{value / 1e8:{digits}}" for value in values) + "·10⁸ N/m"
            for values, digits in ((stated, ".3f"), (k[row], ".4f"))
        )
        lines = ", ".join(f"{value / paper.LINE_HZ:.1f}" for value in width[row])
        coefficients = ", ".join(f"{value}" for value in damping)
        rows.append(
            Row(
                *(f"k of f1x, f1y, f2x, f2y, {load} kg", printed, f"{', '.join(map(str, hertz))} Hz", found, HOLDS),
                f"b = {coefficients} kg/s are widths of {lines} lines",
            )
        )
    sides = 100 * np.abs(k[:, ::2] / k[:, 1::2] - 1).ravel()
    loads = 100 * (1 - k.min(axis=0) / k.max(axis=0))
    upper = [both_loads((paper.TABLE_2[0][1][c], paper.TABLE_2[1][1][c])) for c in (0, 1)]
    low = [both_loads((paper.TABLE_2[0][1][c], paper.TABLE_2[1][1][c])) for c in (2, 3)]
    return [
        *rows,
        Row("k of x and y, one load", "below 0.5 %", "", ", ".join(f"{s:.2f}" for s in sides) + " %", ROUNDED),
        Row(
            "k by load, x and y", "up to 15 %", "", ", ".join(f"{s:.1f}" for s in loads) + " %", HOLDS, "of the larger"
        ),
        Row(
            *(
                "one k for both loads, upper peaks",
                "",
                "f1x, f1y",
                ", ".join(f"{u[0] / 1e8:.3f}" for u in upper) + "·10⁸ N/m",
            ),
            *(EXPLAINED, f"and m_i = {', '.join(f'{u[2]:.3f}' for u in upper)} kg (± {upper[0][3]:.3f} kg)"),
        ),
        Row(
            *(
                "one k for both loads, lower peaks",
                "",
                "f2x, f2y",
                "m_i = " + ", ".join(f"{u[2]:.2f}" for u in low) + " kg",
            ),
            *(NOT, "a negative m_i: not the motion of one mass on one spring"),
        ),
        Row(
            *("Fig. 13, two peaks", "a second spring below", "any chain, acceleration over adapter", "one peak", NOT),
            "a ratio to the adapter is independent of springs below it: the second peak is pitching, or the adapter "
            "was not measured at the sensor's foot",
        ),
        Row(
            *("a chain for the four frequencies", "", "m_i = 0.769 kg", f"±{100 * chain_misfit():.1f} %", NOT),
            "largest deviation of the best chain base–adapter–sensor from f1x and f2x of both loads",
        ),
    ]


def chain_misfit() -> float:
    """Return the largest relative deviation that a chain base–adapter–sensor leaves of the four frequencies in x."""
    wanted = [np.sort([hertz[0], hertz[2]]) for _, hertz, _, _ in paper.TABLE_2]

    def deviations(log_values: FloatArray) -> FloatArray:
        k_adapter, k, m_adapter = np.exp(log_values)
        found = []
        for load, frequency in zip(paper.LOADS_KG, wanted, strict=True):
            mass = np.array([m_adapter, load + paper.INTERNAL_KG])
            chain = MassChain(("adapter", "sensor"), mass, np.array([k_adapter, k]), np.zeros(2))
            found.append(np.log(chain.modes()[0] / frequency))
        return np.concatenate(found)

    starts = [np.log([k_adapter, 5e8, m]) for k_adapter in (3e7, 3e8) for m in (1.0, 5.0)]
    best = min((least_squares(deviations, start) for start in starts), key=lambda fit: float(fit.cost))
    return float(np.abs(best.fun).max())


def sensitivity() -> list[Row]:
    """Section 5.3: sensitivity and phase over frequency."""
    k = [required_stiffness(f, m + paper.INTERNAL_KG) for f, m in zip(paper.RESONANCE_HZ, paper.LOADS_KG, strict=True)]
    at_1000, at_800 = np.array([1000.0]), np.array([800.0])
    springs = list(zip(k, paper.DAMPING_KG_PER_S, strict=True))
    size = np.array([100 * relative_sensitivity(at_1000, *spring)[0] for spring in springs])
    turn = np.array([sensitivity_phase_rad(at_800, *spring, "series")[0] for spring in springs])
    needed = damping_from_sensitivity(0.953, 1000.0, k[0]), damping_from_phase(-0.25, 800.0, k[0], "series")
    times = needed[0] / paper.DAMPING_KG_PER_S[0]
    zeta = needed[0] / (2 * sqrt(k[0] * (paper.LOADS_KG[0] + paper.INTERNAL_KG)))
    lag = ChainModel("lag", np.array([paper.LAG_S])).response(np.array([800.0, 1000.0]))
    left_out = 100 * paper.INTERNAL_KG / np.array(paper.LOADS_KG)
    return [
        Row(
            *("S at 1000 Hz, eq. 1", "95.3 % (measured)", "k, b of either load", _pair(size, ".3f", "%"), NOT),
            "exact form and series differ by less than 10⁻⁷",
        ),
        Row("phase at 800 Hz, eq. 2", "-0.25 rad (measured)", "the same", _pair(turn, ".4f", "rad"), NOT),
        Row(
            *("b that eqs. 1, 2 need", "699.18 kg/s", "95.3 %; -0.25 rad", _pair(np.array(needed), ".0f", "kg/s"), NOT),
            f"{times:.0f} times that of the resonance; with it ζ = {zeta:.2f} and no peak of Q = 66",
        ),
        Row(
            *(
                "a lag of 50 µs in the chain",
                "",
                "50 µs",
                f"{100 * abs(lag[1]):.1f} %, {np.angle(lag[0]):.3f} rad",
                EXPLAINED,
            ),
            "amplifier, filter or synchronisation, not the sensor; the printed phase stays at -0.25 rad to 1000 Hz, "
            f"a lag alone goes on to {np.angle(lag[1]):.2f} rad",
        ),
        Row(
            *("m in eq. 11", "top mass", "0.769 kg", _pair(left_out, ".1f", "%"), WRONG),
            "the force in the spring accelerates the internal mass too (Sect. 2); S is too large by its share",
        ),
        Row("frequencies", "375.9, 1020.3 Hz", "53.7 Hz", f"{375.9 / 53.7:.0f}, {1020.3 / 53.7:.0f} times", HOLDS),
    ]
