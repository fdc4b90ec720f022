"""Mass matrix, lever arms and gravity tilt of the load, and its elastic parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from fusion.errors import InputError
from fusion.estimation.uncertainty import Scope, Unknown, as_complex, real_stack
from fusion.sensitivity.elastic import (
    ONLY_NAMED,
    ElasticPart,
    InstrumentPosition,
    MeasuredModes,
    NaturalModes,
    Variant,
    response,
)
from fusion.sensitivity.mode_shapes import elastic_part, mode_shapes
from fusion.sensitivity.sensitivity_notices import LOAD_UNSTATED, MODES_CONTRADICT
from photogram.camera import principal_components
from photogram.geometry import skew
from shaker.identification.measured_curves import InertiaError
from shaker.labels import MOTION_COMPONENTS
from shaker.sine.phasor import real_stacked_diagonal
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray, check_shapes
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.estimation.measurement_model import Deviates
    from fusion.phasors.stereo_phasors import StereoResult
    from fusion.recording.load import Manifest
    from fusion.recording.rig import Rig, RigLoad
    from fusion.recording.rig import RigPart as PartTable

# The elastic joint: the load itself is rigid, and the fused motion is that of the load.


@dataclass(frozen=True)
class MountingJoint:
    """The joint of a load, with the instruments on the load.

    `frequency_hz` (6,): resonance of the load on the joint with a fixed lower side, per component. `u_frequency_hz`
    (6,): its standard uncertainty, 0 if the joint is only named; then the result is not corrected, and the whole
    correction is uncertain. `damping`: damping ratio of that resonance.
    """

    frequency_hz: FloatArray
    u_frequency_hz: FloatArray
    damping: float

    def follow(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the motion (K, 6) of the lower side over that of the load.

        1/(1 + G) = 1 - r²/(1 + 2jζr). The joint carries the load's inertia, -ω²·m·x_load = (k + jωb)·(x_below -
        x_load).
        """
        stated = self.u_frequency_hz > 0.0
        return np.asarray(np.where(stated, 1.0 - self._stretch(frequency_hz), 1.0))

    def change(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the change (K, 6) of `follow` per standard uncertainty of the joint.

        With correction, the derivative by f_e times its uncertainty. If the joint is only named, 1/√3 of the whole: the
        root mean square of a joint anywhere between rigid and that elastic.
        """
        r = frequency_hz[:, None] / self.frequency_hz
        damped = 1.0 + 2j * self.damping * r
        slope = r * r * (1.0 + damped) / damped**2 / self.frequency_hz
        stated = self.u_frequency_hz > 0.0
        named = -self._stretch(frequency_hz) * ONLY_NAMED
        return np.asarray(np.where(stated, slope * self.u_frequency_hz, named))

    def _stretch(self, frequency_hz: FloatArray) -> ComplexArray:
        """Share of the load's motion in the joint, G/(1 + G), finite at resonance."""
        r = frequency_hz[:, None] / self.frequency_hz
        return np.asarray(r * r / (1.0 + 2j * self.damping * r))


JOINT = "joint of the load"
"""Label of its unknowns."""


def joint_unknown(frequency_hz: float, axis: str) -> str:
    """Return the name of the unknown of a joint along an axis (x … rz)."""
    return f"{JOINT} {frequency_hz:.9g} Hz: {axis}"


def make_joint(frequency_hz: ArrayLike, u_frequency_hz: ArrayLike = 0.0, damping: float = 0.0) -> MountingJoint:
    """Return a joint; one number applies to all six components."""
    frequency = np.broadcast_to(np.asarray(frequency_hz, dtype=np.float64), (6,)).copy()
    u_frequency = np.broadcast_to(np.asarray(u_frequency_hz, dtype=np.float64), (6,)).copy()
    return MountingJoint(frequency, u_frequency, float(damping))


# Bodies about the sensor origin: mass matrix, tilt of the weight in air, and effects of uncertain parameters.


INERTIA_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
AIR_MOVED_ALONG = 0.5
"""Mass of the air that moves with a body, over the displaced air: that of a sphere (Lamb 1932, Art. 92)."""
U_AIR_MOVED_ALONG = 0.5 / np.sqrt(3.0)
"""Its standard uncertainty: uniform from zero to the displaced air, that of a long cylinder moving across."""


@dataclass(frozen=True)
class MovingPart:
    """A rigid part in the sensor frame, with standard uncertainties.

    `mass_kg`; `centre_of_mass_m` (3,); `inertia_kgm2` (3, 3) about its centre of mass; `u_mass_kg`;
    `u_centre_of_mass_m` (3,); `u_inertia_kgm2` (3, 3), one per entry. `air_share`: mass of the displaced air over the
    part's mass, 0 if unknown. `below_joint`: on the sensor's side of the load's elastic joint.
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
        check_shapes(self, (3,), "centre_of_mass_m", "u_centre_of_mass_m")
        check_shapes(self, (3, 3), "inertia_kgm2", "u_inertia_kgm2")
        if not np.allclose(self.inertia_kgm2, self.inertia_kgm2.T, rtol=0.0, atol=1e-12):
            raise ValueError(f"inertia_kgm2: expected a symmetric matrix, found {self.inertia_kgm2.tolist()}")

    @property
    def terms(self) -> InertialTerms:
        """Contribution of the part to the equations of motion."""
        return InertialTerms.of(self.mass_kg, self.centre_of_mass_m, self.inertia_kgm2, self.air_share)


def make_moving_part(
    name: str,
    mass_kg: float,
    centre_of_mass_m: ArrayLike,
    inertia_kgm2: ArrayLike,
    uncertainties: tuple[float, ArrayLike, ArrayLike] = (0.0, 0.0, 0.0),
    air_share: float = 0.0,
    below_joint: bool = False,
) -> MovingPart:
    """Return a part from plain lists; one number as an uncertainty applies to all entries."""
    u_mass, u_centre, u_inertia = uncertainties
    return MovingPart(
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
    """Contribution of a part, or of its change, to the equations of motion.

    About the sensor origin. `mass_matrix` (..., 6, 6): wrench = mass_matrix · [a, alpha] of the origin. `weight_kg`
    (...) and `weight_moment_kgm` (..., 3): mass, and mass times centre of mass, less those of the displaced air;
    gravity acts on these.
    """

    mass_matrix: FloatArray
    weight_kg: FloatArray
    weight_moment_kgm: FloatArray

    @classmethod
    def of(
        cls, mass_kg: ArrayLike, centre_of_mass_m: FloatArray, inertia_kgm2: FloatArray, air_share: float = 0.0
    ) -> InertialTerms:
        """Return the terms of masses (...).

        The air that moves with a part has inertia but no weight.
        """
        stated = np.asarray(mass_kg, dtype=np.float64)
        mass, weight = stated * (1.0 + AIR_MOVED_ALONG * air_share), stated * (1.0 - air_share)
        lever, moving = skew(centre_of_mass_m), mass[..., None, None]
        matrix = np.zeros((*mass.shape, 6, 6))
        matrix[..., :3, :3] = moving * np.eye(3)
        matrix[..., :3, 3:] = -moving * lever
        matrix[..., 3:, :3] = moving * lever
        matrix[..., 3:, 3:] = inertia_kgm2 - moving * lever @ lever
        return cls(matrix, weight, weight[..., None] * centre_of_mass_m)

    def load_matrix(self, frequency_hz: FloatArray, gravity_mps2: ArrayLike | None) -> FloatArray:
        """Return matrices (..., K, 6, 6) from acceleration to wrench, with gravity tilt.

        In body axes. With theta = -alpha/omega^2 the weight turns: F = m (theta × g), M = c × m (theta × g).
        """
        matrix = np.repeat(self.mass_matrix[..., None, :, :], len(frequency_hz), axis=-3)
        if gravity_mps2 is not None:
            pull = skew(np.asarray(gravity_mps2, dtype=np.float64))
            tilt = np.concatenate(
                [self.weight_kg[..., None, None] * pull, skew(self.weight_moment_kgm) @ pull], axis=-2
            )
            matrix[..., 3:] += tilt[..., None, :, :] / (2.0 * np.pi * frequency_hz[:, None, None]) ** 2
        return matrix


@dataclass(frozen=True)
class Body:
    """Parts that move together, or as one above and one below a `joint`.

    `gravity_mps2` (3,) in sensor axes, None if unknown, with its standard uncertainty. `sense`: wrenches are positive
    as they act on the load or on the sensor. `elastic`: bending parts of the load; accelerations are then those of its
    foot. `first_frequency_hz` (6,): first resonances of the load with clamped foot, without correction. `cable_npm`
    (3,) with `u_cable_npm`: stiffness of cables between the load and the room, which carry k·x = -k·a/ω² of the force
    along each axis.
    """

    parts: tuple[MovingPart, ...]
    joint: MountingJoint | None = None
    gravity_mps2: ArrayLike | None = None
    u_gravity_mps2: ArrayLike = (0.0, 0.0, 0.0)
    sense: Literal["on_load", "on_sensor"] = "on_load"
    elastic: tuple[ElasticPart, ...] = ()
    first_frequency_hz: FloatArray | None = None
    cable_npm: ArrayLike = (0.0, 0.0, 0.0)
    u_cable_npm: ArrayLike = (0.0, 0.0, 0.0)

    @property
    def rigid(self) -> Body:
        """The body without elastic parts."""
        return replace(self, joint=None, elastic=(), first_frequency_hz=None)

    @property
    def weightless(self) -> Body:
        """The body without the weight that turns with it."""
        return replace(self, gravity_mps2=None, u_gravity_mps2=np.zeros(3))

    @property
    def mass_matrix(self) -> FloatArray:
        """Mass matrix (6, 6) of all parts about the sensor origin as rigid ones."""
        return np.asarray(np.sum([part.terms.mass_matrix for part in self.parts], axis=0))

    def load_matrix(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return matrices (K, 6, 6) from the acceleration of the load to the wrench.

        Parts below its joint follow it.
        """
        rigid = np.sum([self._carried(frequency_hz, part, part.terms) for part in self.parts], axis=0)
        rigid = rigid + self._tied(frequency_hz, self.cable_npm)
        return np.asarray(rigid + sum(part.act(partial(self._wrench, frequency_hz)) for part in self.elastic))

    def _tied(self, frequency_hz: FloatArray, stiffness_npm: ArrayLike) -> ComplexArray:
        """Load matrix (K, 6, 6) of cables to the room, at the sensor origin."""
        sign = -1.0 if self.sense == "on_load" else 1.0
        stiffness = np.diag(np.concatenate([np.asarray(stiffness_npm, dtype=np.complex128), np.zeros(3)]))
        return np.asarray(sign * stiffness / (2.0 * np.pi * frequency_hz[:, None, None]) ** 2)

    def _wrench(self, frequency_hz: FloatArray, modes: NaturalModes) -> ComplexArray:
        """Load matrix of modes, whose weight turns like that of a rigid body."""
        return modes.wrench(frequency_hz) if self.sense == "on_load" else -modes.wrench(frequency_hz)

    def _carried(self, frequency_hz: FloatArray, part: MovingPart, terms: InertialTerms) -> ComplexArray:
        """Load matrices by terms of a part, which may be below the joint."""
        sign = 1.0 if self.sense == "on_load" else -1.0
        matrix = sign * terms.load_matrix(frequency_hz, self.gravity_mps2).astype(np.complex128)
        if self.joint is None or not part.below_joint:
            return matrix
        return matrix * self.joint.follow(frequency_hz)[:, None, :]

    def matrix_changes(self, frequency_hz: FloatArray) -> tuple[Unknown[ComplexArray], ...]:
        """Return the changes of the load matrix (K, 6, 6) by every uncertain number."""
        changes: list[Unknown[ComplexArray]] = []
        for part in self.parts:
            changes += _parameters(part, partial(self._carried, frequency_hz, part))
        below = tuple(part for part in self.parts if part.below_joint)
        if self.joint is not None and below:
            # The joint is unchanged until the next mounting: one unknown per component.
            lower = replace(self, parts=below, joint=None, cable_npm=np.zeros(3)).load_matrix(frequency_hz)
            by_joint = self.joint.change(frequency_hz)
            for index, axis in enumerate(MOTION_COMPONENTS):
                stated, u = float(self.joint.frequency_hz[index]), float(self.joint.u_frequency_hz[index])
                effect = np.zeros_like(lower)
                effect[:, :, index] = lower[:, :, index] * by_joint[:, None, index]
                unknown = joint_unknown(stated, axis), JOINT, u or 1.0, "Hz" if u else "1"
                changes.append(Unknown(*unknown, effect, "mounting"))
        for bending in self.elastic:
            changes += bending.changes(partial(self._wrench, frequency_hz))
        if self.first_frequency_hz is not None:
            above = replace(self.rigid, parts=tuple(part for part in self.parts if not part.below_joint))
            # r²/(1 - r²) of a mass on a spring, more than for a distributed mass; 2r² above r² = ½.
            square = (frequency_hz[:, None] / self.first_frequency_hz) ** 2
            bound = square / np.maximum(1.0 - square, 0.5) * ONLY_NAMED
            for index, axis in enumerate(MOTION_COMPONENTS):
                effect = np.zeros((len(frequency_hz), 6, 6), np.complex128)
                effect[:, :, index] = above.load_matrix(frequency_hz)[:, :, index] * bound[:, None, index]
                name, label = f"{self.first_frequency_hz[index]:.9g} Hz: {axis}", "first natural frequency of the load"
                changes.append(Unknown(f"{label} {name}", label, 1.0, "1", effect, "mounting"))
        for axis, tied in zip("xyz", np.diag(np.asarray(self.u_cable_npm, dtype=np.float64)), strict=True):
            if np.any(tied):
                effect, label = self._tied(frequency_hz, tied), "stiffness of cables"
                changes.append(Unknown(f"{label} {axis}", label, float(tied.sum()), "N/m", effect, "mounting"))
        # Of the vector of gravity only the tilt of the weight knows.
        weightless = self.weightless.load_matrix(frequency_hz)
        for axis, along, u in zip("xyz", np.eye(3), np.asarray(self.u_gravity_mps2).tolist(), strict=True):
            if u > 0.0:
                change = replace(self, gravity_mps2=along * u).load_matrix(frequency_hz) - weightless
                changes.append(Unknown(f"gravity {axis}", "gravity", u, "m/s^2", change, "rig"))
        return tuple(changes)

    def draw_load_matrices(self, frequency_hz: FloatArray, deviates: Deviates) -> ComplexArray:
        """Return N load matrices (N, K, 6, 6) of drawn parts and other uncertain numbers.

        Masses, centres of mass and inertias of the parts are exact. Gravity, joint, modes and the air act by their
        first-order changes.
        """
        drawn = []
        for part in self.parts:
            heavier = part.u_mass_kg * deviates.normal(f"{part.name}: mass")
            moved = part.u_centre_of_mass_m * deviates.normal(f"{part.name}: centre of mass", 3)
            inertia_change = part.u_inertia_kgm2 * _symmetric(deviates.normal(f"{part.name}: inertia", 6))
            centre, inertia = part.centre_of_mass_m + moved, part.inertia_kgm2 + inertia_change
            terms = InertialTerms.of(part.mass_kg + heavier, centre, inertia, part.air_share)
            drawn.append(self._carried(frequency_hz, part, terms))
        drawn += [part.act(partial(self._wrench, frequency_hz)) for part in self.elastic]
        total = np.asarray(sum(drawn))
        part_labels = {f"{part.name}: {what}" for part in self.parts for what in ("mass", "centre of mass", "inertia")}
        for change in self.matrix_changes(frequency_hz):
            if change.label not in part_labels:
                # What instruments read errs by the same draws: the truth is the estimate less its error.
                total = total - deviates.normal(change.name)[:, None, None, None] * change.effect
        return total


def _symmetric(entries: FloatArray) -> FloatArray:
    """Symmetric matrices (..., 3, 3) of their entries (..., 6)."""
    return entries[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]


def _parameters(part: MovingPart, matrix: Callable[[InertialTerms], ComplexArray]) -> Iterator[Unknown[ComplexArray]]:
    """Yield every uncertain number of a part with its effect on the load matrix.

    `matrix`: from a change of the terms. The name contains the stated value, so that another part or position is
    another unknown.
    """
    centre, rigid = part.centre_of_mass_m, np.zeros((3, 3))

    def unknown(what: str, stated: str, u: float, unit: str, change: InertialTerms) -> Unknown[ComplexArray]:
        scope: Scope = "mounting" if what == "centre of mass" else "rig"
        name = f"{part.name} {part.mass_kg:.9g} kg: {what}{stated}"
        return Unknown(name, f"{part.name}: {what}", u, unit, matrix(change), scope)

    if part.u_mass_kg > 0.0:
        heavier = InertialTerms.of(part.u_mass_kg, centre, rigid, part.air_share)
        yield unknown("mass", "", part.u_mass_kg, "kg", heavier)
    position = ", ".join(f"{x:.9g}" for x in centre.tolist())
    for letter, step in zip("xyz", np.diag(part.u_centre_of_mass_m), strict=True):
        if np.any(step > 0.0):
            # The terms are of second order in the place: half their difference is the derivative.
            ahead, behind = (InertialTerms.of(part.mass_kg, centre + s, rigid, part.air_share) for s in (step, -step))
            matrix_change = (ahead.mass_matrix - behind.mass_matrix) / 2.0
            moment_change = (ahead.weight_moment_kgm - behind.weight_moment_kgm) / 2.0
            moved = InertialTerms(matrix_change, np.zeros(()), moment_change)
            yield unknown("centre of mass", f" [{position}] {letter}", float(step.sum()), "m", moved)
    for entry, (row, column) in zip(np.eye(6), INERTIA_ENTRIES, strict=True):
        u = float(part.u_inertia_kgm2[row, column])
        if u > 0.0:
            stated = f" {part.inertia_kgm2[row, column]:.9g} {'xyz'[row]}{'xyz'[column]}"
            change = InertialTerms.of(0.0, np.zeros(3), u * _symmetric(entry))
            yield unknown("inertia", stated, u, "kg.m^2", change)
    if part.air_share > 0.0:
        u = U_AIR_MOVED_ALONG * part.air_share * part.mass_kg
        air = InertialTerms(InertialTerms.of(u, centre, rigid).mass_matrix, np.zeros(()), np.zeros(3))
        yield unknown("air moved along", "", u, "kg", air)


# The body from the tables of rig.toml and recording.toml.


def moving_parts(rig: Rig, parts: Sequence[PartTable]) -> tuple[MovingPart, ...]:
    """Return all parts that move above the elastic element: load, parts and internal mass.

    None without a `[load]`. Masses are true masses, in air of the density that the rig states or that follows from its
    pressure, temperature, humidity and height. The sensor's internal mass is below the load's joint, if there is one.
    """
    load, sensor = rig.load, rig.sensor
    if load is None:
        return ()
    moving, air_density = [], rig.surroundings.air.value
    tables: list[tuple[str, RigLoad | PartTable, bool]] = [("load", load, False)]
    tables += [(part.name, part, part.below_joint) for part in parts if part.body == "load"]
    for name, table, below in tables:
        u = (table.mass_uncertainty, table.centre_of_mass_uncertainty, table.inertia_uncertainty)
        share = 0.0 if table.density is None else air_density / table.density
        moving.append(make_moving_part(name, table.true_mass, table.centre_of_mass, table.inertia, u, share, below))
    if sensor is not None and sensor.internal_mass > 0.0:
        u = (
            sensor.internal_mass_uncertainty,
            sensor.internal_centre_of_mass_uncertainty,
            sensor.internal_inertia_uncertainty,
        )
        centre, inertia = sensor.internal_centre_of_mass, sensor.internal_inertia
        moving.append(make_moving_part("internal mass", sensor.internal_mass, centre, inertia, u, below_joint=True))
    return tuple(moving)


def load_body(rig: Rig, parts: Sequence[PartTable]) -> Body | None:
    """Return the `moving_parts` with elastic parts and cables, None without a `[load]`."""
    load = rig.load
    if load is None:
        return None
    joint = None
    if load.elastic_frequency is not None:
        joint = make_joint(load.elastic_frequency, load.elastic_frequency_uncertainty, load.elastic_damping)
    sense = "on_load" if rig.sensor is None else rig.sensor.sense
    elastic = tuple(elastic_part(table) for table in load.elastic)
    first = None if load.first_frequency is None else np.array(load.first_frequency)
    tied = (load.cable_stiffness or np.zeros(3), load.cable_stiffness_uncertainty)
    gravity = rig.surroundings.free_fall_mps2
    return Body(moving_parts(rig, parts), joint, *gravity, sense, elastic, first, *tied)


def rigid_load(manifest: Manifest) -> Body:
    """Return load and parts without the sensor's internal mass; raise `InputError` without a load."""
    parts = moving_parts(manifest.rig.model_copy(update={"sensor": None}), manifest.part)
    if not parts:
        expected = "[load] with the mass, centre of mass and inertia of what is mounted on the sensor"
        raise InputError(LOAD_UNSTATED, manifest.rig_path, "load", found="none", expected=expected)
    return Body(parts)


def inertia_errors(manifest: Manifest, body: Body) -> tuple[InertiaError, ...]:
    """Return the changes of the mass matrix by every uncertain number of load and parts.

    Their names are the same in all recordings; unknowns of a mounting are separate for every mounting.
    """
    errors = []
    for change in body.matrix_changes(np.ones(1)):
        suffix = "" if change.scope == "rig" else f" [{manifest.mounting}]"
        errors.append(InertiaError(f"{change.name}{suffix}", change.effect[0].real))
    return tuple(errors)


# Responses of modes by measured amplitudes, as the mean with the stated ones.


CONTRADICTED = 0.01
"""Chance below which a response is not the stated one."""
NOT_DRIVEN = 1e-6  # share of the largest drive below which a mode is not driven


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
    """Return a part with measured responses of modes of `size` in m, and notices."""
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

    from scipy.special import chdtrc

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
