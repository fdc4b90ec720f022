"""Modes of an elastic load as rig.toml states them, and their shapes in images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion.errors import ComputeError, as_input_error
from fusion.estimation.uncertainty import Scope
from fusion.recording.placement import perpendicular_axes
from fusion.sensitivity.elastic import ElasticPart, InstrumentPosition, NaturalModes, Plate, Rod, Variant, join_modes
from fusion.sensitivity.sensitivity_notices import POSITION_UNSTATED
from shaker.io.table import read_table_columns
from shakercal._common.arrays import FloatArray

if TYPE_CHECKING:
    from fusion.recording.rig import Elastic, ElasticMode, RigLoad

NEIGHBOURS = 30  # points of a surface used for interpolation
COLUMNS = ("x", "y", "z", "ux", "uy", "uz")


# What rig.toml states of an elastic load as modes with their unknowns.


UNCERTAIN: Mapping[str, tuple[str, Scope]] = {
    "young_modulus": ("Pa", "rig"),
    "density": ("kg/m^3", "rig"),
    "poisson_ratio": ("1", "rig"),
    "length": ("m", "rig"),
    "diameter": ("m", "rig"),
    "inner_diameter": ("m", "rig"),
    "thickness": ("m", "rig"),
    "clamped_diameter": ("m", "rig"),
    "tip_mass": ("kg", "rig"),
    "axial_frequency": ("Hz", "mounting"),
    "bending_frequency": ("Hz", "mounting"),
    "damping": ("1", "mounting"),
    "frequencies": ("1", "rig"),
    "participation": ("1", "rig"),
}
"""Keys of `[[load.elastic]]` with an uncertainty, its unit and its scope."""
FACTORS = ("frequencies", "participation")
"""Of all modes together: 1, with a relative uncertainty."""


def elastic_part(table: Elastic) -> ElasticPart:
    """Return the modes of a block `[[load.elastic]]`, and their changes by its uncertain numbers."""
    title, variants = f"elastic {table.name}", []

    def add(
        what: str, stated: float, u: float, unit: str, scope: Scope, changed: Callable[[float], NaturalModes]
    ) -> None:
        if u > 0.0:
            name, label = f"{title}: {what} {stated:.9g}", f"{title}: {what}"
            variants.append(Variant(name, label, u, unit, scope, changed(stated + u), changed(stated - u)))

    for key, (unit, scope) in UNCERTAIN.items():
        stated, u = 1.0 if key in FACTORS else getattr(table, key), getattr(table, f"{key}_uncertainty")

        def other(value: float, key: str = key) -> NaturalModes:
            return stated_modes(table, {key: value})

        if stated is not None:
            add(key.replace("_", " "), stated, u, unit, scope, other)
    for index, mode in enumerate(table.mode):

        def shifted(frequency: float, index: int = index, mode: ElasticMode = mode) -> NaturalModes:
            moved = mode.model_copy(update={"frequency": frequency})
            return stated_modes(table, {"mode": (*table.mode[:index], moved, *table.mode[index + 1 :])})

        add("frequency", mode.frequency, mode.frequency_uncertainty, "Hz", "rig", shifted)
    mass = None if table.shape == "modes" else elastic_body(table).mass_kg
    return ElasticPart(table.name, stated_modes(table, {}), tuple(variants), mass)


def elastic_body(table: Elastic) -> Rod | Plate:
    """Return the rod or plate of a block."""
    foot, axis = np.array(table.foot), np.array(table.axis or (0.0, 0.0, 1.0))
    material = table.young_modulus or 0.0, table.density or 0.0, table.poisson_ratio
    across_it = table.diameter or 0.0
    if table.shape == "rod":
        return Rod(foot, axis, table.length or 0.0, across_it, table.inner_diameter, *material, table.tip_mass)
    return Plate(foot, axis, table.thickness or 0.0, across_it, table.clamped_diameter or 0.0, *material)


def stated_modes(table: Elastic, change: Mapping[str, Any]) -> NaturalModes:
    """Return the modes of a block with some values changed."""
    table = table.model_copy(update={key: value for key, value in change.items() if key not in FACTORS})
    if table.shape == "modes":
        modes = _tabled(table)
    else:
        families = elastic_body(table).families()
        for kind, tapped in (("axial", table.axial_frequency), ("bending", table.bending_frequency)):
            if tapped is not None:
                natural = families[kind].frequency_hz
                families[kind] = replace(families[kind], frequency_hz=natural * (tapped / natural.min()))
        modes = join_modes(list(families.values()))
        modes = replace(modes, damping=np.full(len(modes.damping), table.damping))
    return replace(
        modes,
        frequency_hz=modes.frequency_hz * change.get("frequencies", 1.0),
        participation=modes.participation * change.get("participation", 1.0),
    )


def _tabled(table: Elastic) -> NaturalModes:
    """Return the modes of a finite element program, with a modal mass of 1."""
    root = np.sqrt([mode.modal_mass for mode in table.mode])

    def motion(position: InstrumentPosition) -> FloatArray:
        # A channel of a later set-up is named by that, too.
        names = [
            name for name in (position.name, position.name.rpartition(": ")[2]) if name in table.mode[0].displacement
        ]
        if not names:
            key = f"load.elastic.mode.displacement of {table.name}"
            raise ComputeError(POSITION_UNSTATED, instrument=position.name, key=key)
        rows = [mode.displacement[names[0]] for mode in table.mode]
        return np.array([[*row, *[0.0] * (6 - len(row))] for row in rows]) / root[:, None]

    return NaturalModes(
        np.array([mode.frequency for mode in table.mode]),
        np.array([table.damping if mode.damping is None else mode.damping for mode in table.mode]),
        np.array([mode.participation for mode in table.mode]) / root[:, None],
        motion,
    )


# Their shapes, as stereo pairs measure them.


@dataclass(frozen=True)
class _Chosen:
    """The modes of one elastic part that images measure: their numbers and labels."""

    table: Elastic
    which: tuple[int, ...]
    labels: tuple[str, ...]

    @classmethod
    def of(cls, table: Elastic) -> _Chosen:
        """Choose a table's modes with a surface, or a drawing's first ones."""
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
        """Largest displacement (M,) per unit of each mode, in the table or along a drawing."""
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
        """Return the displacement (S, N, 3) of points per 1 m of each mode."""
        return np.concatenate([part.displacement(points_m) / part.size[:, None, None] for part in self.parts])


def mode_shapes(load: RigLoad | None, pair: str) -> ModeShapes | None:
    """Return the modes of a load that a stereo pair measures (`measured_by`), None for none."""
    tables = () if load is None else load.elastic
    parts = tuple(_Chosen.of(table) for table in tables if pair.rpartition(": ")[2] in table.measured_by)
    return ModeShapes(parts) if parts else None
