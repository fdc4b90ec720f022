"""Cross-beam element as a frame of Timoshenko beams with a rigid platform.

Its modes, their sensitivities to the dimensions, and platform data that fit measured frequencies.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from shaker.elastomer.geometry import CrossBeams, ElasticMaterial, Section, beam_matrices, lump_mass
from shaker.model_notices import PLATFORM_MISFIT, PLATFORM_NOT_VALIDATED
from shakercal._common.arrays import Arrays, FloatArray, IntArray, check_shape, check_shapes
from shakercal._common.fitting import LMOptions, WhitenedResiduals, levenberg_marquardt
from shakercal._common.notices import Notice

# Rigid bodies of the element, the platform and attached parts, as mass, height and inertia.


@dataclass(frozen=True, repr=False)
class RigidPart(Arrays):
    """A rigid body on the axis of the element.

    `mass_kg`; `height_m` of its centre of mass along z above the plane of the beams' axes; `inertia_kgm2` (3,): Jx, Jy,
    Jz about the centre of mass.
    """

    mass_kg: float
    height_m: float
    inertia_kgm2: FloatArray

    def __post_init__(self) -> None:
        inertia = np.asarray(self.inertia_kgm2, dtype=np.float64)
        check_shape("inertia_kgm2", inertia, (3,))
        object.__setattr__(self, "inertia_kgm2", inertia)
        if self.mass_kg < 0.0 or np.any(inertia < 0.0):
            found = f"{self.mass_kg} kg, {inertia.tolist()} kg.m2"
            raise ValueError(f"mass_kg, inertia_kgm2: expected none negative, found {found}")

    @property
    def gyration_m(self) -> FloatArray:
        """Radii of gyration √(J/m) (3,)."""
        return np.asarray(np.sqrt(self.inertia_kgm2 / self.mass_kg))

    @property
    def mass_matrix(self) -> FloatArray:
        """Mass matrix (6, 6) of the origin, in the plane of the beams."""
        m, h = self.mass_kg, self.height_m
        matrix = np.diag(np.concatenate([[m, m, m], self.inertia_kgm2 + m * h**2 * np.array([1.0, 1.0, 0.0])]))
        matrix[0, 4] = matrix[4, 0] = m * h
        matrix[1, 3] = matrix[3, 1] = -m * h
        return matrix


def block(density_kgm3: float, half_size_m: float, thickness_m: float, height_m: float = 0.0) -> RigidPart:
    """Return a square block of edge 2p and thickness H at a height."""
    edge = 2.0 * half_size_m
    mass = density_kgm3 * edge**2 * thickness_m
    across = mass * (edge**2 + thickness_m**2) / 12.0
    return RigidPart(mass, height_m, np.array([across, across, mass * edge**2 / 6.0]))


def pillar(density_kgm3: float, radius_m: float, length_m: float, foot_m: float) -> RigidPart:
    """Return an upright cylinder with its foot at a height `foot_m`."""
    mass = density_kgm3 * np.pi * radius_m**2 * length_m
    across = mass * (3.0 * radius_m**2 + length_m**2) / 12.0
    return RigidPart(mass, foot_m + 0.5 * length_m, np.array([across, across, 0.5 * mass * radius_m**2]))


def join_bodies(parts: Sequence[RigidPart]) -> RigidPart:
    """Return several bodies as one (Steiner's theorem)."""
    mass = sum(part.mass_kg for part in parts)
    if not mass > 0.0:
        raise ValueError("parts: expected a mass above 0, found none")
    height = sum(part.mass_kg * part.height_m for part in parts) / mass
    offsets = np.array([1.0, 1.0, 0.0])
    inertia = [part.inertia_kgm2 + part.mass_kg * (part.height_m - height) ** 2 * offsets for part in parts]
    return RigidPart(mass, height, np.sum(inertia, axis=0))


# Frame of beams in space with one rigid body and clamped ends: assembly and reduction.


@dataclass(frozen=True, repr=False)
class BeamFrame(Arrays):
    """Beams between nodes: `node_m` (N, 3), `beam` (E, 2) node numbers, `section` of every beam.

    `rigid` (R,): nodes that move with a body, whose reference point is the origin; `clamped` (C,). Local z of every
    beam is the global one, so that no beam may be vertical. `consistent`: consistent mass matrix, else lumped at the
    ends.
    """

    node_m: FloatArray
    beam: IntArray
    section: Sequence[Section]
    material: ElasticMaterial
    shear_factor: float
    rigid: IntArray
    clamped: IntArray
    consistent: bool = True

    def __post_init__(self) -> None:
        check_shape("node_m", self.node_m, (None, 3))
        check_shape("beam", self.beam, (len(self.section), 2))
        check_shapes(self, (None,), "rigid", "clamped")
        if np.intersect1d(self.rigid, self.clamped).size:
            raise ValueError("rigid, clamped: expected different nodes, found some in both")

    @cached_property
    def reduction(self) -> FloatArray:
        """Motion (6N, F) of all nodes per unknown, the body's first."""
        count = len(self.node_m)
        free = np.setdiff1d(np.arange(count), np.concatenate([self.rigid, self.clamped]))
        first = 6 if len(self.rigid) else 0
        matrix = np.zeros((6 * count, first + 6 * len(free)))
        for index, node in enumerate(free):
            column = first + 6 * index
            matrix[6 * node : 6 * node + 6, column : column + 6] = np.eye(6)
        for node in self.rigid:
            matrix[6 * node : 6 * node + 6, :6] = rigid_motion(self.node_m[node])
        return matrix

    @cached_property
    def matrices(self) -> tuple[FloatArray, FloatArray]:
        """Stiffness and mass (F, F) of the beams over the unknowns."""
        size = 6 * len(self.node_m)
        stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
        for ends, section in zip(self.beam, self.section, strict=True):
            indices = (6 * ends[:, None] + np.arange(6)).ravel()
            along = self.node_m[ends[1]] - self.node_m[ends[0]]
            length = float(np.linalg.norm(along))
            elastic, inert = beam_matrices(self.material, section, length, self.shear_factor)
            inert = inert if self.consistent else lump_mass(inert)
            x, z = along / length, np.array([0.0, 0.0, 1.0])
            turn = np.kron(np.eye(4), np.stack([x, np.cross(z, x), z]))
            stiffness[np.ix_(indices, indices)] += turn.T @ elastic @ turn
            mass[np.ix_(indices, indices)] += turn.T @ inert @ turn
        reduced = (self.reduction.T @ whole @ self.reduction for whole in (stiffness, mass))
        elastic, inert = (0.5 * (matrix + matrix.T) for matrix in reduced)
        return elastic, inert

    def rigid_motions(self, about_m: FloatArray) -> FloatArray:
        """Return the unknowns (F, 6) for rigid motions about a point (3,), clamps released."""
        about_origin = self.reduction.T @ np.concatenate([rigid_motion(node) for node in self.node_m])
        if len(self.rigid):
            about_origin[:6] = np.eye(6)
        return np.asarray(about_origin @ rigid_motion(-np.asarray(about_m)))


def rigid_motion(offset_m: FloatArray) -> FloatArray:
    """Return the motion (6, 6) of a point at an offset per origin motion."""
    x, y, z = offset_m
    matrix = np.eye(6)
    matrix[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return matrix


# Natural frequencies and shapes, named after the motion of the moving parts that carries most of their mass.

MODE_NAMES = ("Tx", "Ty", "Tz", "Rx", "Ry", "Rz")
"""Translations along and rotations about the axes."""
EQUAL = 1e-4
"""Relative difference below which frequencies are equal, as the pairs of a symmetric element."""


@dataclass(frozen=True, repr=False)
class NamedModes(Arrays, shapes="frequency_hz 6; participation 6 6; shape D 6; others_hz O"):
    """The six named modes, in the order of `MODE_NAMES`.

    `frequency_hz` (6,). `participation` (6, 6): share of each rigid motion's mass in each mode, modes down,
    `MODE_NAMES` across: (φᵀMr)²/(rᵀMr) with φᵀMφ = 1. r are translations of all moving parts and rotations about their
    common centre. `shape` (D, 6): unknowns of every mode. `others_hz`: modes between them.
    """

    frequency_hz: FloatArray
    participation: FloatArray
    shape: FloatArray
    others_hz: FloatArray


def dense_modes(stiffness: FloatArray, mass: FloatArray, count: int = 12) -> tuple[FloatArray, FloatArray]:
    """Return the lowest frequencies (K,) in Hz and shapes (D, K), φᵀMφ = 1."""
    from scipy.linalg import eigh

    last = min(count, len(stiffness)) - 1
    squared, shape = eigh(stiffness, mass, subset_by_index=[0, last])
    return np.sqrt(np.maximum(squared, 0.0)) / (2.0 * np.pi), shape


def named_modes(
    frequency_hz: FloatArray, shape: FloatArray, weigh: Callable[[FloatArray], FloatArray], rigid: FloatArray
) -> NamedModes:
    """Return the modes that deserve each name.

    Among modes (K,), (D, K) the assignment of largest total mass is selected. `weigh` multiplies by the mass matrix.
    `rigid` (D, 6): translations, and rotations about the centre of mass. Modes of equal frequency are combined so that
    each follows one axis, with the motion that gives its name positive.
    """
    from scipy.linalg import polar, qr

    weighed = weigh(rigid)
    total = np.einsum("ij,ij->j", rigid, weighed)
    factor = shape.T @ weighed / np.sqrt(total)
    shape = shape.copy()
    separate = np.diff(frequency_hz) > EQUAL * frequency_hz[1:]
    for group in np.split(np.arange(len(frequency_hz)), 1 + np.flatnonzero(separate)):
        if len(group) > 1:  # rotated so that each follows one axis as closely as possible
            axes = np.sort(qr(factor[group], pivoting=True, mode="r")[1][: len(group)])
            turn = polar(factor[group][:, axes])[0]
            shape[:, group] = shape[:, group] @ turn
            factor[group] = turn.T @ factor[group]
    chosen = assign_names(factor)
    sign = np.where(factor[chosen, np.arange(6)] < 0.0, -1.0, 1.0)
    between = np.setdiff1d(np.arange(chosen.max() + 1), chosen)
    return NamedModes(frequency_hz[chosen], factor[chosen] ** 2, shape[:, chosen] * sign, frequency_hz[between])


def assign_names(factor: FloatArray) -> IntArray:
    """Return the mode of each name (N,) of largest total mass, from factors (K, N)."""
    from scipy.optimize import linear_sum_assignment

    return np.asarray(linear_sum_assignment(-(np.asarray(factor) ** 2).T)[1])


# The element as a frame: frequencies, shapes, stiffness, and their sensitivities to the dimensions.

SAME_M = 1e-9
"""Distance below which nodes are the same, 1 nm."""


def cross_frame(beams: CrossBeams, half_size_m: float, pieces: int = 6, consistent: bool = True) -> BeamFrame:
    """Return the frame of a cross with a platform of edge 2p.

    Arms start at the faces of the platform, move with it, and end at the axes of the compliant beams, l/2 - p long.
    `pieces`: divisions of every arm and of every half of a compliant beam.
    """
    beams.arm_m(half_size_m)
    outer, half = 0.5 * beams.span_m, 0.5 * beams.compliant_length_m
    nodes: list[FloatArray] = []

    def numbered(points: list[FloatArray]) -> list[int]:
        """Return the numbers of the nodes at some points, adding missing nodes."""
        numbers = []
        for point in points:
            near = [i for i, node in enumerate(nodes) if np.linalg.norm(node - point) < SAME_M]
            if not near:
                nodes.append(point)
            numbers.append(near[0] if near else len(nodes) - 1)
        return numbers

    pairs: list[tuple[int, int]] = []
    sections, rigid, clamped = [], [], []
    for quarter in range(4):
        x = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]][quarter] + [0.0])
        y = np.array([-x[1], x[0], 0.0])
        arm = numbered([x * r for r in np.linspace(half_size_m, outer, pieces + 1)])
        bar = numbered([x * outer + y * s for s in np.linspace(-half, half, 2 * pieces + 1)])
        for line, section in ((arm, beams.beam), (bar, beams.compliant)):
            pairs += pairwise(line)
            sections += [section] * (len(line) - 1)
        rigid.append(arm[0])
        clamped += [bar[0], bar[-1]]
    return BeamFrame(
        node_m=np.array(nodes),
        beam=np.array(pairs),
        section=tuple(sections),
        material=beams.material,
        shear_factor=beams.shear_factor,
        rigid=np.unique(rigid),
        clamped=np.array(clamped),
        consistent=consistent,
    )


def platform_stiffness(frame: BeamFrame) -> FloatArray:
    """Return 1/C_ii (6,) in N/m and N·m/rad: load per displacement, others free."""
    stiffness, _ = frame.matrices
    loads = np.eye(len(stiffness))[:, :6]
    return np.asarray(1.0 / np.diag(np.linalg.solve(stiffness, loads)[:6]))


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


@dataclass(frozen=True, repr=False)
class FrameModel(Arrays):
    """A solved frame: `frame`, `modes`, `stiffness` (6,) in N/m and N·m/rad as of `platform_stiffness`."""

    frame: BeamFrame
    modes: NamedModes
    stiffness: FloatArray

    def node_motion(self, mode: int) -> FloatArray:
        """Return displacement and turn (N, 6) of every node in a mode."""
        return np.asarray((self.frame.reduction @ self.modes.shape[:, mode]).reshape(-1, 6))


def solve_frame(
    beams: CrossBeams, half_size_m: float, platform: RigidPart, pieces: int = 6, consistent: bool = True
) -> FrameModel:
    """Solve an element with a rigid platform for frequencies, shapes and stiffness.

    Parameters
    ----------
    beams
        dimensions and material of the cross
    half_size_m
        half the edge p of the platform, m
    platform
        mass, height and inertia of all rigid parts
    pieces
        divisions per arm, default 6
    consistent
        consistent mass matrix, default True; else lumped

    Returns
    -------
    FrameModel : the frame, its named modes and stiffness (see `cross_frame`)

    Examples
    --------
    >>> from shaker import solve_frame
    >>> from shaker.elastomer.frame import block
    >>> from shaker.elastomer.geometry import CrossBeams, ElasticMaterial
    >>> cross = CrossBeams(ElasticMaterial(71e9, 0.33, 2810.0), 0.06, 0.006, 0.006, 0.002, 0.02, 0.006)
    >>> print(solve_frame(cross, 0.012, block(2810.0, 0.012, 0.006)).modes.frequency_hz.round())
    [ 5830.  5830.  5130. 12575. 12575. 14082.]
    """
    frame = cross_frame(beams, half_size_m, pieces, consistent)
    return FrameModel(frame, frame_modes(frame, platform), platform_stiffness(frame))


def frame_modes(frame: BeamFrame, platform: RigidPart, count: int = 12) -> NamedModes:
    """Return the named modes among the `count` lowest of a frame with a platform."""
    stiffness, mass = frame.matrices
    mass = mass.copy()
    mass[:6, :6] += platform.mass_matrix

    def weigh(motion: FloatArray) -> FloatArray:
        return np.asarray(mass @ motion)

    about_origin = frame.rigid_motions(np.zeros(3))
    whole = about_origin.T @ weigh(about_origin)
    centre = np.array([-whole[2, 4] / whole[2, 2], whole[2, 3] / whole[2, 2], whole[0, 4] / whole[0, 0]])
    return named_modes(*dense_modes(stiffness, mass, count), weigh, frame.rigid_motions(centre))


def sensitivities(beams: CrossBeams, half_size_m: float, platform: RigidPart) -> dict[str, FloatArray]:
    """Return d ln f/d ln x (6,) of the six modes by dimension x.

    Dimensions are those of the beams, and the platform's half-size, mass, height and gyration (moments at constant
    mass).
    """

    def element(name: str, factor: float) -> tuple[CrossBeams, float, RigidPart]:
        """Return the element with one quantity changed; moments of inertia grow with the mass."""
        if name in DIMENSIONS:
            return replace(beams, **{name: getattr(beams, name) * factor}), half_size_m, platform
        if name == "half_size_m":
            return beams, half_size_m * factor, platform
        names = (name, "inertia_kgm2") if name == "mass_kg" else (name,)
        return beams, half_size_m, replace(platform, **{field: getattr(platform, field) * factor for field in names})

    def slope(name: str) -> FloatArray:
        ends = 1.0 + STEP, 1.0 - STEP
        up, down = (solve_frame(*element(name, factor), pieces=2).modes.frequency_hz for factor in ends)
        return np.asarray(np.log(up / down) / np.log(ends[0] / ends[1]))

    return {name: slope(name) for name in (*DIMENSIONS, "half_size_m", "mass_kg", "height_m", "inertia_kgm2")}


# Platform data for measured frequencies: a family of solutions, which does not validate the model.

NEEDED = (("Tx", "Ty"), ("Tz",), ("Rx", "Ry"), ("Rz",))
"""Of each group one frequency at least: they fix mass, height and two moments of inertia."""
EXACT = 1e-4
"""Relative misfit below which frequencies agree."""
PIECES = 3  # per arm, chosen for speed
SMALL = 1e-7
"""Step of the derivatives by logarithms of platform data."""


@dataclass(frozen=True, repr=False)
class PlatformFit(Arrays):
    """The rigid `platform` of a `half_size_m` for given frequencies; `frequency_hz` (6,) of `MODE_NAMES`.

    `misfit`: largest relative deviation from a target frequency, pairs by their mean. Frequencies do not determine the
    sign of the height; it is positive.
    """

    half_size_m: float
    platform: RigidPart
    frequency_hz: FloatArray
    misfit: float
    notices: tuple[Notice, ...]


def fit_platform(beams: CrossBeams, half_size_m: float, target_hz: Mapping[str, float]) -> PlatformFit:
    """Return mass, height and moments of inertia for which the frame has some frequencies.

    `target_hz`: frequencies in Hz by name. Four unknowns fit four different frequencies at every half-size. Agreement
    therefore does not validate the model, as a notice states. Jx = Jy. If no platform fits exactly, the result has the
    least relative squares.
    """
    unknown = [name for name in target_hz if name not in MODE_NAMES]
    if unknown or any(not any(name in target_hz for name in group) for group in NEEDED):
        expected = "Tz, Rz, one of Tx, Ty and one of Rx, Ry"
        raise ValueError(f"target_hz: expected {expected}, found {', '.join(target_hz) or 'none'}")
    frame = cross_frame(beams, half_size_m, PIECES)
    targets = np.array([np.mean([target_hz[name] for name in group if name in target_hz]) for group in NEEDED])

    def platform(logarithms: FloatArray) -> RigidPart:
        """Return the platform from logarithms of mass, height and two radii of gyration."""
        mass, height, across, along = np.exp(np.clip(logarithms, -30.0, 30.0))  # a trial step may go anywhere
        return RigidPart(float(mass), float(height), mass * np.array([across, across, along]) ** 2)

    def misfit(logarithms: FloatArray) -> FloatArray:
        hertz = frame_modes(frame, platform(logarithms), 8).frequency_hz
        return np.asarray(np.log(np.maximum(hertz[[MODE_NAMES.index(group[0]) for group in NEEDED]] / targets, 1e-30)))

    def point(logarithms: FloatArray) -> WhitenedResiduals:
        residual, moves = misfit(logarithms), SMALL * np.eye(len(logarithms))
        slopes = [(misfit(logarithms + move) - residual) / SMALL for move in moves]
        return WhitenedResiduals(logarithms, residual, np.stack(slopes, axis=1))

    start = point(_start(platform_stiffness(frame), targets))
    fit = levenberg_marquardt(point, start, LMOptions(predicted_decrease_share=1e-14)).point
    fitted, worst = platform(fit.parameters), float(np.max(np.abs(np.expm1(fit.residual))))
    where = f"platform of half-size {1e3 * half_size_m:g} mm"
    notices = [Notice(PLATFORM_NOT_VALIDATED, where)]
    if worst > EXACT:
        notices.append(Notice(PLATFORM_MISFIT, where, misfit_percent=100.0 * worst))
    return PlatformFit(half_size_m, fitted, frame_modes(frame, fitted, 8).frequency_hz, worst, tuple(notices))


def platform_family(
    beams: CrossBeams, half_sizes_m: Sequence[float], target_hz: Mapping[str, float]
) -> tuple[PlatformFit, ...]:
    """Return the fits at several half-sizes, which the frequencies do not distinguish."""
    return tuple(fit_platform(beams, half_size, target_hz) for half_size in half_sizes_m)


def _start(stiffness: FloatArray, targets: FloatArray) -> FloatArray:
    """Return start values of mass, height and radii of gyration."""
    omega = (2.0 * np.pi * targets) ** 2
    mass = stiffness[2] / omega[1]
    turning = stiffness[3] / omega[2] / mass
    height = np.clip((stiffness[0] / (omega[0] * mass) - 1.0) * stiffness[3] / stiffness[0], 1e-6, turning)
    gyrations = np.sqrt([max(turning - height, 0.3 * turning), stiffness[5] / omega[3] / mass])
    return np.asarray(np.log(np.concatenate([[mass, np.sqrt(height)], gyrations])))
