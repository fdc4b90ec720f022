"""The whole element: cross, platform, modes; the platform that fits measured frequencies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from shaker.arrays import FloatArray, Notice
from shaker.elastomer.frame import NAMES, Frame, Modes, RigidPart, centre_of_mass, dense_modes, named_modes
from shaker.elastomer.geometry import CrossBeams

# The frame of a cross-beam element: four arms, four compliant beams, a rigid platform.


SAME_M = 1e-9
"""Nodes nearer than this are one."""


def cross_frame(beams: CrossBeams, half_size_m: float, pieces: int = 6, consistent: bool = True) -> Frame:
    """Return the frame: arms from the faces of a platform of edge 2p to the axes of the compliant beams.

    The platform lies within the span: arms are l/2 - p long and begin at its faces, which move with it. `pieces`: into
    which every arm and every half of a compliant beam is divided.
    """
    beams.arm_m(half_size_m)
    outer, half = 0.5 * beams.span_m, 0.5 * beams.compliant_length_m
    nodes: list[FloatArray] = []
    pairs: list[tuple[int, int]] = []
    sections, rigid, clamped = [], [], []
    for quarter in range(4):
        x = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]][quarter] + [0.0])
        y = np.array([-x[1], x[0], 0.0])
        arm = _numbered(nodes, [x * r for r in np.linspace(half_size_m, outer, pieces + 1)])
        bar = _numbered(nodes, [x * outer + y * s for s in np.linspace(-half, half, 2 * pieces + 1)])
        for line, section in ((arm, beams.beam), (bar, beams.compliant)):
            pairs += pairwise(line)
            sections += [section] * (len(line) - 1)
        rigid.append(arm[0])
        clamped += [bar[0], bar[-1]]
    return Frame(
        node_m=np.array(nodes),
        beam=np.array(pairs),
        section=tuple(sections),
        material=beams.material,
        shear_factor=beams.shear_factor,
        rigid=np.unique(rigid),
        clamped=np.array(clamped),
        consistent=consistent,
    )


def frame_matrices(frame: Frame, platform: RigidPart) -> tuple[FloatArray, FloatArray]:
    """Return stiffness and mass (F, F) of a frame whose body is the platform."""
    stiffness, mass = frame.matrices
    mass = mass.copy()
    mass[:6, :6] += platform.mass_matrix
    return stiffness, mass


def platform_stiffness(frame: Frame) -> FloatArray:
    """Return 1/C_ii (6,): load per displacement in its own direction, nothing else being held.

    Forces in N/m, moments in N·m/rad, at the origin, which is in the plane of the beams' axes.
    """
    stiffness, _ = frame.matrices
    loads = np.eye(len(stiffness))[:, :6]
    return np.asarray(1.0 / np.diag(np.linalg.solve(stiffness, loads)[:6]))


def _numbered(nodes: list[FloatArray], places: list[FloatArray]) -> list[int]:
    """Numbers of nodes at some places, which are added where no node is yet."""
    found = []
    for place in places:
        near = [i for i, node in enumerate(nodes) if np.linalg.norm(node - place) < SAME_M]
        if not near:
            nodes.append(place)
        found.append(near[0] if near else len(nodes) - 1)
    return found


# The element with its platform as a frame: frequencies, shapes, stiffness, and what each dimension does to them.


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


# Platform data that give measured frequencies: a family of solutions, which validates nothing.


NEEDED = (("Tx", "Ty"), ("Tz",), ("Rx", "Ry"), ("Rz",))
"""Of each group one frequency at least: they fix mass, height and two moments of inertia."""
EXACT = 1e-4
"""Relative misfit below which frequencies count as met."""
PIECES = 3


@dataclass(frozen=True)
class PlatformFit:
    """The rigid `platform` of a `half_size_m` that gives some frequencies; `frequency_hz` (6,) of `NAMES`.

    `misfit`: largest relative departure from a wanted frequency, pairs by their mean. The height's sign is not told by
    frequencies: it is given as positive.
    """

    half_size_m: float
    platform: RigidPart
    frequency_hz: FloatArray
    misfit: float
    notices: tuple[Notice, ...]


def fit_platform(beams: CrossBeams, half_size_m: float, wanted_hz: Mapping[str, float]) -> PlatformFit:
    """Return mass, height and moments of inertia with which the frame has some frequencies in Hz, by name.

    Four unknowns for four distinct frequencies at every half-size: that they are met says nothing for the model, which
    a notice tells. Jx = Jy. Where no platform meets them, the one nearest in relative least squares.
    """
    from scipy.optimize import least_squares

    unknown = [name for name in wanted_hz if name not in NAMES]
    if unknown or any(not any(name in wanted_hz for name in group) for group in NEEDED):
        expected = "one of Tx, Ty, one of Rx, Ry, and Tz, Rz"
        raise ValueError(f"wanted_hz: expected {expected}, found {', '.join(wanted_hz) or 'none'}")
    frame = cross_frame(beams, half_size_m, PIECES)
    targets = np.array([np.mean([wanted_hz[name] for name in group if name in wanted_hz]) for group in NEEDED])
    stiffness = platform_stiffness(frame)

    def misfit(logarithms: FloatArray) -> FloatArray:
        found = _platform_fit_frequencies(frame, _platform(logarithms))
        return np.asarray(np.log([found[NAMES.index(group[0])] for group in NEEDED] / targets))

    fit = least_squares(misfit, _start(stiffness, targets), x_scale=0.1, xtol=1e-10, ftol=1e-14, gtol=1e-12)
    platform, worst = _platform(fit.x), float(np.max(np.abs(np.expm1(fit.fun))))
    return PlatformFit(
        half_size_m, platform, _platform_fit_frequencies(frame, platform), worst, _notices(half_size_m, worst)
    )


def platform_family(
    beams: CrossBeams, half_sizes_m: Sequence[float], wanted_hz: Mapping[str, float]
) -> tuple[PlatformFit, ...]:
    """Return the fit at every half-size: the family between whose members the frequencies do not choose."""
    return tuple(fit_platform(beams, half_size, wanted_hz) for half_size in half_sizes_m)


def _platform(logarithms: FloatArray) -> RigidPart:
    """The platform of logarithms of mass, height, and two radii of gyration."""
    mass, height, across, along = np.exp(logarithms)
    return RigidPart(float(mass), float(height), mass * np.array([across, across, along]) ** 2)


def _start(stiffness: FloatArray, targets: FloatArray) -> FloatArray:
    """Where to begin: a mass for Tz, a height that lowers Tx to where it is, gyrations for Rx and Rz."""
    omega = (2.0 * np.pi * targets) ** 2
    mass = stiffness[2] / omega[1]
    turning = stiffness[3] / omega[2] / mass
    height = np.clip((stiffness[0] / (omega[0] * mass) - 1.0) * stiffness[3] / stiffness[0], 1e-6, turning)
    gyrations = np.sqrt([max(turning - height, 0.3 * turning), stiffness[5] / omega[3] / mass])
    return np.asarray(np.log(np.concatenate([[mass, np.sqrt(height)], gyrations])))


def _platform_fit_frequencies(frame: Frame, platform: RigidPart) -> FloatArray:
    """Frequencies of the six modes of a frame with a platform."""
    stiffness, mass = frame_matrices(frame, platform)

    def weigh(motion: FloatArray) -> FloatArray:
        return np.asarray(mass @ motion)

    centre = centre_of_mass(weigh, frame.rigid_motions(np.zeros(3)))
    return named_modes(*dense_modes(stiffness, mass, 8), weigh, frame.rigid_motions(centre)).frequency_hz


def _notices(half_size_m: float, worst: float) -> tuple[Notice, ...]:
    """That a fit is no validation, and whether it met the frequencies."""
    where = f"platform of half-size {1e3 * half_size_m:g} mm"
    text = (
        "mass, height and moments of inertia are fitted to the frequencies: other half-sizes meet them too, with other "
        "data, so that agreement does not validate the model; only platform data from a drawing or a balance can"
    )
    notices = [Notice("warning", text, where)]
    if worst > EXACT:
        notices.append(Notice("warning", f"no platform meets all frequencies; {100.0 * worst:.2g} % are left", where))
    return tuple(notices)
