"""The kinds of instruments: rows of the model, errors by name and drawn, unit, what can be observed.

A new kind of transducer is a `Transducer`, named here: manifest, model, Monte Carlo run, identification, `check` and
units follow. The simulator does not: it is what all these are tested against.
"""

from fusion.instruments.transducer import ACCELERATION, ANGULAR_VELOCITY, DISPLACEMENT, VELOCITY, Transducer

TRANSDUCERS: dict[str, Transducer] = {
    transducer.quantity: transducer for transducer in (DISPLACEMENT, VELOCITY, ACCELERATION, ANGULAR_VELOCITY)
}
"""What reads one component of a body's motion, by the `quantity` of its channel in recording.toml."""
