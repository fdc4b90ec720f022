"""Stereo pairs: displacement of a body in all six components, -A/ω², and its uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from fusion.estimation.measurement_model import CommonError, Deviates, Geometry, Observation
from fusion.estimation.uncertainty import Scope
from fusion.instruments.channel import ChannelRelativeError, clock_rate, delay_errors
from fusion.recording.rig import Stereo
from photogram.geometry import rotation_from_vector, skew
from shaker.sine.phasor import Phasors, derivative_factor
from shakercal._common.arrays import ComplexArray, FloatArray

CALIBRATION = "calibration"
SURFACE = "surface"
PERIODIC = "error periodic in the pixel"
PATTERN = "fixed pattern of the sensors"
SCOPES: dict[str, Scope] = {SURFACE: "mounting", PERIODIC: "recording", PATTERN: "recording"}
GEOMETRY = np.eye(6)
"""Observed components of a pair, as rows (6, 6) on the motion of the sensor origin: all six."""


def carrier_of(name: str, pair: Stereo) -> str:
    """Return the support of the cameras of a pair, by default a separate one."""
    return f"cameras {pair.support or name}"


@dataclass(frozen=True)
class Exposure:
    """Exposure time of frames at the edges of a `trigger`.

    `u_length_s`: 0 if the manifest states the length, else with `dof` degrees of freedom of the measured pulses.
    """

    trigger: str
    length_s: float
    u_length_s: float = 0.0
    dof: float = np.inf

    def errors(self, frequency_hz: FloatArray) -> tuple[ChannelRelativeError, ...]:
        """Return the relative error (K, 1) of phasors by a measured exposure time T.

        An error u of T shifts the frames by u/2, and changes the correction of the loss sin(x)/x, x = πfT:
        u·[(1 - x·cot x)/T - jπf].
        """
        if self.u_length_s == 0.0:
            return ()
        x = np.pi * frequency_hz[:, None] * self.length_s
        change = self.u_length_s * ((1.0 - x / np.tan(x)) / self.length_s - 1j * np.pi * frequency_hz[:, None])
        name = f"{self.trigger}: pulse width"
        return (ChannelRelativeError(name, name, self.u_length_s, "s", np.asarray(change), "start", "A", self.dof),)


@dataclass(frozen=True)
class StereoReading(Geometry):
    """One stereo pair: manifest entry, displacement phasors (K, 6), m and rad.

    The phasors are about the sensor origin.     `effects`: by name, changes (P, K, 6) of the phasors for one standard
    uncertainty of further unknowns. Examples are the principal components of the calibration's covariance (CALIBRATION)
    and the surface before a single camera (SURFACE), which are stated. `through_surface` (6, K, 6): effects of pose
    errors on a single camera's phasors by its distance from the surface; None for a pair. `clock_uncertainty`:
    relative. `errors`: unknowns of one recording, such as those of trigger instants and line frequencies, common to all
    pairs with the same trigger. `face_m` (3,): centre of the tracked points at rest, if available.
    """

    name: str
    pair: Stereo
    phasors: Phasors
    effects: Mapping[str, ComplexArray] = field(default_factory=dict)
    clock_uncertainty: float = 0.0
    errors: tuple[ChannelRelativeError, ...] = ()
    face_m: FloatArray | None = None
    through_surface: ComplexArray | None = None

    def observation(self) -> Observation:
        """Return the rows of the pair, displacement phasors = -A/ω², with named common errors.

        These are scale and pose of its frame, delay of the exposure, `effects`, relative `errors`, and the clock.
        """
        title, frequency = self._title, self.phasors.frequency_hz
        factor = derivative_factor(frequency, -2)
        design = factor[:, None, None] * GEOMETRY
        none = np.zeros_like(self.phasors.value)
        offsets = [none] * 7 if self.through_surface is None else [none, *self.through_surface[[0, 3, 1, 4, 2, 5]]]
        common = [
            CommonError(name, label, u, unit, "rig", factor[:, None, None] * (u * change), offset)
            for (name, label, u, unit, change), offset in zip(self._frame_errors(), offsets, strict=True)
            if u > 0.0
        ]
        delay = delay_errors(f"{title}: delay", frequency, self.pair.delay_uncertainty, "rig")
        common += [error.of_rows(design) for error in delay]
        stated = bool(common) or any(len(self.effects.get(what, ())) for what in (CALIBRATION, SURFACE))
        for what, changes in self.effects.items():
            label = f"{title}: {what}"
            scopes = [scope for begins, scope in SCOPES.items() if what.startswith(begins)]
            scope: Scope = scopes[0] if scopes else "rig"
            for index, effect in enumerate(np.asarray(changes)):
                common.append(CommonError(f"{label} {index}", label, 1.0, "1", scope, np.zeros_like(design), effect))
        common += [error.of_rows(design) for error in self.errors]
        common += clock_rate(design, np.full(6, 2.0), self.clock_uncertainty)
        members = (title,) * 6
        return Observation(
            self.name, "photogrammetry", self.pair.body, self.phasors, design, tuple(common), members, stated, self
        )

    @property
    def _title(self) -> str:
        return f"stereo {self.name}"

    def _frame_errors(self) -> Iterator[tuple[str, str, float, str, FloatArray]]:
        """Yield name, label, u, unit and change (6, 6) of every frame error.

        These are the scale of all lengths, the position p of the sensor origin (the translation changes by theta × p)
        and the rotation φ of the axes (vectors change by φ × v).
        """
        scale = f"{self._title}: scale"
        yield scale, scale, self.pair.scale_uncertainty or 0.0, "1", np.diag([1.0, 1, 1, 0, 0, 0])
        for axis, letter in enumerate("xyz"):
            spin, shift = skew(np.eye(3)[axis]), np.zeros((6, 6), np.float64)
            shift[:3, 3:] = -spin
            position, rotation = (f"{self._title}: pose {kind}" for kind in ("position", "rotation"))
            yield f"{position} {letter}", position, self.pair.pose_uncertainty[axis], "m", shift
            turn: FloatArray = np.kron(np.eye(2), spin).astype(np.float64)
            yield f"{rotation} {letter}", rotation, self.pair.pose_uncertainty[3 + axis], "rad", turn

    # The pose of the frame, for the Monte Carlo run.

    @property
    def unknowns(self) -> frozenset[str]:
        """Names of the unknowns of the pose, which `moved` samples.

        Those of a single camera act to first order.
        """
        if self.through_surface is not None:
            return frozenset()
        return frozenset(name for kind in ("position", "rotation") for name in self._pose_names(kind))

    def _pose_names(self, kind: str) -> list[str]:
        return [f"{self._title}: pose {kind} {axis}" for axis in "xyz"]

    def moved(self, readings: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return phasors (N, K, 6) in sampled frames.

        t' = R (t + theta × p), theta' = R theta.
        """
        if not self.unknowns:
            return readings
        u = np.asarray(self.pair.pose_uncertainty, dtype=np.float64)
        position, rotation = (
            np.stack([deviates.normal(name) for name in self._pose_names(kind)], axis=1)
            for kind in ("position", "rotation")
        )
        turn = rotation_from_vector(u[3:] * rotation)
        shift, spin = readings[..., :3], readings[..., 3:]
        moved = shift + np.cross(spin, (u[:3] * position)[:, None])
        return np.concatenate([np.einsum("nij,nkj->nki", turn, part) for part in (moved, spin)], axis=-1)
