"""Every printed number of the wrist sensor (J. Sensors 2018, 6216979) beside what the program makes of its inputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import published_wrist as paper
from numpy.typing import NDArray
from papers_rows import EXPLAINED, HOLDS, NOT, OPEN, ROUNDED, WRONG, Row
from published_formulas import rounding_range, supported_deflection
from scipy.optimize import brentq

from fusion.sensor.elastomer.element_evaluation import ComparedColumn, spread
from shaker.compensation.filter import band_ratio, single_mode
from shaker.elastomer.frame import platform_family
from shaker.elastomer.geometry import PublishedStatics, beam_stiffness, guided_stiffness
from shaker.lti.indices import Indices, Mode, indices
from shaker.mechanics import MassChain, oscillator_hz, required_stiffness
from shaker.release.record import StepRecord
from shaker.release.step_fit import fit_step
from shaker.release.step_methods import fit_sim

FloatArray = NDArray[np.float64]
POINT_M = 1e-9
"""Half-size of a platform that is a point."""


def beam_width_needed() -> float:
    """Return the side of square beams in mm for which equation 11 gives equation 12."""

    def beyond(side_m: float) -> float:
        beams = replace(paper.BEAMS, beam_width_m=side_m, beam_height_m=side_m)
        return PublishedStatics(beams).stiffness() - paper.SPRING_N_PER_M

    return 1e3 * float(brentq(beyond, 2e-3, 5e-3))


def statics() -> list[Row]:
    """Section 3.1: the stiffness of the element."""
    beams, formula = paper.BEAMS, PublishedStatics(paper.BEAMS)
    four = PublishedStatics(replace(beams, beam_width_m=4e-3)).force_ratio
    middle, end = (supported_deflection(formula, share * beams.span_m) for share in (0.5, 1.0))
    material = beams.material
    return [
        Row(
            *("G, below eq. 6", "E/(1 + μ)", "72 GPa, 0.3", f"{material.shear_modulus_pa / 1e9:.1f} GPa", WRONG),
            f"E/2(1 + μ); as printed {formula.shear_modulus_pa / 1e9:.1f} GPa. Changes k by {_shear_share():.1f} %",
        ),
        Row(
            *("eq. 3", "F·l·x²/4EI", "eqs. 1, 2", "F·x²/4EI", WRONG),
            "the printed slope is a length; signs of both lines contradict eq. 4",
        ),
        Row(
            *("eqs. 4, 5", "ω(l/2), ω(l) = 0", "Table 1", f"{1e6 * middle:.4f}, {1e6 * end:.4f} µm/N", HOLDS),
            f"eq. 5: {1e6 * formula.beam_compliance:.4f} µm/N",
        ),
        Row(
            *("eq. 6", "l_c³/24EI_c + 2l_c/KGA_c", "", "l_c³/96EI_c + l_c/2KGA_c", WRONG),
            "a cantilever of half the length; by symmetry mid-span does not turn, which is four times as stiff",
        ),
        Row(
            *(
                "eq. 10",
                "F_Q = 8F_c = 0.4F",
                "Table 1",
                f"{formula.force_ratio:.3f}F_c = {formula.beam_share:.3f}F",
                NOT,
            ),
            f"of the printed model; h = 4 mm in place of 3.8 gives {four:.3f}",
        ),
        Row(
            *("eq. 11", "l³/60EI + l/5KGA", "eqs. 5, 10", f"{1e6 / formula.stiffness():.4f} µm/N", HOLDS),
            "0.8 times eq. 5, given F_Q = 0.4F",
        ),
        Row(
            *("k, eq. 12", "1.824·10⁵ N/m", "Table 1, eq. 11", f"{formula.stiffness() / 1e5:.3f}·10⁵ N/m", NOT),
            f"{beam_width_needed():.2f} mm in place of 3.8 mm would give it; model put right "
            f"{guided_stiffness(beams) / 1e5:.2f}, frame in space, platform a point, "
            f"{beam_stiffness(beams, POINT_M).x / 1e5:.2f}·10⁵ N/m",
        ),
    ]


def _shear_share() -> float:
    """Return by how many per cent the shear modulus put right changes equation 11."""
    formula = PublishedStatics(paper.BEAMS)
    half = PublishedStatics(replace(paper.BEAMS, shear_factor=0.5 * paper.BEAMS.shear_factor))
    return 100 * (1 - half.stiffness() / formula.stiffness())


def frequencies() -> list[Row]:
    """Sections 3.2 and 4 and Table 6: natural frequencies."""
    k, mass = paper.SPRING_N_PER_M, paper.MASS_KG
    found, wanted = oscillator_hz(k, mass), required_stiffness(1642.0, mass)
    stages = ("pedestal", "sensor", "hand")
    chain = MassChain(stages, np.array([3.0, 2.0, 1.0]), np.full(3, 1e6), np.array([40.0, 20.0, 10.0]))
    damping = chain.matrices[1][::-1, ::-1]
    simple, finite = paper.MODELS["simplified dynamics"], paper.MODELS["finite elements"]
    apart = [100 * value for value in differences()]
    below = [100 * (a / b - 1) for a, b in zip(simple, finite, strict=True)]
    return [
        Row(
            *("f of Fy, eq. 17", "1642 Hz", "1.824·10⁵ N/m, 49 g", f"{found:.0f} Hz", NOT),
            f"1642 Hz needs {wanted / 1e6:.3f}·10⁶ N/m, {wanted / k:.1f} times as much, or "
            f"{1e3 * mass * k / wanted:.2f} g",
        ),
        Row(
            *("Table 2, others", "1973, 3376, 4892 Hz", "", "", OPEN),
            "neither stiffnesses nor inertias are given",
        ),
        Row(
            *("eqs. 14, 16", "-c_k, 0, -c", "c of 10, 20, 40", _matrix(damping), WRONG),
            "row 1: -c_h; row 2: -c_t in column 3; row 3: -c_t. Natural frequencies are the roots of det Z, not "
            "eigenvalues of Z",
        ),
        Row(
            *("Table 2 to Table 3", "close to", "Fx, My, Mz, Fz", _percents(below), EXPLAINED),
            "Table 2 is not what its formula gives",
        ),
        Row(
            *("Table 3", "1660, 2025, 3577, 5094 Hz", "platforms of 2 × 10, 2 × 18 mm", _platforms(), EXPLAINED),
            "either mass gives all four, each at a height and inertias of its own: the table, without the platform, "
            "confirms no model",
        ),
        Row(
            *("Table 6, differences", "4.5, 5.6, 4.0, 2.6 %", "Fx, My, Mz, Fz", _percents(apart, ".2f"), ROUNDED),
            "(largest − smallest)/largest; 5.65 % is printed as 5.6",
        ),
    ]


def _platforms() -> str:
    """Return the masses of platforms with which the frame has the frequencies of Table 3."""
    wanted = {"Tx": 1660.0, "Tz": 2025.0, "Rx": 3577.0, "Rz": 5094.0}
    fits = platform_family(paper.BEAMS, (10e-3, 18e-3), wanted)
    if max(fit.misfit for fit in fits) > 1e-4:
        raise ArithmeticError("platform_family: expected platforms that give Table 3")
    return ", ".join(f"{1e3 * fit.platform.mass_kg:.1f}" for fit in fits) + " g"


def differences() -> list[float]:
    """Return (max - min)/max of the four models of Table 6, by component."""
    columns = [
        ComparedColumn(name, "stated", np.array([*hertz, np.nan, np.nan]), np.zeros(6))
        for name, hertz in paper.MODELS.items()
    ]
    return [float(value) for value in spread(columns)[:4]]


def _percents(values: list[float], form: str = "+.1f") -> str:
    """Return numbers in per cent."""
    return ", ".join(format(value, form) for value in values) + " %"


def _matrix(values: FloatArray) -> str:
    """Return a matrix in one line."""
    return "; ".join(" ".join(f"{value:.0f}" for value in row) for row in values)


def dominant(found: Indices) -> Mode:
    """Return the dominant mode of a system that oscillates."""
    if found.dominant is None:
        raise ValueError("found: expected a system that oscillates")
    return found.dominant


def simultaneous() -> list[Row]:
    """Section 5.2: the model that SIM found, equations 19 to 21."""
    converted = paper.difference_equation().continuous("tustin")
    above, below = converted.coefficients()
    found = indices(paper.transfer_function(), sample_rate_hz=paper.RATE_HZ)
    sampled = indices(paper.difference_equation())
    mode, real = dominant(found), found.real_poles_hz[0]
    return [
        Row(
            *("eq. 20 → 21, numerator", "8.2·10⁻⁴, 4430, -5.36·10⁸, 8.532·10¹³", "Tustin, 100 kHz"),
            *(
                f"{1e4 * above[0]:.3f}·10⁻⁴, {above[1]:.1f}, {above[2] / 1e8:.3f}·10⁸, {above[3] / 1e13:.4f}·10¹³",
                HOLDS,
            ),
        ),
        Row(
            *("eq. 20 → 21, denominator", "8.643·10⁵, 5.494·10⁹, 8.587·10¹³", ""),
            *(f"{below[1] / 1e5:.4f}·10⁵, {below[2] / 1e9:.4f}·10⁹, {below[3] / 1e13:.4f}·10¹³", HOLDS),
        ),
        Row(
            *("natural frequency", "1720 Hz", "eq. 21", f"{mode.natural_hz:.0f} Hz", NOT),
            f"ζ = {mode.damping_ratio:.3f}; damped {mode.damped_hz:.0f} Hz, highest gain {found.peak_gain:.2f} at "
            f"{found.peak_hz:.0f} Hz, -90° at {found.quadrature_hz:.0f} Hz",
        ),
        Row(
            *("step", "intense oscillation", "eq. 21", f"overshoot {100 * (found.overshoot or 0.0):.0f} %", NOT),
            "a lightly damped sensor overshoots by more than 90 %",
        ),
        Row(
            *("third pole", "", "eq. 21", f"{real / 1e3:.1f} kHz", EXPLAINED),
            f"beyond half the sampling rate; in eq. 20 z = {paper.difference_equation().poles[-1].real:.3f}, which "
            "turns its sign with every sample: no motion of a sensor",
        ),
        Row(
            *("±10 %, ±5 %", "560, 414 Hz", "eq. 21"),
            *(f"{found.band_10_nominal_hz:.1f}, {found.band_5_nominal_hz:.1f} Hz", ROUNDED),
            f"of a gain of 1; of the static gain {found.static_gain:.4f} {found.band_10_hz:.1f}, "
            f"{found.band_5_hz:.1f} Hz. From eq. 20 itself {sampled.band_10_nominal_hz:.1f}, "
            f"{sampled.band_5_nominal_hz:.1f} Hz",
        ),
        _again(),
    ]


def simulated_release(ratio_db: float = 44.0) -> StepRecord:
    """Return 30 ms of a 1720 Hz mode, ζ = 0.02, after a step, at 100 kHz in white noise so far below the step."""
    system = single_mode(1720.0, 0.02).system
    time = np.arange(4000) / paper.RATE_HZ - 0.01
    noise = 10 ** (-ratio_db / 20) * np.random.default_rng(0).normal(size=len(time))
    samples = (system.step(time) + noise)[None]
    return StepRecord("simulated", ("Fx",), "V", samples, paper.RATE_HZ, "Fx", 1.0, start_s=-0.01, onset_s=0.0)


def _again() -> Row:
    """What SIM makes of a lightly damped mode."""
    record = simulated_release()
    by_equation, by_output = fit_sim(record, "Fx", order=3), fit_step(record, "Fx").model
    if by_output is None:
        raise ValueError("fit_step: expected a model of a single mode")
    mode, z = dominant(indices(by_equation.system)), by_equation.system.sampled(paper.RATE_HZ, "tustin").poles[-1].real
    return Row(
        *("how eq. 20 came about", "", "simulated 1720 Hz, ζ = 0.02, 44 dB"),
        *(f"SIM: {mode.natural_hz:.0f} Hz, ζ = {mode.damping_ratio:.2f}, z = {z:.2f}", EXPLAINED),
        "least squares on the equation error take the noise of fast samples for damping; `fit_step` on the same: "
        f"{by_output.frequency_hz[0]:.0f} Hz, ζ = {by_output.damping_ratio[0]:.3f}",
    )


def evolution() -> list[Row]:
    """Section 5.3: the models that differential evolution found, equations 22 to 26."""
    rows = []
    bands = {"Fx": "530, 395 (405) Hz", "My": "980, 678 Hz", "Mz": "1610, 1285 Hz", "Fz": "648, 466 Hz"}
    for number, name in enumerate(paper.COMPONENTS):
        found, printed = indices(paper.evolved(name)), paper.MODELS["DE"][number]
        box = rounding_range(*paper.evolved_digits(name), paper.RATE_HZ)
        mode = dominant(found)
        stable = "" if box.radius < 1 else "; some of those are unstable"
        turning = [pole.real for pole in paper.evolved(name).poles if pole.imag == 0 and pole.real < 0]
        false = f"; false pole z = {turning[0]:.3f}" if turning else ""
        rows.append(
            Row(
                *(f"f of {name}, eq. {23 + number}", f"{printed:.0f} Hz", "100 kHz", f"{mode.natural_hz:.0f} Hz", NOT),
                f"ζ = {mode.damping_ratio:.3f}{false}; the last digits permit {box.natural_hz[0]:.0f} to "
                f"{box.natural_hz[1]:.0f} Hz{stable}; {printed / mode.natural_hz * paper.RATE_HZ / 1e3:.0f} kHz needed",
            )
        )
        rows.append(
            Row(
                *(f"±10 %, ±5 % of {name}", bands[name], "", f"{found.band_10_hz:.0f}, {found.band_5_hz:.0f} Hz", NOT),
                f"of the static gain {found.static_gain:.3f}; of 1: {_band(found.band_10_nominal_hz)}, "
                f"{_band(found.band_5_nominal_hz)}",
            )
        )
    return [*rows, *_ratios()]


def _ratios() -> list[Row]:
    """Bands over natural frequencies in Tables 4 and 5."""
    ten, five = (
        [
            band / f
            for name in ("SIM", "DE")
            for band, f in zip(paper.BANDS_HZ[name][column], paper.MODELS[name], strict=True)
        ]
        for column in (0, 1)
    )
    return [
        Row(
            *("±5 % in Table 5, Fx", "405 Hz (395 in the text)", "", "", OPEN),
            "two values; the abstract says more than 400 Hz",
        ),
        Row(
            *(
                "±10 % over f, Tables 4, 5",
                f"{min(ten):.3f} to {max(ten):.3f}",
                "ζ → 0",
                f"{band_ratio(1e-6, 0.1):.4f}",
            ),
            *(EXPLAINED, "of an oscillator; the tables agree with it, roughly, and not with eqs. 23 to 26"),
        ),
        Row(
            *(
                "±5 % over f, Tables 4, 5",
                f"{min(five):.3f} to {max(five):.3f}",
                "ζ → 0",
                f"{band_ratio(1e-6, 0.05):.4f}",
            ),
            EXPLAINED,
        ),
    ]


def _band(value: float | None) -> str:
    """Return a band's end, or that there is none."""
    return "none" if value is None else f"{value:.0f} Hz"
