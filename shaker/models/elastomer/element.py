"""The element with its platform as a frame: frequencies, shapes, stiffness, and what each dimension does to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import FloatArray
from shaker.models.elastomer.cross import cross_frame, frame_matrices, platform_stiffness
from shaker.models.elastomer.frame import Frame
from shaker.models.elastomer.geometry import CrossBeams
from shaker.models.elastomer.modes import Modes, centre_of_mass, dense_modes, named_modes
from shaker.models.elastomer.platform import RigidPart

DIMENSIONS = (
    "span_m",
    "beam_width_m",
    "beam_height_m",
    "compliant_thickness_m",
    "compliant_length_m",
    "compliant_height_m",
)
STEP = 1e-3
"""Relative step of the derivatives."""


@dataclass(frozen=True)
class FrameModel:
    """A solved frame: `frame`, `modes`, `stiffness` (6,) in N/m and N·m/rad as of `platform_stiffness`."""

    frame: Frame
    modes: Modes
    stiffness: FloatArray

    def node_motion(self, mode: int) -> FloatArray:
        """Return displacement and turn (N, 6) of every node in a mode."""
        return np.asarray((self.frame.reduction @ self.modes.shape[:, mode]).reshape(-1, 6))

    def platform_motion(self, mode: int) -> FloatArray:
        """Return displacement and turn (6,) of the platform's point in the plane of the beams."""
        return self.modes.shape[:6, mode]


def solve_frame(
    beams: CrossBeams, half_size_m: float, platform: RigidPart, pieces: int = 6, consistent: bool = True
) -> FrameModel:
    """Return frequencies, shapes and stiffness of an element with a rigid platform of edge 2p (see `cross_frame`)."""
    frame = cross_frame(beams, half_size_m, pieces, consistent)
    stiffness, mass = frame_matrices(frame, platform)
    frequency_hz, shape = dense_modes(stiffness, mass)

    def weigh(motion: FloatArray) -> FloatArray:
        return mass @ motion

    centre = centre_of_mass(weigh, frame.rigid_motions(np.zeros(3)))
    modes = named_modes(frequency_hz, shape, weigh, frame.rigid_motions(centre))
    return FrameModel(frame, modes, platform_stiffness(frame))


def sensitivities(beams: CrossBeams, half_size_m: float, platform: RigidPart) -> dict[str, FloatArray]:
    """Return d ln f/d ln x (6,) of the six modes by dimension: percent of frequency per percent of x.

    By the dimensions of the beams, the platform's half-size, mass, height and gyration (moments at fixed mass), one at
    a time; central differences. Young's modulus has 0.5 and is left out.
    """
    found = {}
    for name in DIMENSIONS:
        changed = [replace(beams, **{name: getattr(beams, name) * (1.0 + step)}) for step in (STEP, -STEP)]
        found[name] = _slope([_frequencies(other, half_size_m, platform) for other in changed])
    grown = [_frequencies(beams, half_size_m * (1.0 + step), platform) for step in (STEP, -STEP)]
    found["half_size_m"] = _slope(grown)
    for name in ("mass_kg", "height_m", "inertia_kgm2"):
        parts = [_scaled(platform, name, 1.0 + step) for step in (STEP, -STEP)]
        found[name] = _slope([_frequencies(beams, half_size_m, part) for part in parts])
    return found


def _scaled(platform: RigidPart, name: str, factor: float) -> RigidPart:
    """The platform with one quantity larger; moments of inertia grow with the mass."""
    if name == "mass_kg":
        return replace(platform, mass_kg=platform.mass_kg * factor, inertia_kgm2=platform.inertia_kgm2 * factor)
    return replace(platform, **{name: getattr(platform, name) * factor})


def _frequencies(beams: CrossBeams, half_size_m: float, platform: RigidPart) -> FloatArray:
    """Frequencies of the six modes."""
    return solve_frame(beams, half_size_m, platform, pieces=2).modes.frequency_hz


def _slope(pair: list[FloatArray]) -> FloatArray:
    """Logarithmic derivative from frequencies at a relative step to either side."""
    return np.asarray(np.log(pair[0] / pair[1]) / np.log((1.0 + STEP) / (1.0 - STEP)))
