"""The outputs of the sensor under test, read through a bridge amplifier: phasors, common errors by name, and drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.estimation.measurement_model import Deviates
from fusion.estimation.uncertainty import Contribution, Uncertainty, added_up, as_complex, real_stack
from fusion.instruments.channel import Reading, chain_errors
from fusion.instruments.transducer import chain_name
from shaker.arrays import ComplexArray
from shaker.sine.phasor import Phasors, stack_phasors

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

    def draw(self, deviates: Deviates) -> ComplexArray:
        """Return N draws (N, K, C) with noise, from which relative errors c of the chains are taken off exactly.

        They act as (1 + Re c)·exp(j·Im c).
        """
        value = self.phasors.value
        drawn = np.repeat(value[None], deviates.count, axis=0)
        for part in self.uncertainty.random:
            dof = np.full(len(part.covariance), np.inf) if part.dof is None else part.dof
            drawn = drawn + as_complex(deviates.noise(f"{part.label} of outputs", part.covariance, dof))
        for influence in self.uncertainty.influences:
            effect = as_complex(influence.effect)
            relative = np.divide(effect, value, out=np.zeros_like(value), where=(value != 0.0) & np.isfinite(effect))
            size = deviates.normal(influence.name)[:, None, None]
            drawn = drawn / ((1.0 + size * relative.real) * np.exp(1j * size * relative.imag))
        return np.asarray(drawn)


def sensor_outputs(readings: Sequence[Reading], order: Sequence[str]) -> Outputs | None:
    """Return what of some readings are outputs of the sensor, in the order and by the names of its outputs, if any."""
    named = {str(reading.entry.channel): reading for reading in readings if reading.entry.quantity == "output"}
    own = [
        replace(named[name], phasors=replace(named[name].phasors, channels=(name,))) for name in order if name in named
    ]
    return output_phasors(own) if own else None


def output_phasors(readings: Sequence[Reading]) -> Outputs:
    """Return the outputs of C channels, in the order given.

    An error of a chain, relative (K, C), changes the reading U by relative · U for one standard uncertainty; channels
    that name one `common` instrument share its errors. A budget names those of a chain by their kind, whichever channel
    has them.
    """
    if not readings:
        raise ValueError("readings: expected at least one output channel, found none")
    signals = stack_phasors([reading.phasors for reading in readings])
    chains: dict[str, list[int]] = {}
    for place, reading in enumerate(readings):
        chains.setdefault(chain_name(reading.entry), []).append(place)
    influences = []
    for places in chains.values():
        for error in chain_errors([readings[place] for place in places]):
            change = np.zeros_like(signals.value)
            change[:, places] = error.effect * signals.value[:, places]
            label = error.label if error.scope == "recording" else "output " + error.label.rpartition(": ")[2]
            influences.append(replace(error.acting(real_stack(change)), label=label))
    noise = Contribution(NOISE, "A", signals.covariance, signals.dof)
    uncertainty = Uncertainty((noise,), added_up(influences))
    return Outputs(replace(signals, covariance=uncertainty.covariance), uncertainty)
