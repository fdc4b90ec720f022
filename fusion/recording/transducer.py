"""Transducers: measured motion, unit, order of its derivative.

A new kind is an entry of `TRANSDUCERS`, which manifest, model, Monte Carlo run, identification, `check` and units use.
The simulator is independent of it, as the reference of all tests.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker.sine.phasor import derivative_factor
from shakercal._common.arrays import ComplexArray, FloatArray

STATIONARY, HEAD = "room", "head"
"""Values of `body` in addition to load and base: a stationary object, and the head of other channels."""
TRANSVERSE = "transverse sensitivity"


@dataclass(frozen=True)
class Transducer:
    """A kind of channel that measures one component of motion.

    `quantity`: its name in the manifest.     It measures (jω)^`order` times an acceleration, in `unit`, along its
    direction, or about it if `rotational`. If it `senses_gravity`, it measures d·(a - g) in body axes. `kind`: of
    instrument, as selected by the fusion.
    """

    quantity: str
    unit: str
    kind: Literal["vibrometer", "accelerometer"]
    order: int
    rotational: bool = False
    senses_gravity: bool = False

    def geometry(self, point: FloatArray, direction: FloatArray) -> FloatArray:
        """Return [d, r × d] (..., 6), or [0, d] if rotational.

        It determines the observed components at all frequencies.
        """
        none = np.zeros_like(direction)
        parts = (none, direction) if self.rotational else (direction, np.cross(point, direction))
        return np.concatenate(parts, axis=-1)

    def rows(self, geometry: FloatArray, frequency_hz: FloatArray, gravity_mps2: FloatArray | None) -> ComplexArray:
        """Return rows (..., K, 6) of the model from geometries, or their changes, (..., 6).

        A transducer that senses gravity tilts with the body, which adds (d × g)/ω² to its rotations.
        """
        rows = np.repeat(geometry[..., None, :], len(frequency_hz), axis=-2)
        if self.senses_gravity and gravity_mps2 is not None:
            tilt = np.cross(geometry[..., :3], gravity_mps2)
            rows[..., 3:] += tilt[..., None, :] / (2.0 * np.pi * frequency_hz[:, None]) ** 2
        return np.asarray(derivative_factor(frequency_hz, self.order)[:, None] * rows)


TRANSDUCERS: dict[str, Transducer] = {
    transducer.quantity: transducer
    for transducer in (
        Transducer("displacement", "m", "vibrometer", order=-2),
        Transducer("velocity", "m/s", "vibrometer", order=-1),
        # Uni- and triaxial: the axes of a triaxial one are channels with the same `common` name, which share a chain.
        Transducer("acceleration", "m/s^2", "accelerometer", order=0, senses_gravity=True),
        # Gyroscopes: on the body, with an inertial reference, as accelerometers.
        Transducer("angular_velocity", "rad/s", "accelerometer", order=-1, rotational=True),
    )
}
"""Transducers by the `quantity` of their channels in recording.toml."""
