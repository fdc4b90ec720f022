"""Modes of a load in images: their shapes, and responses by their amplitudes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from fusion.errors import as_input_error
from fusion.estimation.uncertainty import as_complex, real_stack
from fusion.recording.placement import perpendicular_axes
from fusion.sensitivity.elastic import (
    ElasticPart,
    InstrumentPosition,
    MeasuredModes,
    NaturalModes,
    Rod,
    Variant,
    response,
)
from fusion.sensitivity.moving_body import Body, elastic_body, stated_modes
from fusion.sensitivity.sensitivity_notices import MODES_CONTRADICT
from photogram.camera import principal_components
from shaker.io.text import read_table_columns
from shaker.sine.phasor import real_stacked_diagonal
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.phasors.stereo_phasors import StereoResult
    from fusion.recording.rig import Elastic, RigLoad

CONTRADICTED = 0.01
"""Chance below which a response is not the stated one."""
NOT_DRIVEN = 1e-6  # share of the largest drive below which a mode is not driven
NEIGHBOURS = 30  # points of a surface used for interpolation
COLUMNS = ("x", "y", "z", "ux", "uy", "uz")


@dataclass(frozen=True)
class _Chosen:
    """The modes of one elastic part that images measure: their numbers and labels."""

    table: Elastic
    which: tuple[int, ...]
    labels: tuple[str, ...]

    @classmethod
    def of(cls, table: Elastic) -> _Chosen:
        """Choose the measurable modes of a table or a drawing.

        Of a table those with a surface, of a drawing the first along and across its axis.
        """
        if table.shape == "modes":
            numbers = [number for number, mode in enumerate(table.mode) if mode.surface is not None]
            return cls(table, tuple(numbers), tuple(f"mode {number + 1}" for number in numbers))
        which, labels, start = list[int](), list[str](), 0
        for kind, modes in elastic_body(table).families().items():
            sides = {"axial": 1, "bending": 2}.get(kind, 0)
            each = len(modes.frequency_hz) // max(sides, 1)
            which += [start + side * each for side in range(sides)]
            labels += [f"{kind} {side + 1}" if sides > 1 else kind for side in range(sides)]
            start += len(modes.frequency_hz)
        return cls(table, tuple(which), tuple(labels))

    @cached_property
    def surfaces(self) -> tuple[tuple[Path, FloatArray], ...]:
        """Files of the modes of a table, with positions and displacements (P, 6)."""
        found = []
        for path in (self.table.mode[number].surface for number in self.which):
            assert path is not None
            with as_input_error(path):
                found.append((path, read_table_columns(path, COLUMNS)))
        return tuple(found)

    def displacement(self, points_m: FloatArray) -> FloatArray:
        """Return the displacement (M, N, 3) of points (N, 3) per unit of each mode."""
        if self.table.shape == "modes":
            moved = []
            for path, surface in self.surfaces:
                with as_input_error(path):
                    moved.append(_between(surface, points_m))
            return np.stack(moved)
        motion = self._drawn_modes.motion
        return np.stack([motion(InstrumentPosition("", point))[list(self.which), :3] for point in points_m], axis=1)

    @cached_property
    def _drawn_modes(self) -> NaturalModes:
        return stated_modes(self.table, {})

    def __reduce__(self) -> tuple[type[_Chosen], tuple[Elastic, tuple[int, ...], tuple[str, ...]]]:
        """Pickle without computed values: modes of a drawing are functions and cannot be pickled."""
        return _Chosen, (self.table, self.which, self.labels)

    @cached_property
    def size(self) -> FloatArray:
        """Largest displacement (M,) per unit of each mode.

        In the table, or along a drawing.
        """
        if self.table.shape == "modes":
            return np.array([np.linalg.norm(rows[:, 3:], axis=1).max() for _, rows in self.surfaces])
        shape = elastic_body(self.table)
        if isinstance(shape, Rod):
            positions = shape.foot_m + np.linspace(0.0, shape.length_m, 9)[:, None] * shape.axis
        else:
            angle, sides = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False), np.array(perpendicular_axes(shape.axis))
            around = np.column_stack([np.cos(angle), np.sin(angle)]) @ sides
            positions = shape.foot_m + shape.diameter_m / 2.0 * around
        return np.asarray(np.linalg.norm(self.displacement(positions), axis=2).max(axis=1))


def _between(surface: FloatArray, points_m: FloatArray) -> FloatArray:
    """Return the displacement (N, 3) of points (N, 3) between positions of a surface.

    `surface` (P, 6): positions and displacements. Thin plate splines over its plane, extended linearly beyond its rim.
    """
    from scipy.interpolate import RBFInterpolator

    middle = surface[:, :3].mean(axis=0)
    plane = np.linalg.svd(surface[:, :3] - middle, full_matrices=False)[2][:2].T
    moved, finite = np.full(points_m.shape, np.nan), np.isfinite(points_m).all(axis=1)
    neighbours = min(NEIGHBOURS, len(surface))
    spline = RBFInterpolator((surface[:, :3] - middle) @ plane, surface[:, 3:], neighbors=neighbours)
    moved[finite] = spline((points_m[finite] - middle) @ plane)
    return moved


@dataclass(frozen=True)
class ModeShapes:
    """The modes of a load that a stereo pair measures, for `photogram`.

    An amplitude is the largest displacement of a mode in m, on the surface of its table or along its drawing.
    """

    parts: tuple[_Chosen, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Return the modes as "plate: axial"."""
        return tuple(f"{part.table.name}: {label}" for part in self.parts for label in part.labels)

    def __call__(self, points_m: FloatArray) -> FloatArray:
        """Return the displacement (S, N, 3) of points per 1 m of each mode.

        `points_m` (N, 3).
        """
        return np.concatenate([part.displacement(points_m) / part.size[:, None, None] for part in self.parts])


def mode_shapes(load: RigLoad | None, pair: str) -> ModeShapes | None:
    """Return the modes of a load that a stereo pair measures (`measured_by`), None for none."""
    tables = () if load is None else load.elastic
    parts = tuple(_Chosen.of(table) for table in tables if pair.rpartition(": ")[2] in table.measured_by)
    return ModeShapes(parts) if parts else None


# Responses of modes by measured amplitudes, as the mean with the stated ones.


@dataclass(frozen=True)
class _ObservedModes:
    """Measurement of the load and its modes by one stereo pair.

    At its U resolved lines. `foot` (U, 6): acceleration of the load's foot. `modal` (U, S): amplitudes of the modes in
    m/s², with `covariance` (U, 2S, 2S) of all real and imaginary parts. `share` (6, S).
    """

    pair: StereoResult
    foot: ComplexArray
    modal: ComplexArray
    covariance: FloatArray
    share: FloatArray

    @classmethod
    def of(cls, pair: StereoResult, parts: Sequence[tuple[ElasticPart, IntArray]]) -> _ObservedModes:
        """Return the measurement by `pair`.

        `parts`: elastic parts of the load with the numbers of the modes that the pair measures.
        """
        assert pair.shapes is not None
        frequency, shapes = pair.phasors.frequency_hz, pair.shapes
        square = -((2.0 * np.pi * frequency[:, None]) ** 2)
        rigid = square * pair.phasors.value
        modal = square * shapes.phasors.value
        others = np.zeros((len(frequency), 6, 6), np.complex128)
        face_m = np.asarray(np.nanmean(next(iter(pair.surface or ())).reference_m, axis=0))
        for part, which in parts:
            participation = part.modes.participation.copy()
            participation[which] = 0.0
            others += replace(part.modes, participation=participation).stretch(
                frequency, InstrumentPosition(pair.name, face_m)
            )
        moved = rigid - modal @ shapes.share.T
        foot = np.linalg.solve(np.eye(6) + others, moved[..., None])[..., 0]
        return cls(pair, np.asarray(foot), np.asarray(modal), square[..., None] ** 2 * shapes.covariance, shapes.share)


def with_measured_modes(
    body: Body | None, load: RigLoad | None, stereo: Sequence[StereoResult]
) -> tuple[Body | None, tuple[Notice, ...]]:
    """Return a load whose mode responses are means of measured and stated ones.

    The response G = q̈/(Lᵀ·A) of a mode with participation L follows from its amplitude and the motion of the foot in
    the same images, so that scale and clock of the pair cancel. Stated natural frequencies and damping are its prior,
    if the part has any uncertainty. A response that contradicts the prior at 1 % replaces it.
    """
    if body is None:
        return None, ()
    parts, contradictions = {part.name: part for part in body.elastic}, list[Notice]()
    for pair in stereo:
        shapes = mode_shapes(load, pair.name) if pair.body == "load" else None
        if shapes is None or pair.shapes is None or pair.shapes.phasors.channels != shapes.names:
            continue
        chosen = {part.table.name: np.array(part.which, dtype=np.int64) for part in shapes.parts}
        none, start = np.zeros(0, np.int64), 0
        seen = _ObservedModes.of(pair, [(part, chosen.get(name, none)) for name, part in parts.items()])
        for one in shapes.parts:
            columns = np.arange(start, start + len(one.which))
            start += len(one.which)
            name = one.table.name
            size = one.size / np.sqrt([one.table.mode[n].modal_mass if one.table.mode else 1.0 for n in one.which])
            parts[name], notices = _measured(parts[name], chosen[name], seen, columns, size)
            contradictions += notices
    return replace(body, elastic=tuple(parts.values())), tuple(contradictions)


def _measured(
    part: ElasticPart, which: IntArray, seen: _ObservedModes, columns: IntArray, size: FloatArray
) -> tuple[ElasticPart, list[Notice]]:
    """Return a part with the measured responses of some modes, and notices.

    `size` (M,) in m for a unit of each.
    """
    pair, count, both = seen.pair, len(which), np.concatenate([columns, columns + seen.share.shape[1]])
    drive = seen.foot @ part.modes.participation[which].T
    driven = np.abs(drive) > NOT_DRIVEN * np.abs(drive).max(initial=1e-300)
    scale = np.where(driven, 1.0 / (np.where(driven, drive, 1.0) * size), 0.0)
    moved = seen.modal[:, columns] * scale
    turn = real_stacked_diagonal(scale)
    covariance = turn @ seen.covariance[:, both[:, None], both] @ turn.swapaxes(1, 2)
    frequency = pair.phasors.frequency_hz
    gain, contradicted = _gain(part, which, frequency, moved, covariance)
    gain *= np.tile(driven, 2)[:, None, :]
    lines = len(pair.usable)
    whole, weight = np.zeros((lines, count), np.complex128), np.zeros((lines, 2 * count, 2 * count))
    whole[pair.usable], weight[pair.usable] = moved, gain
    measured = MeasuredModes(pair.name, which, whole, weight, (seen.share[:, columns] * size).T)

    def carrying(modes: NaturalModes, change: ComplexArray | float = 0.0) -> NaturalModes:
        return replace(modes, measured=(*modes.measured, replace(measured, response=whole + change)))

    variants = [replace(v, above=carrying(v.above), below=carrying(v.below)) for v in part.variants]
    label = f"elastic {part.name}: as stereo {pair.name} sees it"
    for line, hertz, of_line in zip(np.flatnonzero(pair.usable), frequency, covariance, strict=True):
        for number, step in enumerate(principal_components(of_line)):
            change = np.zeros_like(whole)
            change[line] = as_complex(step)
            sides = carrying(part.modes, change), carrying(part.modes, -change)
            variants.append(Variant(f"{label}, {hertz:.9g} Hz {number}", label, 1.0, "1", "recording", *sides))
    found = replace(part, modes=carrying(part.modes), variants=tuple(variants))
    return found, _contradictions(part, pair, contradicted)


def _gain(
    part: ElasticPart, which: IntArray, frequency_hz: FloatArray, found: ComplexArray, covariance: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the weight (U, 2M, 2M) of measured responses, and where they contradict.

    P·(P + C)⁻¹ with the stated covariance P and the measured covariance C; 1 where measured responses (U, M) contradict
    the stated ones.
    """

    def stated(modes: NaturalModes) -> FloatArray:
        moved = response(frequency_hz, modes.frequency_hz, modes.damping)[:, which]
        return real_stack(moved)

    effects = np.stack([(stated(v.above) - stated(v.below)) / 2.0 for v in part.variants])
    prior = np.einsum("vui,vuj->uij", effects, effects)
    off = real_stack(found) - stated(part.modes)
    inverse = np.linalg.pinv(prior + covariance, hermitian=True)
    square = np.einsum("ui,uij,uj->u", off, inverse, off)
    contradicted = np.asarray(chdtrc(float(off.shape[1]), square) < CONTRADICTED / len(off))
    gain = prior @ inverse
    gain[contradicted] = np.eye(off.shape[1])
    return gain, contradicted


def _contradictions(part: ElasticPart, pair: StereoResult, contradicted: BoolArray) -> list[Notice]:
    """Return a warning for each line at which measured and stated responses contradict."""
    frequency_hz = pair.phasors.frequency_hz[contradicted].tolist()
    return [
        Notice(MODES_CONTRADICT, f"{hertz:.6g} Hz", part=part.name, pair=pair.name, frequency_hz=hertz)
        for hertz in frequency_hz
    ]
