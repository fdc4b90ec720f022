"""Frozen inputs and reference results of `shakercal validate`, by closed form, mpmath and SciPy's linear programming.

Nothing here imports the program. `python benchmarks/validation_references.py FILE` writes them; mpmath 1.3 with 50
digits made those of the package (`fusion/planning/validation/references.json`).
"""

from __future__ import annotations

import base64
import json
import math
import random
import sys
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mpmath as mp
import scipy
from scipy.optimize import linprog

DIGITS = 50
MPMATH = f"mpmath {mp.__version__}, {DIGITS} digits"
Case = dict[str, Any]


def expected(value: float, tolerance: float, unit: str) -> dict[str, Any]:
    return {"value": float(value), "tolerance": float(tolerance), "unit": unit}


def relative(value: Any, share: float, unit: str) -> dict[str, Any]:
    return expected(value, abs(float(value)) * share, unit)


def sines() -> Case:
    """Least squares of offset and two lines beyond the Nyquist rate, normal equations in 50 digits."""
    rng = random.Random(1)
    time = [(n + rng.uniform(-0.2, 0.2)) / 21.3 for n in range(120)]
    lines = [80.0, 133.7]
    true = [(2e-6, 0.5), (4e-7, -1.1)]
    samples = [
        sum(a * math.cos(2 * math.pi * f * t + p) for f, (a, p) in zip(lines, true, strict=True))
        + 3e-7
        + rng.gauss(0.0, 1e-8)
        for t in time
    ]
    rows = [[mp.mpf(1)] + [g(2 * mp.pi * f * mp.mpf(t)) for f in lines for g in (mp.cos, mp.sin)] for t in time]
    design, data = mp.matrix(rows), mp.matrix(samples)
    normal = design.T * design
    found = mp.lu_solve(normal, design.T * data)
    rest = data - design * found
    variance = (rest.T * rest)[0] / (len(time) - 5) * mp.inverse(normal)[1, 1]
    quantities = {"offset": relative(found[0], 1e-9, "m"), "u_re 80 Hz": relative(mp.sqrt(variance), 1e-6, "m")}
    for place, f in enumerate(lines):
        re, im = found[1 + 2 * place], -found[2 + 2 * place]
        size = mp.sqrt(re**2 + im**2)
        quantities |= {
            f"re {f:g} Hz": expected(re, size * mp.mpf("1e-10"), "m"),
            f"im {f:g} Hz": expected(im, size * mp.mpf("1e-10"), "m"),
            f"acceleration {f:g} Hz": relative((2 * mp.pi * f) ** 2 * size, 1e-9, "m/s^2"),
        }
    inputs = {"time_s": time, "samples_m": samples, "frequency_hz": lines}
    return case("sine approximation below the Nyquist rate", MPMATH, inputs, quantities)


def trigger() -> Case:
    """All start times and periods that agree with every sampling interval: bounds by linear programming."""
    rate, start, period, count = 10_000.0, 0.012345, 1.0 / 21.3, 43
    edges = [start + n * period for n in range(count)]
    samples = [float(any(0.0 <= n / rate - edge < 2e-3 for edge in edges)) for n in range(20_500)]
    after = [math.ceil(edge * rate) for edge in edges]
    rows = [[s, s * n] for n in range(count) for s in (1.0, -1.0)]
    limits = [bound for a in after for bound in (a / rate, -(a - 1) / rate)]

    def bound(cost: Sequence[float]) -> float:
        found = linprog(cost, A_ub=rows, b_ub=limits, bounds=[(None, None)] * 2, method="highs")
        return float(sum(c * x for c, x in zip(cost, found.x, strict=True)))

    quantities = {"edges": expected(count, 0.0, "1")}
    for name, low, high in (
        ("start", bound([1.0, 0.0]), -bound([-1.0, 0.0])),
        ("period", bound([0.0, 1.0]), -bound([0.0, -1.0])),
    ):
        quantities[name] = expected((low + high) / 2.0, (high - low) / 2.0, "s")
    packed = base64.b64encode(zlib.compress(bytes(int(v) for v in samples), 9)).decode()
    inputs = {"samples": packed, "sample_rate_hz": rate}
    return case("trigger of a camera", f"SciPy {scipy.__version__}, linear programme (HiGHS)", inputs, quantities)


def frames() -> Case:
    """Two frames of a speckle pattern of Gaussian dots: a closed form, displaced by an affine map."""
    rng = random.Random(2)
    side, u, v, strain, shear = 96, 0.37, -0.21, 2e-3, -1e-3
    dots = [(rng.uniform(-4, side + 4), rng.uniform(-4, side + 4), rng.uniform(2.0, 2.6)) for _ in range(420)]
    middle = (side - 1) / 2.0

    def grey(x: float, y: float) -> float:
        near = [(x - a, y - b, s) for a, b, s in dots if abs(x - a) < 6 * s and abs(y - b) < 6 * s]
        return 6000.0 + 9000.0 * sum(math.exp(-(dx * dx + dy * dy) / (2 * s * s)) for dx, dy, s in near)

    def before(x: float, y: float) -> tuple[float, float]:
        """Return where a point came from: x' = x + u + strain (x - m) + shear (y - m), y' = y + v."""
        old = y - v
        return (x - u - shear * (old - middle) + strain * middle) / (1.0 + strain), old

    first = [[round(grey(x, y)) for x in range(side)] for y in range(side)]
    second = [[round(grey(*before(x, y))) for x in range(side)] for y in range(side)]
    centres = [[x, y] for y in (24.0, 48.0, 71.5) for x in (24.0, 48.0, 71.5)]
    quantities: dict[str, Any] = {}
    for place, (x, y) in enumerate(centres, 1):
        along = u + strain * (x - middle) + shear * (y - middle)
        quantities |= {
            f"u of subset {place}": expected(along, 3e-4, "px"),
            f"v of subset {place}": expected(v, 3e-4, "px"),
        }
    text = {"first": packed(first), "second": packed(second), "side": side, "centre_px": centres, "radius_px": 14}
    return case("registration of two frames", "closed form (Gaussian dots, affine map)", text, quantities)


def packed(image: list[list[int]]) -> str:
    """Return grey values as text: 16 bit little-endian, row by row, zlib, base64."""
    return base64.b64encode(zlib.compress(b"".join(g.to_bytes(2, "little") for row in image for g in row), 9)).decode()


def cameras() -> Case:
    """Points projected into two cameras with lens distortion (Brown 1971), in 50 digits, and triangulated."""
    left = [1800.0, 1810.0, 640.0, 512.0, -0.11, 0.08, 4e-4, -3e-4, 0.01]
    right = [1790.0, 1795.0, 630.0, 520.0, -0.10, 0.06, -2e-4, 5e-4, 0.0]
    angle, shift = mp.mpf("0.3"), [mp.mpf("-0.12"), mp.mpf("0.004"), mp.mpf("0.02")]
    turn = [[mp.cos(angle), 0, mp.sin(angle)], [0, 1, 0], [-mp.sin(angle), 0, mp.cos(angle)]]
    points = [[0.01, -0.02, 0.4], [-0.03, 0.015, 0.42], [0.05, 0.03, 0.38], [0.0, 0.0, 0.4]]

    def project(point: Sequence[Any], camera: Sequence[float]) -> list[float]:
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = map(mp.mpf, camera)
        x, y = point[0] / point[2], point[1] / point[2]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        return [
            float(fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx),
            float(fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy),
        ]

    seen_left = [project([mp.mpf(c) for c in point], left) for point in points]
    seen_right = [
        project(
            [sum(row[i] * mp.mpf(point[i]) for i in range(3)) + t for row, t in zip(turn, shift, strict=True)], right
        )
        for point in points
    ]
    quantities = {}
    for place, point in enumerate(points, 1):
        for axis, value, pixel in zip("xyz", point, [*seen_left[place - 1], None], strict=True):
            quantities[f"{axis} of point {place}"] = expected(value, 1e-12, "m")
            if pixel is not None:
                quantities[f"left {axis} of point {place}"] = expected(pixel, 1e-9, "px")
    inputs = {
        "left": left, "right": right, "rotation": [[float(v) for v in row] for row in turn],
        "translation_m": [float(v) for v in shift], "point_m": points, "left_px": seen_left, "right_px": seen_right,
    }  # fmt: skip
    return case("projection and triangulation", MPMATH, inputs, quantities)


def step() -> Case:
    """A damped oscillation after a load is taken off, and the figures of its system by closed form."""
    rng = random.Random(3)
    frequency, damping, rate, count, load, gain = 310.0, 0.02, 10_000.0, 4000, -20.0, 0.1
    omega = 2 * math.pi * frequency
    damped = omega * math.sqrt(1 - damping**2)
    samples = []
    for n in range(count):
        t = n / rate - 0.05
        rest = math.exp(-damping * omega * t) * (
            math.cos(damped * t) + damping / math.sqrt(1 - damping**2) * math.sin(damped * t)
        )
        samples.append((-gain * load) * (1.0 if t < 0 else rest) + rng.gauss(0.0, 1e-3))
    z, w = mp.mpf(damping), mp.mpf(2) * mp.pi * frequency
    root = mp.sqrt(1 - z**2)
    band = frequency * mp.sqrt(1 - 2 * z**2 - mp.sqrt((1 - 2 * z**2) ** 2 - 1 + 1 / mp.mpf("1.05") ** 2))
    quantities = {
        "frequency of the record": relative(frequency, 1e-4, "Hz"),
        "damping ratio of the record": relative(damping, 1e-2, "1"),
        "overshoot": relative(mp.exp(-mp.pi * z / root), 1e-9, "1"),
        "peak gain": relative(1 / (2 * z * root), 1e-9, "1"),
        "frequency of the peak": relative(frequency * mp.sqrt(1 - 2 * z**2), 1e-9, "Hz"),
        "5 % band": relative(band, 1e-9, "Hz"),
        "natural frequency": relative(w / (2 * mp.pi), 1e-12, "Hz"),
    }
    inputs = {
        "samples": samples, "sample_rate_hz": rate, "amplitude_n": load, "damping": damping, "frequency_hz": frequency,
    }  # fmt: skip
    return case("step response", f"closed form ({MPMATH}); frequency and damping as put in", inputs, quantities)


def rotation() -> Case:
    """A weight with a lever arm turned in gravity on a sensor with cross-talk: statics in closed form."""
    rng = random.Random(4)
    weight, centre = 49.05, (0.004, -0.003, 0.031)
    outputs = [[(1.0 if i == j else 0.0) + rng.uniform(-0.02, 0.02) for j in range(6)] for i in range(6)]
    # Turned about y with gravity along -z at zero angle, U = d + j n x d: forces W U, moments r x W U.
    turning = (complex(0, -1.0), complex(0), complex(-1.0))
    force = [weight * c for c in turning]
    moment = [
        centre[1] * force[2] - centre[2] * force[1],
        centre[2] * force[0] - centre[0] * force[2],
        centre[0] * force[1] - centre[1] * force[0],
    ]
    load = [mp.mpc(c) for c in (*force, *moment)]
    amplitude = [sum(mp.mpf(s) * c for s, c in zip(row, load, strict=True)) for row in outputs]
    inputs = {
        "sensitivity": outputs, "amplitude_re": [float(a.real) for a in amplitude],
        "amplitude_im": [float(a.imag) for a in amplitude], "variance": 1e-8,
    }  # fmt: skip
    quantities = {"weight": relative(weight, 1e-7, "N")}
    quantities |= {
        f"first moment {axis}": expected(weight * c, 1e-6, "N.m") for axis, c in zip("xyz", centre, strict=True)
    }
    return case("rotation in gravity", "statics in closed form", inputs, quantities)


def matrix() -> Case:
    """Eight recordings of known loads: rows of the 6x6 matrix by complex least squares in 50 digits."""
    rng = random.Random(5)
    true = [[(1.0 if i == j else rng.uniform(-0.02, 0.02)) * 5e-7 for j in range(6)] for i in range(6)]
    loads = [[complex(rng.gauss(0, 100), rng.gauss(0, 100)) for _ in range(6)] for _ in range(8)]
    outputs = [
        [
            sum(s * c for s, c in zip(row, load, strict=True)) * (1 - 0.01j)
            + complex(rng.gauss(0, 1e-9), rng.gauss(0, 1e-9))
            for row in true
        ]
        for load in loads
    ]
    design = mp.matrix([[mp.mpc(c) for c in load] for load in loads])
    normal = design.H * design
    quantities = {}
    for i, channel in enumerate(("Fx", "Fy", "Fz", "Mx", "My", "Mz")):
        found = mp.lu_solve(normal, design.H * mp.matrix([mp.mpc(row[i]) for row in outputs]))
        for j in (i, (i + 1) % 6):
            component = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")[j]
            for part, value in (("re", found[j].real), ("im", found[j].imag)):
                quantities[f"{part} {channel}/{component}"] = expected(value, 5e-7 * 1e-7, "V/V per load")
    inputs = {
        "load_re": [[c.real for c in row] for row in loads], "load_im": [[c.imag for c in row] for row in loads],
        "output_re": [[c.real for c in row] for row in outputs],
        "output_im": [[c.imag for c in row] for row in outputs],
        "u_output": 1e-9,
    }  # fmt: skip
    return case("6x6 matrix from eight recordings", MPMATH, inputs, quantities)


def certificate() -> Case:
    """What a certificate states: coverage factors, magnitude and phase with U, rounding, and the same in its XML."""
    quantities = {}
    degrees = [3.0, 10.0, 57.5]
    for dof in degrees:
        nu = mp.mpf(dof)

        def tail(t: Any, nu: Any = nu) -> Any:
            return mp.betainc(nu / 2, mp.mpf("0.5"), 0, nu / (nu + t**2), regularized=True) - mp.mpf("0.05")

        quantities[f"k of {dof:g} degrees of freedom"] = relative(mp.findroot(tail, 2), 1e-10, "1")
        below = mp.mpf("0.05") ** (-2 / nu) - 1  # closed quantile of F(2, nu), times 2
        quantities[f"region factor of {dof:g}"] = relative(mp.sqrt(nu * below), 1e-10, "1")
    quantities["k of infinite degrees of freedom"] = relative(mp.sqrt(2) * mp.erfinv(mp.mpf("0.95")), 1e-10, "1")
    re, im, var_re, var_im, mixed = (mp.mpf(v) for v in (5.1e-7, -7.2e-9, 1.1e-19, 1.0e-20, 3.0e-21))
    size2 = re**2 + im**2
    along = (re**2 * var_re + im**2 * var_im + 2 * re * im * mixed) / size2
    across = (im**2 * var_re + re**2 * var_im - 2 * re * im * mixed) / size2
    quantities |= {
        "magnitude": relative(mp.sqrt(size2), 1e-12, "(V/V)/N"),
        "phase": relative(mp.atan2(im, re), 1e-10, "rad"),
        "u of the magnitude": relative(mp.sqrt(along), 1e-10, "(V/V)/N"),
        "u of the phase": relative(mp.sqrt(across / size2), 1e-10, "rad"),
    }
    inputs: dict[str, Any] = {
        "dof": degrees, "value": [float(re), float(im)],
        "covariance": [[float(var_re), float(mixed)], [float(mixed), float(var_im)]],
        "rounding": [[80.00019, 0.0034, "(80.0002 ± 0.0034)"], [-3.1204, 0.0734, "(−3.120 ± 0.073)"],
                     [1234.4, 56.0, "(1234 ± 56)"]],
        "mass": [0.7689, 2.9e-4],
    }  # fmt: skip
    k, (kg, u_kg) = mp.sqrt(2) * mp.erfinv(mp.mpf("0.95")), (mp.mpf(v) for v in inputs["mass"])
    sensitivity, squared = "(V/V)/N", "((V/V)/N)^2"
    in_xml = {
        "frequency": (80, "Hz"), "magnitude": (mp.sqrt(size2), sensitivity),
        "U of the magnitude": (k * mp.sqrt(along), sensitivity), "k": (k, "1"), "phase": (mp.atan2(im, re), "rad"),
        "U of the phase": (k * mp.sqrt(across / size2), "rad"), "real part": (re, sensitivity),
        "imaginary part": (im, sensitivity), "variance, re": (var_re, squared), "covariance": (mixed, squared),
        "covariance again": (mixed, squared), "variance, im": (var_im, squared),
        "factor": (mp.sqrt(-2 * mp.log(mp.mpf("0.05"))), "1"), "mass": (kg, "kg"), "U of the mass": (k * u_kg, "kg"),
    }  # fmt: skip
    quantities |= {f"XML: {name}": relative(mp.mpf(value), 1e-9, unit) for name, (value, unit) in in_xml.items()}
    quantities["texts rounded as JCGM 100, 7.2.6 asks"] = expected(3, 0, "1")
    return case("figures of a certificate", MPMATH, inputs, quantities)


def case(what: str, source: str, inputs: dict[str, Any], quantities: dict[str, Any]) -> Case:
    return {"what": what, "source": source, "inputs": inputs, "expected": quantities}


CASES: dict[str, Callable[[], Case]] = {
    made.__name__: made for made in (sines, trigger, frames, cameras, step, rotation, matrix, certificate)
}


def references() -> dict[str, Case]:
    """Return every case by its name."""
    with mp.workdps(DIGITS):
        return {name: make() for name, make in CASES.items()}


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(references(), indent=1) + "\n", encoding="utf-8")
