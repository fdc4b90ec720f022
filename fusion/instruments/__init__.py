"""The kinds of instruments, one module each: rows of the model, errors by name and drawn, unit, what can be observed.

A new kind of transducer is a module with its `Transducer`, named here: manifest, model, Monte Carlo, identification,
`check` and units follow.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from fusion.estimation.measurement_model import Observation
from fusion.instruments.accelerometer import ACCELERATION, ANGULAR_VELOCITY
from fusion.instruments.channel import Reading, Transducer, by_instrument, observe_group
from fusion.instruments.vibrometer import DISPLACEMENT, VELOCITY

TRANSDUCERS: dict[str, Transducer] = {
    transducer.quantity: transducer for transducer in (DISPLACEMENT, VELOCITY, ACCELERATION, ANGULAR_VELOCITY)
}
"""What reads one component of a body's motion, by the `quantity` of its channel in recording.toml."""


def observe_channels(
    readings: Sequence[Reading], gravity_mps2: ArrayLike | None = None, clock_uncertainty: float = 0.0
) -> tuple[Observation, ...]:
    """Return the rows of all motion channels, one observation per instrument and body.

    Row of a channel at r with direction d: [d, r × d] · {1, 1/(jω), -1/ω²} for acceleration, velocity, displacement;
    an accelerometer reads d·(a - g) in body axes, so that its rotation part gains (d × g)/ω² when `gravity_mps2` (3,)
    is given; a gyroscope reads d·alpha/(jω). `clock_uncertainty`: relative, of the time base.
    """
    gravity = None if gravity_mps2 is None else np.asarray(gravity_mps2, dtype=np.float64)
    groups = by_instrument(readings, TRANSDUCERS)
    return tuple(observe_group(transducer, group, gravity, clock_uncertainty) for transducer, group in groups)
