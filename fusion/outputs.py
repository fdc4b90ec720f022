"""The sensor's outputs: phasors of all channels with noise of their own and the errors of their chains by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.observe import Reading, RelativeError, chain_errors, chain_name
from fusion.uncertainty import Contribution, Influence, Uncertainty
from shaker._checks import ComplexArray
from shaker.signals.phasor import Phasors, stack_phasors

NOISE = "output noise"


@dataclass(frozen=True)
class Outputs:
    """Phasors (K, C) of the sensor's outputs, in the unit of the sensor, with their whole covariance.

    `uncertainty`: noise of the sine approximation, and scale, delay, response and clock errors under the names that
    the motion's instruments use, so that what both share (a clock, an amplifier) acts on both.
    """

    phasors: Phasors
    uncertainty: Uncertainty

    def __post_init__(self) -> None:
        expected, found = self.phasors.covariance.shape, self.uncertainty.random[0].covariance.shape
        if found != expected:
            raise ValueError(f"uncertainty: expected covariances of shape {expected}, found {found}")


def output_phasors(readings: Sequence[Reading]) -> Outputs:
    """Return the outputs of C channels, in the order given.

    An error of a chain, relative (K, C), changes the reading U by relative · U for one standard uncertainty; channels
    that name one `common` instrument share its errors.
    """
    if not readings:
        raise ValueError("readings: expected at least one output channel, found none")
    signals = stack_phasors([reading.phasors for reading in readings])
    chains: dict[str, list[int]] = {}
    for place, reading in enumerate(readings):
        chains.setdefault(chain_name(reading), []).append(place)
    effects: dict[str, tuple[RelativeError, ComplexArray]] = {}
    for places in chains.values():
        for error in chain_errors([readings[place] for place in places]):
            known = effects.get(error.name, (error, np.zeros_like(signals.value)))[1]
            known[:, places] += error.relative * signals.value[:, places]
            effects[error.name] = error, known
    noise = Contribution(NOISE, "A", signals.covariance, signals.dof)
    uncertainty = Uncertainty((noise,), tuple(_influence(error, change) for error, change in effects.values()))
    return Outputs(replace(signals, covariance=uncertainty.covariance), uncertainty)


def _influence(error: RelativeError, change: ComplexArray) -> Influence:
    """One unknown of the outputs; a budget names that of a chain by its kind, whichever channel has it."""
    label = error.label if error.scope == "recording" else "output " + error.label.rpartition(": ")[2]
    effect = np.concatenate([change.real, change.imag], axis=1)
    return Influence(error.name, label, error.u, error.unit, effect, error.scope, error.type)
