"""A cross-beam element as it is drawn, and the sensor made of it, whose dimensions are off by their tolerances."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.models_file import MODELS_FILE, ModelEntry, ModelsFile, models_text
from fusion.simulate.draws import Draws
from fusion.simulate.toml_text import to_toml
from shaker.models.elastomer.element import solve_frame
from shaker.models.elastomer.geometry import CrossBeams, Material
from shaker.models.elastomer.modes import NAMES
from shaker.models.elastomer.platform import block
from shaker.models.modal import ModalModel

GEOMETRY_FILE, TRUTH_FILE = "elastomer.toml", "truth.json"
WRITTEN = (GEOMETRY_FILE, MODELS_FILE, TRUTH_FILE)
HALF_SIZE_M, THICKNESS_M = 0.0179, 0.0059
"""The platform, which the publication leaves out: the solid block that comes nearest to its frequencies."""
DRAWN = CrossBeams(
    material=Material(72e9, 0.3, 2820.0),
    span_m=0.064,
    beam_width_m=0.0038,
    beam_height_m=0.0038,
    compliant_thickness_m=0.001,
    compliant_length_m=0.032,
    compliant_height_m=0.0038,
)
"""Table 1 of J. Sensors 2018, 6216979."""
TOLERANCE_M = {"beam_width_m": 1e-5, "beam_height_m": 1e-5, "compliant_thickness_m": 1e-5, "span_m": 3e-5}
"""Standard deviations of what was milled."""
PUBLISHED = {
    "published formulas": (1642.0, 1642.0, 1973.0, 3376.0, 3376.0, 4892.0),
    "published finite elements": (1660.0, 1661.0, 2025.0, 3577.0, 3578.0, 5094.0),
}
FIT_HALF_SIZES_M = [0.005, 0.008, 0.010, 0.012, 0.014, 0.016, 0.018, 0.020]
COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
DAMPING_RATIO, U_DAMPING_RATIO, U_FREQUENCY = 0.015, 1e-4, 1e-4
SAMPLE_RATE_HZ, NOISE = 1e5, 1e-9


def write_element(folder: Path, seed: int) -> Path:
    """Write `elastomer.toml`, the measured `models.json` and `truth.json` into an empty folder and return the first."""
    draws = Draws(seed, True)
    milled: dict[str, Any] = {name: _made(draws, name, spread) for name, spread in TOLERANCE_M.items()}
    made = replace(DRAWN, **milled)
    platform = block(made.material.density_kgm3, HALF_SIZE_M, THICKNESS_M)
    frequency = solve_frame(made, HALF_SIZE_M, platform).modes.frequency_hz
    truth = {
        "seed": seed,
        "dimensions_m": {name: getattr(made, name) for name in TOLERANCE_M},
        "frequency_hz": dict(zip(NAMES, frequency.tolist(), strict=True)),
    }
    entries = tuple(
        _entry(component, float(value), draws) for component, value in zip(COMPONENTS, frequency, strict=True)
    )
    models = ModelsFile("cross-beam element, simulated", "six-axis wrist sensor", "simulated", entries)
    texts = {GEOMETRY_FILE: to_toml(_tables()), MODELS_FILE: models_text(models), TRUTH_FILE: json.dumps(truth)}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    return folder / GEOMETRY_FILE


def _made(draws: Draws, name: str, spread: float) -> float:
    """A dimension as it was milled."""
    return float(getattr(DRAWN, name) + draws.normal(f"element.{name}", spread))


def _entry(component: str, frequency_hz: float, draws: Draws) -> ModelEntry:
    """The model of one channel as a step response would tell it, with a frequency that is off by its uncertainty."""
    measured = frequency_hz * (1.0 + float(draws.normal(f"{component}.frequency", U_FREQUENCY)))
    omega, gain = 2.0 * np.pi * measured, 1e-6
    residue = gain * omega / (2j * np.sqrt(1.0 - DAMPING_RATIO**2))
    u = np.array([U_FREQUENCY * frequency_hz, U_DAMPING_RATIO, 1e-4 * abs(residue), 1e-4 * abs(residue)])
    model = ModalModel(
        frequency_hz=np.array([measured]),
        damping_ratio=np.array([DAMPING_RATIO]),
        residue=np.array([residue]),
        real_hz=np.zeros(0),
        real_residue=np.zeros(0),
        covariance=np.diag(u**2),
    )
    return ModelEntry(component, component, "V/V", "pencil", model, SAMPLE_RATE_HZ, NOISE, f"{component}-1")


def _tables() -> dict[str, Any]:
    """Return elastomer.toml as nested dictionaries."""
    return {
        "format": 1,
        "name": "cross-beam element of a wrist sensor",
        "measured": MODELS_FILE,
        "material": {"youngs_modulus": 72e9, "poisson_ratio": 0.3, "density": 2820.0},
        "beams": {"span": DRAWN.span_m, "width": DRAWN.beam_width_m, "height": DRAWN.beam_height_m},
        "compliant_beams": {"thickness": DRAWN.compliant_thickness_m, "length": DRAWN.compliant_length_m},
        "platform": {"half_size": HALF_SIZE_M, "thickness": THICKNESS_M},
        "fit": {
            "half_sizes": FIT_HALF_SIZES_M,
            "frequencies": dict(zip(NAMES, PUBLISHED["published finite elements"], strict=True)),
        },
        "mounting": {
            "direction": "Tx",
            "hand_mass": 0.1,
            "hand_stiffness": 5e7,
            "sensor_damping": 8.0,
            "pedestal_mass": 0.3,
            "pedestal_stiffness": 2e8,
        },
        "stated": [{"name": name, **dict(zip(NAMES, values, strict=True))} for name, values in PUBLISHED.items()],
    }
