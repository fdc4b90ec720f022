"""Evaluation of an elastic element: natural frequencies and mode shapes from its geometry."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fusion.base import CommandEvaluation, ProgressCallback, no_progress
from fusion.errors import InputError, as_input_error
from fusion.sensor import bench_notices as declared
from fusion.sensor.elastomer.element_definition import ElementDefinition
from fusion.sensor.model_files import read_models
from fusion.sensor.unmodelled_effects import coverage_notice
from shaker.elastomer.frame import (
    MODE_NAMES,
    FrameModel,
    PlatformFit,
    platform_family,
    rigid_motion,
    sensitivities,
    solve_frame,
)
from shaker.elastomer.geometry import PublishedStatics, Section, beam_stiffness, guided_stiffness
from shaker.elastomer.solid import SolidModel, mesh_change, solve_solid
from shaker.labels import LOAD_COMPONENTS
from shaker.lti.system import ModalModel
from shaker.mechanics import MassChain, oscillator_hz, required_stiffness
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

# Numbers of an elastic element.


class StaticsFact(NamedTuple):
    """A number of the beam formulas, as `printed` and `right`; NaN without a value."""

    name: str
    label: str
    printed: float
    right: float
    unit: str
    remark: str


@dataclass(frozen=True)
class ComparedColumn:
    """Natural frequencies by one model or measurement: `frequency_hz`, `u_hz` (6,), NaN without a value.

    `kind`: "formula", "frame", "solid", "measured" or "stated". `u_hz` is 0 of computed and stated frequencies.
    """

    name: str
    kind: str
    frequency_hz: FloatArray
    u_hz: FloatArray


@dataclass(frozen=True)
class SolidStudy:
    """The solid on refined meshes, and `rigid` on the second-finest mesh."""

    refinements: tuple[int, ...]
    meshes: tuple[SolidModel, ...]
    rigid: SolidModel

    @property
    def finest(self) -> SolidModel:
        """The solution on the finest mesh."""
        return self.meshes[-1]


@dataclass(frozen=True)
class MountedElement:
    """Sensor between hand and pedestal: modes (N,) of the chain.

    `stiffness`, `mass`: of the sensor along the direction, by the frame. `mounted_hz` (H,): with a rigidly joined hand.
    """

    direction: str
    stiffness: float
    mass: float
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    hand_mass: FloatArray
    mounted_hz: FloatArray


@dataclass(frozen=True)
class ElementEvaluation(CommandEvaluation):
    """All models; `sensitivity`: relative change of frequencies per relative change of a dimension."""

    definition: ElementDefinition
    facts: tuple[StaticsFact, ...]
    frame: FrameModel
    sensitivity: dict[str, FloatArray]
    solid: SolidStudy | None
    columns: tuple[ComparedColumn, ...]
    fits: tuple[PlatformFit, ...]
    mounted: MountedElement | None


def spread(columns: Sequence[ComparedColumn]) -> FloatArray:
    """Return (max - min)/max (6,) over columns; NaN with fewer than two values."""
    values = np.stack([column.frequency_hz for column in columns])
    filled = np.isfinite(values)
    highest = np.max(np.where(filled, values, -np.inf), axis=0)
    lowest = np.min(np.where(filled, values, np.inf), axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(filled.sum(axis=0) > 1, (highest - lowest) / highest, np.nan))


# The columns of the comparison: beam formulas, frame, solid, measured models, stated frequencies.

MODE_OF = dict(zip(LOAD_COMPONENTS, MODE_NAMES, strict=True))
"""Which mode a load component excites."""


def measured_column(definition: ElementDefinition) -> tuple[ComparedColumn | None, list[Notice]]:
    """Return the dominant mode of every measured model with its standard uncertainty."""
    path = definition.file.measured
    if path is None:
        return None, []
    value, u, notices = np.full(6, np.nan), np.full(6, np.nan), []
    for entry in read_models(path).driven:
        name = MODE_OF.get(entry.component)
        if name is None or not len(entry.model.frequency_hz):
            notices.append(Notice(declared.NO_MEASURED_MODE, "measured", component=entry.component, file=path.name))
            continue
        index = MODE_NAMES.index(name)
        value[index], u[index] = dominant(entry.model)
        if entry.scope and np.isfinite(u[index]):
            notices.append(coverage_notice(entry.scope, entry.outside or "", f"measured, {entry.component}"))
    return ComparedColumn("measured", "measured", value, u), notices


def dominant(model: ModalModel) -> tuple[float, float]:
    """Return frequency (Hz) and u of the mode with the largest |r/p|."""
    count = len(model.frequency_hz)
    index = int(np.argmax(np.abs(model.residue / model.poles[:count])))
    u = np.nan if model.covariance is None else float(np.sqrt(model.covariance[index, index]))
    return float(model.frequency_hz[index]), u


def _exact(name: str, kind: str, frequency_hz: FloatArray | Mapping[str, float]) -> ComparedColumn:
    """Return a column of numbers (6,), or by mode, without uncertainty."""
    if isinstance(frequency_hz, Mapping):
        frequency_hz = np.array([frequency_hz.get(mode, np.nan) for mode in MODE_NAMES])
    return ComparedColumn(name, kind, frequency_hz, np.zeros(6))


# The numbers of the beam formulas: as the publication's formulas give them, and as mechanics does.

PRINTED_SHARE = 0.4
"""F_Q/F of equation 10."""
GUIDED, CANTILEVERS = "compliant beams guided at mid-span", "compliant beams as cantilevers"


def statics_facts(definition: ElementDefinition, frame: FrameModel) -> tuple[StaticsFact, ...]:
    """Return shear modulus, force shares, stiffnesses and frequencies, by printed and correct formulas."""
    beams, mass = definition.beams, definition.platform.mass_kg
    printed, closed = PublishedStatics(beams), beam_stiffness(beams, definition.file.platform.half_size)
    point, first = guided_stiffness(beams), float(frame.modes.frequency_hz[0])
    stiffness = printed.stiffness(PRINTED_SHARE)
    ratio = printed.force_ratio / 4.0
    shear, needed = beams.material.shear_modulus_pa, required_stiffness(first, mass)
    point_hz = (oscillator_hz(stiffness, mass), oscillator_hz(point, mass))
    masses, same = f"platform and parts, {1e3 * mass:.4g} g", f"{first:.1f} Hz with the same mass"
    shares = (printed.beam_share, ratio / (2 * ratio + 4))
    facts: list[tuple[str, str, float, float, str, str]] = [
        ("shear_modulus", "shear modulus G", printed.shear_modulus_pa, shear, "Pa", "E/(1+μ) printed for E/2(1+μ)"),
        ("force_ratio", "F_Q/F_c, eq. 10", printed.force_ratio, ratio, "1", f"{CANTILEVERS}; printed value 8"),
        ("beam_share", "F_Q/F, eq. 10", *shares, "1", "printed value 0.4"),
        ("stiffness_point", "k, platform a point, eq. 11", stiffness, point, "N/m", f"F_Q = 0.4 F; {GUIDED}"),
        ("stiffness_x", "k along x, y with the platform", np.nan, closed.x, "N/m", "closed form, no turning"),
        ("stiffness_z", "k along z with the platform", np.nan, closed.z, "N/m", "closed form, no turning"),
        ("frequency_point", "f of k and the moving mass, eq. 17", *point_hz, "Hz", masses),
        ("stiffness_needed", "k of one oscillator at the frame's Tx", np.nan, needed, "N/m", same),
    ]
    return tuple(StaticsFact(*fact) for fact in facts)


def mounted_chain(definition: ElementDefinition, frame: FrameModel) -> MountedElement | None:
    """Return the sensor between hand and pedestal, with stiffness and effective mass of the frame."""
    mounting = definition.file.mounting
    if mounting is None:
        return None
    index = MODE_NAMES.index(mounting.direction)
    stiffness = float(frame.stiffness[index])
    mass = stiffness / (2.0 * np.pi * float(frame.modes.frequency_hz[index])) ** 2
    stages = {
        "pedestal": (mounting.pedestal_mass, mounting.pedestal_stiffness, mounting.pedestal_damping),
        "sensor": (mass, stiffness, mounting.sensor_damping),
    }
    if mounting.hand_mass > 0.0:
        stages["hand"] = (mounting.hand_mass, mounting.hand_stiffness, mounting.hand_damping)
    chain = MassChain(tuple(stages), *np.array(list(stages.values())).T)
    frequency, damping = chain.modes()
    top = mounting.hand_mass or mass
    hands = np.linspace(0.0, 2.0 * top, 81)
    rigid = np.array([oscillator_hz(stiffness, mass + hand) for hand in hands])
    return MountedElement(mounting.direction, stiffness, mass, frequency, damping, hands, rigid)


# Mode shapes as faces in space: beams and platform of the frame, the surface of the solid.

SIDES = ((0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5), (0, 1, 3, 2), (4, 5, 7, 6))
"""Faces of a box by its corners, numbered with the bits of x, y, z."""
PLATFORM_PARTS = 4
"""Tiles along each edge of the platform, so that its colours show how it turns."""
REVERSED_X, REVERSED_Y = ("Tx", "Ry", "Rz"), ("Ty", "Rx", "Rz")
"""Modes whose motion is mirrored with reversed sign in the planes x = 0 and y = 0."""


@dataclass(frozen=True)
class DrawnShape:
    """One mode: corners `rest_m` (P, 4, 3) of all faces and their `motion`."""

    name: str
    frequency_hz: float
    rest_m: FloatArray
    motion: FloatArray


def frame_shapes(definition: ElementDefinition, model: FrameModel) -> list[DrawnShape]:
    """Return the six modes of the frame, with sections of beams and a block."""
    frame, platform = model.frame, definition.file.platform
    thickness = platform.thickness or definition.beams.beam_height_m
    centre = np.array([0.0, 0.0, platform.height])
    part = platform.half_size / PLATFORM_PARTS
    tiles = part * np.arange(1.0 - PLATFORM_PARTS, PLATFORM_PARTS, 2.0)
    blocks = [centre + np.array([x, y, 0.0]) + _box(part, part, 0.5 * thickness) for x in tiles for y in tiles]
    beams, shapes = list(zip(frame.beam, frame.section, strict=True)), []
    for mode, name in enumerate(MODE_NAMES):
        nodes, rigid = model.node_motion(mode), model.modes.shape[:6, mode]
        solids = [_beam(frame.node_m[ends], nodes[ends], section) for ends, section in beams]
        solids += [(block, np.stack([(rigid_motion(corner) @ rigid)[:3] for corner in block])) for block in blocks]
        rest, motion = (np.stack(parts)[:, SIDES].reshape(-1, 4, 3) for parts in zip(*solids, strict=True))
        shapes.append(DrawnShape(name, float(model.modes.frequency_hz[mode]), rest, motion))
    return shapes


def solid_shapes(drawn: SolidModel, finest: SolidModel) -> list[DrawnShape]:
    """Return the six modes on the surface of one mesh, with the finest mesh's frequencies."""
    faces, shapes = _outside(drawn), []
    for mode, name in enumerate(MODE_NAMES):
        rest, motion = [], []
        for x, y in ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)):
            mirror = np.array([x, y, 1.0])
            sense = (x if name in REVERSED_X else 1.0) * (y if name in REVERSED_Y else 1.0)
            rest.append(drawn.vertex_m[faces] * mirror)
            motion.append(sense * drawn.motion[mode][faces] * mirror)
        shapes.append(DrawnShape(name, float(finest.frequency_hz[mode]), np.concatenate(rest), np.concatenate(motion)))
    return shapes


def _beam(ends: FloatArray, motion: FloatArray, section: Section) -> tuple[FloatArray, FloatArray]:
    """Return corners (8, 3) of a beam and their motion by its nodes' (2, 6)."""
    along = ends[1] - ends[0]
    across = np.cross([0.0, 0.0, 1.0], along / np.linalg.norm(along))
    box = _box(1.0, 0.5 * section.width_m, 0.5 * section.height_m)
    offset = box[:, 1:2] * across + box[:, 2:] * np.array([0.0, 0.0, 1.0])
    end = (box[:, 0] > 0.0).astype(np.int64)
    moves = [(rigid_motion(o) @ motion[e])[:3] for o, e in zip(offset, end, strict=True)]
    return ends[end] + offset, np.stack(moves)


def _box(x: float, y: float, z: float) -> FloatArray:
    """Return the corners (8, 3) of a box about the origin."""
    bits = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
    return np.asarray((2.0 * bits - 1.0) * np.array([x, y, z]))


def _outside(model: SolidModel) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Return vertex numbers (P, 4) of the outer faces, without those in planes of symmetry."""
    corners = model.vertex_m[model.cell]
    bits = (corners > corners.mean(axis=1, keepdims=True)).astype(np.int64) @ np.array([1, 2, 4])
    ordered = np.take_along_axis(model.cell, np.argsort(bits, axis=1), axis=1)
    faces = ordered[:, SIDES].reshape(-1, 4)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    single = faces[first[count == 1]]
    inner = np.any(np.all(np.abs(model.vertex_m[single][..., :2]) < 1e-9, axis=1), axis=1)
    return np.asarray(single[~inner])


# From an element's geometry to its modes: formulas, frame, solid, comparison.

KEYS = {
    "compliant_length_m": "compliant_beams.length",
    "beam_width_m": "beams.width",
    "half_size_m": "platform.half_size",
    "height_m": "platform.height",
}
"""Keys of GEOMETRY.toml by the argument that a model refuses."""
STIFF = 1e3
"""Factor on the modulus of a platform that does not bend."""
MAX_MESH_CHANGE, MAX_DEVIATION = 0.02, 0.10
"""Relative change with the mesh, and deviation of frame and solid, from which a notice is given: chosen."""


def evaluate_element(
    definition: ElementDefinition, hashes: dict[str, str], *, solid: bool, progress: ProgressCallback = no_progress
) -> ElementEvaluation:
    """Evaluate all models of an elastic element: formulas, frame, solid, and comparison.

    Parameters
    ----------
    definition
        The element, of `read_definition`.
    hashes
        SHA-256 of the input files by name, for the results.
    solid
        Whether the solid model is computed, which takes about a minute.
    progress
        Callback (stage, done, total). Default: none.

    Returns
    -------
    ElementEvaluation : natural frequencies by every model, with their comparison.

    Raises
    ------
    InputError : a key that the user has to correct, or a missing package for the solid model.

    Examples
    --------
    >>> from fusion import evaluate_element
    >>> from fusion.sensor.elastomer.element_definition import read_definition
    >>> definition = read_definition("elastomer.toml")  # doctest: +SKIP
    >>> evaluation = evaluate_element(definition, {}, solid=False)  # doctest: +SKIP
    """
    started = time.monotonic()
    file = definition.file
    consistent = file.frame.mass_matrix == "consistent"
    half_size = file.platform.half_size
    fits: tuple[PlatformFit, ...] = ()
    if file.fit is not None:
        with as_input_error(definition.path, "fit.frequencies"):
            fits = platform_family(definition.beams, file.fit.half_sizes, file.fit.frequencies.values_hz)
    frame = solve_frame(definition.beams, half_size, definition.platform, file.frame.pieces, consistent)
    study = _solid(definition, progress) if solid else None
    stiffness, mass = beam_stiffness(definition.beams, half_size), definition.platform.mass_kg
    along = oscillator_hz(stiffness.x, mass)
    closed = {"Tx": along, "Ty": along, "Tz": oscillator_hz(stiffness.z, mass)}  # the closed form has no turns
    columns = [_exact("beam formulas", "formula", closed), _exact("frame", "frame", frame.modes.frequency_hz)]
    columns += [] if study is None else [_exact("solid", "solid", study.finest.frequency_hz)]
    measured, notices = measured_column(definition)
    columns += [] if measured is None else [measured]
    columns += [_exact(item.name, "stated", item.values_hz) for item in file.stated]
    remarks = [notice for fit in fits for notice in fit.notices]
    texts = [notice.text for notice in remarks]  # equal notices of several fits appear once
    of_fits = [notice.at("fit") if texts.count(notice.text) > 1 else notice for notice in remarks]
    notices += [*_of_frame(definition, frame), *_of_solid(frame, study), *dict.fromkeys(of_fits)]
    return ElementEvaluation(
        name=file.name,
        definition=definition,
        facts=statics_facts(definition, frame),
        frame=frame,
        sensitivity=sensitivities(definition.beams, half_size, definition.platform),
        solid=study,
        columns=tuple(columns),
        fits=fits,
        mounted=mounted_chain(definition, frame),
        notices=tuple(notices),
        settings={"solid": int(solid), "pieces": file.frame.pieces, "mass_matrix": file.frame.mass_matrix},
        input_hashes=hashes,
        duration_s=time.monotonic() - started,
    )


def _solid(definition: ElementDefinition, progress: ProgressCallback) -> SolidStudy:
    """Return the solid on all meshes; raise `InputError` for a missing key or scikit-fem."""
    block, refinements = definition.solid_block, definition.file.solid.refinements
    if block is None:
        raise InputError(declared.BLOCK_THICKNESS_MISSING, definition.path, "platform.thickness")
    stiff = replace(block, stiffening=STIFF)
    models_to_solve = [*((block, refinement) for refinement in refinements), (stiff, refinements[-2])]
    models = []
    for done, (model, refinement) in enumerate(models_to_solve):
        progress("solid", done, len(models_to_solve))
        try:
            models.append(solve_solid(definition.beams, model, refinement))
        except ImportError as error:
            raise InputError(declared.SOLID_PACKAGE_MISSING, "--solid", reason=str(error)) from error
        except ValueError as error:
            key = KEYS.get(str(error).partition(":")[0], "")
            raise InputError.from_exception(error, definition.path, key, declared.SOLID_REFUSED) from error
    progress("solid", len(models_to_solve), len(models_to_solve))
    return SolidStudy(refinements, tuple(models[:-1]), models[-1])


def _of_frame(definition: ElementDefinition, frame: FrameModel) -> list[Notice]:
    """Return notices on mixed modes, further modes, and stated platform data."""
    found, participation = [], frame.modes.participation
    for name, share, highest in zip(MODE_NAMES, np.diag(participation), participation.max(axis=0), strict=True):
        if share < highest:
            found.append(Notice(declared.MIXED_MODE, name, share_percent=100.0 * float(share)))
    if len(frame.modes.others_hz):
        frequencies_hz = ", ".join(f"{value:.0f}" for value in frame.modes.others_hz)
        found.append(Notice(declared.FURTHER_MODES, "frame", frequencies_hz=frequencies_hz))
    if definition.file.platform.mass is not None:
        found.append(Notice(declared.PLATFORM_AS_STATED, "platform"))
    return found


def _of_solid(frame: FrameModel, study: SolidStudy | None) -> list[Notice]:
    """Return notices on convergence of the mesh, and deviations of the frame."""
    if study is None:
        return []
    found, change = [], mesh_change(study.meshes)
    worst = int(np.argmax(np.abs(change)))
    if abs(change[worst]) > MAX_MESH_CHANGE:
        percent = 100.0 * float(change[worst])
        found.append(Notice(declared.MESH_NOT_CONVERGED, "solid", mode=MODE_NAMES[worst], change_percent=percent))
    for index, name in enumerate(MODE_NAMES):
        one, other = frame.modes.frequency_hz[index], study.finest.frequency_hz[index]
        if abs(one / other - 1.0) > MAX_DEVIATION:
            stiff = study.rigid.frequency_hz[index]
            deviation, from_stiff = (100.0 * float(one / value - 1.0) for value in (other, stiff))
            found.append(Notice(declared.FRAME_DEVIATES, name, deviation_percent=deviation, stiff_percent=from_stiff))
    return found
