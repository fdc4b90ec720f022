"""Errors that act on all lines of a transfer function at once: scale, delay, chain response, clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.manifest import ChannelEntry
from fusion.response import read_response
from fusion.transfer.result import CommonError
from shaker._checks import ComplexArray, FloatArray
from shaker.signals.chain import ChainResponse


@dataclass(frozen=True)
class ChannelChain:
    """A channel as recorded, with its chain at K lines and the uncertainty of its block's tie to the first clock."""

    entry: ChannelEntry
    frequency_hz: FloatArray
    response: ChainResponse | None
    clock: str
    u_clock_s: float

    @property
    def correction(self) -> ComplexArray:
        """Factor (K,) from recorded to true phasor, exp(+jω·delay) / response(f)."""
        factor = np.exp(2j * np.pi * self.frequency_hz * self.entry.delay)
        return np.asarray(factor if self.response is None else factor / self.response.value, dtype=np.complex128)

    @property
    def errors(self) -> Mapping[str, ComplexArray]:
        """Complex relative error (K,) of the corrected phasor by the name of its cause, one standard deviation each.

        Channels of one `common` name share scale, delay and response, hence these names.
        """
        entry, shared = self.entry, self.entry.common or self.entry.name
        turn = np.asarray(2j * np.pi * self.frequency_hz, dtype=np.complex128)
        flat = np.ones(len(turn), dtype=np.complex128)
        found = {
            f"{shared}: scale": entry.scale_uncertainty * flat,
            f"{shared}: delay": entry.delay_uncertainty * turn,
            f"{entry.name}: individual scale": entry.individual_uncertainty * flat,
            f"clock {self.clock}": -self.u_clock_s * turn,
        }
        if self.response is not None:
            for cause, error in zip(self.response.causes, self.response.errors, strict=True):
                found[f"{shared}: {cause}"] = -error
        return found


def channel_chain(entry: ChannelEntry, frequency_hz: FloatArray, clock: str, u_clock_s: float) -> ChannelChain:
    """Return a channel with its response file read at frequencies (K,)."""
    response = None if entry.response is None else read_response(entry.response, frequency_hz)
    return ChannelChain(entry, frequency_hz, response, clock, u_clock_s)


def ratio_errors(reference: ChannelChain, responses: Sequence[ChannelChain]) -> tuple[CommonError, ...]:
    """Return the common errors of the ratios (K, C) responses over reference; what both share cancels."""
    below, above = reference.errors, [chain.errors for chain in responses]
    zero = np.zeros(len(reference.frequency_hz), dtype=np.complex128)
    names = dict.fromkeys([*below, *(name for errors in above for name in errors)])
    found = []
    for name in names:
        relative = np.stack([errors.get(name, zero) - below.get(name, zero) for errors in above], axis=1)
        if np.any(relative != 0.0):
            found.append(CommonError(name, relative))
    return tuple(found)
