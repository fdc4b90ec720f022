"""Mass matrix, lever arms and gravity tilt of the load, and what lies below an elastic joint."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fusion.base import InputError
from photogram.geometry import skew
from shaker.arrays import ComplexArray, FloatArray
from shaker.identification.measured import InertiaError
from shaker.labels import MOTION_COMPONENTS

if TYPE_CHECKING:
    from fusion.estimation.measurement_model import Deviates
    from fusion.estimation.uncertainty import Scope
    from fusion.recording.load import Manifest
    from fusion.recording.manifest import Load, Rig
    from fusion.recording.manifest import Part as PartTable

# The elastic joint between a load and what is mounted below it: how the lower side follows the upper one.


@dataclass(frozen=True)
class Joint:
    """The joint on which a load sits, with the instruments on the load.

    `frequency_hz` (6,): at which the load would resonate on the joint if the lower side stood still, component by
    component; `u_frequency_hz` (6,): its standard uncertainty, 0 where the joint is only named: then nothing is
    corrected, and what a correction would change is uncertain as a whole; `damping`: damping ratio of that resonance.
    """

    frequency_hz: FloatArray
    u_frequency_hz: FloatArray
    damping: float

    def follow(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return (K, 6): motion of the lower side over that of the load, 1 - r²/(1 + 2jζr) with r = f/f_e.

        The joint carries the load's inertia, -ω²·m·x_load = (k + jωb)·(x_below - x_load).
        """
        stated = self.u_frequency_hz > 0.0
        return np.asarray(np.where(stated, 1.0 - self._stretch(frequency_hz), 1.0))

    def change(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return (K, 6): change of `follow` for one standard uncertainty of the joint.

        Where it is corrected the derivative by f_e times its uncertainty; where it is only named the root mean square,
        1/√3 of the whole, of an error anywhere between nothing and a joint as elastic as that.
        """
        r = frequency_hz[:, None] / self.frequency_hz
        damped = 1.0 + 2j * self.damping * r
        slope = r * r * (1.0 + damped) / damped**2 / self.frequency_hz
        stated = self.u_frequency_hz > 0.0
        return np.asarray(np.where(stated, slope * self.u_frequency_hz, -self._stretch(frequency_hz) / np.sqrt(3.0)))

    def _stretch(self, frequency_hz: FloatArray) -> ComplexArray:
        """Share (K, 6) of the load's motion that the joint takes up."""
        r = frequency_hz[:, None] / self.frequency_hz
        return np.asarray(r * r / (1.0 + 2j * self.damping * r))


def make_joint(frequency_hz: ArrayLike, u_frequency_hz: ArrayLike = 0.0, damping: float = 0.0) -> Joint:
    """Return a joint; one number stands for all six components."""
    frequency = np.broadcast_to(np.asarray(frequency_hz, dtype=np.float64), (6,)).copy()
    u_frequency = np.broadcast_to(np.asarray(u_frequency_hz, dtype=np.float64), (6,)).copy()
    return Joint(frequency, u_frequency, float(damping))


# Bodies about the sensor origin: mass matrix, tilt of the weight in air, and what their uncertain parameters do.


INERTIA_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
AIR_MOVED_ALONG = 0.5
"""Mass of the air that a body takes along, in masses of the air it displaces: a sphere's (Lamb 1932, Art. 92)."""
U_AIR_MOVED_ALONG = 0.5 / np.sqrt(3.0)
"""Its standard uncertainty: anything from none to once the displaced air, which a long cylinder takes across."""


@dataclass(frozen=True)
class Part:
    """A rigid part in the sensor frame, with standard uncertainties.

    `mass_kg`; `centre_of_mass_m` (3,); `inertia_kgm2` (3, 3) about its centre of mass; `u_mass_kg`;
    `u_centre_of_mass_m` (3,); `u_inertia_kgm2` (3, 3), one per entry. `air_share`: mass of the displaced air over the
    part's own, 0 where it is not known. `below_joint`: on the sensor's side of the load's elastic joint.
    """

    name: str
    mass_kg: float
    centre_of_mass_m: FloatArray
    inertia_kgm2: FloatArray
    u_mass_kg: float
    u_centre_of_mass_m: FloatArray
    u_inertia_kgm2: FloatArray
    air_share: float = 0.0
    below_joint: bool = False

    def __post_init__(self) -> None:
        for key, shape in (("centre_of_mass_m", (3,)), ("inertia_kgm2", (3, 3))):
            for name in (key, f"u_{key}"):
                found = np.shape(getattr(self, name))
                if found != shape:
                    raise ValueError(f"{name}: expected shape {shape}, found {found}")
        if not np.allclose(self.inertia_kgm2, self.inertia_kgm2.T, rtol=0.0, atol=1e-12):
            raise ValueError(f"inertia_kgm2: expected a symmetric matrix, found {self.inertia_kgm2.tolist()}")


def make_part(
    name: str,
    mass_kg: float,
    centre_of_mass_m: ArrayLike,
    inertia_kgm2: ArrayLike,
    uncertainties: tuple[float, ArrayLike, ArrayLike] = (0.0, 0.0, 0.0),
    air_share: float = 0.0,
    below_joint: bool = False,
) -> Part:
    """Return a part from plain lists; one number as an uncertainty (mass, centre of mass, inertia) holds for all."""
    u_mass, u_centre, u_inertia = uncertainties
    return Part(
        name=name,
        mass_kg=float(mass_kg),
        centre_of_mass_m=np.array(centre_of_mass_m, dtype=np.float64),
        inertia_kgm2=np.array(inertia_kgm2, dtype=np.float64),
        u_mass_kg=float(u_mass),
        u_centre_of_mass_m=np.broadcast_to(np.asarray(u_centre, dtype=np.float64), (3,)).copy(),
        u_inertia_kgm2=np.broadcast_to(np.asarray(u_inertia, dtype=np.float64), (3, 3)).copy(),
        air_share=float(air_share),
        below_joint=below_joint,
    )


@dataclass(frozen=True)
class InertialTerms:
    """What a body, or the change of one, contributes to the equations of motion about the sensor origin.

    `mass_matrix` (6, 6): wrench = mass_matrix · [a, alpha] of the origin. `weight_kg` and `weight_moment_kgm` (3,):
    mass and mass times centre of mass less those of the displaced air, which gravity acts on.
    """

    mass_matrix: FloatArray
    weight_kg: float
    weight_moment_kgm: FloatArray

    def load_matrix(self, frequency_hz: FloatArray, gravity_mps2: FloatArray | None) -> FloatArray:
        """Return (K, 6, 6): wrench phasors = matrix · acceleration phasors, in body axes, with the tilt of gravity.

        With theta = -alpha/omega^2 the weight turns in body axes: F = m (theta × g), M = c × m (theta × g).
        """
        omega2 = (2.0 * np.pi * frequency_hz) ** 2
        matrix = np.repeat(self.mass_matrix[None], len(frequency_hz), axis=0)
        if gravity_mps2 is not None:
            weight = skew(gravity_mps2)
            tilt = np.concatenate([self.weight_kg * weight, skew(self.weight_moment_kgm) @ weight])
            matrix[:, :, 3:] += tilt / omega2[:, None, None]
        return matrix


@dataclass(frozen=True)
class MatrixChange:
    """What one standard uncertainty of one unknown does to the load matrix: `change` (K, 6, 6)."""

    name: str
    label: str
    u: float
    unit: str
    scope: Scope
    change: ComplexArray


@dataclass(frozen=True)
class Body:
    """Parts that move as one, or, where the load's `joint` is known, as one above and one below it."""

    parts: tuple[Part, ...]
    joint: Joint | None = None

    @property
    def terms(self) -> InertialTerms:
        """Sum of the parts' terms about the sensor origin, as if everything were rigid."""
        return _sum([_terms(part) for part in self.parts])

    @property
    def mass_matrix(self) -> FloatArray:
        """Mass matrix (6, 6) about the sensor origin: F = m (a + alpha × c), M = c × F + J alpha."""
        return self.terms.mass_matrix

    def load_matrix(self, frequency_hz: FloatArray, gravity_mps2: FloatArray | None) -> ComplexArray:
        """Return (K, 6, 6): wrench = matrix · acceleration of the load; parts below its joint follow it."""
        above, below = ([_terms(p) for p in self.parts if self._below(p) == side] for side in (False, True))
        matrix = _sum(above).load_matrix(frequency_hz, gravity_mps2).astype(np.complex128)
        if self.joint is not None and below:
            lower = _sum(below).load_matrix(frequency_hz, gravity_mps2)
            matrix += lower * self.joint.follow(frequency_hz)[:, None, :]
        return matrix

    def matrix_changes(
        self, frequency_hz: FloatArray, gravity_mps2: FloatArray | None, u_gravity_mps2: FloatArray | None = None
    ) -> tuple[MatrixChange, ...]:
        """Return what every uncertain number does to the load matrix: of the parts, of gravity and of the joint."""
        changes = []
        for part in self.parts:
            follow = self.joint.follow(frequency_hz)[:, None, :] if self.joint and self._below(part) else np.ones(1)
            for name, label, u, unit, scope, terms in _parameters(part):
                change = (terms.load_matrix(frequency_hz, gravity_mps2) * follow).astype(np.complex128)
                changes.append(MatrixChange(name, label, u, unit, scope, change))
        below = [_terms(part) for part in self.parts if self._below(part)]
        if self.joint is not None and below:
            # The joint holds until it is screwed together anew: one unknown per component.
            lower, by_joint = _sum(below).load_matrix(frequency_hz, gravity_mps2), self.joint.change(frequency_hz)
            for place, axis in enumerate(MOTION_COMPONENTS):
                stated, u = float(self.joint.frequency_hz[place]), float(self.joint.u_frequency_hz[place])
                own = np.zeros(lower.shape, dtype=np.complex128)
                own[:, :, place] = lower[:, :, place] * by_joint[:, None, place]
                name, label = f"joint of the load {stated:.9g} Hz: {axis}", "joint of the load"
                changes.append(MatrixChange(name, label, u or 1.0, "Hz" if u else "1", "mounting", own))
        # Of the vector of gravity only the tilt of the weight knows.
        still = self.load_matrix(frequency_hz, None)
        u_gravity = np.zeros(3) if u_gravity_mps2 is None else u_gravity_mps2
        for axis, along, u in zip("xyz", np.eye(3), u_gravity.tolist(), strict=True):
            if u > 0.0:
                change = self.load_matrix(frequency_hz, along * u) - still
                changes.append(MatrixChange(f"gravity {axis}", "gravity", u, "m/s^2", "rig", change))
        return tuple(changes)

    def _below(self, part: Part) -> bool:
        """Whether a part lies on the sensor's side of a joint."""
        return self.joint is not None and part.below_joint


def _sum(terms: list[InertialTerms]) -> InertialTerms:
    """Terms of several parts together, zero of none."""
    return InertialTerms(
        mass_matrix=np.sum([np.zeros((6, 6)), *(term.mass_matrix for term in terms)], axis=0),
        weight_kg=float(sum(term.weight_kg for term in terms)),
        weight_moment_kgm=np.sum([np.zeros(3), *(term.weight_moment_kgm for term in terms)], axis=0),
    )


def _terms(part: Part) -> InertialTerms:
    """Terms of one part about the sensor origin; the air it takes along has inertia but no weight."""
    mass, lever = part.mass_kg * (1.0 + AIR_MOVED_ALONG * part.air_share), skew(part.centre_of_mass_m)
    weight = part.mass_kg * (1.0 - part.air_share)
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = mass * np.eye(3)
    matrix[:3, 3:] = -mass * lever
    matrix[3:, :3] = mass * lever
    matrix[3:, 3:] = part.inertia_kgm2 - mass * lever @ lever
    return InertialTerms(matrix, weight, weight * part.centre_of_mass_m)


def _parameters(part: Part) -> Iterator[tuple[str, str, float, str, Scope, InertialTerms]]:
    """Yield every uncertain number of a part: name, label, `u` in its unit, scope, and the change of the terms by it.

    The name contains what was stated, so that another part or another place is another unknown.
    """
    told = f"{part.name} {part.mass_kg:.9g} kg"
    place = "[{}]".format(", ".join(f"{float(x):.9g}" for x in part.centre_of_mass_m))
    none = np.zeros((3, 3))
    if part.u_mass_kg > 0.0:
        change = _terms(make_part(part.name, part.u_mass_kg, part.centre_of_mass_m, none))
        yield f"{told}: mass", f"{part.name}: mass", part.u_mass_kg, "kg", "rig", change
    for letter, unit, u in zip("xyz", np.eye(3), part.u_centre_of_mass_m.tolist(), strict=True):
        if u > 0.0:
            lever, shift = skew(part.centre_of_mass_m), skew(unit * u)
            matrix = np.zeros((6, 6))
            matrix[:3, 3:] = -part.mass_kg * shift
            matrix[3:, :3] = part.mass_kg * shift
            matrix[3:, 3:] = -part.mass_kg * (lever @ shift + shift @ lever)
            moved = InertialTerms(matrix, 0.0, part.mass_kg * (1.0 - part.air_share) * unit * u)
            yield f"{told}: centre of mass {place} {letter}", f"{part.name}: centre of mass", u, "m", "mounting", moved
    for row, column in INERTIA_ENTRIES:
        u = float(part.u_inertia_kgm2[row, column])
        if u > 0.0:
            matrix = np.zeros((6, 6))
            matrix[3 + row, 3 + column] = matrix[3 + column, 3 + row] = u
            name = f"{told}: inertia {part.inertia_kgm2[row, column]:.9g} {'xyz'[row]}{'xyz'[column]}"
            yield name, f"{part.name}: inertia", u, "kg.m^2", "rig", InertialTerms(matrix, 0.0, np.zeros(3))
    if part.air_share > 0.0:
        u = U_AIR_MOVED_ALONG * part.air_share * part.mass_kg
        air = _terms(make_part(part.name, u, part.centre_of_mass_m, none)).mass_matrix
        terms = InertialTerms(air, 0.0, np.zeros(3))
        yield f"{told}: air moved along", f"{part.name}: air moved along", u, "kg", "rig", terms


# Bodies whose masses, centres and moments of inertia are what a Monte Carlo run draws.


def draw_load_matrices(
    body: Body,
    frequency_hz: FloatArray,
    gravity_mps2: FloatArray | None,
    u_gravity_mps2: FloatArray | None,
    deviates: Deviates,
) -> ComplexArray:
    """Return N load matrices (N, K, 6, 6): mass, centre of mass and inertia of every part drawn, and whatever else.

    The parts' own numbers enter exactly; gravity, the joint and the air by their first-order changes.
    """
    own = {f"{part.name}: {what}" for part in body.parts for what in ("mass", "centre of mass", "inertia")}
    total = np.zeros((deviates.count, len(frequency_hz), 6, 6), dtype=np.complex128)
    for part in body.parts:
        # Mass times (1, c, products of c), and the six entries of the inertia.
        mass = part.mass_kg + part.u_mass_kg * deviates.normal(f"{part.name}: mass")
        centre = part.centre_of_mass_m + part.u_centre_of_mass_m * deviates.normal(f"{part.name}: centre of mass", 3)
        products = [centre[:, i] * centre[:, j] for i, j in INERTIA_ENTRIES]
        entries = tuple(np.array(INERTIA_ENTRIES).T)
        inertia = part.inertia_kgm2[entries] + part.u_inertia_kgm2[entries] * deviates.normal(
            f"{part.name}: inertia", 6
        )
        moments = mass[:, None] * np.column_stack([np.ones(deviates.count), centre, *products])
        terms = _polynomial(replace(body, parts=(part,)), frequency_hz, gravity_mps2)
        total += np.tensordot(np.column_stack([moments, inertia]), terms, 1)
    for change in body.matrix_changes(frequency_hz, gravity_mps2, u_gravity_mps2):
        if change.label not in own:
            total += deviates.normal(change.name)[:, None, None, None] * change.change
    return total


def _polynomial(alone: Body, frequency_hz: FloatArray, gravity_mps2: FloatArray | None) -> ComplexArray:
    """Coefficients (16, K, 6, 6) of mass · (1, c, products of c) and inertia in the load matrix of a body of one part.

    The matrix is linear in mass and inertia and of second order in the centre of mass: its values at 0, ±e_i and
    e_i + e_j tell all of it.
    """
    (part,) = alone.parts

    def at(mass: float, centre: FloatArray, inertia: FloatArray) -> ComplexArray:
        one = replace(part, mass_kg=mass, centre_of_mass_m=centre, inertia_kgm2=inertia)
        return replace(alone, parts=(one,)).load_matrix(frequency_hz, gravity_mps2)

    none, unit = np.zeros((3, 3)), np.eye(3)
    still = at(1.0, np.zeros(3), none)
    ahead, behind = ([at(1.0, sign * e, none) for e in unit] for sign in (1.0, -1.0))
    slope = [(a - b) / 2.0 for a, b in zip(ahead, behind, strict=True)]
    square = [(a + b) / 2.0 - still for a, b in zip(ahead, behind, strict=True)]
    mixed, turning = [], []
    for i, j in INERTIA_ENTRIES:
        entry = np.zeros((3, 3))
        entry[i, j] = entry[j, i] = 1.0
        turning.append(at(0.0, np.zeros(3), entry))
        if i != j:
            mixed.append(at(1.0, unit[i] + unit[j], none) - still - slope[i] - slope[j] - square[i] - square[j])
    return np.stack([still, *slope, *square, *mixed, *turning])


# The body from the tables of rig.toml and recording.toml.


def load_body(rig: Rig, parts: Sequence[PartTable]) -> Body | None:
    """Return all that moves above the elastic element: load, parts and internal mass; None without a `[load]`.

    Masses are true ones, in air of the density that the rig states. The sensor's own mass lies below the load's joint,
    where there is one.
    """
    load, sensor, environment = rig.load, rig.sensor, rig.environment
    if load is None:
        return None
    air_density = 0.0 if environment is None else environment.air_density or 0.0
    tables: list[tuple[str, Load | PartTable, bool]] = [("load", load, False)]
    tables += [(part.name, part, part.below_joint) for part in parts if part.body == "load"]
    rigid = []
    for name, table, below in tables:
        u = (table.mass_uncertainty, table.centre_of_mass_uncertainty, table.inertia_uncertainty)
        share = 0.0 if table.density is None else air_density / table.density
        rigid.append(make_part(name, table.true_mass, table.centre_of_mass, table.inertia, u, share, below))
    if sensor is not None and sensor.internal_mass > 0.0:
        u = (
            sensor.internal_mass_uncertainty,
            sensor.internal_centre_of_mass_uncertainty,
            sensor.internal_inertia_uncertainty,
        )
        centre, inertia = sensor.internal_centre_of_mass, sensor.internal_inertia
        rigid.append(make_part("internal mass", sensor.internal_mass, centre, inertia, u, below_joint=True))
    if load.elastic_frequency is None:
        return Body(tuple(rigid))
    joint = make_joint(load.elastic_frequency, load.elastic_frequency_uncertainty, load.elastic_damping)
    return Body(tuple(rigid), joint)


def rigid_load(manifest: Manifest) -> Body:
    """Return load and parts without what moves inside the sensor; `InputError` without a load."""
    sensor = manifest.rig.sensor
    bare = None if sensor is None else sensor.model_copy(update={"internal_mass": 0.0})
    body = load_body(manifest.rig.model_copy(update={"sensor": bare}), manifest.part)
    if body is None:
        expected = "[load] with the mass, centre of mass and inertia of what is mounted on the sensor"
        raise InputError(manifest.rig_path, "load", found="nothing", expected=expected)
    return replace(body, joint=None)


def inertia_errors(manifest: Manifest, body: Body) -> tuple[InertiaError, ...]:
    """Return what every uncertain number of load and parts does to the mass matrix, by names that hold everywhere.

    What holds until something is mounted anew is another unknown in every mounting.
    """
    errors = []
    for change in body.matrix_changes(np.ones(1), None):
        suffix = "" if change.scope == "rig" else f" [{manifest.mounting}]"
        errors.append(InertiaError(f"{change.name}{suffix}", change.change[0].real))
    return tuple(errors)
